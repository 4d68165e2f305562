"""PSF as the sum of two round Gaussians, from the radii that contain 50 and 80 % of the light.

The encircled energy of the two Gaussians is::

    EE(r) = 1 - c exp(-r^2 / 2 s1^2) - (1 - c) exp(-r^2 / 2 s2^2)

References
----------
Serrano et al. 2024, section 4.2 (the form, for NISP-S); c is assumed, see the mission database.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from truesky.render.camera.detectors import Detector
from truesky.render.psf import model
from truesky.render.psf.euclid import NISP
from truesky.render.psf.model import Planes, Psf

# Wavelength of the radii in the mission database, Angstrom.
_MIDDLE = 15_000.0


def widths(ee50: float, ee80: float, part: float) -> tuple[float, float]:
    """Widths s1 and s2 of the two Gaussians, in the unit of the radii.

    Parameters
    ----------
    ee50, ee80 : float
        Radii that contain 50 and 80 % of the light.
    part : float
        Fraction c of the light in the core. The two Gaussians exist only if it is between 0.5 and 0.8.

    Returns
    -------
    (float, float)
        Widths s1 and s2, equal if a single Gaussian with this EE50 has an EE80 of at least `ee80`.

    Raises
    ------
    BadInput
        If `ee80` is not larger than `ee50`, or if `part` is outside its range.
    """
    if not 0.5 < part < 0.8:
        raise BadInput(f"the core must contain between 0.5 and 0.8 of the light, got {part:g}")
    if not 0.0 < ee50 < ee80:
        raise BadInput(f"radii of 50 and 80 % of the light must be positive and increase, got {ee50:g} and {ee80:g}")

    def outer_width(core: float) -> float:
        """Width s2 from the light that remains outside the core beyond EE50."""
        return float(ee50 / np.sqrt(-2.0 * np.log((0.5 - part * core) / (1.0 - part))))

    def core_width(core: float) -> float:
        return float(ee50 / np.sqrt(-2.0 * np.log(core)))

    def light_excess(core: float) -> float:
        light = (part, core_width(core)), (1.0 - part, outer_width(core))
        return sum(fraction * float(np.exp(-0.5 * (ee80 / s) ** 2)) for fraction, s in light) - 0.2

    # At the ends, the second Gaussian is infinitely wide or equal to the first.
    ends = (0.5 - (1.0 - part)) / part * (1.0 + 1e-9), 0.5
    if light_excess(ends[1]) >= 0.0:
        return core_width(0.5), core_width(0.5)
    best_core = float(brentq(light_excess, *ends, xtol=1e-14))
    return core_width(best_core), outer_width(best_core)


def psf_at(detector: Detector, waves: Float, mission: MissionConfiguration) -> Psf:
    """PSF of a detector at given wavelengths, including all blur except the pixel.

    Parameters
    ----------
    detector : Detector
        The detector.
    waves : float array, shape (w,)
        Wavelengths, Angstrom.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    Psf
        One PSF for the whole detector, with radii that are linear in wavelength.
    """
    samples, side, section = NISP.samples, NISP.side, detector.section
    core = mission.value(f"{section}.spectra.core", "")
    radius = np.hypot(*np.meshgrid(*[np.arange(side * samples + 1) - side * samples // 2] * 2))
    images = []
    for wavelength in waves.tolist():
        wavelength_offset = (wavelength - _MIDDLE) / 1e4
        ee50, ee80 = (
            mission.value(f"{section}.spectra.ee{part}", "arcsec")
            + wavelength_offset * mission.value(f"{section}.spectra.ee{part}_slope", "arcsec / um")
            for part in (50, 80)
        )
        image = np.zeros(radius.shape)
        for part, width in zip((core, 1.0 - core), widths(ee50, ee80, core), strict=True):
            sigma = width / detector.pixel_scale * samples
            image += part / (2.0 * np.pi * sigma**2) * np.exp(-0.5 * (radius / sigma) ** 2)
        images.append(image.astype(np.float32))
    half = (detector.nx - 1) / 2, (detector.ny - 1) / 2
    planes = Planes(waves, np.stack(images), np.zeros((0, *radius.shape), np.float32), half, samples=samples)
    return model.from_planes(planes, detector.pixel_scale, has_pixel=False, side=side)
