"""Masters and calibrated images as FITS files, and back.

A master has the extensions VALUE, UNCERTAINTY and COUNT, a calibrated image and a stack SCI, WHT (inverse variance)
and FLG (bits, named in its header); all behind a header that holds for all of them.

write_master, read_master     a combined frame
write_image, read_image       image, weight, flags
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jobs.render.camera import astrometry
from jobs.render.channels import registry
from jobs.render.effects.light import illumination
from jobs.render.reduction import calibration
from jobs.render.reduction.calibration import FLAGS, Reduced
from jobs.render.reduction.combining import Combined
from jobs.render.reduction.frames import Frame
from lake_schema import __version__, user_files
from lake_schema.errors import BadInput
from lake_schema.fits.images import Card, Image, read_images, write_images

KINDS = ("bias", "dark", "flat")
_UNITS = {"bias": "electron", "dark": "electron/s", "flat": ""}
# What a master must share with the frame that it is applied to: the detector's patterns are keyed by these.
SAME = ("INSTRUME", "DETECTOR", "SEED")
# Of a raw file's header what is not so any more.
_RAW = ("BUNIT", "GAIN", "BIAS", "SATURATE", "PRESCAN", "OVERSCAN", "OVERROWS", "INJROWS")
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


def master_name(folder: Path, channel: str, detector: str, kind: str) -> Path:
    """The file of a master in a folder; kind : of KINDS, of a channel's detector."""
    return folder / f"{channel}_{detector}_{kind}.fits"


def write_master(path: Path, combined: Combined, kind: str, frames: Sequence[Frame]) -> None:
    """One master of these frames, in one rename; path : of its file, combined : what it holds, kind : of KINDS."""
    first = frames[0]
    cards: tuple[Card, ...] = (
        *(card for card in first.cards if card[0] in (*SAME, "CHANNEL", "MISSION", "TRUESKY")),
        ("IMAGETYP", f"master {kind}", "image type"),
        ("BUNIT", _UNITS[kind], "unit of the pixels"),
        *((("VIGNETTE", _through_optics(first), "vignetting is in it"),) if kind == "flat" else ()),
        ("NCOMBINE", len(frames), "frames"),
        ("EXPTIME", float(np.mean([frame.exposure.exposure_time_s for frame in frames])), "[s] mean of the frames"),
        *((f"FRAME{i}", frame.exposure.exposure_id, "exposure") for i, frame in enumerate(frames, start=1)),
    )
    units = [Image(None, cards), Image(combined.mean, (), "VALUE"), Image(combined.uncertainty, (), "UNCERTAINTY")]
    write_images(path, [*units, Image(combined.count, (), "COUNT")])


def _through_optics(flat: Frame) -> bool:
    """Whether the lamp's light came through the telescope, as a dome's does."""
    return illumination.EFFECT.name in flat.applied and registry.CHANNELS[flat.exposure.channel].on_ground


def read_master(path: Path, kind: str, frame: Frame) -> tuple[Combined, float]:
    """(a master for a frame, s that its frames lasted); BadInput: it is of another detector, or another seed's."""
    units = read_images(user_files.checked(path, "master frame"))
    header = {keyword: value for keyword, value, _ in units[0].cards}
    if header.get("IMAGETYP") != f"master {kind}" or len(units) != 4:
        raise BadInput(f"{user_files.shown(path)}: is no master {kind}")
    for keyword in SAME:
        # Older versions wrote the instrument in small letters.
        if str(header.get(keyword)).lower() != str(frame.card(keyword)).lower():
            what = f"{keyword} = {header.get(keyword)}, the frame's is {frame.card(keyword)}"
            raise BadInput(f"{user_files.shown(path)}: {what}: it cannot calibrate {frame.stem}")
    mean, uncertainty, count = (np.asarray(unit.data) for unit in units[1:])
    shape = (frame.scene.ny, frame.scene.nx)
    if not mean.shape == uncertainty.shape == count.shape == shape:
        raise BadInput(f"{user_files.shown(path)}: {mean.shape} pixels, the frame has {shape}")
    vignetted = bool(header.get("VIGNETTE", False))
    return Combined(mean, uncertainty, count, vignetted), float(header["EXPTIME"])


def masters(folder: Path, frame: Frame, without: Sequence[str] = ()) -> calibration.Masters:
    """The masters of a frame's detector; without : those that are not wanted."""
    shape, found, dark_time = (frame.scene.ny, frame.scene.nx), {}, np.inf
    for kind in KINDS:
        if kind in without:
            found[kind] = calibration.nothing(shape, 1.0 if kind == "flat" else 0.0)
        else:
            path = master_name(folder, frame.exposure.channel, frame.detector, kind)
            found[kind], time = read_master(path, kind, frame)
            dark_time = time if kind == "dark" else dark_time
    flags = np.zeros(shape, np.uint8)
    if "flat" not in without:
        flags |= calibration.response_flags(found["flat"])
    if "dark" not in without:
        flags |= calibration.dark_flags(found["dark"])
    return calibration.Masters(found["bias"], found["dark"], found["flat"], flags, dark_time)


def reduced_cards(frame: Frame, per_second: bool, without: Sequence[str]) -> tuple[Card, ...]:
    """Header of a calibrated image: the raw one's, and what was done."""
    return (
        *(card for card in frame.cards if card[0] not in (*_RAW, *_STRUCTURE)),
        ("BUNIT", "electron/s" if per_second else "electron", "unit of SCI; of WHT its inverse square"),
        ("GAIN", 1.0, "[electron/electron] of the pixels"),
        *((f"CAL{kind.upper()}", kind not in without, f"master {kind} applied?") for kind in KINDS),
        ("CALLIN", "nonlinearity" in frame.applied, "response of the amplifiers undone?"),
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
    place = tuple(card for card in cards if card[0] in _PLACE or card[0].startswith(("A_", "B_")))
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
