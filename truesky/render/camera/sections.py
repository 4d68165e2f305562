"""Where the pixels of an array are: sections as FITS headers write them, of the array, the detector and the mosaic.

Section    a rectangle of an array
Sections   which of an array's pixels are the detector's, which tell the bias
in_mosaic  a section of a detector -> of the picture that all detectors of its camera are laid out on

Ref : NOAO, mosaic data structures (Valdes 1998): DATASEC, BIASSEC, TRIMSEC, CCDSEC, DETSEC, DETSIZE
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from truesky.render.camera.detectors import Detector

# Quarters of a turn by which columns lie along the mosaic's columns.
_ALONG = (0, 2)


@dataclass(frozen=True, slots=True)
class Section:
    """Columns x to x + nx and rows y to y + ny of an array, from 0."""

    x: int
    y: int
    nx: int
    ny: int

    @property
    def text(self) -> str:
        """As FITS headers have it: from 1, the last one included."""
        return f"[{self.x + 1}:{self.x + self.nx},{self.y + 1}:{self.y + self.ny}]"

    @property
    def slices(self) -> tuple[slice, slice]:
        """Of an array [rows, columns]."""
        return slice(self.y, self.y + self.ny), slice(self.x, self.x + self.nx)

    @classmethod
    def from_text(cls, text: str) -> Section:
        """From a header's text."""
        (x, past_x), (y, past_y) = (map(int, part.split(":")) for part in text.strip("[] ").split(","))
        return cls(x - 1, y - 1, past_x - x + 1, past_y - y + 1)


@dataclass(frozen=True, slots=True)
class Sections:
    """Of an array in the detector's own axes.

    data : the detector's pixels;  ccd : the same, on the detector
    bias : columns that no light reaches, in all rows of the array, which tell its level; None: there are none
    """

    data: Section
    ccd: Section
    bias: Section | None = None

    @classmethod
    def full_frame(cls, nx: int, ny: int) -> Sections:
        """Of an array that is the detector's pixels."""
        section = Section(0, 0, nx, ny)
        return cls(section, section)


def to_mosaic_section(detector: Detector, section: Section, detectors: Sequence[Detector]) -> str | None:
    """A section of a detector's pixels as the mosaic's, whose pixels go on where the gaps are.

    every   : detectors of its camera, along most of which the mosaic's columns are, and whose first corner is its
    returns : from high to low where the detector is mounted upside down; None where it lies across: what are its
              columns there are no columns here
    Error   : half a pixel, and what detectors are turned by besides quarters of a turn
    """
    aligned_detector, *aligned_camera = _align_to_mosaic((detector, *detectors))
    if _quarter_turns(aligned_detector) not in _ALONG:
        return None
    x_offset, y_offset = (
        round(position - first)
        for position, first in zip(_corner(aligned_detector), _mosaic_origin(aligned_camera), strict=True)
    )
    columns, rows = (section.x + 1, section.x + section.nx), (section.y + 1, section.y + section.ny)
    if aligned_detector.upside_down:
        columns, rows = (
            (size + 1 - first, size + 1 - last) for size, (first, last) in ((detector.nx, columns), (detector.ny, rows))
        )
    return f"[{x_offset + columns[0]}:{x_offset + columns[1]},{y_offset + rows[0]}:{y_offset + rows[1]}]"


def mosaic_size(detectors: Sequence[Detector]) -> str:
    """The mosaic of these detectors as DETSIZE."""
    aligned = _align_to_mosaic(detectors)
    right, top = (
        max(round(_corner(d)[axis] - first) + _sides(d)[axis] for d in aligned)
        for axis, first in enumerate(_mosaic_origin(aligned))
    )
    return f"[1:{right},1:{top}]"


def _align_to_mosaic(detectors: Sequence[Detector]) -> Sequence[Detector]:
    """Detectors on axes along which most of them lie: those of the focal plane, or a quarter of a turn from them."""
    if 2 * sum(_quarter_turns(d) in _ALONG for d in detectors) >= len(detectors):
        return detectors
    return [replace(d, x=d.y, y=-d.x, rotation=d.rotation - 90.0) for d in detectors]


def _quarter_turns(detector: Detector) -> int:
    return round(detector.rotation / 90.0) % 4


def _sides(detector: Detector) -> tuple[int, int]:
    """Columns and rows of the mosaic that it fills."""
    along = _quarter_turns(detector) in _ALONG
    return (detector.nx, detector.ny) if along else (detector.ny, detector.nx)


def _corner(detector: Detector) -> tuple[float, float]:
    """Where it begins, pixels."""
    nx, ny = _sides(detector)
    return detector.x / detector.pixel_scale - nx / 2, detector.y / detector.pixel_scale - ny / 2


def _mosaic_origin(detectors: Sequence[Detector]) -> tuple[float, float]:
    corners = [_corner(d) for d in detectors]
    return min(x for x, _ in corners), min(y for _, y in corners)
