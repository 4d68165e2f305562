"""How wide and how round points are."""

from __future__ import annotations

import math

import numpy as np

from truesky.validation.lake.measure.rows import Row
from truesky.validation.lake.measure.seen import Check, Seen, wants_stars
from truesky.validation.verdicts import MOST

SOURCE = 'PSFFWHM of the header; VIS: McCracken et al. 2025 (0.16"), requirement e < 0.15 (Cropper et al. 2016)'
# Of the FWHM over the header's; and of the ellipticity (a^2 - b^2) / (a^2 + b^2) in space.
_WIDTH, _ROUND = 0.08, 0.15
_LEAST = 12


def check(of: Seen) -> list[Row]:
    """FWHM over the header's, and in space the mean ellipticity."""
    assert of.measured is not None
    found, stars = of.measured, of.measured.stars
    told = float(of.frame.header["PSFFWHM"]) / of.frame.scale
    note = f"{len(stars)} stars, mean profile"
    rows = [
        Row("psf", "fwhm", of.place, found.fwhm / told, found.fwhm_error / told, 1.0, _WIDTH, "", SOURCE, note=note)
    ]  # fmt: skip
    if of.channel != "EXT":
        mean = [float(np.median(component)) for component in (stars.e1, stars.e2)]
        error = 1.25 * float(np.hypot(stars.e1.std(), stars.e2.std())) / np.sqrt(2.0 * len(stars))
        rows.append(Row("psf", "ellipticity", of.place, math.hypot(*mean), error, 0.0, _ROUND, "", SOURCE, MOST,
                        f"{len(stars)} stars, in a window of the half-light diameter"))  # fmt: skip
    of.series |= {"size": stars.size, "e1": stars.e1, "e2": stars.e2, "half_light": found.half_light * of.frame.scale}
    return rows


PSF = Check("psf", SOURCE, wants_stars(_LEAST), check)
