"""Input of the checks of images: a frame, its references, and measurements that several checks share."""

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
    """Another frame of the same detector.

    Attributes
    ----------
    path : Path
        Science file.
    exposure_id : int
        Exposure.
    sources : Reference
        Known sources of the frame.
    """

    path: Path
    exposure_id: int
    sources: Reference


@dataclass(slots=True, eq=False)
class FrameContext:
    """A frame with its references and measurements.

    Attributes
    ----------
    place : Place
        Channel, band, exposure and detector.
    frame : Frame
        The frame.
    sources : Reference
        Known sources.
    spectra : Table, optional
        Rows of `rendered_spectra`, at least those of first orders; only for dispersed frames.
    noise : float
        rms of a pixel of blank sky, e-; 0 if not measured.
    tiles : Tiles, optional
        Tiles of blank sky; only for direct images of the sky.
    measurements : StarMeasurements, optional
        Measured stars; only for direct images of the sky.
    partner : PartnerFrame, optional
        Another frame with which the gain is measured.
    series : dict of str to object
        Numbers for figures and for checks of several frames, added by the checks.
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
        """Channel of the frame, from its header."""
        return str(self.frame.header["CHANNEL"])

    @property
    def sees_sky(self) -> bool:
        """True for images of the sky, not of lamps or darks."""
        return self.frame.header["IMAGETYP"] in SKY_TYPES


@dataclass(frozen=True, slots=True)
class Result:
    """Results of one frame or of a check of catalogues.

    Attributes
    ----------
    place : Place
        Place of the measurement.
    rows : list of Row
        Rows with verdicts.
    series : mapping of str to object
        Numbers for figures and for checks of several frames.
    """

    place: Place
    rows: list[Row]
    series: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class FrameCheck:
    """A check of one frame.

    Attributes
    ----------
    name : str
        Name of the check.
    source : str
        Source of the expectation.
    why_not_applicable : callable
        Function of the context that returns the reason why the check does not apply, "" if it applies.
    measure : callable
        Function of the context that returns the rows.
    """

    name: str
    source: str
    why_not_applicable: Callable[[FrameContext], str]
    measure: Callable[[FrameContext], list[Row]]

    def run(self, context: FrameContext) -> list[Row]:
        """Return the rows of the check, or one row with the reason if it does not apply."""
        why = self.why_not_applicable(context)
        return [not_applicable(self.name, context.place, why, self.source)] if why else self.measure(context)


@dataclass(frozen=True, slots=True)
class ExposureCheck:
    """A check of all frames together.

    Attributes
    ----------
    name : str
        Name of the check.
    source : str
        Source of the expectations.
    rows : callable
        Function of the results of all frames that returns the rows.
    """

    name: str
    source: str
    rows: Callable[[Sequence[Result]], list[Row]]


def measure_frame(
    path: Path, place: Place, sources: Reference, spectra: Any = None, instrument: Instrument | None = None
) -> FrameContext:
    """Open a science file and make the measurements that several checks share.

    Parameters
    ----------
    path : Path
        Science file.
    place : Place
        Channel, band, exposure and detector.
    sources : Reference
        Known sources of the frame.
    spectra : Table, optional
        Rows of `rendered_spectra` of a dispersed frame.
    instrument : Instrument, optional
        Camera of the frame; None for a linear detector without vignetting.

    Returns
    -------
    FrameContext
        The frame with noise, tiles and stars if it shows the sky.
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
    """Return a function that returns the reason if a frame has fewer than `min_stars` usable stars, else ""."""

    def why_not_applicable(context: FrameContext) -> str:
        if context.measurements is None:
            return "no direct image of the sky"
        n = len(context.measurements.stars)
        return "" if n >= min_stars else f"{n} isolated, bright and unsaturated stars; {min_stars} are required"

    return why_not_applicable


def require_blank_sky(context: FrameContext) -> str:
    """Return the reason if a frame has no blank sky, else ""."""
    if context.tiles is None:
        return "no direct image of the sky"
    return "" if len(context.tiles.row) > 1 else "no blank sky between its sources"


def all_rows(checks: Sequence[FrameCheck], context: FrameContext) -> list[Row]:
    """Return the rows of all checks of a frame."""
    return [row for check in checks for row in check.run(context)]
