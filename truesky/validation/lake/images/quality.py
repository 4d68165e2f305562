"""Check the chi^2 of the fits to infrared ramps: its distribution over all pixels, and the fraction of bad fits.

Notes
-----
A ramp of NG groups of reads has NG - 1 differences, to which one number is fitted: the signal. Therefore chi^2 has
NG - 2 degrees of freedom.
"""

from __future__ import annotations

import numpy as np
import scipy.stats

from lake_schema.arrays import Array, Float
from truesky.validation.lake.measure.frame_context import FrameCheck, FrameContext
from truesky.validation.lake.measure.rows import Row
from truesky.validation.verdicts import AT_MOST

SOURCE = "chi^2 with NG - 2 degrees of freedom (Kubik et al. 2016, PASP 128, 104504)"
# Relative tolerance of the median and quartiles of chi^2 of the ramp fits. The file has chi^2 as rounded integers,
# which limits the accuracy.
_MIDDLE = 0.06
# Fraction of pixels that may have a bad fit, because of cosmic rays and correlated noise of the groups.
_FLAGGED = 0.03


def check(context: FrameContext) -> list[Row]:
    """Check the median and the quartiles of chi^2 divided by the expected values, and the fraction of bad fits.

    Returns rows (measurements with expected value and verdict). If the file contains only a flag per pixel instead of
    chi^2, the only row is the fraction of bad fits.
    """
    quality = np.asarray(context.frame.quality)
    if "QUALFLAG" in context.frame.header:
        return [_flagged_row(context, quality > 0)]
    freedom = int(context.frame.header["NG"]) - 2
    edges = np.arange(257)
    count = np.bincount(quality.ravel(), minlength=256)[:256]
    rows = [_flagged_row(context, quality > float(context.frame.header["QUALLIM"]))]
    for part, name in ((0.25, "lower_quartile"), (0.5, "median"), (0.75, "upper_quartile")):
        expected = float(scipy.stats.chi2.ppf(part, freedom))
        value = _quantile(count, edges, part)
        error = np.sqrt(part * (1 - part) / quality.size) / float(scipy.stats.chi2.pdf(expected, freedom))
        rows.append(Row("quality", name, context.place, value / expected, error / expected, 1.0, _MIDDLE, "", SOURCE,
                        note=f"{quality.size} pixels"))  # fmt: skip
    context.series["chi2"] = count / count.sum()
    context.series["freedom"] = freedom
    return rows


def _quantile(count: Array, edges: Array, part: float) -> float:
    """Return the quantile of rounded values, for the fraction `part` (0 to 1) of values that are below it.

    `count` says how many values were rounded to each of the integers 0, 1, 2, ..., and `edges` are these integers with
    one more at the end. Values are assumed to be evenly distributed within 0.5 of their integer.
    """
    below: Float = np.append(0.0, np.cumsum(count)) / count.sum()
    return float(np.interp(part, below, edges - 0.5))


def _flagged_row(context: FrameContext, bad: Array) -> Row:
    value = float(np.mean(bad))
    error = np.sqrt(max(value, 1.0 / bad.size) / bad.size)
    return Row(
        "quality", "not_fitting", context.place, value, error, 0.0, _FLAGGED, "", SOURCE, AT_MOST, f"{bad.size} pixels"
    )


def _why_not_applicable(context: FrameContext) -> str:
    if context.frame.quality is None:
        return "no ramp with a plane of chi^2"
    return "" if context.sees_sky else "no sky signal in the ramps"


QUALITY = FrameCheck("quality", SOURCE, _why_not_applicable, check)
