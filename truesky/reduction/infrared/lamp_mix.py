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
_SUM, _MEAN, _SQUARE, _EVEN = 1e4, 1e2, 1.0, 1e-2
# Sky whose colour is matched, e-/s in a pixel: zodiacal light where surveys look.
_SKY = 1.0


def weights(scene: Scene, lamps: Sequence[int]) -> tuple[float, ...]:
    """Weights of lamps, 0 or more and 1 in all: the mean wavelength of their light in the band is the sky's.

    Of many lamps the mean square is as near as it can be. An observer knows the passband, the Sun and the lamps.
    scene : of a flat in the band;  lamps : their numbers
    Error : of lamps that all lie on one side of the sky's mean wavelength the nearest is taken
    """
    band = chromatic_response.band_of(scene)
    wide = float(band.wavelength[-1] - band.wavelength[0])
    sky = diffuse_light.photons(scene.section, _SKY, band, scene.mission)
    target = _moments(band, sky, 0.0, wide)
    rows = np.array(
        [
            _moments(band, calibration_lamp.photons(band, lamp, scene.section, scene.mission), target[0], wide)
            for lamp in lamps
        ]
    ).T
    of_sky = _moments(band, sky, target[0], wide)
    scale = np.array([_MEAN, _SQUARE])
    system = np.vstack([np.full(len(lamps), _SUM), scale[:, None] * rows, _EVEN * np.eye(len(lamps))])
    wanted = np.concatenate([[_SUM], scale * of_sky, np.full(len(lamps), _EVEN / len(lamps))])
    found, _ = nnls(system, wanted)
    return tuple((found / found.sum()).tolist())


def _moments(band: Passband, photons: Float, about: float, wide: float) -> Float:
    """Mean and mean square of the wavelength over the band's width, told from `about`."""
    x = band.wavelength / wide - about
    return np.array([np.average(x, weights=photons), np.average(x**2, weights=photons)])
