"""Split a detector into quadrants or amplifiers in readout order, with prescan and overscan.

A detector is read through its four corners. Between its halves are rows for charge injection. They are not read: light
and cosmic rays that fall there are lost.

Readout order is [E, F, G, H][row, column], where [0, 0] is read first. E is the upper left quadrant, F the upper right,
G the lower right and H the lower left (Euclid Data Product Description Document, LE1 VIS). Columns are prescan, pixels,
overscan; rows are pixels, overscan. Amplifiers of a ground camera follow the table of the detector.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import numpy.typing as npt

from lake_schema.errors import BadInput, OutOfRange
from truesky.render.camera.amplifiers import Layout
from truesky.render.camera.sections import Section, Sections
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

NAMES = "EFGH"
# True for quadrants in the upper half, and in the right half.
_UPPER, _RIGHT = (True, True, False, False), (False, True, True, False)

Number = TypeVar("Number", bound=np.generic)


def apply(
    frame: Frame,
    prescan: int,
    overscan: int,
    rows: int,
    injection_rows: int = 0,
    rng: np.random.Generator | None = None,
) -> Frame:
    """Split a detector into four quadrants in readout order.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    prescan, overscan : int
        Columns before and after the pixels, 0 to 4096.
    rows : int
        Overscan rows after the pixels, 0 to 4096.
    injection_rows : int, optional
        Rows between the halves of the detector, which are not read, 0 to 4096. The number must be even.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape (4, (ny - injection_rows) / 2 + rows, prescan + nx / 2 + overscan)
        Electrons; 0 in prescan and overscan.

    Raises
    ------
    OutOfRange
        If a number of rows or columns is outside its limits.
    BadInput
        If `ny`, `nx` or `injection_rows` is odd, or if `injection_rows` is more than `ny`.
    """
    for name, value in (
        ("prescan", prescan),
        ("overscan", overscan),
        ("overscan rows", rows),
        ("middle rows", injection_rows),
    ):
        if not 0 <= value <= 4096:
            raise OutOfRange(name, value, 0, 4096)
    ny, nx = frame.shape
    if ny % 2 or nx % 2 or injection_rows % 2 or injection_rows > ny:
        raise BadInput(f"a detector of {ny} x {nx} pixels has no quadrants: its sides must be even")
    half_y, half_x = (ny - injection_rows) // 2, nx // 2
    out = np.zeros((4, half_y + rows, prescan + half_x + overscan), frame.dtype)
    for number in range(4):
        y, x = (half_y + injection_rows) * _UPPER[number], half_x * _RIGHT[number]
        part = frame[y : y + half_y, x : x + half_x]
        out[number, :half_y, prescan : prescan + half_x] = to_detector_axes(part, number)
    return out


def to_detector_axes(quadrant: npt.NDArray[Number], number: int) -> npt.NDArray[Number]:
    """Flip a quadrant (ny, nx) from readout order to the axes of the detector, or back."""
    return quadrant[:: -1 if _UPPER[number] else 1, :: -1 if _RIGHT[number] else 1]


def pixel_offset(
    number: int, shape: tuple[int, ...], prescan: int, overscan: int, rows: int, injection_rows: int = 0
) -> tuple[int, int]:
    """Offset between pixel positions on the detector and in a quadrant in detector axes.

    Parameters
    ----------
    number : int
        Index of the quadrant, 0 to 3 for E, F, G, H.
    shape : (int, int)
        Rows and columns of the quadrant, with prescan and overscan.
    prescan, overscan, rows, injection_rows : int
        Same as in `apply`.

    Returns
    -------
    column, row : int
        Offset to add to a position on the detector.
    """
    ny, nx = shape
    across = overscan - (nx - prescan - overscan) if _RIGHT[number] else prescan
    return across, rows - (ny - rows) - injection_rows if _UPPER[number] else 0


def sections(
    number: int, shape: tuple[int, ...], prescan: int, overscan: int, rows: int, injection_rows: int = 0
) -> Sections:
    """Image sections of a quadrant in detector axes.

    Parameters
    ----------
    number : int
        Index of the quadrant, 0 to 3 for E, F, G, H.
    shape : (int, int)
        Rows and columns of the quadrant, with prescan and overscan.
    prescan, overscan, rows, injection_rows : int
        Same as in `apply`.

    Returns
    -------
    Sections
        Sections of the pixels, of their place on the detector, and of the bias (None without overscan).

    Notes
    -----
    The bias is measured in the second half of the overscan columns, because the first half contains charge released
    from traps.
    """
    (ny, nx), (across, up) = shape, pixel_offset(number, shape, prescan, overscan, rows, injection_rows)
    x, y = overscan if _RIGHT[number] else prescan, rows if _UPPER[number] else 0
    data = Section(x, y, nx - prescan - overscan, ny - rows)
    bias_columns = max(overscan // 2, 1)
    bias = Section(0 if _RIGHT[number] else nx - bias_columns, 0, bias_columns, ny) if overscan else None
    return Sections(data, Section(x - across, y - up, data.nx, data.ny), bias)


def assemble(
    quadrants: npt.NDArray[Number], prescan: int, overscan: int, rows: int, injection_rows: int = 0
) -> npt.NDArray[Number]:
    """Combine quadrants in readout order into a detector.

    Parameters
    ----------
    quadrants : array, shape (4, ny, nx)
        Result of `apply`.
    prescan, overscan, rows, injection_rows : int
        Same as in `apply`.

    Returns
    -------
    array, shape (ny, nx)
        Detector without prescan and overscan; 0 in the rows between the halves.
    """
    pixels = [
        to_detector_axes(q[: q.shape[0] - rows, prescan : q.shape[1] - overscan], i) for i, q in enumerate(quadrants)
    ]
    e, f, g, h = pixels
    middle_block = np.zeros((injection_rows, h.shape[1] + g.shape[1]), quadrants.dtype)
    return np.concatenate([np.hstack([h, g]), middle_block, np.hstack([e, f])])


def overscan_sizes(scene: Scene) -> tuple[int, int, int, int]:
    """Return the numbers of prescan columns, overscan columns, overscan rows, and rows between the halves."""
    prescan, overscan, rows = (
        int(scene.value(f"fpa.{key}", "pix")) for key in ("prescan", "overscan", "parallel_overscan")
    )
    return prescan, overscan, rows, scene.injection_rows


def apply_amplifiers(frame: Frame, layout: Layout, rng: np.random.Generator | None = None) -> Frame:
    """Split a detector into amplifiers (q, rows, columns) in readout order, with prescan and overscan.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    layout : Layout
        Amplifiers of the detector.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape (q, rows, columns)
        Electrons. Pixels that are not read are lost.
    """
    return layout.split(frame)


def _layout(scene: Scene) -> tuple[Layout]:
    if scene.layout is None:
        raise BadInput(f"{scene.section}: the detector must have a table of its amplifiers")
    return (scene.layout,)


EFFECT = Effect("quadrants", apply, overscan_sizes, lambda scene: 0.0, optional=False, cost=3e-3)
AMPLIFIERS = Effect("amplifiers", apply_amplifiers, _layout, lambda scene: 0.0, optional=False, cost=3e-3)
