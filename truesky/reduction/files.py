"""Masters and calibrated images as FITS files, and back.

A master has the extensions VALUE, UNCERTAINTY and COUNT, a calibrated image and a stack SCI, WHT (inverse variance)
and FLG (bits, named in its header); all behind a header that holds for all of them.

write_master, read_master     a combined frame
write_image, read_image       image, weight, flags
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema import __version__, user_files
from lake_schema.arrays import Float
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
from truesky.render.effects.light import illumination

KINDS = ("bias", "dark", "flat")
# Of an infrared detector, whose ramps have no bias.
INFRARED_KINDS = ("dark", "linearity", "flat")
# What can be left as it is.
CORRECTIONS = (*KINDS, "linearity", "crosstalk", "nonlinearity", "fringes", "persistence")
_UNITS = {"bias": "electron", "dark": "electron/s", "flat": "", "linearity": "electron-1"}
# What a master must share with the frame that it is applied to: the detector's patterns are keyed by these.
SHARED_CARDS = ("INSTRUME", "DETECTOR", "SEED")
# Of a raw file's header what is not so any more; of amplifiers, with their number or letter at the end.
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
_AMPLIFIER_CARDS = re.compile(r"(AMP|DSEC|CSEC|BSEC|GAIN|RDN)[0-9]+|(DATASEC|BIASSEC|CCDSEC|GAIN|RDNOISE|SATURAT)[A-Z]")
# Pixels of a master of the user's.
_MAX_PIXELS = 1 << 28
_NONLINEARITY_EFFECTS = {"nonlinearity", "ramp_nonlinearity", "signal_nonlinearity"}
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
    """A calibrated image and its header."""

    reduced: ReducedImage
    cards: tuple[Card, ...]

    def card(self, keyword: str) -> Any:
        """Its value, None = there is none."""
        return next((value for key, value, _ in self.cards if key == keyword), None)


def master_kinds(frame: Frame) -> tuple[str, ...]:
    """Kinds of master that a frame is calibrated with."""
    return INFRARED_KINDS if frame.scene.ramp else KINDS


def master_path(folder: Path, frame: Frame, kind: str) -> Path:
    """The file in a folder of the master for a frame; kind : of KINDS.

    Of ground cameras, whose channel is one, it has the camera's name; and, a flat, that of the band. Names of a user's
    camera are joined by dots: with underscores, camera a_b in band c would have the file of camera a in band b_c. Of
    NISP a dark has its ramp's numbers, and both channels have one linearity.
    """
    exposure = frame.exposure
    if frame.scene.ramp:
        detail = {"dark": "-".join(map(str, frame.ramp)) if kind == "dark" else "", "flat": exposure.band}.get(kind)
        channel = "NISP" if kind == "linearity" else exposure.channel
        return folder / "_".join(filter(None, (channel, detail, frame.detector, f"{kind}.fits")))
    if exposure.camera in SPACE_CAMERAS:
        return folder / f"{exposure.channel}_{frame.detector}_{kind}.fits"
    names = (exposure.camera, *((exposure.band,) if kind == "flat" else ()), frame.detector)
    return folder / f"{('_' if exposure.camera in CAMERAS else '.').join(names)}_{kind}.fits"


def write_master(
    path: Path, combined: CombinedFrame, kind: str, frames: Sequence[Frame], extra_cards: Sequence[Card] = ()
) -> None:
    """One master of these frames, in one rename.

    path : of its file;  combined : what it holds;  kind : of `kinds`;  more : cards of its header
    """
    first = frames[0]
    cards: tuple[Card, ...] = (
        *(card for card in first.cards if card[0] in (*SHARED_CARDS, "CHANNEL", "MISSION", "TRUESKY")),
        ("IMAGETYP", f"master {kind}", "image type"),
        ("BUNIT", _UNITS[kind], "unit of the pixels"),
        *((("VIGNETTE", _through_optics(first), "vignetting is in it"),) if kind == "flat" else ()),
        ("NCOMBINE", len(frames), "frames"),
        ("EXPTIME", float(np.mean([frame.exposure.exposure_time_s for frame in frames])), "[s] mean of the frames"),
        *extra_cards,
        *((f"FRAME{i}", frame.exposure.exposure_id, "exposure") for i, frame in enumerate(frames, start=1)),
    )
    units = [Image(None, cards), Image(combined.mean, (), "VALUE"), Image(combined.uncertainty, (), "UNCERTAINTY")]
    write_images(path, [*units, Image(combined.count, (), "COUNT")])


def _through_optics(flat: Frame) -> bool:
    """Whether the lamp's light came through the telescope, as a dome's does."""
    return illumination.EFFECT.name in flat.applied and registry.CHANNELS[flat.exposure.channel].on_ground


def read_master(path: Path, kind: str, frame: Frame) -> tuple[CombinedFrame, float]:
    """(a master for a frame, s that its frames lasted); BadInput: it is of another detector, or another seed's.

    One of the user's is an image of the detector's pixels in the units of ours, NaN where it says nothing; whether
    vignetting is in a flat its card VIGNETTE says, else it is in that of a ground camera.
    """
    shape = (frame.scene.ny, frame.scene.nx)
    user_plane, user_header = external.read_planes(
        user_files.check_file(path, "master frame"), "", "master frame", _MAX_PIXELS
    )
    if user_header.get("EXTNAME") != "VALUE":
        _refuse_other_shape(path, user_plane.shape, shape)
        vignetted = bool(user_header.get("VIGNETTE", registry.CHANNELS[frame.exposure.channel].on_ground))
        return _user_master(user_plane, 1.0 if kind == "flat" else 0.0, vignetted), np.inf
    units = read_images(path)
    header = {keyword: value for keyword, value, _ in units[0].cards}
    if header.get("IMAGETYP") != f"master {kind}" or len(units) != 4:
        raise BadInput(f"{user_files.format_path(path)}: is no master {kind}")
    for keyword in SHARED_CARDS:
        if str(header.get(keyword)) != str(frame.card(keyword)):
            problem = f"{keyword} = {header.get(keyword)}, the frame's is {frame.card(keyword)}"
            raise BadInput(f"{user_files.format_path(path)}: {problem}: it cannot calibrate {frame.stem}")
    mean, uncertainty, count = (np.asarray(unit.data) for unit in units[1:])
    for plane in (mean, uncertainty, count):
        _refuse_other_shape(path, plane.shape, shape)
    vignetted = bool(header.get("VIGNETTE", False))
    return CombinedFrame(mean, uncertainty, count, vignetted), float(header["EXPTIME"])


def _refuse_other_shape(path: Path, shape: tuple[int, ...], expected: tuple[int, int]) -> None:
    if shape != expected:
        raise BadInput(f"{user_files.format_path(path)}: {shape} pixels, the frame has {expected}")


def _user_master(values: Float, neutral: float, vignetted: bool) -> CombinedFrame:
    """A master without uncertainty; neutral : what stands where it says nothing;  vignetted : of a flat."""
    defined = np.isfinite(values)
    mean = np.where(defined, values, neutral).astype(np.float32)
    return CombinedFrame(mean, np.zeros(values.shape, np.float32), defined.astype(np.int16), vignetted)


def read_masters(folder: Path, frame: Frame, without: Sequence[str] = ()) -> calibration.Masters:
    """The masters of a frame's detector; without : those that are not wanted."""
    shape, combined, dark_time = (frame.scene.ny, frame.scene.nx), {}, np.inf
    for kind in KINDS:
        if kind in without:
            combined[kind] = calibration.neutral_master(shape, 1.0 if kind == "flat" else 0.0)
        else:
            path = master_path(folder, frame, kind)
            combined[kind], time = read_master(path, kind, frame)
            dark_time = time if kind == "dark" else dark_time
    flags = calibration.master_flags(shape, combined, without)
    return calibration.Masters(combined["bias"], combined["dark"], combined["flat"], flags, dark_time)


def reduced_cards(frame: Frame, unit: str, electrons: float, without: Sequence[str]) -> tuple[Card, ...]:
    """Header of a calibrated image: the raw one's, and what was done.

    frame     : its raw one;  unit : of its pixels, as FITS writes it
    electrons : of the exposure that one of them is;  without : of UNDONE what was left as it is
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
        ("BUNIT", unit, "unit of SCI; of WHT its inverse square"),
        ("GAIN", electrons, "[electron/BUNIT] of the pixels"),
        ("MAGZERO", float(frame.card("ZEROPNT")) + 2.5 * math.log10(time / electrons), "[mag] AB magnitude of 1 BUNIT"),
        *((f"CAL{kind.upper()[:5]}", kind not in without, f"master {kind} applied?") for kind in master_kinds(frame)),
        *((("CALPERS", "persistence" not in without, "foreseen persistence taken off?"),) if frame.scene.ramp else ()),
        ("CALXTALK", "crosstalk" in done, "crosstalk undone?"),
        ("CALLIN", bool(_NONLINEARITY_EFFECTS & done), "response undone?"),
        ("CALFRING", "fringes" in done, "fringes of the sky taken off?"),
        ("CALILLUM", bool({"illumination", "shutter"} & frame.applied), "vignetting and shutter undone?"),
        *flag_cards(),
    )


def flag_cards() -> tuple[Card, ...]:
    """Meaning of the bits of FLG."""
    return tuple((f"FLAG{bit}", text, "bit of FLG") for bit, text in FLAGS)


def write_image(path: Path, reduced: ReducedImage, cards: tuple[Card, ...], extensions: Sequence[Image] = ()) -> None:
    """A calibrated image or a stack, in one rename.

    path : of its file;  reduced : its pixels;  cards : of its header;  more : extensions after it
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
    """A file that `write_image` wrote."""
    units = read_images(user_files.check_file(path, "calibrated image"))
    if [unit.name for unit in units[1:4]] != ["SCI", "WHT", "FLG"]:
        raise BadInput(f"{user_files.format_path(path)}: is no calibrated image (extensions SCI, WHT, FLG)")
    image, weight, flags = (np.asarray(unit.data) for unit in units[1:4])
    astrometry.from_cards(units[0].cards)
    return ImageFile(ReducedImage(image, weight, flags), units[0].cards)
