"""Quadrants: a detector is read through its four corners, each with its own pre- and overscan.

Between the halves of a detector lie rows of charge injection. They are not read: what of light or cosmic rays falls
there ends here.

Readout order: [E, F, G, H][row, column], where [0, 0] is read first. E lies upper left, F upper right, G lower right,
H lower left (Euclid Data Product Description Document, LE1 VIS). Columns: prescan, pixels, overscan; rows: pixels,
overscan.

apply, EFFECT    detector -> quadrants in readout order, no charge outside the pixels
AMPLIFIERS       the same of a ground camera's detector, whose amplifiers its table lays out
placed           one quadrant in readout order -> as it lies on the detector, and back
sections         which of its pixels are the detector's, which tell the bias
assembled        quadrants -> detector, without pre- and overscan
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
# Whether a quadrant lies in the upper half, in the right half.
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
    """frame [ny, nx] e- -> quadrants [4, (ny - middle) / 2 + rows, prescan + nx / 2 + overscan] e-.

    prescan, overscan, rows : columns before and after the pixels, and rows after them;  rng : not used
    middle                  : rows between the halves, which have no pixels
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
    """A quadrant [ny, nx] in readout order -> in the detector's own axes; applied twice it is itself."""
    return quadrant[:: -1 if _UPPER[number] else 1, :: -1 if _RIGHT[number] else 1]


def pixel_offset(
    number: int, shape: tuple[int, ...], prescan: int, overscan: int, rows: int, injection_rows: int = 0
) -> tuple[int, int]:
    """What is added to a detector's (column, row) to find it in a quadrant [ny, nx] as it is `placed`.

    number : of the quadrant;  shape : ny, nx of it
    prescan, overscan, rows, middle : as of `apply`
    """
    ny, nx = shape
    across = overscan - (nx - prescan - overscan) if _RIGHT[number] else prescan
    return across, rows - (ny - rows) - injection_rows if _UPPER[number] else 0


def sections(
    number: int, shape: tuple[int, ...], prescan: int, overscan: int, rows: int, injection_rows: int = 0
) -> Sections:
    """Of a quadrant [ny, nx] as it is `placed`: the bias from the last half of its overscan.

    Charge that traps gave back is in the first half.

    number : of the quadrant;  shape : ny, nx of it
    prescan, overscan, rows, middle : as of `apply`
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
    """Quadrants [4, ..] in readout order -> detector [ny, nx], pre- and overscan cut off, 0 in the rows between.

    quadrants                       : of `apply`
    prescan, overscan, rows, middle : as of `apply`
    """
    pixels = [
        to_detector_axes(q[: q.shape[0] - rows, prescan : q.shape[1] - overscan], i) for i, q in enumerate(quadrants)
    ]
    e, f, g, h = pixels
    middle_block = np.zeros((injection_rows, h.shape[1] + g.shape[1]), quadrants.dtype)
    return np.concatenate([np.hstack([h, g]), middle_block, np.hstack([e, f])])


def overscan_sizes(scene: Scene) -> tuple[int, int, int, int]:
    """prescan, overscan, overscan rows, rows between the halves."""
    prescan, overscan, rows = (
        int(scene.value(f"fpa.{key}", "pix")) for key in ("prescan", "overscan", "parallel_overscan")
    )
    return prescan, overscan, rows, scene.injection_rows


def apply_amplifiers(frame: Frame, layout: Layout, rng: np.random.Generator | None = None) -> Frame:
    """frame [ny, nx] e- -> [q, rows, columns] e- in readout order, with pre- and overscan; what is not read is lost.

    own : the detector's amplifiers;  rng : not used
    """
    return layout.split(frame)


def _layout(scene: Scene) -> tuple[Layout]:
    if scene.layout is None:
        raise BadInput(f"{scene.section}: a detector without a table of its amplifiers is not read through them")
    return (scene.layout,)


EFFECT = Effect("quadrants", apply, overscan_sizes, lambda scene: 0.0, optional=False, cost=3e-3)
AMPLIFIERS = Effect("amplifiers", apply_amplifiers, _layout, lambda scene: 0.0, optional=False, cost=3e-3)
