"""Where stars are, against where the catalogue and the frame's WCS put them.

Windowed centroids of undersampled stars move with the place in the pixel: odd harmonics of that are fitted, too.
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float
from truesky.validation.lake.measure.rows import Row
from truesky.validation.lake.measure.seen import Check, Seen, wants_stars
from truesky.validation.verdicts import MOST

SOURCE = "Serrano et al. 2024, app. C: below 1 mas rms; ground cameras 5 mas"
# mas: of the mean, and of what a linear term brings to the edge of the detector.
TOLERANCE = {"VIS": 1.0, "NISP-P": 1.0, "EXT": 5.0}
_LEAST, _CLIP = 12, 4.0


def check(of: Seen) -> list[Row]:
    """Mean offset along columns and rows, and the largest that a linear term makes at the detector's edge."""
    assert of.measured is not None
    stars, mas = of.measured.stars, 1000.0 * of.frame.scale
    ny, nx = of.frame.electrons.shape
    u, v = 2.0 * stars.x / nx - 1.0, 2.0 * stars.y / ny - 1.0
    rows, left, means, tolerance = [], {}, [], TOLERANCE[of.channel]
    note = f"{len(stars)} stars, windowed centroids"
    for axis, off, place in (("x", stars.dx, stars.x), ("y", stars.dy, stars.y)):
        value, error, phased = fitted(off, stars.error, u, v, place)
        rows.append(Row("astrometry", f"offset_{axis}", of.place, mas * value[0], mas * error[0], 0.0, tolerance,
                        "mas", SOURCE, note=note))  # fmt: skip
        edge, its = np.hypot(value[1], value[2]), np.hypot(error[1], error[2])
        rows.append(Row("astrometry", f"stretch_{axis}", of.place, mas * edge, mas * its, 0.0, 2.0 * tolerance, "mas",
                        SOURCE, MOST, note))  # fmt: skip
        of.series[f"off_{axis}"] = mas * off
        left[axis] = off - phased
        means.append((value[0], error[0]))
    of.series |= {"u": u, "v": v, "id": stars.id}
    # On the sky, without what the place in the pixel does.
    cd = of.frame.wcs.pixel_scale_matrix * 3.6e6
    of.series["east"], of.series["north"] = (row[0] * left["x"] + row[1] * left["y"] for row in cd)
    (x, dx), (y, dy) = means
    of.series["mean_off"] = np.array([(a * x + b * y, np.hypot(a * dx, b * dy)) for a, b in cd])
    return rows


def fitted(off: Float, noise: Float, u: Float, v: Float, place: Float) -> tuple[Float, Float, Float]:
    """(mean and linear terms, their errors, what the place in the pixel does to each star [n]).

    off, noise : of stars [n], and their expected errors;  u, v : on the detector, from -1 to 1
    place      : in pixels, whose fraction the centroid's own error goes with
    """
    phase = 2.0 * np.pi * place
    columns = [np.ones(len(off)), u, v, *(np.sin(k * phase) for k in (1, 2, 3))]
    matrix = np.stack(columns, axis=1)
    kept = np.abs(off - np.median(off)) < _CLIP * _spread(off)
    for _ in range(4):
        root = 1.0 / np.hypot(noise, 0.5 * _spread((off - np.median(off))[kept]))
        inverse = np.linalg.pinv(matrix[kept] * root[kept, None])
        solution = inverse @ (off[kept] * root[kept])
        left = off - matrix @ solution
        kept = np.abs(left) < _CLIP * max(_spread(left[kept]), 1e-9)
    freedom = max(int(kept.sum()) - matrix.shape[1], 1)
    scale = float(((left[kept] * root[kept]) ** 2).sum()) / freedom
    error = np.sqrt((inverse[:3] ** 2).sum(axis=1) * scale)
    return np.asarray(solution[:3], float), error, matrix[:, 3:] @ solution[3:]


def _spread(values: Float) -> float:
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) + 1e-12


ASTROMETRY = Check("astrometry", SOURCE, wants_stars(_LEAST), check)
