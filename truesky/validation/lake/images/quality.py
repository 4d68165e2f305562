"""How well ramps fit: chi^2 of blank pixels against its distribution, and how many exceed the limit of the header.

Of NG groups there are NG - 1 differences, and one number, the signal, is told by them: NG - 2 degrees of freedom.
"""

from __future__ import annotations

import numpy as np
import scipy.stats

from lake_schema.arrays import Array, Float
from truesky.validation.lake.measure.frame_context import FrameCheck, FrameContext
from truesky.validation.lake.measure.rows import Row
from truesky.validation.verdicts import AT_MOST

SOURCE = "chi^2 with NG - 2 degrees of freedom (Kubik et al. 2016, PASP 128, 104504)"
# Of the middle half of the distribution, over what is expected; a rounded chi^2 tells it to a part of one.
_MIDDLE = 0.06
# Ramps that do not fit although nothing hit them: reads share photons, and cosmic rays hit others.
_FLAGGED = 0.03


def check(context: FrameContext) -> list[Row]:
    """Median and inner quartiles of chi^2 over the expected ones; part of the pixels that do not fit."""
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
    """Of rounded values, as if each were spread over its own interval."""
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
        return "no ramp with a quality"
    return "" if context.sees_sky else "no sky that ramps would climb with"


QUALITY = FrameCheck("quality", SOURCE, _why_not_applicable, check)
