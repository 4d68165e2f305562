"""Check the positions of stars against the catalogue and the WCS of the frame.

Notes
-----
Windowed centroids of undersampled stars depend on the position within the pixel. Odd harmonics of this dependence are
fitted as well.
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float
from truesky.validation.lake.measure.frame_context import FrameCheck, FrameContext, require_stars
from truesky.validation.lake.measure.rows import Row
from truesky.validation.verdicts import AT_MOST

SOURCE = "Serrano et al. 2024, app. C: below 1 mas rms; ground cameras 5 mas"
# Tolerance of the mean offset, mas; that of the linear term at the edge of the detector is twice as large.
TOLERANCE = {"VIS": 1.0, "NISP-P": 1.0, "EXT": 5.0}
_MIN_STARS, _CLIP = 12, 4.0


def check(context: FrameContext) -> list[Row]:
    """Check the mean offset along columns and rows, and the linear term at the edge of the detector."""
    assert context.measurements is not None
    stars, mas = context.measurements.stars, 1000.0 * context.frame.scale
    ny, nx = context.frame.electrons.shape
    u, v = 2.0 * stars.x / nx - 1.0, 2.0 * stars.y / ny - 1.0
    rows, residuals, means, tolerance = [], {}, [], TOLERANCE[context.channel]
    note = f"{len(stars)} stars, windowed centroids"
    for axis, offset, position in (("x", stars.dx, stars.x), ("y", stars.dy, stars.y)):
        value, error, phased = fit_offsets(offset, stars.error, u, v, position)
        rows.append(Row("astrometry", f"offset_{axis}", context.place, mas * value[0], mas * error[0], 0.0, tolerance,
                        "mas", SOURCE, note=note))  # fmt: skip
        edge, edge_error = np.hypot(value[1], value[2]), np.hypot(error[1], error[2])
        rows.append(
            Row(
                "astrometry",
                f"stretch_{axis}",
                context.place,
                mas * edge,
                mas * edge_error,
                0.0,
                2.0 * tolerance,
                "mas",
                SOURCE,
                AT_MOST,
                note,
            )
        )
        context.series[f"off_{axis}"] = mas * offset
        residuals[axis] = offset - phased
        means.append((value[0], error[0]))
    context.series |= {"u": u, "v": v, "id": stars.id}
    # Offsets on the sky do not include the effect of the position within the pixel.
    cd = context.frame.wcs.pixel_scale_matrix * 3.6e6
    context.series["east"], context.series["north"] = (row[0] * residuals["x"] + row[1] * residuals["y"] for row in cd)
    (x, dx), (y, dy) = means
    context.series["mean_off"] = np.array([(a * x + b * y, np.hypot(a * dx, b * dy)) for a, b in cd])
    return rows


def fit_offsets(offset: Float, noise: Float, u: Float, v: Float, position: Float) -> tuple[Float, Float, Float]:
    """Fit mean, linear terms and the effect of the position within the pixel to the offsets of stars along one axis.

    Parameters
    ----------
    offset, noise : float array, shape (n,)
        Offsets of the stars and their expected errors, pixels.
    u, v : float array, shape (n,)
        Positions on the detector, -1 to 1.
    position : float array, shape (n,)
        Position along the axis in pixels; centroid errors depend on its fraction.

    Returns
    -------
    value, error : float array, shape (3,)
        Mean, and linear terms in u and v, with their errors, pixels.
    phased : float array, shape (n,)
        Effect of the position within the pixel on each star, pixels.
    """
    phase = 2.0 * np.pi * position
    columns = [np.ones(len(offset)), u, v, *(np.sin(k * phase) for k in (1, 2, 3))]
    matrix = np.stack(columns, axis=1)
    used = np.abs(offset - np.median(offset)) < _CLIP * _spread(offset)
    for _ in range(4):
        root = 1.0 / np.hypot(noise, 0.5 * _spread((offset - np.median(offset))[used]))
        inverse = np.linalg.pinv(matrix[used] * root[used, None])
        solution = inverse @ (offset[used] * root[used])
        residual = offset - matrix @ solution
        used = np.abs(residual) < _CLIP * max(_spread(residual[used]), 1e-9)
    freedom = max(int(used.sum()) - matrix.shape[1], 1)
    scale = float(((residual[used] * root[used]) ** 2).sum()) / freedom
    error = np.sqrt((inverse[:3] ** 2).sum(axis=1) * scale)
    return np.asarray(solution[:3], float), error, matrix[:, 3:] @ solution[3:]


def _spread(values: Float) -> float:
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) + 1e-12


ASTROMETRY = FrameCheck("astrometry", SOURCE, require_stars(_MIN_STARS), check)
