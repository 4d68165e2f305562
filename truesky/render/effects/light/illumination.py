"""Uneven illumination of the focal plane by the optics (vignetting), and uneven exposure times by the shutter.

Every map of the illumination is 1 + f(column) + g(row), also on a rotated detector: a paraboloid plus a slope across
the focal plane. The optics have the paraboloid only, and the shutter the slope only. The blades of the shutter open on
one side of the focal plane first, and close on the other side first.
"""

from __future__ import annotations

import numpy as np

from lake_schema.errors import BadInput, OutOfRange
from truesky.render.camera import detectors as camera_detectors
from truesky.render.effects.effect import Effect, copy_frame, row_blocks
from truesky.render.effects.scene import Frame, Scene


def apply(
    frame: Frame, columns: Frame, rows: Frame, rng: np.random.Generator | None = None, out: Frame | None = None
) -> Frame:
    """Multiply a frame by the illumination 1 + columns + rows.

    Parameters
    ----------
    frame : float array, shape (..., ny, nx)
        Expected electrons.
    columns : float array, shape (nx,)
        Term of the illumination that depends on the column, relative to the nominal illumination.
    rows : float array, shape (ny,)
        Term of the illumination that depends on the row, relative to the nominal illumination.
    rng : numpy.random.Generator, optional
        Not used.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape of `frame`
        Expected electrons with the illumination.

    Raises
    ------
    BadInput
        If the last two axes of the frame do not have the lengths of `rows` and `columns`.
    OutOfRange
        If the illumination of a pixel is negative, infinite or NaN.
    """
    if frame.shape[-2:] != (len(rows), len(columns)):
        raise BadInput(f"illumination has the shape {(len(rows), len(columns))}, must be {frame.shape[-2:]}")
    if frame.size and not (1.0 + columns.min() + rows.min() >= 0.0 and columns.max() + rows.max() < np.inf):
        raise OutOfRange("illumination", 1.0 + float(columns.min() + rows.min()), 0.0, np.inf)
    out = copy_frame(frame, out)
    for block in row_blocks(out):
        illumination = columns + rows[block, None]
        illumination += 1.0
        out[..., block, :] *= illumination
    return out


def pattern(scene: Scene, nx: int, ny: int, bowl: float, slope: tuple[float, float]) -> tuple[Frame, Frame]:
    """Return the illumination of a detector, a paraboloid plus a slope, as one term for columns and one for rows.

    It is 1 - bowl r^2 + slope[0] x + slope[1] y at each pixel of the detector. The position (x, y) in the focal plane
    is relative to its centre, with x = 1 at the right edge and y = 1 at the upper edge. The distance r from the centre
    is 1 in the corners.

    Parameters
    ----------
    scene : Scene
        Settings of the exposure, with the position of the detector in the focal plane.
    nx, ny : int
        Columns and rows of the detector.
    bowl : float
        Relative loss of light in the corners of the focal plane, where the radius r is 1.
    slope : (float, float)
        Relative changes of light at the right and at the upper edge of the focal plane.

    Returns
    -------
    columns : float array, shape (nx,)
        Term that depends on the column.
    rows : float array, shape (ny,)
        Term that depends on the row. The map is 1 + columns + rows.
    """
    half_x, half_y = _half_sides(scene)
    corner = float(np.hypot(half_x, half_y))
    detector = scene.detector
    x0, y0, scale, axes = 0.0, 0.0, 1.0, np.eye(2)
    if detector is not None:
        x0, y0, scale, axes = detector.x, detector.y, detector.pixel_scale, detector.axes
    along, up = scale * (np.arange(nx) - (nx - 1) / 2), scale * (np.arange(ny) - (ny - 1) / 2)
    sx, sy = slope[0] / half_x, slope[1] / half_y
    # A pixel at the offset d from the detector's centre c has the squared distance |c + R d|^2 = |c|^2 + 2 c . R d +
    # |d|^2 from the centre of the focal plane, with the axes R of the detector. This is a sum of a function of the
    # column and a function of the row.
    columns = -bowl * (2 * along * (x0 * axes[0, 0] + y0 * axes[1, 0]) + along**2) / corner**2
    rows = -bowl * (2 * up * (y0 * axes[1, 1] + x0 * axes[0, 1]) + up**2) / corner**2
    columns += along * (sx * axes[0, 0] + sy * axes[1, 0])
    rows += up * (sy * axes[1, 1] + sx * axes[0, 1])
    return columns, rows + (x0 * sx + y0 * sy) - bowl * (x0**2 + y0**2) / corner**2


def _half_sides(scene: Scene) -> tuple[float, float]:
    """Return half the width and half the height of the camera's focal plane in arcsec, including all detectors."""
    detectors = camera_detectors.detectors(scene.section.rpartition(".")[2], scene.mission)
    scale, nx, ny = detectors[0].pixel_scale, detectors[0].nx, detectors[0].ny
    return (
        max(abs(d.x) for d in detectors) + scale * nx / 2,
        max(abs(d.y) for d in detectors) + scale * ny / 2,
    )


def _vignetting_pattern(scene: Scene) -> tuple[Frame, Frame]:
    return pattern(scene, scene.nx, scene.ny, scene.value("illumination", ""), (0.0, 0.0))


def _shutter_pattern(scene: Scene) -> tuple[Frame, Frame]:
    return pattern(scene, scene.nx, scene.ny, 0.0, (0.0, _shutter_excess(scene)))


def _shutter_excess(scene: Scene) -> float:
    """Return the relative excess of the exposure time at the upper edge of the focal plane, between -1 and 1.

    It is proportional to 1 / exposure time, because the blades of the shutter have a fixed speed. It is 0 for an
    exposure of 0 seconds.
    """
    time = scene.exposure_time_s
    return float(np.clip(scene.value("shutter_map", "s") / time, -1.0, 1.0)) if time > 0.0 else 0.0


def _brightest_electrons(scene: Scene) -> float:
    return scene.peak_electrons + scene.sky_electrons


EFFECT = Effect(
    "illumination",
    apply,
    _vignetting_pattern,
    lambda scene: abs(scene.value("illumination", "")) * _brightest_electrons(scene),
    cost=5e-3,
    in_place=True,
)
SHUTTER = Effect(
    "shutter",
    apply,
    _shutter_pattern,
    lambda scene: abs(_shutter_excess(scene)) * _brightest_electrons(scene),
    cost=5e-3,
    in_place=True,
)
