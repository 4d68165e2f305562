"""Split a detector into quadrants or amplifiers, in the order in which pixels are read, with prescan and overscan.

A VIS detector is read through its four corners. Between its halves are rows for charge injection, which are not read:
light and cosmic rays that fall there are lost.

In readout order the axes are [quadrant, row, column], and the pixel at [0, 0] of each quadrant is read first. The
quadrants are H (upper left), G (upper right), F (lower right) and E (lower left). Columns are prescan, pixels and
overscan, in this order; rows are pixels and overscan. The amplifiers of ground cameras are listed in a table of the
detector in the mission database.

The letters follow two programs for Euclid's frames, which agree. The programs give places along the axes of the focal
plane: E is at the lower left in columns 1 to 3 of the grid of CCDs, and at the upper right in columns 4 to 6. CCDs in
columns 4 to 6 are mounted upside down. The quadrant E is therefore at the lower left of every CCD along the axes of the
CCD, which this module uses.

References
----------
Euclid's package SHE_PPT, function get_vis_quadrant, after the charts of the Euclid Data Product Description
Document, LE1 VIS. PyAutoArray, function roe_corner_from.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Int
from lake_schema.errors import BadInput, OutOfRange
from lake_schema.fits.images import Image
from truesky.render.camera.amplifiers import Layout
from truesky.render.camera.sections import Section, Sections
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

# Names of the quadrants in the order of the planes, which is clockwise from the upper left.
NAMES = "HGFE"
# Numbers of the planes in the order of a file's extensions, which is that of the letters: E, F, G and H.
FILE_ORDER = tuple(sorted(range(len(NAMES)), key=NAMES.__getitem__))
# For the quadrants H, G, F and E: True if the quadrant is in the upper half of the detector.
_UPPER = (True, True, False, False)
# For the quadrants H, G, F and E: True if the quadrant is in the right half of the detector.
_RIGHT = (False, True, True, False)

Number = TypeVar("Number", bound=np.generic)


def apply(
    frame: Frame,
    prescan: int,
    overscan: int,
    rows: int,
    injection_rows: int = 0,
    rng: np.random.Generator | None = None,
) -> Frame:
    """Split a frame into the four quadrants H, G, F, E, each flipped so that the pixel at [0, 0] is read first.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    prescan, overscan : int
        Number of columns that are added before and after the pixels of a quadrant, 0 to 4096.
    rows : int
        Number of overscan rows that are added after the pixels of a quadrant, 0 to 4096.
    injection_rows : int, optional
        Number of rows between the halves of the detector, which are not read, 0 to 4096. The number must be even.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape (4, (ny - injection_rows) / 2 + rows, prescan + nx / 2 + overscan)
        Electrons of the quadrants H (upper left), G (upper right), F (lower right) and E (lower left); 0 in prescan and
        overscan.

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


def readout_places(
    pixels: tuple[Int, Int],
    shape: tuple[int, int],
    prescan: int,
    overscan: int,
    rows: int,
    injection_rows: int = 0,
) -> tuple[Int, tuple[int, int, int]]:
    """Return where n pixels of a detector are in the result of `apply`.

    Parameters
    ----------
    pixels : (int64 array, int64 array), each of shape (n,)
        Rows and columns of the pixels on the detector.
    shape : (int, int)
        Number of rows and columns of the detector.
    prescan, overscan : int
        Number of columns that are read before and after the pixels of a quadrant.
    rows : int
        Number of overscan rows that are read after the pixels of a quadrant.
    injection_rows : int, optional
        Number of rows between the halves of the detector, which are not read.

    Returns
    -------
    places : int64 array, shape (n, 3)
        Quadrant, row and column of each pixel; -1 for pixels that are not read.
    shape : (int, int, int)
        Shape of the result of `apply`.
    """
    (row, column), (ny, nx) = pixels, shape
    half_y, half_x = (ny - injection_rows) // 2, nx // 2
    is_upper, is_right = row >= half_y + injection_rows, column >= half_x
    quadrant = np.where(is_upper, is_right, 3 - is_right)
    place_row = np.where(is_upper, ny - 1 - row, row)
    places = np.column_stack([quadrant, place_row, prescan + np.where(is_right, nx - 1 - column, column)])
    places[(row >= half_y) & ~is_upper] = -1
    return places, (4, half_y + rows, prescan + half_x + overscan)


def to_detector_axes(quadrant: npt.NDArray[Number], number: int) -> npt.NDArray[Number]:
    """Flip a quadrant [ny, nx] from readout order (pixel [0, 0] read first) to the axes of the detector, or back.

    `number` is the index of the quadrant: 0 upper left, 1 upper right, 2 lower right, 3 lower left. The result is a
    view that shares the memory of `quadrant`.
    """
    return quadrant[:: -1 if _UPPER[number] else 1, :: -1 if _RIGHT[number] else 1]


def quadrant_of_pixel(column: int, row: int, nx: int, ny: int) -> int:
    """Find the quadrant that reads a pixel.

    Parameters
    ----------
    column, row : int
        Place of the pixel, from 0.
    nx, ny : int
        Number of columns and of rows of the detector.

    Returns
    -------
    int
        0 to 3 for H, G, F, E. Rows between the halves, which are not read, count to the nearer half.
    """
    return number_of_place(row >= ny / 2, column >= nx / 2)


def number_of_place(is_upper: bool, is_right: bool) -> int:
    """Return the index of the quadrant in the upper or lower and in the right or left half of the detector, 0 to 3."""
    return next(n for n, half in enumerate(zip(_UPPER, _RIGHT, strict=True)) if half == (is_upper, is_right))


def in_plane_order(extensions: Sequence[Image]) -> list[Image]:
    """Sort the extensions of a detector's file in the order of its amplifiers, which is that of the planes of an array.

    Only quadrants have another order in files. Their order is found from their sections on the detector (CCDSEC), not
    from their letters, so that files of earlier versions with other letters are read, too.
    """

    def number(extension: Image) -> int:
        text = next(value for keyword, value, _ in extension.cards if keyword == "CCDSEC")
        section = Section.from_text(str(text))
        return number_of_place(section.y > 0, section.x > 0)

    has_quadrants = all("QUADRANT" in {keyword for keyword, *_ in extension.cards} for extension in extensions)
    return sorted(extensions, key=number) if has_quadrants else list(extensions)


def pixel_offset(
    number: int, shape: tuple[int, ...], prescan: int, overscan: int, rows: int, injection_rows: int = 0
) -> tuple[int, int]:
    """Return the offset from pixel positions on the detector to positions in the image of a quadrant.

    The image includes prescan and overscan, and is oriented as on the detector.

    Parameters
    ----------
    number : int
        Index of the quadrant, 0 to 3 for H, G, F, E.
    shape : (int, int)
        Rows and columns of the quadrant, with prescan and overscan.
    prescan, overscan : int
        Number of columns that are read before and after the pixels.
    rows : int
        Number of overscan rows that are read after the pixels.
    injection_rows : int, optional
        Number of rows between the halves of the detector, which are not read.

    Returns
    -------
    column, row : int
        Number of columns and of rows to add to a position on the detector.
    """
    ny, nx = shape
    across = overscan - (nx - prescan - overscan) if _RIGHT[number] else prescan
    return across, rows - (ny - rows) - injection_rows if _UPPER[number] else 0


def sections(
    number: int, shape: tuple[int, ...], prescan: int, overscan: int, rows: int, injection_rows: int = 0
) -> Sections:
    """Return the sections of a quadrant's image for its FITS header: pixels, their place on the detector, and bias.

    The image includes prescan and overscan, and is oriented as on the detector.

    Parameters
    ----------
    number : int
        Index of the quadrant, 0 to 3 for H, G, F, E.
    shape : (int, int)
        Rows and columns of the quadrant, with prescan and overscan.
    prescan, overscan : int
        Number of columns that are read before and after the pixels.
    rows : int
        Number of overscan rows that are read after the pixels.
    injection_rows : int, optional
        Number of rows between the halves of the detector, which are not read.

    Returns
    -------
    Sections
        Section of the pixels in the image, section of the same pixels on the detector, and section of columns that
        measure the bias (None without overscan).

    Notes
    -----
    The bias is measured in those overscan columns that are read last, the second half, because the first half contains
    charge released from traps.
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
    """Combine the four quadrants of a detector, in readout order, to one image.

    Parameters
    ----------
    quadrants : array, shape (4, ny, nx)
        Quadrants H, G, F, E with prescan and overscan, the result of `apply`.
    prescan, overscan : int
        Number of columns before and after the pixels of a quadrant.
    rows : int
        Number of overscan rows after the pixels of a quadrant.
    injection_rows : int, optional
        Number of rows between the halves of the detector, which are not read.

    Returns
    -------
    array, shape (ny, nx)
        Image of the detector without prescan and overscan; 0 in the rows between the halves.
    """
    pixels = [
        to_detector_axes(q[: q.shape[0] - rows, prescan : q.shape[1] - overscan], i) for i, q in enumerate(quadrants)
    ]
    upper_left, upper_right, lower_right, lower_left = pixels
    middle_block = np.zeros((injection_rows, lower_left.shape[1] + lower_right.shape[1]), quadrants.dtype)
    return np.concatenate([np.hstack([lower_left, lower_right]), middle_block, np.hstack([upper_left, upper_right])])


def overscan_sizes(scene: Scene) -> tuple[int, int, int, int]:
    """Return the sizes with which the detector of a scene is split into quadrants by `apply`.

    They are the numbers of prescan columns, overscan columns, overscan rows, and rows between the halves of the
    detector.
    """
    prescan, overscan, rows = (
        int(scene.value(f"fpa.{key}", "pix")) for key in ("prescan", "overscan", "parallel_overscan")
    )
    return prescan, overscan, rows, scene.injection_rows


def apply_amplifiers(frame: Frame, layout: Layout, rng: np.random.Generator | None = None) -> Frame:
    """Split a frame into the amplifiers of a ground camera's detector, each with the pixel at [0, 0] read first.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    layout : Layout
        Pixels that each of the q amplifiers reads, and numbers of prescan columns, overscan columns and overscan rows.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape (q, rows, columns)
        Electrons; 0 in prescan and overscan. Pixels that no amplifier reads are lost.

    Raises
    ------
    BadInput
        If the frame does not have the size of the detector.
    """
    return layout.split(frame)


def _layout(scene: Scene) -> tuple[Layout]:
    if scene.layout is None:
        raise BadInput(f"{scene.section}: the detector must have a table of its amplifiers")
    return (scene.layout,)


EFFECT = Effect("quadrants", apply, overscan_sizes, lambda scene: 0.0, optional=False, cost=3e-3)
AMPLIFIERS = Effect("amplifiers", apply_amplifiers, _layout, lambda scene: 0.0, optional=False, cost=3e-3)
