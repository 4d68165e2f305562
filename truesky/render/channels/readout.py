"""How a detector is read: the arrays that it gives, each with its unit and cards, and back from its files.

FRAME       one array of pixels
RAMP        the signal of a ramp, and whether it fits, in the frame of pixels that see no light
RAMP_AND_CHI2  the same, with chi^2 itself
QUADRANTS   four of them, each in the detector's own axes with its pre- and overscan
BY_AMPLIFIER  an array of each amplifier, in the detector's own axes with its pre- and overscan
ELECTRONS   what lies in the pixels before they are read
AMPLIFIERS  one array: the pixels of all amplifiers as they lie on the detector, their pre- and overscans around them
planes, pixels  a frame by quadrants or amplifiers, in the order in which they are read, and back
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import scipy.special
from astropy.wcs import WCS

from lake_schema.arrays import Array, Float
from lake_schema.fits.images import Card, Image
from truesky.render.camera import astrometry
from truesky.render.camera.sections import Section, Sections
from truesky.render.effects.charge import ramp
from truesky.render.effects.readout import adc
from truesky.render.effects.readout import quadrants as layout
from truesky.render.effects.scene import Frame, Scene


@dataclass(frozen=True, slots=True)
class Extension:
    """An array of a readout; its dtype is the file's: a slope may have 16 bits, the quality of its fit 8.

    name      : of its extension; "" = the only array of its file
    data      : [ny, nx], or [n, ny, nx], such as the groups of a ramp
    unit      : as FITS writes it; "" = none, of a flag
    cards     : of it alone
    amplifier : the number of the one that it is read through; None = of several
    sections  : which of its pixels are the detector's; None: it is not told
    """

    name: str
    data: Array
    unit: str
    cards: tuple[Card, ...] = ()
    amplifier: int | None = None
    sections: Sections | None = None


@dataclass(frozen=True, slots=True)
class Readout:
    """The arrays of a detector.

    raw     : as the last effect leaves them, in readout order
    pixels  : [ny, nx] those of the detector alone, in its own axes
    cards   : for all arrays
    """

    extensions: tuple[Extension, ...]
    raw: Array
    pixels: Array
    cards: tuple[Card, ...] = ()

    @property
    def unit(self) -> str | None:
        """Of all arrays; None where they differ."""
        units = {extension.unit for extension in self.extensions}
        return units.pop() if len(units) == 1 else None


@dataclass(frozen=True, slots=True)
class ReadoutMode:
    """How a detector is read, and how what was written of it is read back.

    arrays    : (what the last effect leaves, scene, name of the detector, WCS) -> the arrays of its file
    assembled : (array with the axes of what any effect leaves, scene) -> [ny, nx] the detector's pixels, in its own
                axes; the array itself where it is that already
    pixels    : images of a file -> [ny, nx] its pixels as stored
    electrons : images of a file -> float64[ny, nx] its pixels in e-, the bias subtracted
    before    : the effect from which on nothing of a channel is applied; "" = all of it is
    written   : bytes of a file for each of the detector's pixels; None = as measured (channels/cost.py)
    apart     : ([ny, nx] of the detector, scene) -> what is read at a time side by side, in readout order
    """

    arrays: Callable[[Frame, Scene, str, WCS], Readout]
    assembled: Callable[[Array, Scene], Array]
    pixels: Callable[[Sequence[Image]], Array]
    electrons: Callable[[Sequence[Image]], Float]
    before: str = ""
    written: int | None = None
    apart: Callable[[Array, Scene], Array] = lambda array, scene: array


# ---------------------------------------------------------------------------------------------- one frame


def _frame(found: Frame, scene: Scene, detector: str, system: WCS) -> Readout:
    """[ny, nx] ADU, in as many bits as the converter wants."""
    raw = adc.as_stored(found, scene)
    return Readout((Extension("", raw, "adu", sections=Sections.whole(*raw.shape[::-1])),), raw, raw)


def _frame_electrons(read: Sequence[Image]) -> Float:
    header = _header(read[0])
    return np.asarray((np.asarray(read[0].data) - float(header["BIAS"])) * float(header["GAIN"]))


FRAME = ReadoutMode(
    arrays=_frame,
    assembled=lambda array, scene: array,
    pixels=lambda read: np.asarray(read[0].data),
    electrons=_frame_electrons,
)


# ---------------------------------------------------------------------------------------------- the signal of a ramp

# Of eight bits.
_MOST_CHI2 = 255.0


def _ramp(found: Frame, scene: Scene, detector: str, system: WCS, whole: bool) -> Readout:
    """Signal uint16 ADU and quality uint8, 1 where the ramp does not fit; two groups have no quality.

    whole : the quality is chi^2 itself, rounded, 255 = as much or more

    Error : reads that are correlated, and expected noise, make of a chance of 1e-3 up to 8e-3
    """
    mode, border = ramp.mode_of(scene), int(scene.value("fpa.reference_border", "pix"))
    # Of n differences one number, the signal, is estimated: n - 1 degrees of freedom.
    limit = float(scipy.special.chdtri(max(mode.groups - 2, 1), scene.value("quality_chance", "")))
    signal = found[0].astype(np.uint16)
    level = np.uint16(scene.value("reference_level", "adu"))
    cards: tuple[Card, ...] = (
        ("READMODE", "MACC", "multiple accumulated groups"),
        ("NG", mode.groups, "groups"),
        ("NR", mode.reads, "reads in a group"),
        ("ND", mode.drops, "frames dropped between two groups"),
        ("FRTIME", ramp.frame_time(scene), "[s] from frame to frame"),
        ("ELAPTIME", mode.frames * ramp.frame_time(scene), "[s] from the reset to the last read"),
        ("REFPIX", border, "[pix] width of the border of reference pixels"),
    )
    place = astrometry.cards(astrometry.shifted(system, border, border))
    ny, nx = signal.shape
    own = Sections(Section(border, border, nx, ny), Section(0, 0, nx, ny))
    padded = np.pad(signal, border, constant_values=level)
    planes = [Extension(f"{detector}.SCI", padded, "adu", place, sections=own)]
    if mode.groups > 2:
        flag = np.rint(np.minimum(found[1], _MOST_CHI2)) if whole else found[1] > limit
        meaning = () if whole else (("QUALFLAG", 1, "value where chi^2 exceeds QUALLIM, else 0"),)
        quality = np.pad(flag.astype(np.uint8), border)
        planes.append(Extension(f"{detector}.CHI2", quality, "", (*meaning, *place), sections=own))
        text = "chi^2 above which a ramp does not fit" if whole else "chi^2 above which a pixel's quality is 1"
        cards += (("QUALLIM", limit, text),)
    else:
        cards += (("QUALLIM", 0.0, "two groups have no chi^2: there is no quality"),)
    return Readout(tuple(planes), signal, signal, cards)


def _signal(read: Sequence[Image]) -> Array:
    """Of the extensions after the header the first is the signal."""
    border, data = int(_header(read[0])["REFPIX"]), np.asarray(read[1].data)
    return data[border : len(data) - border, border : data.shape[1] - border]


def _signal_electrons(read: Sequence[Image]) -> Float:
    header = _header(read[0])
    return np.asarray((_signal(read) - float(header["BIAS"])) * float(header["GAIN"]))


RAMP = ReadoutMode(
    arrays=partial(_ramp, whole=False),
    assembled=lambda array, scene: array if array.ndim == 2 else array[0],
    pixels=_signal,
    electrons=_signal_electrons,
)
RAMP_AND_CHI2 = replace(RAMP, arrays=partial(_ramp, whole=True))


# ---------------------------------------------------------------------------------------------- quadrants


def _quadrants(found: Frame, scene: Scene, detector: str, system: WCS) -> Readout:
    """[4, rows, columns] ADU as stored, extensions named detector.quadrant."""
    raw = adc.as_stored(found, scene)
    prescan, overscan, rows, middle = sizes = layout.sizes(scene)
    scans = (
        ("PRESCAN", prescan, "[pix] columns before the pixels"),
        ("OVERSCAN", overscan, "[pix] columns after the pixels"),
        ("OVERROWS", rows, "[pix] rows after the pixels"),
        ("INJROWS", middle, "[pix] rows between the halves, without pixels"),
    )  # fmt: skip
    extensions = []
    for number, name in enumerate(layout.NAMES):
        # Of the detector's first pixel in the extension, from 0.
        across, up = layout.origin(number, raw[number].shape, *sizes)
        place = astrometry.cards(astrometry.shifted(system, across, up))
        cards: tuple[Card, ...] = (("QUADRANT", name, "quadrant"), *scans, *place)
        own, plane = layout.sections(number, raw[number].shape, *sizes), layout.placed(raw[number], number)
        extensions.append(Extension(f"{detector}.{name}", plane, "adu", cards, number, own))
    return Readout(tuple(extensions), raw, layout.assembled(raw, *sizes), scans)


def _assembled(array: Array, scene: Scene) -> Array:
    return array if array.ndim == 2 else layout.assembled(array, *layout.sizes(scene))


def _quadrant_pixels(read: Sequence[Image]) -> Array:
    raw, sizes = _raw(read)
    return layout.assembled(raw, *sizes)


def _quadrant_electrons(read: Sequence[Image]) -> Float:
    """Above the level of each amplifier."""
    raw, sizes = _raw(read)
    # In the extension's header where the amplifiers have different gains.
    own = [{**_header(read[0]), **_header(unit)} for unit in read[1:]]
    gain = np.array([float(cards["GAIN"]) for cards in own]).reshape(-1, 1, 1)
    _, overscan, rows, _ = sizes
    # The last half of the columns after the pixels: charge that traps gave back is in the first.
    level = raw[:, : raw.shape[1] - rows, raw.shape[2] - max(overscan // 2, 1) :].mean(axis=(1, 2), keepdims=True)
    return layout.assembled((raw - level) * gain, *sizes)


def _raw(read: Sequence[Image]) -> tuple[Array, tuple[int, int, int, int]]:
    """Quadrants in readout order; prescan, overscan, overscan rows, rows between the halves."""
    header = _header(read[0])
    raw = np.stack([layout.placed(np.asarray(unit.data), number) for number, unit in enumerate(read[1:])])
    prescan, overscan, rows, between = (int(header[key]) for key in ("PRESCAN", "OVERSCAN", "OVERROWS", "INJROWS"))
    return raw, (prescan, overscan, rows, between)


def _header(image: Image) -> dict[str, Any]:
    return {keyword: value for keyword, value, _ in image.cards}


def _quadrants_apart(array: Array, scene: Scene) -> Array:
    return layout.apply(array, *layout.sizes(scene))


QUADRANTS = ReadoutMode(
    arrays=_quadrants,
    assembled=_assembled,
    pixels=_quadrant_pixels,
    electrons=_quadrant_electrons,
    apart=_quadrants_apart,
)


# ---------------------------------------------------------------------------------------------- amplifiers in one array


def _amplifiers(found: Frame, scene: Scene, detector: str, system: WCS) -> Readout:
    """[q, rows, columns] ADU as stored; its file has one array, and for each amplifier, from 1, where its parts are."""
    own, raw = scene.layout, adc.as_stored(found, scene)
    assert own is not None
    cards: list[Card] = [
        *astrometry.cards(astrometry.shifted(system, own.data.x, own.data.y)),
        ("NAMPS", len(own.amplifiers), "amplifiers"),
    ]
    numbers = (
        ("GAIN", scene.of_amplifiers("gain", "electron / adu"), "[electron/adu] conversion gain"),
        ("RDN", scene.of_amplifiers("read_noise", "electron"), "[electron] rms read noise"),
    )
    for number, amplifier in enumerate(own.amplifiers):
        n = number + 1
        cards += [
            (f"AMP{n}", amplifier.name, "amplifier"),
            (f"DSEC{n}", own.pixels_of(number).text, "its pixels"),
            (f"CSEC{n}", amplifier.pixels.text, "the same, on the detector"),
            (f"BSEC{n}", own.bias_of(number).text, "columns of bias beside them"),
            *((f"{key}{n}", float(np.broadcast_to(value, len(raw))[number]), text) for key, value, text in numbers),
        ]
        # Letters, as DECam's and MegaCam's files have them.
        if len(amplifier.name) == 1:
            cards += [
                (f"DATASEC{amplifier.name}", own.pixels_of(number).text, f"pixels of amplifier {amplifier.name}"),
                (f"BIASSEC{amplifier.name}", own.bias_of(number).text, "columns of bias beside them"),
                (f"CCDSEC{amplifier.name}", amplifier.pixels.text, "its pixels, on the detector"),
            ]
    parts = Sections(own.data, Section(0, 0, own.nx, own.ny))
    return Readout((Extension("", own.raw(raw), "adu", tuple(cards), sections=parts),), raw, own.together(raw))


def _apart_assembled(array: Array, scene: Scene) -> Array:
    return array if array.ndim == 2 or scene.layout is None else scene.layout.together(array)


def _by_amplifier(found: Frame, scene: Scene, detector: str, system: WCS) -> Readout:
    """[q, rows, columns] ADU as stored; extensions named as LSST's segments, or as the amplifiers."""
    own, raw = scene.layout, adc.as_stored(found, scene)
    assert own is not None
    extensions = []
    for number, amplifier in enumerate(own.amplifiers):
        parts = own.sections_of(number)
        across, up = (getattr(parts.data, axis) - getattr(parts.ccd, axis) for axis in "xy")
        cards: tuple[Card, ...] = (
            ("AMPNAME", amplifier.name, "amplifier"),
            *astrometry.cards(astrometry.shifted(system, across, up)),
        )
        name = _SEGMENT.sub("Segment", amplifier.name)
        extensions.append(Extension(name, own.placed(raw[number], number), "adu", cards, number, parts))
    return Readout(tuple(extensions), raw, own.together(raw))


def _assembled_of(read: Sequence[Image], level: Callable[[Array, dict[str, Any]], Array]) -> Array:
    """Extensions of a file -> [ny, nx] the detector's pixels; level : (array, its cards) -> what is taken of them."""
    parts = [(unit, {**_header(read[0]), **_header(unit)}) for unit in read[1:]]
    places = [Section.of(header["CCDSEC"]) for _, header in parts]
    found = [level(np.asarray(unit.data), header)[Section.of(header["DATASEC"]).slices] for unit, header in parts]
    out = np.zeros((max(p.y + p.ny for p in places), max(p.x + p.nx for p in places)), found[0].dtype)
    for place, pixels in zip(places, found, strict=True):
        out[place.slices] = pixels
    return out


def _above_bias(array: Array, header: dict[str, Any]) -> Float:
    bias = Section.of(header["BIASSEC"]) if "BIASSEC" in header else None
    level = float(header["BIAS"]) if bias is None else float(array[bias.slices].mean())
    return np.asarray((array - level) * float(header["GAIN"]))


# An amplifier of LSSTCam is a segment of its sensor.
_SEGMENT = re.compile(r"^C(?=[01][0-7]$)")


def _data(read: Sequence[Image]) -> Array:
    """The detector's pixels; all of a file that has nothing else."""
    if read[0].data is None:
        return _assembled_of(read, lambda array, header: array)
    header, array = _header(read[0]), np.asarray(read[0].data)
    return array[Section.of(header["DATASEC"]).slices] if "DATASEC" in header else array


def _apart_electrons(read: Sequence[Image]) -> Float:
    """Above the level of each amplifier's bias columns, where there are some."""
    if read[0].data is None:
        return _assembled_of(read, _above_bias)
    header, array = _header(read[0]), np.asarray(read[0].data)
    if "NAMPS" not in header:
        return _frame_electrons(read)
    out = np.zeros(_data(read).shape)
    for n in range(1, int(header["NAMPS"]) + 1):
        pixels, place, bias = (Section.of(header[f"{key}{n}"]) for key in ("DSEC", "CSEC", "BSEC"))
        level = float(array[bias.slices].mean()) if bias.nx and bias.ny else float(header["BIAS"])
        out[place.slices] = (array[pixels.slices] - level) * float(header[f"GAIN{n}"])
    return out


def _apart(array: Array, scene: Scene) -> Array:
    return array if scene.layout is None else scene.layout.apart(array)


AMPLIFIERS = ReadoutMode(_amplifiers, _apart_assembled, _data, _apart_electrons, apart=_apart)
BY_AMPLIFIER = replace(AMPLIFIERS, arrays=_by_amplifier)


# ---------------------------------------------------------------------------------------------- electrons in the pixels


def _electrons(found: Frame, scene: Scene, detector: str, system: WCS) -> Readout:
    """float32[ny, nx] e-, the sky and what else has come in them."""
    pixels = found.astype(np.float32)
    own = Extension("", pixels, "electron", sections=Sections.whole(*pixels.shape[::-1]))
    return Readout((own,), pixels, pixels)


ELECTRONS = replace(AMPLIFIERS, arrays=_electrons, before=layout.AMPLIFIERS.name, written=4)


# ---------------------------------------------------------------------------------------------- by amplifiers, and back


def planes(frame: Float, scene: Scene) -> Float:
    """[ny, nx] -> [q, rows, columns] in readout order; 0 in the pre- and overscan that a layout has."""
    if scene.layout is not None:
        return scene.layout.apart(frame)
    return layout.apply(frame, 0, 0, 0, scene.middle)


def pixels(of_amplifiers: Array, scene: Scene) -> Array:
    """[q, rows, columns] as `planes` makes them -> [ny, nx], 0 where nothing is read."""
    if scene.layout is not None:
        return scene.layout.together(of_amplifiers)
    return layout.assembled(of_amplifiers, 0, 0, 0, scene.middle)
