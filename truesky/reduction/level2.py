"""What a survey gives of a detector: the calibrated image, its sources, its PSF, and its place for other tools.

refuse      frames that there is no level 2 of
written     an image and all that lies beside it, the image last: where it is, all is

NAME.fits   SCI, WHT, FLG;  NAME.cat: FITS_LDAC;  NAME.psf: PSFEx;  NAME.head: the WCS as TPV, of each array
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lake_schema import user_files
from lake_schema.errors import BadInput, OutOfRange
from lake_schema.fits import ldac
from lake_schema.fits.images import Card, Image
from truesky.reduction import catalogue, files, point_sources
from truesky.reduction.calibration import Reduced
from truesky.reduction.catalogue import Limits
from truesky.reduction.frames import Frame
from truesky.render.camera import astrometry
from truesky.render.products import head_files

# Of a point source's FWHM, the diameter of the aperture where none is asked for.
_DIAMETER = 3.0
# Of an image's header, what a catalogue does not repeat.
_LEFT = ("EFFECT", "EFKEY", "COMMENT", "HISTORY")


@dataclass(frozen=True, slots=True)
class Settings:
    """limits : what a source is;  diameter : of the aperture of MAG_APER, arcsec, None = 3 FWHM of a point source."""

    limits: Limits = field(default_factory=Limits)
    diameter: float | None = None

    def __post_init__(self) -> None:
        if self.diameter is not None and not 1e-2 <= self.diameter <= 1e3:
            raise OutOfRange("--aperture", self.diameter, 1e-2, 1e3)


def refuse(frames: Sequence[Frame]) -> None:
    """BadInput where the lake has not the PSF of every frame: before anything is written."""
    for frame in frames:
        _psf_of(frame)


def _psf_of(frame: Frame) -> Path:
    if frame.psf is None:
        what = f"the lake has no PSF beside the image {frame.stem}"
        raise BadInput(f"--level2: {what}: choose images of ground cameras by --exposures")
    return frame.psf


def written(path: Path, frame: Frame, image: Reduced, cards: Sequence[Card], settings: Settings) -> int:
    """Number of sources of an image, of which all files are written.

    path  : of the image;  frame : its raw one
    image : calibrated;  cards : of its header, with MAGZERO and GAIN
    settings : of the catalogue
    """
    psf = _psf_of(frame)
    about = {keyword: value for keyword, value, _ in cards}
    scale, system = float(about["PIXSCALE"]), astrometry.from_cards(cards)
    diameter = _DIAMETER * float(about["PSFFWHM"]) if settings.diameter is None else settings.diameter
    inside = point_sources.enclosed(point_sources.profile(frame), scale, 0.5 * diameter / scale)
    found = catalogue.detected(image, float(about["GAIN"]), 0.5 * diameter / scale, settings.limits)
    header = (
        *cards,
        ("APERDIAM", round(diameter / scale, 6), "[pix] diameter of the aperture of MAG_APER"),
        ("APERCOR", round(2.5 * float(np.log10(inside)), 6), "[mag] MAG_APER + this: all of a star's light"),
        ("DETTHR", settings.limits.threshold, "threshold of detection, rms of the sky"),
        ("DETPIX", settings.limits.pixels, "[pix] least pixels of a source"),
        ("NDETECT", len(found["x"]), "sources in the catalogue"),
    )
    said = [card for card in header if not card[0].startswith(_LEFT)]
    rows = catalogue.columns(found, system, float(about["MAGZERO"]))
    ldac.write(path.with_suffix(".cat"), rows, said, image.image.shape)
    with user_files.staged(path.with_suffix(".psf")) as temporary:
        shutil.copyfile(psf, temporary)
    with user_files.staged(path.with_suffix(".head")) as temporary:
        units = [Image(data, tuple(cards)) for data in (image.image, image.weight, image.flags)]
        head_files.write([head_files.text(units)], temporary)
    files.write_image(path, image, header)
    return len(found["x"])
