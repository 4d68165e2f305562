"""Write the level 2 files (products of a ground-based survey) of a detector: image, catalogue, PSF and WCS.

NAME.fits is the calibrated image with SCI, WHT (inverse variance) and FLG (flags), and NAME.cat is a FITS_LDAC
catalogue of sources. NAME.psf is a PSFEx file. NAME.head has the WCS of each extension as text in the convention TPV,
for SourceExtractor, SCAMP and SWarp. The image is written last: if it exists, all files exist.
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
from truesky.render.channels import registry
from truesky.render.products import head_files

# Default diameter of the aperture of MAG_APER, as a multiple of the FWHM of the PSF.
_APERTURE_FWHM = 3.0
# Header cards of the image are not copied to the catalogue if their keyword begins with one of these texts.
_OMITTED_CARDS = ("EFFECT", "EFKEY", "COMMENT", "HISTORY")


@dataclass(frozen=True, slots=True)
class CatalogueSettings:
    """Settings of the source catalogue of a calibrated image.

    Attributes
    ----------
    limits : Limits
        Detection threshold and smallest number of pixels of a source.
    diameter : float, optional
        Diameter of the aperture of MAG_APER in arcsec, 0.01 to 1000; None for 3 FWHM of the PSF.

    Raises
    ------
    OutOfRange
        If the diameter is out of range.
    """

    limits: Limits = field(default_factory=Limits)
    diameter: float | None = None

    def __post_init__(self) -> None:
        if self.diameter is not None and not 1e-2 <= self.diameter <= 1e3:
            raise OutOfRange("--aperture", self.diameter, 1e-2, 1e3)


def check_psfs(frames: Sequence[Frame]) -> None:
    """Check that all frames are of ground cameras and have a PSF file in the lake; call this before files are written.

    BadInput is raised for the first frame of another camera or without a PSF file.
    """
    for frame in frames:
        _psf_file(frame)


def _psf_file(frame: Frame) -> Path:
    if frame.psf is None or not registry.CHANNELS[frame.exposure.channel].on_ground:
        problem = f"the lake has no PSF of a ground camera for the image {frame.stem}"
        raise BadInput(f"--level2: {problem}: choose images of ground cameras with --exposures")
    return frame.psf


def write(path: Path, frame: Frame, image: ReducedImage, cards: Sequence[Card], settings: CatalogueSettings) -> int:
    """Detect sources in a calibrated image, and write the image, catalogue, PSF and .head file.

    Parameters
    ----------
    path : Path
        Path of the image; the other files have the same name with the suffixes .cat, .psf and .head.
    frame : Frame
        The raw frame from which the image was made.
    image : ReducedImage
        The calibrated image in counts.
    cards : sequence of Card
        Header of the image, with MAGZERO (AB magnitude of 1 count), GAIN (electrons per count), PIXSCALE (arcsec),
        PSFFWHM (arcsec) and the WCS.
    settings : CatalogueSettings
        Detection limits, and diameter of the aperture.

    Returns
    -------
    int
        Number of sources in the catalogue.

    Raises
    ------
    BadInput
        If the lake has no PSF file for the frame.
    """
    psf = _psf_file(frame)
    header_values = {keyword: value for keyword, value, _ in cards}
    scale, system = float(header_values["PIXSCALE"]), astrometry.from_cards(cards)
    diameter = _APERTURE_FWHM * float(header_values["PSFFWHM"]) if settings.diameter is None else settings.diameter
    aperture_fraction = point_sources.enclosed_fraction(point_sources.profile(frame), scale, 0.5 * diameter / scale)
    sources = catalogue.detect_sources(image, float(header_values["GAIN"]), 0.5 * diameter / scale, settings.limits)
    header = (
        *cards,
        ("APERDIAM", round(diameter / scale, 6), "[pix] aperture diameter of MAG_APER"),
        (
            "APERCOR",
            round(2.5 * float(np.log10(aperture_fraction)), 6),
            "[mag] add to MAG_APER for total flux of a star",
        ),
        ("DETTHR", settings.limits.threshold, "detection threshold in units of the sky rms"),
        ("DETPIX", settings.limits.pixels, "[pix] minimum area of a source"),
        ("NDETECT", len(sources["x"]), "number of sources in the catalogue"),
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
