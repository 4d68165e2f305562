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
from truesky.reduction.calibration import FLAGS, Reduced
from truesky.reduction.combining import Combined
from truesky.reduction.frames import Frame
from truesky.render.camera import astrometry
from truesky.render.channels import registry
from truesky.render.effects.light import illumination

KINDS = ("bias", "dark", "flat")
# Of an infrared detector, whose ramps have no bias.
INFRARED = ("dark", "linearity", "flat")
# What can be left as it is.
UNDONE = (*KINDS, "linearity", "crosstalk", "nonlinearity", "fringes", "persistence")
_UNITS = {"bias": "electron", "dark": "electron/s", "flat": "", "linearity": "electron-1"}
# What a master must share with the frame that it is applied to: the detector's patterns are keyed by these.
SAME = ("INSTRUME", "DETECTOR", "SEED")
# Of a raw file's header what is not so any more; of amplifiers, with their number or letter at the end.
_RAW: tuple[str, ...] = ("BUNIT", "GAIN", "BIAS", "SATURATE", "PRESCAN", "OVERSCAN", "OVERROWS", "INJROWS", "NAMPS")
_RAW += ("DATASEC", "TRIMSEC", "BIASSEC", "CCDSEC")
_OF_AMPLIFIER = re.compile(r"(AMP|DSEC|CSEC|BSEC|GAIN|RDN)[0-9]+|(DATASEC|BIASSEC|CCDSEC|GAIN|RDNOISE|SATURAT)[A-Z]")
# Pixels of a master of the user's.
_MOST_PIXELS = 1 << 28
_BENT = {"nonlinearity", "ramp_nonlinearity", "signal_nonlinearity"}
_STRUCTURE: tuple[str, ...] = (
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
_STRUCTURE += ("GCOUNT", "EXTNAME", "BZERO", "BSCALE", "ZCMPTYPE", "COMMENT", "HISTORY")


@dataclass(frozen=True, slots=True)
class ImageFile:
    """A calibrated image and its header."""

    reduced: Reduced
    cards: tuple[Card, ...]

    def card(self, keyword: str) -> Any:
        """Its value, None = there is none."""
        return next((value for key, value, _ in self.cards if key == keyword), None)


def kinds(frame: Frame) -> tuple[str, ...]:
    """Kinds of master that a frame is calibrated with."""
    return INFRARED if frame.scene.ramp else KINDS


def master_name(folder: Path, frame: Frame, kind: str) -> Path:
    """The file in a folder of the master for a frame; kind : of KINDS.

    Of ground cameras, whose channel is one, it has the camera's name; and, a flat, that of the band. Names of a user's
    camera are joined by dots: with underscores, camera a_b in band c would have the file of camera a in band b_c. Of
    NISP a dark has its ramp's numbers, and both channels have one linearity.
    """
    exposure = frame.exposure
    if frame.scene.ramp:
        more = {"dark": "-".join(map(str, frame.ramp)) if kind == "dark" else "", "flat": exposure.band}.get(kind)
        channel = "NISP" if kind == "linearity" else exposure.channel
        return folder / "_".join(filter(None, (channel, more, frame.detector, f"{kind}.fits")))
    if exposure.camera in SPACE_CAMERAS:
        return folder / f"{exposure.channel}_{frame.detector}_{kind}.fits"
    names = (exposure.camera, *((exposure.band,) if kind == "flat" else ()), frame.detector)
    return folder / f"{('_' if exposure.camera in CAMERAS else '.').join(names)}_{kind}.fits"


def write_master(path: Path, combined: Combined, kind: str, frames: Sequence[Frame], more: Sequence[Card] = ()) -> None:
    """One master of these frames, in one rename.

    path : of its file;  combined : what it holds;  kind : of `kinds`;  more : cards of its header
    """
    first = frames[0]
    cards: tuple[Card, ...] = (
        *(card for card in first.cards if card[0] in (*SAME, "CHANNEL", "MISSION", "TRUESKY")),
        ("IMAGETYP", f"master {kind}", "image type"),
        ("BUNIT", _UNITS[kind], "unit of the pixels"),
        *((("VIGNETTE", _through_optics(first), "vignetting is in it"),) if kind == "flat" else ()),
        ("NCOMBINE", len(frames), "frames"),
        ("EXPTIME", float(np.mean([frame.exposure.exposure_time_s for frame in frames])), "[s] mean of the frames"),
        *more,
        *((f"FRAME{i}", frame.exposure.exposure_id, "exposure") for i, frame in enumerate(frames, start=1)),
    )
    units = [Image(None, cards), Image(combined.mean, (), "VALUE"), Image(combined.uncertainty, (), "UNCERTAINTY")]
    write_images(path, [*units, Image(combined.count, (), "COUNT")])


def _through_optics(flat: Frame) -> bool:
    """Whether the lamp's light came through the telescope, as a dome's does."""
    return illumination.EFFECT.name in flat.applied and registry.CHANNELS[flat.exposure.channel].on_ground


def read_master(path: Path, kind: str, frame: Frame) -> tuple[Combined, float]:
    """(a master for a frame, s that its frames lasted); BadInput: it is of another detector, or another seed's.

    One of the user's is an image of the detector's pixels in the units of ours, NaN where it says nothing; whether
    vignetting is in a flat its card VIGNETTE says, else it is in that of a ground camera.
    """
    shape = (frame.scene.ny, frame.scene.nx)
    found, about = external.read_planes(user_files.checked(path, "master frame"), "", "master frame", _MOST_PIXELS)
    if about.get("EXTNAME") != "VALUE":
        _refuse_other_shape(path, found.shape, shape)
        vignetted = bool(about.get("VIGNETTE", registry.CHANNELS[frame.exposure.channel].on_ground))
        return _of_user(found, 1.0 if kind == "flat" else 0.0, vignetted), np.inf
    units = read_images(path)
    header = {keyword: value for keyword, value, _ in units[0].cards}
    if header.get("IMAGETYP") != f"master {kind}" or len(units) != 4:
        raise BadInput(f"{user_files.shown(path)}: is no master {kind}")
    for keyword in SAME:
        if str(header.get(keyword)) != str(frame.card(keyword)):
            what = f"{keyword} = {header.get(keyword)}, the frame's is {frame.card(keyword)}"
            raise BadInput(f"{user_files.shown(path)}: {what}: it cannot calibrate {frame.stem}")
    mean, uncertainty, count = (np.asarray(unit.data) for unit in units[1:])
    for part in (mean, uncertainty, count):
        _refuse_other_shape(path, part.shape, shape)
    vignetted = bool(header.get("VIGNETTE", False))
    return Combined(mean, uncertainty, count, vignetted), float(header["EXPTIME"])


def _refuse_other_shape(path: Path, found: tuple[int, ...], wanted: tuple[int, int]) -> None:
    if found != wanted:
        raise BadInput(f"{user_files.shown(path)}: {found} pixels, the frame has {wanted}")


def _of_user(values: Float, neutral: float, vignetted: bool) -> Combined:
    """A master without uncertainty; neutral : what stands where it says nothing;  vignetted : of a flat."""
    said = np.isfinite(values)
    mean = np.where(said, values, neutral).astype(np.float32)
    return Combined(mean, np.zeros(values.shape, np.float32), said.astype(np.int16), vignetted)


def masters(folder: Path, frame: Frame, without: Sequence[str] = ()) -> calibration.Masters:
    """The masters of a frame's detector; without : those that are not wanted."""
    shape, found, dark_time = (frame.scene.ny, frame.scene.nx), {}, np.inf
    for kind in KINDS:
        if kind in without:
            found[kind] = calibration.nothing(shape, 1.0 if kind == "flat" else 0.0)
        else:
            path = master_name(folder, frame, kind)
            found[kind], time = read_master(path, kind, frame)
            dark_time = time if kind == "dark" else dark_time
    flags = calibration.master_flags(shape, found, without)
    return calibration.Masters(found["bias"], found["dark"], found["flat"], flags, dark_time)


def reduced_cards(frame: Frame, unit: str, electrons: float, without: Sequence[str]) -> tuple[Card, ...]:
    """Header of a calibrated image: the raw one's, and what was done.

    frame     : its raw one;  unit : of its pixels, as FITS writes it
    electrons : of the exposure that one of them is;  without : of UNDONE what was left as it is
    """
    kept = (
        card for card in frame.cards if card[0] not in (*_RAW, *_STRUCTURE) and not _OF_AMPLIFIER.fullmatch(card[0])
    )
    time = frame.scene.exposure_time_s
    done = frame.applied - (set(without) | (_BENT if "nonlinearity" in without else set()))
    return (
        *kept,
        ("BUNIT", unit, "unit of SCI; of WHT its inverse square"),
        ("GAIN", electrons, "[electron/BUNIT] of the pixels"),
        ("MAGZERO", float(frame.card("ZEROPNT")) + 2.5 * math.log10(time / electrons), "[mag] AB magnitude of 1 BUNIT"),
        *((f"CAL{kind.upper()[:5]}", kind not in without, f"master {kind} applied?") for kind in kinds(frame)),
        *((("CALPERS", "persistence" not in without, "foreseen persistence taken off?"),) if frame.scene.ramp else ()),
        ("CALXTALK", "crosstalk" in done, "crosstalk undone?"),
        ("CALLIN", bool(_BENT & done), "response undone?"),
        ("CALFRING", "fringes" in done, "fringes of the sky taken off?"),
        ("CALILLUM", bool({"illumination", "shutter"} & frame.applied), "vignetting and shutter undone?"),
        *flag_cards(),
    )


def flag_cards() -> tuple[Card, ...]:
    """Meaning of the bits of FLG."""
    return tuple((f"FLAG{bit}", text, "bit of FLG") for bit, text in FLAGS)


def write_image(path: Path, reduced: Reduced, cards: tuple[Card, ...], more: Sequence[Image] = ()) -> None:
    """A calibrated image or a stack, in one rename.

    path : of its file;  reduced : its pixels;  cards : of its header;  more : extensions after it
    """
    place = tuple(card for card in cards if card[0] in _PLACE or card[0].startswith(("A_", "B_", "PV1_", "PV2_")))
    pixels = zip(("SCI", "WHT", "FLG"), (reduced.image, reduced.weight, reduced.flags), strict=True)
    own = tuple(card for card in cards if card[0] != "TRUESKY")
    whole = Image(None, (*own, ("TRUESKY", __version__, "version of the simulator")))
    write_images(path, [whole, *(Image(data, place, name) for name, data in pixels), *more])


_PLACE = tuple(
    keyword for keyword in (
        "WCSAXES", "CTYPE1", "CTYPE2", "CUNIT1", "CUNIT2", "CRVAL1", "CRVAL2", "CRPIX1", "CRPIX2", "CD1_1", "CD1_2",
        "CD2_1", "CD2_2", "LONPOLE", "RADESYS",
    )
)  # fmt: skip


def read_image(path: Path) -> ImageFile:
    """A file that `write_image` wrote."""
    units = read_images(user_files.checked(path, "calibrated image"))
    if [unit.name for unit in units[1:4]] != ["SCI", "WHT", "FLG"]:
        raise BadInput(f"{user_files.shown(path)}: is no calibrated image (extensions SCI, WHT, FLG)")
    image, weight, flags = (np.asarray(unit.data) for unit in units[1:4])
    astrometry.from_cards(units[0].cards)
    return ImageFile(Reduced(image, weight, flags), units[0].cards)
