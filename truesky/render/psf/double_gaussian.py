"""PSF as the sum of two round Gaussians, computed from the radii that contain 50 % and 80 % of the light.

The fraction of the light within the radius r (encircled energy) is::

    EE(r) = 1 - c exp(-r^2 / (2 s1^2)) - (1 - c) exp(-r^2 / (2 s2^2))

Here c is the fraction of the light in the narrow Gaussian, and s1 and s2 are the widths (rms per axis) of the narrow
and the wide Gaussian.

References
----------
Serrano et al. 2024, section 4.2 (sum of two Gaussians, for NISP-S); c is assumed, see the mission database.
"""

from __future__ import annotations

import numpy as np
import scipy

from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from truesky.render.camera.detectors import Detector
from truesky.render.psf import model
from truesky.render.psf.euclid import NISP
from truesky.render.psf.model import Planes, Psf

# Wavelength, Angstrom, for which the mission database contains the radii of 50 % and 80 % of the light. It also
# contains their slopes, with which they are computed at other wavelengths.
_MIDDLE = 15_000.0


def widths(ee50: float, ee80: float, part: float) -> tuple[float, float]:
    """Return the widths s1 and s2 of two Gaussians whose sum has given radii of 50 % and 80 % of the light.

    Parameters
    ----------
    ee50, ee80 : float
        Radii that contain 50 % and 80 % of the light, in any common unit.
    part : float
        Fraction of the light in the narrow Gaussian, above 0.5 and below 0.8.

    Returns
    -------
    (float, float)
        Widths (rms per axis) of the narrow and the wide Gaussian in the unit of the radii. Both are equal if the 80 %
        radius of a single Gaussian with this `ee50` is `ee80` or more; `ee80` is then not reproduced.

    Raises
    ------
    BadInput
        If `ee50` is not positive, if `ee80` is not larger than `ee50`, or if `part` is outside its range.
    """
    if not 0.5 < part < 0.8:
        raise BadInput(f"the core must contain between 0.5 and 0.8 of the light, got {part:g}")
    if not 0.0 < ee50 < ee80:
        raise BadInput(f"radii of 50 and 80 % of the light must be positive and increase, got {ee50:g} and {ee80:g}")

    def outer_width(core: float) -> float:
        """Return the width (rms) of the wide Gaussian for which both together have half of the light outside `ee50`.

        `core` is the fraction of the narrow Gaussian's own light that lies outside the radius `ee50`.
        """
        return float(ee50 / np.sqrt(-2.0 * np.log((0.5 - part * core) / (1.0 - part))))

    def core_width(core: float) -> float:
        return float(ee50 / np.sqrt(-2.0 * np.log(core)))

    def light_excess(core: float) -> float:
        light = (part, core_width(core)), (1.0 - part, outer_width(core))
        return sum(fraction * float(np.exp(-0.5 * (ee80 / s) ** 2)) for fraction, s in light) - 0.2

    # Interval of `core`, the fraction of the narrow Gaussian's own light outside the radius `ee50`, in which the
    # solution is searched. At its lower end the other Gaussian is infinitely wide, and at its upper end both are equal.
    ends = (0.5 - (1.0 - part)) / part * (1.0 + 1e-9), 0.5
    if light_excess(ends[1]) >= 0.0:
        return core_width(0.5), core_width(0.5)
    best_core = float(scipy.optimize.brentq(light_excess, *ends, xtol=1e-14))
    return core_width(best_core), outer_width(best_core)


def psf_at(detector: Detector, waves: Float, mission: MissionConfiguration) -> Psf:
    """Return the PSF of a detector at given wavelengths as a sum of two round Gaussians.

    It includes all blur except the average over a pixel.

    Parameters
    ----------
    detector : Detector
        The detector.
    waves : float array, shape (w,)
        Wavelengths, Angstrom.
    mission : MissionConfiguration
        Mission database, which contains the radii of 50 % and 80 % of the light and their slopes with wavelength.

    Returns
    -------
    Psf
        PSF that is the same on the whole detector. The radii depend linearly on wavelength.
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
