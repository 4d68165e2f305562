"""Readout modes of detectors: convert the simulated pixels to the arrays of an image file, and read them back.

Each array has a unit and FITS cards. The modes of Euclid are QUADRANTS (four arrays of VIS), RAMP and RAMP_AND_CHI2
(signal of an up-the-ramp readout of NISP with a quality flag or with chi^2). Ground cameras have AMPLIFIERS (all
amplifiers in one array), BY_AMPLIFIER (one array per amplifier) and ELECTRONS (charge in the pixels before readout).
FRAME is a single array without amplifiers.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from lake_schema.arrays import Array, Float, Int
from lake_schema.fits.images import Card, Image
from truesky.render.camera import astrometry
from truesky.render.camera.amplifiers import Layout
from truesky.render.camera.sections import Section, Sections, steps_of_text
from truesky.render.effects.charge import ramp
from truesky.render.effects.readout import adc
from truesky.render.effects.readout import quadrants as layout
from truesky.render.effects.scene import Frame, Scene

if TYPE_CHECKING:
    from astropy.wcs import WCS


@dataclass(frozen=True, slots=True)
class Extension:
    """One array (FITS extension) of the image file of a detector.

    Attributes
    ----------
    name : str
        Name of the extension; "" if it is the only array of its file.
    data : array, shape (ny, nx) or (n, ny, nx)
        Pixels, or n planes such as the groups of a ramp, with the data type that the file has.
    unit : str
        Unit in FITS notation; "" for a flag.
    cards : tuple of Card
        FITS header cards of this extension only.
    amplifier : int or None
        Number (from 0) of the amplifier through which the array is read; None for several amplifiers.
    sections : Sections or None
        Part of the array that contains pixels of the detector, and its place on the detector; None if unknown.
    """

    name: str
    data: Array
    unit: str
    cards: tuple[Card, ...] = ()
    amplifier: int | None = None
    sections: Sections | None = None


def _identity(array: Array) -> Array:
    return array


@dataclass(frozen=True, slots=True)
class Readout:
    """All arrays of the image file of a detector.

    Attributes
    ----------
    extensions : tuple of Extension
        Arrays of the file in their order.
    raw : array
        Pixels after the last effect, with prescan and overscan. The pixels of each amplifier are in the order in which
        they are read, with one plane per amplifier if there are several.
    assemble : callable
        Function of `raw` that returns the pixels of the detector in its own orientation, without prescan and overscan.
        Few users need them, and they take as long as several effects.
    cards : tuple of Card
        FITS header cards that apply to all arrays.
    """

    extensions: tuple[Extension, ...]
    raw: Array
    assemble: Callable[[Array], Array] = _identity
    cards: tuple[Card, ...] = ()

    @property
    def pixels(self) -> Array:
        """Pixels of the detector in its own orientation, without prescan and overscan, shape (ny, nx)."""
        return self.assemble(self.raw)

    @property
    def unit(self) -> str | None:
        """Pixel unit of all arrays in FITS notation; None if they have different units."""
        units = {extension.unit for extension in self.extensions}
        return units.pop() if len(units) == 1 else None


@dataclass(frozen=True, slots=True)
class ReadoutMode:
    """Functions that convert the pixels of a detector to the arrays of an image file, and back.

    In the signatures below, "scene" is the `Scene` with the properties of the detector and its exposure, and "effects"
    are the detector effects of the simulation, which are applied one after the other.

    Attributes
    ----------
    make_readout : callable
        (pixels after the last effect, scene, name of the detector, WCS) -> `Readout` with the arrays of the file.
    assemble : callable
        (pixels after any effect, as one array [ny, nx] or one plane per amplifier, scene) -> pixels [ny, nx] of the
        detector in its own orientation.
    read_pixels : callable
        (images of a file) -> pixels [ny, nx] of the detector as stored, without prescan and overscan.
    read_electrons : callable
        (images of a file) -> the same pixels in electrons, with the bias subtracted.
    stop_before : str
        Name of the first effect of the channel that is not applied; "" if all effects are applied.
    file_bytes_per_pixel : int or None
        Bytes of the file per pixel of the detector; None for the measured value in the `Cost` of the channel.
    readout_places : callable
        (rows, columns, scene) -> (places, shape). `rows` and `columns` are the positions of n pixels on the detector,
        int64[n]. `places`, int64[n, k], are their indices in an array with the shape `shape` (k axes), which has one
        plane per amplifier. Pixels at the same place in all planes are read at the same time. Indices are -1 for pixels
        that are not read.
    """

    make_readout: Callable[[Frame, Scene, str, WCS], Readout]
    assemble: Callable[[Array, Scene], Array]
    read_pixels: Callable[[Sequence[Image]], Array]
    read_electrons: Callable[[Sequence[Image]], Float]
    stop_before: str = ""
    file_bytes_per_pixel: int | None = None
    readout_places: Callable[[Int, Int, Scene], tuple[Int, tuple[int, ...]]] = lambda rows, columns, scene: (
        np.column_stack([rows, columns]),
        (scene.ny, scene.nx),
    )


def _frame(frame: Frame, scene: Scene, detector: str, system: WCS) -> Readout:
    """Make the file of a detector with one array [ny, nx] in ADU, in the data type of the converter (ADC).

    `frame` has the pixels after the last effect. `detector` and `system` (its WCS) are not used.
    """
    raw = adc.to_file_type(frame, scene)
    return Readout((Extension("", raw, "adu", sections=Sections.full_frame(*raw.shape[::-1])),), raw)


def _frame_electrons(read: Sequence[Image]) -> Float:
    header = _header(read[0])
    return np.asarray((np.asarray(read[0].data) - float(header["BIAS"])) * float(header["GAIN"]))


FRAME = ReadoutMode(
    make_readout=_frame,
    assemble=lambda array, scene: array,
    read_pixels=lambda read: np.asarray(read[0].data),
    read_electrons=_frame_electrons,
)


# Largest chi^2 of the fit to an up-the-ramp exposure that is stored, because its array has eight bits. Larger values of
# chi^2 are stored as this number.
_MAX_CHI2 = 255.0


def _ramp(frame: Frame, scene: Scene, detector: str, system: WCS, store_chi2: bool) -> Readout:
    """Make the arrays of an up-the-ramp exposure: the signal (uint16, ADU) and its quality (uint8).

    `frame` has two planes: the signal in ADU, and chi^2 of the fit to the groups of reads. The quality is 1 if the fit
    is bad, otherwise 0; with `store_chi2` it is chi^2 itself, rounded and at most 255. An exposure of two groups has no
    quality. A fit is bad if chi^2 exceeds the limit for the probability `quality_chance`, nominally 1e-3. Correlated
    reads and the use of the expected noise raise this probability to up to 8e-3. Both arrays get a border of reference
    pixels. The WCS `system` is shifted by the border.
    """
    mode, border = ramp.mode_of_scene(scene), int(scene.value("fpa.reference_border", "pix"))
    # The signal is fitted to n = groups - 1 differences, which leaves n - 1 degrees of freedom for chi^2.
    limit = float(scipy.special.chdtri(max(mode.groups - 2, 1), scene.value("quality_chance", "")))
    signal = frame[0].astype(np.uint16)
    level = np.uint16(scene.value("reference_level", "adu"))
    cards: tuple[Card, ...] = (
        ("READMODE", "MACC", "multiple accumulated groups"),
        ("NG", mode.groups, "number of groups"),
        ("NR", mode.reads, "number of reads per group"),
        ("ND", mode.drops, "number of frames dropped between groups"),
        ("FRTIME", ramp.frame_time(scene), "[s] time per frame"),
        ("ELAPTIME", mode.frames * ramp.frame_time(scene), "[s] time from reset to last read"),
        ("REFPIX", border, "[pix] width of the reference-pixel border"),
    )
    place = astrometry.cards(astrometry.shift_pixels(system, border, border))
    ny, nx = signal.shape
    sections = Sections(Section(border, border, nx, ny), Section(0, 0, nx, ny))
    padded = np.pad(signal, border, constant_values=level)
    planes = [Extension(f"{detector}.SCI", padded, "adu", place, sections=sections)]
    if mode.groups > 2:
        flag = np.rint(np.minimum(frame[1], _MAX_CHI2)) if store_chi2 else frame[1] > limit
        meaning = () if store_chi2 else (("QUALFLAG", 1, "value if chi^2 > QUALLIM, else 0"),)
        quality = np.pad(flag.astype(np.uint8), border)
        planes.append(Extension(f"{detector}.CHI2", quality, "", (*meaning, *place), sections=sections))
        text = "largest chi^2 of a good fit to the ramp" if store_chi2 else "largest chi^2 of a pixel with quality 0"
        cards += (("QUALLIM", limit, text),)
    else:
        cards += (("QUALLIM", 0.0, "no quality: two groups have no chi^2"),)
    return Readout(tuple(planes), signal, cards=cards)


def _signal(read: Sequence[Image]) -> Array:
    """Return the signal of a ramp in ADU without the border of reference pixels, from the images of its file.

    The first image has only the header, the second has the signal.
    """
    border, data = int(_header(read[0])["REFPIX"]), np.asarray(read[1].data)
    return data[border : len(data) - border, border : data.shape[1] - border]


def _signal_electrons(read: Sequence[Image]) -> Float:
    header = _header(read[0])
    return np.asarray((_signal(read) - float(header["BIAS"])) * float(header["GAIN"]))


RAMP = ReadoutMode(
    make_readout=partial(_ramp, store_chi2=False),
    assemble=lambda array, scene: array if array.ndim == 2 else array[0],
    read_pixels=_signal,
    read_electrons=_signal_electrons,
)
RAMP_AND_CHI2 = replace(RAMP, make_readout=partial(_ramp, store_chi2=True))


def _quadrants(frame: Frame, scene: Scene, detector: str, system: WCS) -> Readout:
    """Make the four arrays (ADU) of a VIS detector, one per quadrant, each with its prescan and overscan.

    Their names are the name of the detector, a dot and that of the quadrant. They are sorted by name: "3-4.E" is first.
    """
    raw = adc.to_file_type(frame, scene)
    prescan, overscan, rows, middle = sizes = layout.overscan_sizes(scene)
    scans = (
        ("PRESCAN", prescan, "[pix] number of prescan columns"),
        ("OVERSCAN", overscan, "[pix] number of overscan columns"),
        ("OVERROWS", rows, "[pix] number of overscan rows"),
        ("INJROWS", middle, "[pix] charge-injection rows between the halves"),
    )  # fmt: skip
    extensions = []
    for number in layout.FILE_ORDER:
        name = layout.NAMES[number]
        # Number of columns and rows to add to a position on the detector to get the position in this quadrant's array.
        across, up = layout.pixel_offset(number, raw[number].shape, *sizes)
        place = astrometry.cards(astrometry.shift_pixels(system, across, up))
        cards: tuple[Card, ...] = (("QUADRANT", name, "quadrant name"), *scans, *place)
        sections, plane = (
            layout.sections(number, raw[number].shape, *sizes),
            layout.to_detector_axes(raw[number], number),
        )
        extensions.append(Extension(f"{detector}.{name}", plane, "adu", cards, number, sections))
    return Readout(tuple(extensions), raw, lambda planes: layout.assemble(planes, *sizes), scans)


def _assemble_quadrants(array: Array, scene: Scene) -> Array:
    return array if array.ndim == 2 else layout.assemble(array, *layout.overscan_sizes(scene))


def _quadrant_pixels(read: Sequence[Image]) -> Array:
    raw, sizes = _read_quadrants(read)
    return layout.assemble(raw, *sizes)


def _quadrant_electrons(read: Sequence[Image]) -> Float:
    """Return the pixels [ny, nx] of a VIS detector in electrons, from the images of its file.

    The bias of each quadrant is the mean of the second half of its overscan columns, which is read last.
    """
    raw, sizes = _read_quadrants(read)
    # Use the card GAIN in the header of each quadrant's extension or, if it has none, in the primary header of the
    # file.
    headers = [{**_header(read[0]), **_header(unit)} for unit in layout.in_plane_order(read[1:])]
    gain = np.array([float(cards["GAIN"]) for cards in headers]).reshape(-1, 1, 1)
    _, overscan, rows, _ = sizes
    # Measure the bias in the half of the overscan columns that is read last: the first half contains charge that traps
    # have released.
    level = raw[:, : raw.shape[1] - rows, raw.shape[2] - max(overscan // 2, 1) :].mean(axis=(1, 2), keepdims=True)
    return layout.assemble((raw - level) * gain, *sizes)


def _read_quadrants(read: Sequence[Image]) -> tuple[Array, tuple[int, int, int, int]]:
    """Return the four quadrants of a VIS file, with rows and columns in the order of the readout, and four sizes.

    The sizes are the numbers of prescan columns, overscan columns, overscan rows, and injection rows between the two
    halves of the detector.
    """
    header = _header(read[0])
    planes = enumerate(layout.in_plane_order(read[1:]))
    raw = np.stack([layout.to_detector_axes(np.asarray(unit.data), number) for number, unit in planes])
    prescan, overscan, rows, between = (int(header[key]) for key in ("PRESCAN", "OVERSCAN", "OVERROWS", "INJROWS"))
    return raw, (prescan, overscan, rows, between)


def _header(image: Image) -> dict[str, Any]:
    return {keyword: value for keyword, value, _ in image.cards}


def _quadrant_places(rows: Int, columns: Int, scene: Scene) -> tuple[Int, tuple[int, ...]]:
    return layout.readout_places((rows, columns), (scene.ny, scene.nx), *layout.overscan_sizes(scene))


QUADRANTS = ReadoutMode(
    make_readout=_quadrants,
    assemble=_assemble_quadrants,
    read_pixels=_quadrant_pixels,
    read_electrons=_quadrant_electrons,
    readout_places=_quadrant_places,
)


def _amplifiers(frame: Frame, scene: Scene, detector: str, system: WCS) -> Readout:
    """Make the file of a ground detector with all amplifiers in one array (ADU).

    FITS cards give the section, gain and read noise of each amplifier; their keywords end with its number from 1. If
    prescan or overscan lies between the pixels, the array has no section DATASEC. The WCS is then that of the detector
    after the sections DSECn have been joined, as in files of Hyper Suprime-Cam.
    """
    amplifier_layout, raw = scene.layout, adc.to_file_type(frame, scene)
    assert amplifier_layout is not None
    data = amplifier_layout.data_section
    cards: list[Card] = [
        *astrometry.cards(system if data is None else astrometry.shift_pixels(system, data.x, data.y)),
        ("NAMPS", len(amplifier_layout.amplifiers), "number of amplifiers"),
    ]
    numbers = (
        ("GAIN", scene.amplifier_values("gain", "electron / adu"), "[electron/adu] conversion gain"),
        ("RDN", scene.amplifier_values("read_noise", "electron"), "[electron] rms read noise"),
    )
    for number, amplifier in enumerate(amplifier_layout.amplifiers):
        n = number + 1
        cards += [
            (f"AMP{n}", amplifier.name, "amplifier name"),
            (f"DSEC{n}", amplifier_layout.amplifier_data_section(number).text, "pixels of the amplifier"),
            (f"CSEC{n}", amplifier.pixels.text, "pixels in detector coordinates"),
            (f"BSEC{n}", amplifier_layout.amplifier_bias_section(number).text, "bias section of the amplifier"),
            *((f"{key}{n}", float(np.broadcast_to(value, len(raw))[number]), text) for key, value, text in numbers),
        ]
        # If the amplifier is named by a letter, also write the keywords that DECam and MegaCam use, such as DATASECA.
        if len(amplifier.name) == 1:
            cards += [
                (
                    f"DATASEC{amplifier.name}",
                    amplifier_layout.amplifier_data_section(number).text,
                    f"pixels of amplifier {amplifier.name}",
                ),
                (
                    f"BIASSEC{amplifier.name}",
                    amplifier_layout.amplifier_bias_section(number).text,
                    f"bias section of amplifier {amplifier.name}",
                ),
                (f"CCDSEC{amplifier.name}", amplifier.pixels.text, "pixels in detector coordinates"),
            ]
    parts = None if data is None else Sections(data, Section(0, 0, amplifier_layout.nx, amplifier_layout.ny))
    return Readout(
        (Extension("", amplifier_layout.to_raw_image(raw), "adu", tuple(cards), sections=parts),),
        raw,
        amplifier_layout.assemble,
    )


def _assemble_amplifiers(array: Array, scene: Scene) -> Array:
    return array if array.ndim == 2 or scene.layout is None else scene.layout.assemble(array)


def _by_amplifier(frame: Frame, scene: Scene, detector: str, system: WCS) -> Readout:
    """Make the file of a ground detector with one extension (ADU) per amplifier, in the order of the readout.

    The first pixel of an array is read first: prescan, pixels and overscan of each row follow one another. The name of
    an extension is that of the amplifier. Amplifiers of LSSTCam have the names in its own files: "C10" becomes
    "Segment10".
    """
    amplifier_layout, raw = scene.layout, adc.to_file_type(frame, scene)
    assert amplifier_layout is not None
    extensions = []
    for number, amplifier in enumerate(amplifier_layout.amplifiers):
        parts = amplifier_layout.amplifier_sections(number)
        cards: tuple[Card, ...] = (
            ("AMPNAME", amplifier.name, "amplifier name"),
            *astrometry.cards(_amplifier_wcs(system, parts, amplifier_layout)),
        )
        name = _SEGMENT.sub("Segment", amplifier.name)
        extensions.append(Extension(name, raw[number], "adu", cards, number, parts))
    return Readout(tuple(extensions), raw, amplifier_layout.assemble)


def _amplifier_wcs(system: WCS, parts: Sections, amplifier_layout: Layout) -> WCS:
    """Return the world coordinate system of an amplifier's plane from that of the detector, `system`."""
    size, place = (amplifier_layout.nx, amplifier_layout.ny), parts.ccd
    # First column and row of the amplifier's pixels, on the detector with its axes in the order of the readout.
    first = [
        n - low - pixels if step < 0 else low
        for n, low, pixels, step in zip(size, (place.x, place.y), (place.nx, place.ny), parts.steps, strict=True)
    ]
    flipped = astrometry.flip_pixels(system, parts.steps, size)
    return astrometry.shift_pixels(flipped, parts.data.x - first[0], parts.data.y - first[1])


def _assemble_extensions(read: Sequence[Image], calibrate: Callable[[Array, dict[str, Any]], Array]) -> Array:
    """Assemble the pixels [ny, nx] of a detector from a file with one extension per amplifier.

    `read` are the images of the file, of which the first has only the header. `calibrate` converts the array of an
    extension, given its FITS cards, before its detector pixels are cut out. The card CCDSEC also tells whether columns
    or rows of the array are in the opposite order.
    """
    parts = [(unit, {**_header(read[0]), **_header(unit)}) for unit in read[1:]]
    places = [Section.from_text(header["CCDSEC"]) for _, header in parts]
    arrays = [
        calibrate(np.asarray(unit.data), header)[Section.from_text(header["DATASEC"]).slices] for unit, header in parts
    ]
    out = np.zeros((max(p.y + p.ny for p in places), max(p.x + p.nx for p in places)), arrays[0].dtype)
    for (_, header), place, pixels in zip(parts, places, arrays, strict=True):
        column_step, row_step = steps_of_text(header["CCDSEC"])
        out[place.slices] = pixels[::row_step, ::column_step]
    return out


def _above_bias(array: Array, header: dict[str, Any]) -> Float:
    bias = Section.from_text(header["BIASSEC"]) if "BIASSEC" in header else None
    level = float(header["BIAS"]) if bias is None else float(array[bias.slices].mean())
    return np.asarray((array - level) * float(header["GAIN"]))


# Pattern that matches the first letter in the names of LSSTCam's amplifiers, such as "C10". In the files of LSSTCam,
# the extension of this amplifier has the name "Segment10".
_SEGMENT = re.compile(r"^C(?=[01][0-7]$)")


def _amplifier_pixels(read: Sequence[Image]) -> Array:
    """Return the pixels [ny, nx] of a ground detector as stored, from the images of its file.

    Without cards that tell where the pixels are (files in electrons), the whole array is returned.
    """
    if read[0].data is None:
        return _assemble_extensions(read, lambda array, header: array)
    header, array = _header(read[0]), np.asarray(read[0].data)
    if "DATASEC" in header:
        return array[Section.from_text(header["DATASEC"]).slices]
    return _join_sections(header, array, lambda pixels, n: pixels) if "NAMPS" in header else array


def _join_sections(header: Mapping[str, Any], array: Array, convert: Callable[[Array, int], Array]) -> Array:
    """Join the pixels of all amplifiers in an array, by its cards DSECn and CSECn, to an image of the detector.

    `convert` is a function of the pixels of an amplifier and its number from 1, which returns the pixels to join. The
    result is 0 in pixels that no amplifier reads. It has the size of DATASEC, if there is this card.
    """
    numbers = range(1, int(header["NAMPS"]) + 1)
    places = [Section.from_text(header[f"CSEC{n}"]) for n in numbers]
    parts = [convert(array[Section.from_text(header[f"DSEC{n}"]).slices], n) for n in numbers]
    if "DATASEC" in header:
        # The last rows and columns of the detector may belong to no amplifier.
        whole = Section.from_text(header["DATASEC"])
        shape = whole.ny, whole.nx
    else:
        shape = max(p.y + p.ny for p in places), max(p.x + p.nx for p in places)
    out = np.zeros(shape, parts[0].dtype)
    for place, pixels in zip(places, parts, strict=True):
        out[place.slices] = pixels
    return out


def _amplifier_electrons(read: Sequence[Image]) -> Float:
    """Return the pixels [ny, nx] of a ground detector in electrons, from the images of its file.

    The bias of each amplifier is the mean of its bias columns, or the card BIAS if it has no bias columns.
    """
    if read[0].data is None:
        return _assemble_extensions(read, _above_bias)
    header, array = _header(read[0]), np.asarray(read[0].data)
    if "NAMPS" not in header:
        return _frame_electrons(read)

    def to_electrons(pixels: Array, n: int) -> Array:
        bias = Section.from_text(header[f"BSEC{n}"])
        level = float(array[bias.slices].mean()) if bias.nx and bias.ny else float(header["BIAS"])
        return np.asarray((pixels - level) * float(header[f"GAIN{n}"]))

    return _join_sections(header, array, to_electrons)


def _amplifier_places(rows: Int, columns: Int, scene: Scene) -> tuple[Int, tuple[int, ...]]:
    if scene.layout is None:
        return np.column_stack([rows, columns]), (scene.ny, scene.nx)
    return scene.layout.readout_places(rows, columns), scene.layout.planes_shape


AMPLIFIERS = ReadoutMode(
    _amplifiers,
    _assemble_amplifiers,
    _amplifier_pixels,
    _amplifier_electrons,
    readout_places=_amplifier_places,
)
BY_AMPLIFIER = replace(AMPLIFIERS, make_readout=_by_amplifier)


def _electrons(frame: Frame, scene: Scene, detector: str, system: WCS) -> Readout:
    """Make the file of a detector with one float32 array [ny, nx]: the electrons in its pixels before readout."""
    pixels = frame.astype(np.float32)
    extension = Extension("", pixels, "electron", sections=Sections.full_frame(*pixels.shape[::-1]))
    return Readout((extension,), pixels)


ELECTRONS = replace(AMPLIFIERS, make_readout=_electrons, stop_before=layout.AMPLIFIERS.name, file_bytes_per_pixel=4)


def amplifier_of_pixel(column: int, row: int, scene: Scene) -> int:
    """Find the amplifier that reads a pixel of a detector.

    Parameters
    ----------
    column, row : int
        Place of the pixel, from 0.
    scene : Scene
        Properties of the exposure, for the whole detector.

    Returns
    -------
    int
        Number of the amplifier, from 0. If none reads the pixel, the amplifier of the nearer half of a detector with
        quadrants, or 0.
    """
    if scene.layout is None:
        return layout.quadrant_of_pixel(column, row, scene.nx, scene.ny)
    areas = [amplifier.pixels for amplifier in scene.layout.amplifiers]
    return next((n for n, area in enumerate(areas) if area.contains(column, row)), 0)


def split_frame(frame: Float, scene: Scene) -> Float:
    """Split the pixels [ny, nx] of a detector into planes [amplifier, row, column].

    The pixels of each plane are in the order in which they are read. If the detector has a table of amplifiers, planes
    include prescan and overscan with the value 0. Otherwise planes are four quadrants without prescan and overscan.
    """
    if scene.layout is not None:
        return scene.layout.split(frame)
    return layout.apply(frame, 0, 0, 0, scene.injection_rows)


def assemble_frame(amplifier_planes: Array, scene: Scene) -> Array:
    """Join planes [amplifier, row, column], as `split_frame` returns them, to the pixels [ny, nx] of the detector.

    Pixels that no amplifier reads are 0.
    """
    if scene.layout is not None:
        return scene.layout.assemble(amplifier_planes)
    return layout.assemble(amplifier_planes, 0, 0, 0, scene.injection_rows)
