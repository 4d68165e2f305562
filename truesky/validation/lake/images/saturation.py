"""Whether the stars that must be full are, and no others: by their flux, and the part of it in the brightest pixel."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from lake_schema.arrays import Bool, Float
from truesky.validation.lake.measure.rows import Row, not_applicable
from truesky.validation.lake.measure.seen import Check, Seen
from truesky.validation.verdicts import LEAST, MOST

SOURCE = "part of a point's light in its brightest pixel, from the frame's own fainter stars; SATURATE of the header"
# Times the full well from which a star must be full, and up to which it must not.
_OVER, _UNDER = 2.5, 0.4
_WRONG, _LEAST, _ALONE = 0.1, 5, 30.0


def check(of: Seen) -> list[Row]:
    """Parts of the stars, bright and fainter, that have a saturated pixel."""
    assert of.measured is not None
    stars = of.measured.stars
    part = float(np.median(stars.peak / stars.flux))
    expected, full = _alone(of)
    peak = expected * part
    out = []
    for name, chosen, kind, told in (
        ("bright_full", peak > _OVER * of.frame.full, LEAST, 1.0),
        ("faint_full", (peak < _UNDER * of.frame.full) & (peak > 0.05 * of.frame.full), MOST, 0.0),
    ):
        n = int(chosen.sum())
        if n >= _LEAST:
            value = float(full[chosen].mean())
            # Of a share, that of Agresti and Coull, which is not 0 where all are alike.
            near = (full[chosen].sum() + 2.0) / (n + 4.0)
            error = float(np.sqrt(near * (1.0 - near) / (n + 4.0)))
            out.append(Row("saturation", name, of.place, value, error, told, _WRONG, "", SOURCE, kind, f"{n} stars"))
    return out or [not_applicable("saturation", of.place, "too few stars near the full well", SOURCE)]


def _alone(of: Seen) -> tuple[Float, Bool]:
    """(expected e-, whether a pixel is saturated) of points that no brighter source is near."""
    known, (ny, nx) = of.known, of.frame.electrons.shape
    inside = known.point & (known.x > 8) & (known.x < nx - 9) & (known.y > 8) & (known.y < ny - 9)
    index = np.flatnonzero(inside & (known.expected > 1e-3 * of.frame.full))
    if not index.size:
        return np.zeros(0), np.zeros(0, bool)
    tree = cKDTree(np.stack([known.x, known.y], axis=1))
    near = tree.query_ball_point(np.stack([known.x[index], known.y[index]], axis=1), _ALONE)
    alone = [max(known.expected[j] for j in others) <= known.expected[i] for i, others in zip(index, near, strict=True)]
    index = index[np.array(alone, bool)]
    saturated = of.frame.saturated()
    where = zip(np.rint(known.x[index]).astype(int), np.rint(known.y[index]).astype(int), strict=True)
    full = [bool(saturated[y - 2 : y + 3, x - 2 : x + 3].any()) for x, y in where]
    return known.expected[index], np.array(full, bool)


def _applies(of: Seen) -> str:
    if of.measured is None:
        return "no direct image of the sky"
    return "" if len(of.measured.stars) >= _LEAST else "too few stars to tell how peaked a point is"


SATURATION = Check("saturation", SOURCE, _applies, check)
