"""Sections (rectangles of pixels) of an array, of a detector and of the mosaic of a camera, as in FITS headers.

References
----------
NOAO, mosaic data structures (Valdes 1998): DATASEC, BIASSEC, TRIMSEC, CCDSEC, DETSEC, DETSIZE.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Int
from truesky.numerics import matrices
from truesky.render.camera.detectors import Detector


@dataclass(frozen=True, slots=True)
class Section:
    """Rectangle of an array: columns x to x + nx - 1 and rows y to y + ny - 1, counted from 0."""

    x: int
    y: int
    nx: int
    ny: int

    @property
    def text(self) -> str:
        """Text of the rectangle for a FITS header, "[x1:x2,y1:y2]", counted from 1 and with both ends included."""
        return f"[{self.x + 1}:{self.x + self.nx},{self.y + 1}:{self.y + self.ny}]"

    def text_along(self, steps: tuple[int, int]) -> str:
        """Return the text of the rectangle for a FITS header, with decreasing numbers along axes with the step -1.

        `steps` has 1 or -1 for columns and for rows. For example, "[512:1,1:100]" has the steps (-1, 1).
        """
        columns, rows = (
            (low + 1, low + n)[::step] for low, n, step in zip((self.x, self.y), (self.nx, self.ny), steps, strict=True)
        )
        return f"[{columns[0]}:{columns[1]},{rows[0]}:{rows[1]}]"

    @property
    def slices(self) -> tuple[slice, slice]:
        """Slices (rows, columns) that select the rectangle from an array [rows, columns]."""
        return slice(self.y, self.y + self.ny), slice(self.x, self.x + self.nx)

    def contains(self, column: int, row: int) -> bool:
        """Return True if the rectangle contains a pixel, counted from 0."""
        return self.x <= column < self.x + self.nx and self.y <= row < self.y + self.ny

    @classmethod
    def from_text(cls, text: str) -> Section:
        """Create a rectangle from the text of a FITS header, "[x1:x2,y1:y2]", counted from 1.

        Numbers may decrease along an axis; `steps_of_text` tells this. ValueError is raised if the text has another
        form.
        """
        (x, last_x), (y, last_y) = (sorted(ends) for ends in _ends_of_text(text))
        return cls(x - 1, y - 1, last_x - x + 1, last_y - y + 1)


def steps_of_text(text: str) -> tuple[int, int]:
    """Return 1 or -1 for columns and for rows: -1 if the numbers in the text of a FITS section decrease.

    The text has the form "[x1:x2,y1:y2]"; ValueError is raised otherwise.
    """
    columns, rows = (1 if first <= last else -1 for first, last in _ends_of_text(text))
    return columns, rows


def _ends_of_text(text: str) -> list[tuple[int, int]]:
    (x_first, x_last), (y_first, y_last) = (map(int, part.split(":")) for part in text.strip("[] ").split(","))
    return [(x_first, x_last), (y_first, y_last)]


@dataclass(frozen=True, slots=True)
class Sections:
    """Parts of an array, such as the image of an amplifier.

    Attributes
    ----------
    data : Section
        Rectangle of the array that contains pixels of the detector (FITS: DATASEC).
    ccd : Section
        Rectangle of the detector that contains the same pixels (FITS: CCDSEC).
    bias : Section or None
        Columns of the array without light that give its bias level, in all rows (FITS: BIASSEC). None if the array has
        no such columns.
    steps : (int, int)
        Steps on the detector, 1 or -1, from one column and from one row of the array to the next. The default (1, 1) is
        an array with the orientation of the detector.
    """

    data: Section
    ccd: Section
    bias: Section | None = None
    steps: tuple[int, int] = (1, 1)

    @classmethod
    def full_frame(cls, nx: int, ny: int) -> Sections:
        """Return the sections of an array that contains all pixels of a detector and nothing else."""
        section = Section(0, 0, nx, ny)
        return cls(section, section)


def to_mosaic_section(
    detector: Detector, section: Section, detectors: Sequence[Detector], steps: tuple[int, int] = (1, 1)
) -> str | None:
    """Convert a rectangle of a detector to pixels of the camera's mosaic, whose pixel grid continues across the gaps.

    Parameters
    ----------
    detector : Detector
        The detector.
    section : Section
        Rectangle of pixels of the detector.
    detectors : sequence of Detector
        All detectors of the camera. The mosaic has the orientation and the parity of most detectors. It begins at the
        lowest column and row of any detector.
    steps : (int, int), optional
        Steps on the detector, 1 or -1, from one column and from one row of the array to the next.

    Returns
    -------
    str or None
        Text "[x1:x2,y1:y2]" for a FITS header, counted from 1. Numbers decrease along axes in which the array is read
        in the opposite direction, or in which the detector runs against the mosaic. None if the detector is turned by
        90 deg relative to the mosaic, because its columns are rows of the mosaic.

    Notes
    -----
    Positions are rounded to whole pixels, an error of up to half a pixel, and rotations to quarter turns.
    """
    mosaic = _mosaic_axes(detectors)
    directions = matrices.matmul(mosaic.T, _quarter_axes(_orientation(detector)))
    if directions[0, 0] == 0.0:
        return None
    x_offset, y_offset = (
        round(position - first)
        for position, first in zip(_corner(detector, mosaic), _mosaic_origin(detectors, mosaic), strict=True)
    )
    columns = (section.x + 1, section.x + section.nx)[:: steps[0]]
    rows = (section.y + 1, section.y + section.ny)[:: steps[1]]
    if directions[0, 0] < 0.0:
        columns = detector.nx + 1 - columns[0], detector.nx + 1 - columns[1]
    if directions[1, 1] < 0.0:
        rows = detector.ny + 1 - rows[0], detector.ny + 1 - rows[1]
    return f"[{x_offset + columns[0]}:{x_offset + columns[1]},{y_offset + rows[0]}:{y_offset + rows[1]}]"


def mosaic_size(detectors: Sequence[Detector]) -> str:
    """Return the size of the mosaic of a camera's detectors as text for the FITS card DETSIZE: "[1:columns,1:rows]"."""
    mosaic = _mosaic_axes(detectors)
    right, top = (
        max(round(_corner(d, mosaic)[axis] - first) + _sides(d, mosaic)[axis] for d in detectors)
        for axis, first in enumerate(_mosaic_origin(detectors, mosaic))
    )
    return f"[1:{right},1:{top}]"


def _orientation(detector: Detector) -> tuple[bool, int]:
    """Return the parity of a detector (True if it is mirrored) and its rotation in quarter turns, 0 to 3."""
    return detector.is_mirrored, round(detector.rotation / 90.0) % 4


def _quarter_axes(orientation: tuple[bool, int]) -> Int:
    """Return the directions of columns and rows, `Detector.axes`, for a result of `_orientation`, in whole numbers."""
    is_mirrored, turns = orientation
    cosine, sine = (1, 0, -1, 0)[turns], (0, 1, 0, -1)[turns]
    sign = -1 if is_mirrored else 1
    return np.array([[cosine, -sign * sine], [sine, sign * cosine]])


def _mosaic_axes(detectors: Sequence[Detector]) -> Int:
    """Return the directions of columns and rows of the mosaic (image of all detectors of a camera) in the focal plane.

    They are the axes of the focal plane if the columns of most detectors run along its x axis, in either direction, and
    these detectors are not mirrored. Otherwise they are the axes of most detectors with the most frequent parity and
    with columns along the same line. If two opposite rotations are equally frequent, the smaller one is taken.
    """
    counts = Counter((is_mirrored, turns % 2) for is_mirrored, turns in map(_orientation, detectors))
    is_mirrored, line = max(sorted(counts), key=lambda orientation: counts[orientation])
    if not is_mirrored:
        return _quarter_axes((False, line))
    both = Counter(_orientation(d) for d in detectors)
    return _quarter_axes(max(((True, line), (True, line + 2)), key=lambda orientation: both[orientation]))


def _sides(detector: Detector, mosaic: Int) -> tuple[int, int]:
    """Return how many columns and rows of a mosaic, given by its axes, a detector covers."""
    is_along = matrices.matmul(mosaic.T, _quarter_axes(_orientation(detector)))[0, 0] != 0.0
    return (detector.nx, detector.ny) if is_along else (detector.ny, detector.nx)


def _corner(detector: Detector, mosaic: Int) -> tuple[float, float]:
    """Return the lower left corner (x, y) of a detector in a mosaic with given axes, in pixels from the boresight."""
    nx, ny = _sides(detector, mosaic)
    # One of both products is 0.
    x, y = (float(axis[0] * detector.x + axis[1] * detector.y) for axis in mosaic.T)
    return x / detector.pixel_scale - nx / 2, y / detector.pixel_scale - ny / 2


def _mosaic_origin(detectors: Sequence[Detector], mosaic: Int) -> tuple[float, float]:
    corners = [_corner(d, mosaic) for d in detectors]
    return min(x for x, _ in corners), min(y for _, y in corners)
