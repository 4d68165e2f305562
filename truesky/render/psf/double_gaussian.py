"""A PSF as the sum of two round Gaussians, from the radii that hold half and four fifths of the light.

    EE(r) = 1 - c exp(-r^2 / 2 s1^2) - (1 - c) exp(-r^2 / 2 s2^2)

widths     s1, s2 of two radii
psf_at     of NISP's detectors, by wavelength

Ref : Serrano et al. 2024, section 4.2 (the form, of NISP-S); c, of the mission database, is assumed
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

# Wavelength that the mission's radii are of, A.
_MIDDLE = 15_000.0


def widths(ee50: float, ee80: float, part: float) -> tuple[float, float]:
    """(s1, s2), in the unit of the radii; one Gaussian of half of the light where its EE80 is as wide or wider.

    ee50, ee80 : radii that hold 50 and 80 % of the light
    part       : of the light in the core, c; only between 0.5 and 0.8 do such Gaussians exist
    Errors : BadInput where the second radius is not the larger, or for another part
    """
    if not 0.5 < part < 0.8:
        raise BadInput(f"a core of {part:g} of the light is not between 0.5 and 0.8")
    if not 0.0 < ee50 < ee80:
        raise BadInput(f"radii of 50 and 80 % of the light, {ee50:g} and {ee80:g}, do not rise")

    def outer_width(core: float) -> float:
        """s2, of what is left of the core's light beyond EE50."""
        return float(ee50 / np.sqrt(-2.0 * np.log((0.5 - part * core) / (1.0 - part))))

    def core_width(core: float) -> float:
        return float(ee50 / np.sqrt(-2.0 * np.log(core)))

    def light_excess(core: float) -> float:
        light = (part, core_width(core)), (1.0 - part, outer_width(core))
        return sum(fraction * float(np.exp(-0.5 * (ee80 / s) ** 2)) for fraction, s in light) - 0.2

    # From a wider Gaussian without an end to two that are one.
    ends = (0.5 - (1.0 - part)) / part * (1.0 + 1e-9), 0.5
    if light_excess(ends[1]) >= 0.0:
        return core_width(0.5), core_width(0.5)
    best_core = float(brentq(light_excess, *ends, xtol=1e-14))
    return core_width(best_core), outer_width(best_core)


def psf_at(detector: Detector, waves: Float, mission: MissionConfiguration) -> Psf:
    """One PSF for the whole detector, its radii linear in the wavelength; of all that blurs but the pixel.

    detector, waves : whose, and float64[w] A;  mission : the mission database
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
