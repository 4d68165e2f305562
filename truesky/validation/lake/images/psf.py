"""Check the FWHM and the ellipticity of stars in an image."""

from __future__ import annotations

import math

import numpy as np

from truesky.validation.lake.measure.frame_context import FrameCheck, FrameContext, require_stars
from truesky.validation.lake.measure.rows import Row
from truesky.validation.verdicts import AT_MOST

SOURCE = 'PSFFWHM of the header; VIS: McCracken et al. 2025 (0.16"), requirement e < 0.15 (Cropper et al. 2016)'
# Relative tolerance of the measured FWHM of stars compared with the FWHM in the header.
_WIDTH = 0.08
# Largest allowed ellipticity (a^2 - b^2) / (a^2 + b^2), with the axes a and b, of stars in images from space. It is
# computed from the medians of both components of the ellipticity.
_ROUND = 0.15
# With fewer measured stars than this number, the check is not applicable.
_MIN_STARS = 12


def check(context: FrameContext) -> list[Row]:
    """Check the measured FWHM of stars divided by the FWHM in the header and, in space, their median ellipticity.

    Returns one row (measurement with expected value and verdict) for each quantity.
    """
    assert context.measurements is not None
    measurements, stars = context.measurements, context.measurements.stars
    header_fwhm = float(context.frame.header["PSFFWHM"]) / context.frame.scale
    note = f"{len(stars)} stars, mean profile"
    rows = [
        Row(
            "psf",
            "fwhm",
            context.place,
            measurements.fwhm / header_fwhm,
            measurements.fwhm_error / header_fwhm,
            1.0,
            _WIDTH,
            "",
            SOURCE,
            note=note,
        )
    ]
    if context.channel != "EXT":
        mean = [float(np.median(component)) for component in (stars.e1, stars.e2)]
        error = 1.25 * float(np.hypot(stars.e1.std(), stars.e2.std())) / np.sqrt(2.0 * len(stars))
        rows.append(Row("psf", "ellipticity", context.place, math.hypot(*mean), error, 0.0, _ROUND, "", SOURCE, AT_MOST,
                        f"{len(stars)} stars, in a window of the half-light diameter"))  # fmt: skip
    context.series |= {
        "size": stars.size,
        "e1": stars.e1,
        "e2": stars.e2,
        "half_light": measurements.half_light * context.frame.scale,
    }
    return rows


PSF = FrameCheck("psf", SOURCE, require_stars(_MIN_STARS), check)
