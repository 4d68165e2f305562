"""Input of the checks of images: a raw frame, its known sources, and measurements that several checks use.

The module also defines what a check is: a name, a condition and a function that returns rows with verdicts.
"""

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

# Image types (values of the FITS keyword IMAGETYP) of exposures of the sky that are validated as such. Others, such as
# exposures of standard stars, are not included.
SKY_TYPES = ("science", "deep", "self_calibration")
# Channel whose images are slitless spectra.
DISPERSED = "NISP-S"
# Channels with infrared detectors, which are read several times during an exposure (a ramp).
RAMPS = ("NISP-P", "NISP-S")


@dataclass(frozen=True, slots=True, eq=False)
class PartnerFrame:
    """A second frame of the same detector, with which the gain is measured from the difference of two frames.

    Attributes
    ----------
    path : Path
        FITS file of the second frame.
    exposure_id : int
        Number of its exposure.
    sources : Reference
        Known sources of the second frame.
    """

    path: Path
    exposure_id: int
    sources: Reference


@dataclass(slots=True, eq=False)
class FrameContext:
    """A raw frame (one detector of an exposure) with its known sources and the measurements that several checks use.

    Attributes
    ----------
    place : Place
        Channel, band, exposure number and detector of the frame.
    frame : Frame
        Pixels in electrons, and header.
    sources : Reference
        Known sources on the detector, from the tables of the lake.
    spectra : Table, optional
        Rows of the table `rendered_spectra` on this detector, at least those of first orders; None for frames without
        spectra.
    noise : float
        rms noise of a pixel of blank sky, e-; 0 if not measured.
    tiles : Tiles, optional
        Tiles of blank sky; None for frames of lamps or without light, and for spectra.
    measurements : StarMeasurements, optional
        Measured stars; None for frames of lamps or without light, and for spectra.
    partner : PartnerFrame, optional
        Second frame of the detector for the measurement of the gain; None without such a frame.
    series : dict of str to object
        Measured numbers by name, which checks add for the plots of the report and for checks of several frames.
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
        """Return the channel in the header: VIS, NISP-P (images), NISP-S (spectra) or EXT (ground cameras)."""
        return str(self.frame.header["CHANNEL"])

    @property
    def sees_sky(self) -> bool:
        """Return True if the image type is in SKY_TYPES, also for spectra, and False for others, such as flats."""
        return self.frame.header["IMAGETYP"] in SKY_TYPES


@dataclass(frozen=True, slots=True)
class Result:
    """Results of all checks of one frame, or of one check of catalogues.

    Attributes
    ----------
    place : Place
        Channel, band, exposure and detector of the frame; all None for catalogues.
    rows : list of Row
        Measured values with expected values and verdicts.
    series : mapping of str to object
        Measured numbers by name, for the plots of the report and for checks of several frames.
    """

    place: Place
    rows: list[Row]
    series: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class FrameCheck:
    """A check that is applied to single frames, such as the check of the background.

    Attributes
    ----------
    name : str
        Name of the check.
    source : str
        Publication or header keywords from which the expected values are taken.
    why_not_applicable : callable
        Function of a FrameContext that returns the reason why the check cannot be applied to this frame, or "".
    measure : callable
        Function of a FrameContext that returns rows: measured values with expected values and verdicts.
    """

    name: str
    source: str
    why_not_applicable: Callable[[FrameContext], str]
    measure: Callable[[FrameContext], list[Row]]

    def run(self, context: FrameContext) -> list[Row]:
        """Apply the check to a frame, and return its rows (measured values with expected values and verdicts).

        If the check cannot be applied, the only row has the verdict "not_applicable" and the reason.
        """
        why = self.why_not_applicable(context)
        return [not_applicable(self.name, context.place, why, self.source)] if why else self.measure(context)


@dataclass(frozen=True, slots=True)
class ExposureCheck:
    """A check that combines the results of many frames, such as the mean offset of an exposure.

    Attributes
    ----------
    name : str
        Name of the check.
    source : str
        Publication from which the expected values are taken.
    rows : callable
        Function of the results of all frames that returns rows: combined values with expected values and verdicts.
    """

    name: str
    source: str
    rows: Callable[[Sequence[Result]], list[Row]]


def measure_frame(
    path: Path, place: Place, sources: Reference, spectra: Any = None, instrument: Instrument | None = None
) -> FrameContext:
    """Open a raw FITS file, and make the measurements that several checks use: noise, blank sky and stars.

    Parameters
    ----------
    path : Path
        FITS file of one detector of an exposure.
    place : Place
        Channel, band, exposure number and detector.
    sources : Reference
        Known sources of the frame.
    spectra : Table, optional
        Rows of the table `rendered_spectra` for a frame with slitless spectra.
    instrument : Instrument, optional
        Nonlinearity, vignetting and pixel response of the camera; None for a linear detector without vignetting.

    Returns
    -------
    FrameContext
        The frame. The noise is measured for frames of the sky and spectra; blank sky and stars are measured for direct
        images of the sky only.

    Raises
    ------
    BadInput
        If the header lacks a required keyword.
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
    """Return a condition for checks that need at least `min_stars` measured stars.

    The condition is a function of a FrameContext that returns "" for a frame with enough stars, and otherwise the
    reason why the check cannot be applied.
    """

    def why_not_applicable(context: FrameContext) -> str:
        if context.measurements is None:
            return "no direct image of the sky"
        n = len(context.measurements.stars)
        return "" if n >= min_stars else f"{n} isolated, bright and unsaturated stars; {min_stars} are required"

    return why_not_applicable


def require_blank_sky(context: FrameContext) -> str:
    """Return "" if a frame has two or more tiles of blank sky, and otherwise why checks that need them do not apply."""
    if context.tiles is None:
        return "no direct image of the sky"
    return "" if len(context.tiles.row) > 1 else "no blank sky between its sources"


def all_rows(checks: Sequence[FrameCheck], context: FrameContext) -> list[Row]:
    """Apply all checks to a frame, and return their rows (measured values with expected values and verdicts)."""
    return [row for check in checks for row in check.run(context)]
