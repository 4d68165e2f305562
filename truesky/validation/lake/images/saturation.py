"""Check that stars far above the saturation level (2.5 times) are saturated, and stars far below (0.4 times) are not.

The expected peak of a star is its flux times the fraction of a point source's light in the brightest pixel.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from lake_schema.arrays import Bool, Float
from truesky.validation.lake.measure.frame_context import FrameCheck, FrameContext
from truesky.validation.lake.measure.rows import Row, not_applicable
from truesky.validation.verdicts import AT_LEAST, AT_MOST

SOURCE = "part of a point's light in its brightest pixel, from the frame's own fainter stars; SATURATE of the header"
# Stars must be saturated if the expected value of their brightest pixel is above this multiple of the saturation level.
_OVER = 2.5
# Stars must not be saturated if the expected value of their brightest pixel is below this multiple of the saturation
# level.
_UNDER = 0.4
# Allowed fraction of the stars above _OVER that are not saturated, and of the stars below _UNDER that are saturated.
_TOLERANCE = 0.1
# The bright stars, or the faint stars, are not checked if they are fewer than this number.
_MIN_STARS = 5
# A star is used only if there is no brighter source within this distance, pixels.
_ISOLATION_RADIUS = 30.0


def check(context: FrameContext) -> list[Row]:
    """Check the fraction of bright stars, and of faint stars, that have a saturated pixel.

    Returns one row (measurement with expected value and verdict) for each group with at least five stars, or a row
    "not_applicable" if both groups have fewer.
    """
    assert context.measurements is not None
    stars = context.measurements.stars
    part = float(np.median(stars.peak / stars.flux))
    expected, full = _isolated_stars(context)
    peak = expected * part
    out = []
    for name, chosen, kind, expected_share in (
        ("bright_full", peak > _OVER * context.frame.saturation_level, AT_LEAST, 1.0),
        (
            "faint_full",
            (peak < _UNDER * context.frame.saturation_level) & (peak > 0.05 * context.frame.saturation_level),
            AT_MOST,
            0.0,
        ),
    ):
        n = int(chosen.sum())
        if n >= _MIN_STARS:
            value = float(full[chosen].mean())
            # Use the error of a fraction by Agresti and Coull, which is not 0 if all stars are (or are not) saturated.
            adjusted_share = (full[chosen].sum() + 2.0) / (n + 4.0)
            error = float(np.sqrt(adjusted_share * (1.0 - adjusted_share) / (n + 4.0)))
            out.append(
                Row(
                    "saturation",
                    name,
                    context.place,
                    value,
                    error,
                    expected_share,
                    _TOLERANCE,
                    "",
                    SOURCE,
                    kind,
                    f"{n} stars",
                )
            )
    return out or [not_applicable("saturation", context.place, "too few stars near the full well", SOURCE)]


def _isolated_stars(context: FrameContext) -> tuple[Float, Bool]:
    """Find the point sources without a brighter source within 30 pixels.

    Returns their expected light (e-), and a mask that is True for sources with a saturated pixel within 2 pixels.
    """
    sources, (ny, nx) = context.sources, context.frame.electrons.shape
    inside = sources.point & (sources.x > 8) & (sources.x < nx - 9) & (sources.y > 8) & (sources.y < ny - 9)
    index = np.flatnonzero(inside & (sources.expected > 1e-3 * context.frame.saturation_level))
    if not index.size:
        return np.zeros(0), np.zeros(0, bool)
    tree = cKDTree(np.stack([sources.x, sources.y], axis=1))
    neighbours = tree.query_ball_point(np.stack([sources.x[index], sources.y[index]], axis=1), _ISOLATION_RADIUS)
    is_isolated = [
        max(sources.expected[j] for j in nearby) <= sources.expected[i]
        for i, nearby in zip(index, neighbours, strict=True)
    ]
    index = index[np.array(is_isolated, bool)]
    saturated = context.frame.saturated_pixels()
    positions = zip(np.rint(sources.x[index]).astype(int), np.rint(sources.y[index]).astype(int), strict=True)
    full = [bool(saturated[y - 2 : y + 3, x - 2 : x + 3].any()) for x, y in positions]
    return sources.expected[index], np.array(full, bool)


def _why_not_applicable(context: FrameContext) -> str:
    if context.measurements is None:
        return "no direct image of the sky"
    return (
        "" if len(context.measurements.stars) >= _MIN_STARS else "too few stars to measure the peak of a point source"
    )


SATURATION = FrameCheck("saturation", SOURCE, _why_not_applicable, check)
