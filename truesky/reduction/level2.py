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
from truesky.reduction.calibration import ReducedImage
from truesky.reduction.catalogue import Limits
from truesky.reduction.frames import Frame
from truesky.render.camera import astrometry
from truesky.render.products import head_files

# Of a point source's FWHM, the diameter of the aperture where none is asked for.
_APERTURE_FWHM = 3.0
# Of an image's header, what a catalogue does not repeat.
_OMITTED_CARDS = ("EFFECT", "EFKEY", "COMMENT", "HISTORY")


@dataclass(frozen=True, slots=True)
class CatalogueSettings:
    """limits : what a source is;  diameter : of the aperture of MAG_APER, arcsec, None = 3 FWHM of a point source."""

    limits: Limits = field(default_factory=Limits)
    diameter: float | None = None

    def __post_init__(self) -> None:
        if self.diameter is not None and not 1e-2 <= self.diameter <= 1e3:
            raise OutOfRange("--aperture", self.diameter, 1e-2, 1e3)


def check_psfs(frames: Sequence[Frame]) -> None:
    """BadInput where the lake has not the PSF of every frame: before anything is written."""
    for frame in frames:
        _psf_file(frame)


def _psf_file(frame: Frame) -> Path:
    if frame.psf is None:
        problem = f"the lake has no PSF beside the image {frame.stem}"
        raise BadInput(f"--level2: {problem}: choose images of ground cameras by --exposures")
    return frame.psf


def write(path: Path, frame: Frame, image: ReducedImage, cards: Sequence[Card], settings: CatalogueSettings) -> int:
    """Number of sources of an image, of which all files are written.

    path  : of the image;  frame : its raw one
    image : calibrated;  cards : of its header, with MAGZERO and GAIN
    settings : of the catalogue
    """
    psf = _psf_file(frame)
    header_values = {keyword: value for keyword, value, _ in cards}
    scale, system = float(header_values["PIXSCALE"]), astrometry.from_cards(cards)
    diameter = _APERTURE_FWHM * float(header_values["PSFFWHM"]) if settings.diameter is None else settings.diameter
    aperture_fraction = point_sources.enclosed_fraction(point_sources.profile(frame), scale, 0.5 * diameter / scale)
    sources = catalogue.detect_sources(image, float(header_values["GAIN"]), 0.5 * diameter / scale, settings.limits)
    header = (
        *cards,
        ("APERDIAM", round(diameter / scale, 6), "[pix] diameter of the aperture of MAG_APER"),
        ("APERCOR", round(2.5 * float(np.log10(aperture_fraction)), 6), "[mag] MAG_APER + this: all of a star's light"),
        ("DETTHR", settings.limits.threshold, "threshold of detection, rms of the sky"),
        ("DETPIX", settings.limits.pixels, "[pix] least pixels of a source"),
        ("NDETECT", len(sources["x"]), "sources in the catalogue"),
    )
    catalogue_cards = [card for card in header if not card[0].startswith(_OMITTED_CARDS)]
    rows = catalogue.columns(sources, system, float(header_values["MAGZERO"]))
    ldac.write(path.with_suffix(".cat"), rows, catalogue_cards, image.image.shape)
    with user_files.replace_atomically(path.with_suffix(".psf")) as temporary:
        shutil.copyfile(psf, temporary)
    with user_files.replace_atomically(path.with_suffix(".head")) as temporary:
        units = [Image(data, tuple(cards)) for data in (image.image, image.weight, image.flags)]
        head_files.write([head_files.text(units)], temporary)
    files.write_image(path, image, header)
    return len(sources["x"])
