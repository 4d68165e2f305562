"""Which mix of a unit's lamps is like the sky's light in a band: a pixel's response is of the wavelength.

weights   of lamps whose flats are mixed
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

# What the sum, the mean wavelength and its square count in the fit, and that weights are alike.
_SUM_WEIGHT, _MEAN_WEIGHT, _SQUARE_WEIGHT, _EVENNESS_WEIGHT = 1e4, 1e2, 1.0, 1e-2
# Sky whose colour is matched, e-/s in a pixel: zodiacal light where surveys look.
_SKY = 1.0


def weights(scene: Scene, lamps: Sequence[int]) -> tuple[float, ...]:
    """Weights of lamps, 0 or more and 1 in all: the mean wavelength of their light in the band is the sky's.

    Of many lamps the mean square is as near as it can be. An observer knows the passband, the Sun and the lamps.
    scene : of a flat in the band;  lamps : their numbers
    Error : of lamps that all lie on one side of the sky's mean wavelength the nearest is taken
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
    """Mean and mean square of the wavelength over the band's width, told from `about`."""
    x = band.wavelength / band_width - origin
    return np.array([np.average(x, weights=photons), np.average(x**2, weights=photons)])
