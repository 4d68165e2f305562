"""Find the mixture of calibration lamps (LEDs of NISP) whose light in a band is most similar in colour to the sky.

The response of a pixel depends on wavelength. A flat that is made with the right mixture of lamps therefore shows the
response to light with the colour of the sky.
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

# Importance, in the least squares fit of the lamps' weights, of the condition that their sum is 1.
_SUM_WEIGHT = 1e4
# Importance, in the fit of the lamps' weights, of the condition that lamps and sky have the same mean wavelength.
_MEAN_WEIGHT = 1e2
# Importance, in the fit of the lamps' weights, of the condition that lamps and sky have the same mean square of the
# wavelength (relative to the sky's mean wavelength).
_SQUARE_WEIGHT = 1.0
# Importance, in the fit of the lamps' weights, of the condition that all weights are equal: makes the solution unique.
_EVENNESS_WEIGHT = 1e-2
# Brightness of the sky (zodiacal light in survey fields) whose colour is matched, in electrons/s per pixel.
_SKY = 1.0


def weights(scene: Scene, lamps: Sequence[int]) -> tuple[float, ...]:
    """Return weights with which flats of several lamps must be averaged, so that their colour equals that of the sky.

    The colour is the mean wavelength of the detected photons in the band.

    Parameters
    ----------
    scene : Scene
        Exposure of a flat, which defines the band and the detector.
    lamps : sequence of int
        Numbers of the lamps, from 1; at least one lamp.

    Returns
    -------
    tuple of float
        Weight of each lamp, 0 or more, with sum 1.

    Notes
    -----
    With three or more lamps, the mean square of the wavelength is matched as well as possible. An observer can compute
    the weights from the passband, the spectrum of the Sun and the spectra of the lamps. If the wavelengths of all lamps
    are on one side of the sky's mean wavelength, only the nearest lamp is used.
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
    """Return the photon-weighted mean and mean square of x = wavelength / `band_width` - `origin`, shape (2,).

    `photons` has the relative number of photons at each wavelength at which the passband `band` is tabulated.
    """
    x = band.wavelength / band_width - origin
    return np.array([np.average(x, weights=photons), np.average(x**2, weights=photons)])
