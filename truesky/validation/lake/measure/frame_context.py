"""What a check of images is given: a frame, its references, and what several checks measure of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from truesky.validation.lake.measure import blank_sky, frames, stars
from truesky.validation.lake.measure.blank_sky import Tiles
from truesky.validation.lake.measure.frames import Frame, Instrument
from truesky.validation.lake.measure.references import Reference
from truesky.validation.lake.measure.rows import Place, Row, not_applicable
from truesky.validation.lake.measure.stars import StarMeasurements

SKY_TYPES = ("science", "deep", "self_calibration")
DISPERSED = "NISP-S"
RAMPS = ("NISP-P", "NISP-S")


@dataclass(frozen=True, slots=True, eq=False)
class PartnerFrame:
    """Another frame of the same detector: its file, its exposure, and what is known of its sources."""

    path: Path
    exposure_id: int
    sources: Reference


@dataclass(slots=True, eq=False)
class FrameContext:
    """A frame and what is known of it.

    noise, tiles, measured : of its blank sky and its stars; None where it does not show any
    spectra : rows of `rendered_spectra` of a dispersed frame, of first orders at least
    before  : another frame that the gain is told with, None where it is not
    """

    place: Place
    frame: Frame
    sources: Reference
    spectra: Any = None
    noise: float = 0.0
    tiles: Tiles | None = None
    measurements: StarMeasurements | None = None
    partner: PartnerFrame | None = None
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
class FrameCheck:
    """A check of one frame.

    source  : where its expectation is from
    applies : "" where the frame has what it wants, else why not
    rows    : measures
    """

    name: str
    source: str
    why_not_applicable: Callable[[FrameContext], str]
    measure: Callable[[FrameContext], list[Row]]

    def run(self, context: FrameContext) -> list[Row]:
        """Its rows; one that says why where it does not apply."""
        why = self.why_not_applicable(context)
        return [not_applicable(self.name, context.place, why, self.source)] if why else self.measure(context)


@dataclass(frozen=True, slots=True)
class ExposureCheck:
    """A check of all frames together: name, where its expectations are from, and what it makes of their results."""

    name: str
    source: str
    rows: Callable[[Sequence[Result]], list[Row]]


def measure_frame(
    path: Path, place: Place, sources: Reference, spectra: Any = None, instrument: Instrument | None = None
) -> FrameContext:
    """Open a file and measure what several checks want.

    path  : of the science file;  place : what it is of;  known : its sources;  spectra : of `Seen`
    instrument : that took it, None = linear and even
    """
    frame = frames.open_frame(path, instrument)
    context = FrameContext(place, frame, sources, spectra)
    if context.sees_sky or spectra is not None:
        context.noise = blank_sky.rough_noise(frame)
    if context.sees_sky and context.channel != DISPERSED:
        context.tiles = blank_sky.tiles(frame, sources, context.noise)
        context.measurements = stars.measure_stars(frame, sources, context.noise)
    return context


def require_stars(min_stars: int) -> Callable[[FrameContext], str]:
    """Of a check that wants so many stars."""

    def why_not_applicable(context: FrameContext) -> str:
        if context.measurements is None:
            return "no direct image of the sky"
        n = len(context.measurements.stars)
        return "" if n >= min_stars else f"{n} stars that are alone, bright and not saturated; {min_stars} are wanted"

    return why_not_applicable


def require_blank_sky(context: FrameContext) -> str:
    """Of a check that wants blank sky."""
    if context.tiles is None:
        return "no direct image of the sky"
    return "" if len(context.tiles.row) > 1 else "no blank sky between its sources"


def all_rows(checks: Sequence[FrameCheck], context: FrameContext) -> list[Row]:
    """Rows of all checks of a frame."""
    return [row for check in checks for row in check.run(context)]
