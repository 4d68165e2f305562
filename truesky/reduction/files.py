"""Write and read masters (combined calibration frames), calibrated images and stacks as FITS files.

A master has the extensions VALUE, UNCERTAINTY and COUNT (number of combined frames). A calibrated image and a stack
have SCI, WHT (inverse variance) and FLG (flag bits, whose meanings are in the header). The primary header applies to
all extensions.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema import __version__, user_files
from lake_schema.arrays import Array, Float
from lake_schema.errors import BadInput
from lake_schema.fits import external
from lake_schema.fits.images import Card, Image, read_images, write_images
from lake_schema.mission.parameter import CAMERAS, SPACE_CAMERAS
from truesky.reduction import calibration
from truesky.reduction.calibration import FLAGS, ReducedImage
from truesky.reduction.combining import CombinedFrame
from truesky.reduction.frames import Frame
from truesky.render.camera import astrometry
from truesky.render.channels import registry
from truesky.render.effects.light import illumination, pixel_area

# Kinds of masters of a CCD.
KINDS = ("bias", "dark", "flat")
# Kinds of masters of an infrared detector, whose ramps have no bias.
INFRARED_KINDS = ("dark", "linearity", "flat")
# Names of corrections that a user can omit: corrections by masters, then corrections by mission parameters.
CORRECTIONS = (*KINDS, "linearity", "crosstalk", "nonlinearity", "fringes", "pixel_area", "persistence")
# Unit of each kind of master in FITS notation; a flat is dimensionless.
_UNITS = {
    "bias": "electron", "dark": "electron/s", "flat": "", "linearity": "electron-1", "fringes": "", "bad_pixels": "",
}  # fmt: skip
# Header cards that must be equal in a master and the frame to calibrate. SEED is the seed of all random numbers of the
# simulation, on which the pixel pattern of a detector depends.
SHARED_CARDS = ("INSTRUME", "DETECTOR", "SEED")
# Keywords of raw headers that do not apply to a calibrated image, and are therefore not copied to it.
_RAW_CARDS: tuple[str, ...] = (
    "BUNIT",
    "GAIN",
    "BIAS",
    "SATURATE",
    "PRESCAN",
    "OVERSCAN",
    "OVERROWS",
    "INJROWS",
    "NAMPS",
)
_RAW_CARDS += ("DATASEC", "TRIMSEC", "BIASSEC", "CCDSEC")
# Keywords of single amplifiers, which are not copied to a calibrated image: they end with a number or a letter.
_AMPLIFIER_CARDS = re.compile(
    r"(AMP|DSEC|CSEC|BSEC|GAIN|RDN)[0-9]+|(GAIN|RDNOISE|SATURAT)[A-Z]"
    r"|(DATA|BIAS|CCD|TRIM|AMP|PRE|POST|DET|[ADTBC])SEC[A-Z]"
    r"|T_(EF|OS)M[NX][0-9]+|T_GAIN[0-9]+"
)
# Largest allowed number of pixels in a master that the user made with another program.
_MAX_PIXELS = 1 << 28
# Names of the simulated effects that the correction "nonlinearity" undoes: nonlinearity of CCDs, of each read of an
# infrared ramp, and of the total signal of a ramp.
_NONLINEARITY_EFFECTS = {"nonlinearity", "ramp_nonlinearity", "signal_nonlinearity"}
# Keywords that describe the structure of a FITS file; they are not copied from the raw file.
_STRUCTURE_CARDS: tuple[str, ...] = (
    "SIMPLE",
    "BITPIX",
    "NAXIS",
    "NAXIS1",
    "NAXIS2",
    "EXTEND",
    "CHECKSUM",
    "DATASUM",
    "XTENSION",
    "PCOUNT",
)
_STRUCTURE_CARDS += ("GCOUNT", "EXTNAME", "BZERO", "BSCALE", "ZCMPTYPE", "COMMENT", "HISTORY")


@dataclass(frozen=True, slots=True)
class ImageFile:
    """A calibrated image that was read from a file, and its primary header as cards (keyword, value, comment)."""

    reduced: ReducedImage
    cards: tuple[Card, ...]

    def card(self, keyword: str) -> Any:
        """Return the value of a keyword in the header, or None if the header does not have it."""
        return next((value for key, value, _ in self.cards if key == keyword), None)


def master_kinds(frame: Frame) -> tuple[str, ...]:
    """Return the kinds of masters that calibrate a frame: `INFRARED_KINDS` for infrared ramps, otherwise `KINDS`."""
    return INFRARED_KINDS if frame.scene.ramp else KINDS


def master_path(folder: Path, frame: Frame, kind: str) -> Path:
    """Return the path of the file with the master that calibrates a frame.

    Parameters
    ----------
    folder : Path
        Folder of the master files.
    frame : Frame
        Frame to calibrate, or one of the frames that are combined to the master.
    kind : str
        Kind of master: "bias", "dark", "flat", "linearity", "fringes" or "bad_pixels".

    Returns
    -------
    Path
        The file, which may not exist.

    Notes
    -----
    File names begin with the channel, such as VIS or NISP-P. Names of ground cameras begin with the camera, because all
    ground cameras share one channel; their flats and fringes also have the band. For cameras that the user defined,
    parts of the name are joined by dots: with underscores, camera a_b in band c would have the same file as camera a in
    band b_c. A dark of NISP is named by its readout mode (groups-reads-drops). Both channels of NISP use the same
    linearity file and the same map of bad pixels.
    """
    exposure = frame.exposure
    if frame.scene.ramp:
        detail = {"dark": "-".join(map(str, frame.ramp)) if kind == "dark" else "", "flat": exposure.band}.get(kind)
        channel = "NISP" if kind in ("linearity", "bad_pixels") else exposure.channel
        return folder / "_".join(filter(None, (channel, detail, frame.detector, f"{kind}.fits")))
    if exposure.camera in SPACE_CAMERAS:
        return folder / f"{exposure.channel}_{frame.detector}_{kind}.fits"
    names = (exposure.camera, *((exposure.band,) if kind in ("flat", "fringes") else ()), frame.detector)
    return folder / f"{('_' if exposure.camera in CAMERAS else '.').join(names)}_{kind}.fits"


def write_master(
    path: Path, combined: CombinedFrame, kind: str, frames: Sequence[Frame], extra_cards: Sequence[Card] = ()
) -> None:
    """Write a master to a FITS file, which appears under its name only when it is complete.

    Parameters
    ----------
    path : Path
        The file, which is replaced if it exists.
    combined : CombinedFrame
        Pixels of the master, their uncertainty and number of frames.
    kind : str
        Kind of master: "bias", "dark", "flat", "linearity", "fringes" or "bad_pixels".
    frames : sequence of Frame
        Frames that were combined, at least one; the header lists their exposures.
    extra_cards : sequence of Card, optional
        Further header cards (keyword, value, comment).
    """
    first = frames[0]
    cards: tuple[Card, ...] = (
        *(card for card in first.cards if card[0] in (*SHARED_CARDS, "CHANNEL", "MISSION", "TRUESKY")),
        ("IMAGETYP", f"master {kind}", "image type"),
        ("BUNIT", _UNITS[kind], "pixel unit"),
        *((("VIGNETTE", has_vignetting(first), "T if the flat includes vignetting"),) if kind == "flat" else ()),
        ("NCOMBINE", len(frames), "number of combined frames"),
        (
            "EXPTIME",
            float(np.mean([frame.exposure.exposure_time_s for frame in frames])),
            "[s] mean exposure time of the frames",
        ),
        *extra_cards,
        *((f"FRAME{i}", frame.exposure.exposure_id, "exposure of a frame") for i, frame in enumerate(frames, start=1)),
    )
    # Flag bits are whole numbers, as SourceExtractor requires of FLAG_IMAGE.
    values = combined.mean.astype(np.uint8) if kind == "bad_pixels" else combined.mean
    units = [Image(None, cards), Image(values, (), "VALUE"), Image(combined.uncertainty, (), "UNCERTAINTY")]
    write_images(path, [*units, Image(combined.count, (), "COUNT")])


def has_vignetting(flat: Frame) -> bool:
    """Return True if the light of the flat came through the telescope and is vignetted, as in a dome flat."""
    return illumination.EFFECT.name in flat.applied and registry.CHANNELS[flat.exposure.channel].on_ground


def read_master(path: Path, kind: str, frame: Frame) -> tuple[CombinedFrame, float]:
    """Read a master, and check that it can calibrate a frame.

    Parameters
    ----------
    path : Path
        File of `write_master`, or an image that the user made with another program.
    kind : str
        Kind of master: "bias", "dark", "flat", "linearity", "fringes" or "bad_pixels".
    frame : Frame
        Frame to calibrate.

    Returns
    -------
    combined : CombinedFrame
        The master.
    time : float
        Mean exposure time of the combined frames in seconds; infinite for a user's master.

    Raises
    ------
    BadInput
        If the file does not exist, or is for another kind, shape, instrument, detector or seed of the simulation. Only
        the shape of a user's master is checked.

    Notes
    -----
    A user's master is an image of the detector's pixels in the units of this program, without uncertainty. NaN and
    infinity are replaced by 1 in a flat and by 0 in other kinds. The card VIGNETTE is T if a flat contains vignetting;
    without this card, flats of ground cameras are assumed to contain it.
    """
    shape = (frame.scene.ny, frame.scene.nx)
    _refuse_missing(path, kind)
    user_plane, user_header = external.read_planes(
        user_files.check_file(path, "master frame"), "", "master frame", _MAX_PIXELS
    )
    if user_header.get("EXTNAME") != "VALUE":
        _refuse_other_shape(path, user_plane.shape, shape)
        vignetted = bool(user_header.get("VIGNETTE", registry.CHANNELS[frame.exposure.channel].on_ground))
        return _user_master(user_plane, 1.0 if kind == "flat" else 0.0, vignetted), np.inf
    del user_plane
    units = read_images(path)
    header = {keyword: value for keyword, value, _ in units[0].cards}
    if header.get("IMAGETYP") != f"master {kind}" or len(units) != 4:
        raise BadInput(f"{user_files.format_path(path)}: is not a master {kind}")
    for keyword in SHARED_CARDS:
        if str(header.get(keyword)) != str(frame.card(keyword)):
            problem = f"{keyword} = {header.get(keyword)}, the frame has {frame.card(keyword)}"
            raise BadInput(f"{user_files.format_path(path)}: {problem}: it cannot calibrate {frame.stem}")
    mean, uncertainty, count = (np.asarray(unit.data) for unit in units[1:])
    for plane in (mean, uncertainty, count):
        _refuse_other_shape(path, plane.shape, shape)
    seconds = header.get("EXPTIME")
    if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not 0.0 <= seconds < np.inf:
        raise BadInput(f"{user_files.format_path(path)}: EXPTIME = {seconds} must be a number of seconds from 0")
    vignetted = bool(header.get("VIGNETTE", False))
    return CombinedFrame(mean, uncertainty, count, vignetted), float(seconds)


def _refuse_missing(path: Path, kind: str) -> None:
    if not os.path.exists(path):
        source = " from exposures of the sky with three or more pointings" if kind == "fringes" else ""
        remedy = f"make it with truesky masters LAKE --out {path.parent}{source}, or omit its correction"
        remedy += f" with --without {kind}"
        raise BadInput(f"{user_files.format_path(path)}: there is no such master: {remedy}")


def _refuse_other_shape(path: Path, shape: tuple[int, ...], expected: tuple[int, int]) -> None:
    if shape != expected:
        raise BadInput(f"{user_files.format_path(path)}: {shape} pixels, the frame has {expected}")


def _user_master(values: Float, neutral: float, vignetted: bool) -> CombinedFrame:
    """Return a master of the user's pixel values with uncertainty 0.

    Values that are not finite are replaced by `neutral` and get the count 0. `vignetted` is True for a flat that
    contains vignetting.
    """
    defined = np.isfinite(values)
    mean = np.where(defined, values, neutral).astype(np.float32)
    return CombinedFrame(mean, np.broadcast_to(np.float32(0.0), values.shape), defined.astype(np.int16), vignetted)


def read_masters(
    folder: Path, frame: Frame, without: Sequence[str] = (), flags: Array | None = None
) -> calibration.Masters:
    """Read the masters (bias, dark, flat and fringes) with which a frame of a CCD is calibrated.

    Parameters
    ----------
    folder : Path
        Folder of the master files.
    frame : Frame
        Frame to calibrate.
    without : sequence of str, optional
        Kinds of masters that are not read: a flat is replaced by 1, a bias or dark by 0. Fringes are not read either if
        the frame has none.
    flags : uint8 array, shape (ny, nx), optional
        Flag bits of an earlier call for the same detector and band; by default they are computed, which takes time.

    Returns
    -------
    calibration.Masters
        The masters, without the numbers of combined frames, to save memory.

    Raises
    ------
    BadInput
        If a file does not exist, or does not belong to the detector.
    """
    shape, combined, dark_time = (frame.scene.ny, frame.scene.nx), {}, np.inf
    bits = np.zeros(shape, np.uint8) if flags is None else flags
    count = calibration.neutral_master(shape, 0.0).count
    has_fringes = "fringes" in frame.applied and "fringes" not in without
    for kind in (*(kind for kind in KINDS if kind not in without), *(("fringes",) if has_fringes else ())):
        _refuse_missing(master_path(folder, frame, kind), kind)
    # Begin with the flat, whose flags take the most memory.
    for kind in reversed(KINDS):
        if kind in without:
            combined[kind] = calibration.neutral_master(shape, 1.0 if kind == "flat" else 0.0)
            continue
        master, time = read_master(master_path(folder, frame, kind), kind, frame)
        if flags is None:
            bits |= calibration.master_flags(shape, {kind: master}, [other for other in KINDS if other != kind])
        combined[kind] = replace(master, count=count)
        dark_time = time if kind == "dark" else dark_time
        del master
    fringes = None
    if has_fringes:
        fringes = read_master(master_path(folder, frame, "fringes"), "fringes", frame)[0].mean
    return calibration.Masters(combined["bias"], combined["dark"], combined["flat"], bits, dark_time, fringes)


def reduced_cards(frame: Frame, unit: str, electrons: float, without: Sequence[str]) -> tuple[Card, ...]:
    """Return the header of a calibrated image: cards of the raw image, and cards about the calibration.

    Parameters
    ----------
    frame : Frame
        The raw frame.
    unit : str
        Unit of the calibrated pixels in FITS notation, such as "electron/s".
    electrons : float
        Number of electrons of the exposure that correspond to the value 1 in the calibrated image.
    without : sequence of str
        Names of corrections that were not applied, from `CORRECTIONS`.

    Returns
    -------
    tuple of Card
        Header cards (keyword, value, comment).
    """
    raw_cards = (
        card
        for card in frame.cards
        if card[0] not in (*_RAW_CARDS, *_STRUCTURE_CARDS) and not _AMPLIFIER_CARDS.fullmatch(card[0])
    )
    time = frame.scene.exposure_time_s
    done = frame.applied - (set(without) | (_NONLINEARITY_EFFECTS if "nonlinearity" in without else set()))
    return (
        *raw_cards,
        ("BUNIT", unit, "unit of SCI; unit of WHT is its inverse square"),
        ("GAIN", electrons, "[electron/BUNIT] gain"),
        ("MAGZERO", float(frame.card("ZEROPNT")) + 2.5 * math.log10(time / electrons), "[mag] AB magnitude of 1 BUNIT"),
        *(
            (f"CAL{kind.upper()[:5]}", kind not in without, f"T if the master {kind} was applied")
            for kind in master_kinds(frame)
        ),
        *(
            (("CALPERS", "persistence" not in without, "T if predicted persistence was subtracted"),)
            if frame.scene.ramp
            else ()
        ),
        ("CALXTALK", "crosstalk" in done, "T if crosstalk was corrected"),
        ("CALLIN", bool(_NONLINEARITY_EFFECTS & done), "T if nonlinearity was corrected"),
        ("CALFRING", "fringes" in done, "T if sky fringes were subtracted"),
        ("CALAREA", corrects_area(frame, without), "T if the sky has the same pixel area everywhere"),
        ("CALILLUM", bool({"illumination", "shutter"} & frame.applied), "T if vignetting and shutter were corrected"),
        *flag_cards(),
    )


def corrects_area(frame: Frame, without: Sequence[str]) -> bool:
    """Return True if the pattern of pixel areas is subtracted from the sky: in frames of ground cameras with it."""
    on_ground = registry.CHANNELS[frame.exposure.channel].on_ground
    return on_ground and pixel_area.EFFECT.name in frame.applied - set(without)


def flag_cards() -> tuple[Card, ...]:
    """Return header cards FLAG1, FLAG2, FLAG4, ... with the meaning of each bit of the flag map (extension FLG)."""
    return tuple((f"FLAG{bit}", text, "meaning of bit in FLG") for bit, text in FLAGS)


def write_image(path: Path, reduced: ReducedImage, cards: tuple[Card, ...], extensions: Sequence[Image] = ()) -> None:
    """Write a calibrated image or a stack to a FITS file, which appears under its name only when it is complete.

    Parameters
    ----------
    path : Path
        The file, which is replaced if it exists.
    reduced : ReducedImage
        Pixels, weights and flags for the extensions SCI, WHT and FLG.
    cards : tuple of Card
        Primary header. Its WCS is also copied to the three extensions.
    extensions : sequence of Image, optional
        Further extensions after FLG.
    """
    wcs_cards = tuple(
        card for card in cards if card[0] in _WCS_CARDS or card[0].startswith(("A_", "B_", "PV1_", "PV2_"))
    )
    pixels = zip(("SCI", "WHT", "FLG"), (reduced.image, reduced.weight, reduced.flags), strict=True)
    other_cards = tuple(card for card in cards if card[0] != "TRUESKY")
    primary = Image(None, (*other_cards, ("TRUESKY", __version__, "version of the simulator")))
    write_images(path, [primary, *(Image(data, wcs_cards, name) for name, data in pixels), *extensions])


_WCS_CARDS = tuple(
    keyword for keyword in (
        "WCSAXES", "CTYPE1", "CTYPE2", "CUNIT1", "CUNIT2", "CRVAL1", "CRVAL2", "CRPIX1", "CRPIX2", "CD1_1", "CD1_2",
        "CD2_1", "CD2_2", "LONPOLE", "RADESYS",
    )
)  # fmt: skip


def read_image(path: Path) -> ImageFile:
    """Read a calibrated image or a stack that `write_image` wrote.

    Raises
    ------
    BadInput
        If the file does not exist, its extensions do not begin with SCI, WHT and FLG, which must be images of equal
        shape, or its WCS is incomplete or wrong.
    """
    units = read_images(user_files.check_file(path, "calibrated image"))
    if [unit.name for unit in units[1:4]] != ["SCI", "WHT", "FLG"]:
        raise BadInput(
            f"{user_files.format_path(path)}: is not a calibrated image: truesky reduce LAKE --out FOLDER makes them"
        )
    image, weight, flags = (np.asarray(unit.data) for unit in units[1:4])
    if image.ndim != 2 or not image.shape == weight.shape == flags.shape:
        problem = f"SCI, WHT and FLG are no images of equal shape: {image.shape}, {weight.shape} and {flags.shape}"
        raise BadInput(f"{user_files.format_path(path)}: {problem}")
    try:
        astrometry.from_cards(units[0].cards)
    except BadInput as error:
        raise BadInput(f"{user_files.format_path(path)}: {error}") from None
    return ImageFile(ReducedImage(image, weight, flags), units[0].cards)
