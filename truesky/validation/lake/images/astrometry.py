"""Check the measured positions of stars in an image against the catalogue and the WCS of the image.

Notes
-----
Windowed centroids of undersampled stars have errors that depend on the position within the pixel. These errors are
fitted together with the offsets, as sine functions of the position.
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float
from truesky.validation.lake.measure.frame_context import FrameCheck, FrameContext, require_stars
from truesky.validation.lake.measure.rows import Row
from truesky.validation.verdicts import AT_MOST

SOURCE = "Serrano et al. 2024, app. C: below 1 mas rms; ground cameras 5 mas"
# Tolerance of the mean offset between measured and expected positions of stars, in mas: for Euclid's VIS and NISP-P,
# and for cameras on the ground (EXT).
TOLERANCE = {"VIS": 1.0, "NISP-P": 1.0, "EXT": 5.0}
# With fewer measured stars than this number, the check is not applicable.
_MIN_STARS = 12
# Stars whose offset deviates from the fit by more than this number of standard deviations are rejected.
_CLIP = 4.0


def check(context: FrameContext) -> list[Row]:
    """Check the offsets (measured minus expected positions) of the stars of a frame along x and along y.

    For each axis, the result has one row (measurement with expected value and verdict) for the mean offset and one for
    the linear variation at the edge of the detector, in mas. Offsets on the sky are added to `context.series`.
    """
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
    # Convert offsets from pixels to mas along east and north, without the fitted effect of the position in the pixel.
    cd = context.frame.wcs.pixel_scale_matrix * 3.6e6
    context.series["east"], context.series["north"] = (row[0] * residuals["x"] + row[1] * residuals["y"] for row in cd)
    (x, dx), (y, dy) = means
    context.series["mean_off"] = np.array([(a * x + b * y, np.hypot(a * dx, b * dy)) for a, b in cd])
    return rows


def fit_offsets(offset: Float, noise: Float, u: Float, v: Float, position: Float) -> tuple[Float, Float, Float]:
    """Fit the offsets of stars along one axis: a mean, linear terms, and the effect of the position within the pixel.

    Outliers are rejected in four iterations.

    Parameters
    ----------
    offset, noise : float array, shape (n,)
        Offset (measured minus expected position) of each star, and its expected standard error, pixels.
    u, v : float array, shape (n,)
        Positions along columns and rows of the detector, scaled to -1 to 1.
    position : float array, shape (n,)
        Positions in pixels along the axis of the offset; centroid errors depend on the fractional part.

    Returns
    -------
    value, error : float array, shape (3,)
        Mean offset, and changes of the offset per unit of u and of v, with their standard errors, pixels.
    phased : float array, shape (n,)
        Fitted effect of the position within the pixel on each star's offset, pixels.
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
