"""Check the fits of ramps: distribution of chi^2 in all pixels, and fraction above the limit in the header.

Notes
-----
NG groups have NG - 1 differences. They determine one number, the signal, so there are NG - 2 degrees of freedom.
"""

from __future__ import annotations

import numpy as np
import scipy.stats

from lake_schema.arrays import Array, Float
from truesky.validation.lake.measure.frame_context import FrameCheck, FrameContext
from truesky.validation.lake.measure.rows import Row
from truesky.validation.verdicts import AT_MOST

SOURCE = "chi^2 with NG - 2 degrees of freedom (Kubik et al. 2016, PASP 128, 104504)"
# Tolerance of the quartiles over the expected ones; a rounded chi^2 determines them to a fraction of one.
_MIDDLE = 0.06
# Fraction of ramps that may fail to fit: reads share photons, and cosmic rays hit some pixels.
_FLAGGED = 0.03


def check(context: FrameContext) -> list[Row]:
    """Check the median and quartiles of chi^2 over the expected ones, and the fraction of pixels that do not fit."""
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
    """Quantile of rounded values, as if each were evenly distributed over its interval."""
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
