"""Sections of an array, a detector and the mosaic of a camera, as in FITS headers.

References
----------
NOAO, mosaic data structures (Valdes 1998): DATASEC, BIASSEC, TRIMSEC, CCDSEC, DETSEC, DETSIZE.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from truesky.render.camera.detectors import Detector

# Rotations, in quarter turns, for which the columns of a detector are columns of the mosaic.
_ALONG = (0, 2)


@dataclass(frozen=True, slots=True)
class Section:
    """Columns x to x + nx and rows y to y + ny of an array, counted from 0."""

    x: int
    y: int
    nx: int
    ny: int

    @property
    def text(self) -> str:
        """Text for a FITS header, counted from 1, with inclusive ends."""
        return f"[{self.x + 1}:{self.x + self.nx},{self.y + 1}:{self.y + self.ny}]"

    @property
    def slices(self) -> tuple[slice, slice]:
        """Slices for an array [rows, columns]."""
        return slice(self.y, self.y + self.ny), slice(self.x, self.x + self.nx)

    @classmethod
    def from_text(cls, text: str) -> Section:
        """Read a section from the text of a FITS header."""
        (x, past_x), (y, past_y) = (map(int, part.split(":")) for part in text.strip("[] ").split(","))
        return cls(x - 1, y - 1, past_x - x + 1, past_y - y + 1)


@dataclass(frozen=True, slots=True)
class Sections:
    """Sections of an array that has the orientation of the detector.

    Attributes
    ----------
    data : Section
        Pixels of the detector in the array.
    ccd : Section
        The same pixels on the detector.
    bias : Section or None
        Columns without light, in all rows of the array, that give its bias level; None if it has no such columns.
    """

    data: Section
    ccd: Section
    bias: Section | None = None

    @classmethod
    def full_frame(cls, nx: int, ny: int) -> Sections:
        """Sections of an array that contains all pixels of a detector and nothing else."""
        section = Section(0, 0, nx, ny)
        return cls(section, section)


def to_mosaic_section(detector: Detector, section: Section, detectors: Sequence[Detector]) -> str | None:
    """Convert a section of a detector to the mosaic, whose pixel grid continues across the gaps.

    Parameters
    ----------
    detector : Detector
        The detector.
    section : Section
        Section of its pixels.
    detectors : sequence of Detector
        Detectors of its camera. The mosaic has the orientation of most of them and begins at the first corner.

    Returns
    -------
    str or None
        Section in the mosaic, from high to low if the detector is mounted upside down. None if the detector is turned
        by 90 deg, since its columns are rows of the mosaic.

    Notes
    -----
    Positions are rounded to whole pixels, an error of up to half a pixel, and rotations to quarter turns.
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
    """Size of the mosaic of these detectors, as the card DETSIZE."""
    aligned = _align_to_mosaic(detectors)
    right, top = (
        max(round(_corner(d)[axis] - first) + _sides(d)[axis] for d in aligned)
        for axis, first in enumerate(_mosaic_origin(aligned))
    )
    return f"[1:{right},1:{top}]"


def _align_to_mosaic(detectors: Sequence[Detector]) -> Sequence[Detector]:
    """Return the detectors in the focal plane's axes, or in axes turned by 90 deg if most detectors lie along these."""
    if 2 * sum(_quarter_turns(d) in _ALONG for d in detectors) >= len(detectors):
        return detectors
    return [replace(d, x=d.y, y=-d.x, rotation=d.rotation - 90.0) for d in detectors]


def _quarter_turns(detector: Detector) -> int:
    return round(detector.rotation / 90.0) % 4


def _sides(detector: Detector) -> tuple[int, int]:
    """Columns and rows that the detector covers in the mosaic."""
    along = _quarter_turns(detector) in _ALONG
    return (detector.nx, detector.ny) if along else (detector.ny, detector.nx)


def _corner(detector: Detector) -> tuple[float, float]:
    """Position of the detector's first corner, pixels."""
    nx, ny = _sides(detector)
    return detector.x / detector.pixel_scale - nx / 2, detector.y / detector.pixel_scale - ny / 2


def _mosaic_origin(detectors: Sequence[Detector]) -> tuple[float, float]:
    corners = [_corner(d) for d in detectors]
    return min(x for x, _ in corners), min(y for _, y in corners)
