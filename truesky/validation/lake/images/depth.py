"""Check the depth that a stack of four frames would have, from the noise of blank sky in one frame.

For NISP the depth is the AB magnitude of a point source at 5 sigma, with the noise-equivalent area of a Gaussian of the
width PSFFWHM (header). For VIS it is the S/N of a galaxy of AB magnitude 24.5 with half-light radius 0.3" in an
aperture of diameter 1.3"; the requirement is 10.
"""

from __future__ import annotations

import numpy as np

from truesky.validation.lake.measure.frame_context import FrameCheck, FrameContext, require_blank_sky
from truesky.validation.lake.measure.rows import Row
from truesky.validation.verdicts import AT_LEAST

SOURCE = "requirements named by Serrano et al. 2024: NISP 24 AB (point, 5 sigma), VIS S/N 10 at 24.5 (extended)"
# Number of exposures of a field in Euclid's observing sequence, which form the stack whose depth is computed.
_DITHERS = 4
# Required depth of NISP for point sources, AB mag.
_POINT = 24.0
# Signal-to-noise ratio at which the depth of NISP is defined.
_POINT_SIGMA = 5.0
# AB magnitude of the galaxy for which the S/N in VIS is required.
_GALAXY = 24.5
# Fraction of a galaxy's light in the aperture of VIS, for an exponential disc of half-light radius 0.3".
_APERTURE_FRACTION = 0.80
# Diameter of the aperture in which the S/N of a galaxy in VIS is computed, arcsec.
_DIAMETER = 1.3


def check(context: FrameContext) -> list[Row]:
    """Check the depth of a stack of four frames with the noise of the given frame against the mission requirement.

    Returns one row (measurement with requirement and verdict): S/N for VIS, AB magnitude for NISP.
    """
    assert context.tiles is not None
    spread = float(
        np.sqrt(np.mean((context.tiles.pixels - context.tiles.level[:, None, None])[context.tiles.blank] ** 2))
    )
    error = 1.0 / np.sqrt(2.0 * context.tiles.blank.sum())
    header, seconds = context.frame.header, context.frame.seconds
    if context.channel == "VIS":
        light = seconds * 10.0 ** (-0.4 * (_GALAXY - float(header["ZEROPNT"])))
        area = np.pi * (0.5 * _DIAMETER / context.frame.scale) ** 2
        ratio = np.sqrt(_DITHERS) * _APERTURE_FRACTION * light / np.sqrt(_APERTURE_FRACTION * light + area * spread**2)
        return [Row("requirement", "vis_snr_24.5", context.place, ratio, ratio * error, 10.0, 0.0, "", SOURCE, AT_LEAST,
                    f"four frames, noise of blank sky {spread:.4g} e-")]  # fmt: skip
    sigma = float(header["PSFFWHM"]) / context.frame.scale / 2.3548
    noise = np.sqrt(4.0 * np.pi * sigma**2 * spread**2 / _DITHERS)
    depth = float(header["ZEROPNT"]) - 2.5 * np.log10(_POINT_SIGMA * noise / seconds)
    return [Row("requirement", "nisp_depth", context.place, depth, 1.0857 * error, _POINT, 0.0, "mag", SOURCE, AT_LEAST,
                f"four frames, noise of blank sky {spread:.4g} e-")]  # fmt: skip


def _why_not_applicable(context: FrameContext) -> str:
    return (
        require_blank_sky(context)
        if context.channel in ("VIS", "NISP-P")
        else "no requirement on the depth of this channel"
    )


DEPTH = FrameCheck("requirement", SOURCE, _why_not_applicable, check)
