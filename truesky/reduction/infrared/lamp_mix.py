"""Find the mixture of calibration lamps that is most similar to the sky in a band.

A flat of this mixture corrects the response to the sky, because a pixel's response depends on wavelength.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import nnls

from lake_schema.arrays import Float
from truesky.fluxes.passbands import Passband
from truesky.render.effects.light import calibration_lamp, chromatic_response
from truesky.render.effects.scene import Scene
from truesky.render.sky import diffuse_light

# Importance in the fit of the sum of weights, the mean wavelength, the mean square, and equal weights.
_SUM_WEIGHT, _MEAN_WEIGHT, _SQUARE_WEIGHT, _EVENNESS_WEIGHT = 1e4, 1e2, 1.0, 1e-2
# Level of the sky whose colour is matched, e-/s per pixel: zodiacal light in the fields of surveys.
_SKY = 1.0


def weights(scene: Scene, lamps: Sequence[int]) -> tuple[float, ...]:
    """Return weights of lamps such that the mean wavelength of their light in the band equals that of the sky.

    Parameters
    ----------
    scene : Scene
        Scene of a flat in the band.
    lamps : sequence of int
        Numbers of the lamps.

    Returns
    -------
    tuple of float
        Weights, 0 or more, with sum 1.

    Notes
    -----
    With many lamps, the mean square of the wavelength is matched as well as possible. An observer can compute the
    weights from the passband, the spectrum of the Sun and the spectra of the lamps. If all lamps are on one side of
    the sky's mean wavelength, the nearest lamp is used.
    """
    band = chromatic_response.band_of_scene(scene)
    band_width = float(band.wavelength[-1] - band.wavelength[0])
    sky = diffuse_light.photons(scene.section, _SKY, band, scene.mission)
    target = _moments(band, sky, 0.0, band_width)
    lamp_moments = np.array(
        [
            _moments(
                band, calibration_lamp.detected_photons(band, lamp, scene.section, scene.mission), target[0], band_width
            )
            for lamp in lamps
        ]
    ).T
    sky_moments = _moments(band, sky, target[0], band_width)
    scale = np.array([_MEAN_WEIGHT, _SQUARE_WEIGHT])
    system = np.vstack(
        [np.full(len(lamps), _SUM_WEIGHT), scale[:, None] * lamp_moments, _EVENNESS_WEIGHT * np.eye(len(lamps))]
    )
    target_values = np.concatenate(
        [[_SUM_WEIGHT], scale * sky_moments, np.full(len(lamps), _EVENNESS_WEIGHT / len(lamps))]
    )
    solution, _ = nnls(system, target_values)
    return tuple((solution / solution.sum()).tolist())


def _moments(band: Passband, photons: Float, origin: float, band_width: float) -> Float:
    """Return mean and mean square of wavelength over the band's width, relative to `origin`."""
    x = band.wavelength / band_width - origin
    return np.array([np.average(x, weights=photons), np.average(x**2, weights=photons)])
