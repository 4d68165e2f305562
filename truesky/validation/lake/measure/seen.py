"""What a check of images is given: a frame, its references, and what several checks measure of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from truesky.validation.lake.measure import blank, frames, stars
from truesky.validation.lake.measure.blank import Tiles
from truesky.validation.lake.measure.frames import Frame, Instrument
from truesky.validation.lake.measure.references import Reference
from truesky.validation.lake.measure.rows import Place, Row, not_applicable
from truesky.validation.lake.measure.stars import Measured

SKY_TYPES = ("science", "deep", "self_calibration")
DISPERSED = "NISP-S"
RAMPS = ("NISP-P", "NISP-S")


@dataclass(frozen=True, slots=True, eq=False)
class Before:
    """Another frame of the same detector: its file, its exposure, and what is known of its sources."""

    path: Path
    exposure_id: int
    known: Reference


@dataclass(slots=True, eq=False)
class Seen:
    """A frame and what is known of it.

    noise, tiles, measured : of its blank sky and its stars; None where it does not show any
    spectra : rows of `rendered_spectra` of a dispersed frame, of first orders at least
    before  : another frame that the gain is told with, None where it is not
    """

    place: Place
    frame: Frame
    known: Reference
    spectra: Any = None
    noise: float = 0.0
    tiles: Tiles | None = None
    measured: Measured | None = None
    before: Before | None = None
    series: dict[str, Any] = field(default_factory=dict)

    @property
    def channel(self) -> str:
        return str(self.frame.header["CHANNEL"])

    @property
    def sees_sky(self) -> bool:
        return self.frame.header["IMAGETYP"] in SKY_TYPES


@dataclass(frozen=True, slots=True)
class Result:
    """Of one frame: its rows, and numbers that figures and checks of several frames want."""

    place: Place
    rows: list[Row]
    series: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Check:
    """A check of one frame.

    source  : where its expectation is from
    applies : "" where the frame has what it wants, else why not
    rows    : measures
    """

    name: str
    source: str
    applies: Callable[[Seen], str]
    rows: Callable[[Seen], list[Row]]

    def of(self, seen: Seen) -> list[Row]:
        """Its rows; one that says why where it does not apply."""
        why = self.applies(seen)
        return [not_applicable(self.name, seen.place, why, self.source)] if why else self.rows(seen)


@dataclass(frozen=True, slots=True)
class Several:
    """A check of all frames together: name, where its expectations are from, and what it makes of their results."""

    name: str
    source: str
    rows: Callable[[Sequence[Result]], list[Row]]


def seen(path: Path, place: Place, known: Reference, spectra: Any = None, instrument: Instrument | None = None) -> Seen:
    """Open a file and measure what several checks want.

    path  : of the science file;  place : what it is of;  known : its sources;  spectra : of `Seen`
    instrument : that took it, None = linear and even
    """
    frame = frames.opened(path, instrument)
    found = Seen(place, frame, known, spectra)
    if found.sees_sky or spectra is not None:
        found.noise = blank.rough_noise(frame)
    if found.sees_sky and found.channel != DISPERSED:
        found.tiles = blank.tiles(frame, known, found.noise)
        found.measured = stars.measured(frame, known, found.noise)
    return found


def wants_stars(least: int) -> Callable[[Seen], str]:
    """Of a check that wants so many stars."""

    def why(of: Seen) -> str:
        if of.measured is None:
            return "no direct image of the sky"
        n = len(of.measured.stars)
        return "" if n >= least else f"{n} stars that are alone, bright and not saturated; {least} are wanted"

    return why


def wants_blank(of: Seen) -> str:
    """Of a check that wants blank sky."""
    if of.tiles is None:
        return "no direct image of the sky"
    return "" if len(of.tiles.row) > 1 else "no blank sky between its sources"


def all_rows(checks: Sequence[Check], of: Seen) -> list[Row]:
    """Rows of all checks of a frame."""
    return [row for check in checks for row in check.of(of)]
