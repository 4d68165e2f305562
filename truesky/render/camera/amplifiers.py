"""Amplifiers of a ground camera's detector: the pixels that each one reads, and their positions in the raw file.

In most raw files the pixels lie side by side as on the detector, so that one WCS is valid for all amplifiers. The
prescan and overscan columns of amplifiers in the left half of the detector lie to the left of all pixels, the other
ones to the right. Prescan and overscan rows lie below or above all pixels, as in the files of DECam and MegaCam: on the
side away from the readout if one row of amplifiers covers the detector. In interleaved raw files, such as the files of
Hyper Suprime-Cam, prescan and overscan of each amplifier lie next to its own pixels. The WCS is then valid for the
pixels after prescan and overscan have been cut out.

An image that is split into amplifiers has planes "in readout order": its axes are [amplifier, row, column], and the
pixel at [0, 0] of a plane is read first. Columns and rows of a plane are prescan, pixels and overscan, in this order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Bool, Float, Int
from lake_schema.errors import BadInput
from lake_schema.mission import detector_overrides
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.detector_overrides import DetectorPlace
from truesky.randomness import rng
from truesky.render.camera.detectors import Detector
from truesky.render.camera.sections import Section, Sections

Number = TypeVar("Number", bound=np.generic)

# Random deviations of an amplifier's parameters, such as the gain, from the mean of its detector are limited to this
# number of standard deviations. Random crosstalk coefficients have a log-normal distribution, in which the largest
# coefficient of the mission database is at this number of standard deviations above the median.
_MAX_DEVIATION = 3.0
# Crosstalk is proportional to 1 / distance to this power. The distance between two amplifiers is in units of the size
# of an amplifier's pixel area; below 1 it counts as 1.
_FALLOFF_POWER = 2.6
# Distance between two amplifiers beyond which they have no crosstalk, in units of the size of an amplifier. In LSSTCam,
# the crosstalk of amplifiers that are not neighbours was measured to be below 5e-5 of the signal.
_MAX_DISTANCE = 4.0
# Distance that is added for two amplifiers that are read at opposite ends of the columns, because it reduces their
# crosstalk. The unit is the size of an amplifier.
_OPPOSITE_END_DISTANCE = 2.0


# Indices of the parts of an amplifier's columns or rows: prescan, pixels and overscan.
_BEFORE, _PIXELS, _AFTER = range(3)


class _Part(NamedTuple):
    """A part of an amplifier along one axis: `size` pixels from `source` in its plane and from `target` in the file.

    The plane has the axes of the detector. All numbers count from 0.
    """

    source: int
    target: int
    size: int


# Prescan, pixels and overscan.
_Parts = tuple[_Part, _Part, _Part]


@dataclass(frozen=True, slots=True)
class Amplifier:
    """An amplifier of a detector, the pixels that it reads, and the direction in which it reads them.

    Attributes
    ----------
    name : str
        Name of the amplifier.
    pixels : Section
        Rectangle of the detector's pixels that the amplifier reads.
    read_right : bool
        True if the last column of the rectangle is read first.
    read_top : bool
        True if the last row of the rectangle is read first.
    ratios_to_first : tuple of 4 float
        Gain, read noise, bias level and full well of the amplifier, divided by those of the first amplifier in the
        camera's table of amplifiers. If the mission database has a table with the values of each amplifier of the
        camera, they are divided by the medians of the camera instead.
    """

    name: str
    pixels: Section
    read_right: bool
    read_top: bool
    ratios_to_first: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class Layout:
    """Amplifiers of a ground camera's detector, in the order of the planes of an image that is split into amplifiers.

    All amplifiers of a detector have the same number of pixels.

    Attributes
    ----------
    nx, ny : int
        Number of columns and rows of the detector.
    prescan, overscan : int
        Number of columns that each amplifier reads before and after its pixels.
    overscan_rows : int
        Number of rows that each amplifier reads after its pixels.
    amplifiers : tuple of Amplifier
        The amplifiers.
    prescan_rows : int
        Number of rows that each amplifier reads before its pixels.
    is_interleaved : bool
        True if prescan and overscan of each amplifier lie next to its own pixels in the raw file; False if they lie
        outside of all pixels.
    """

    nx: int
    ny: int
    prescan: int
    overscan: int
    overscan_rows: int
    amplifiers: tuple[Amplifier, ...]
    prescan_rows: int = 0
    is_interleaved: bool = False

    @property
    def width(self) -> int:
        """Number of pixel columns of each amplifier, without prescan and overscan."""
        return self.amplifiers[0].pixels.nx

    @property
    def height(self) -> int:
        """Number of pixel rows of each amplifier, without overscan."""
        return self.amplifiers[0].pixels.ny

    @property
    def scan_columns(self) -> int:
        """Number of prescan and overscan columns of each amplifier together."""
        return self.prescan + self.overscan

    @property
    def scan_rows(self) -> int:
        """Number of prescan and overscan rows of each amplifier together."""
        return self.prescan_rows + self.overscan_rows

    @property
    def column_segments(self) -> tuple[tuple[int, int, bool], ...]:
        """Parts of every column of the detector, each shifted as a whole to one serial register, sorted by row.

        Each part is (first row, last row + 1, True if the serial register is above the part and False if it is below).
        """
        pieces = {(a.pixels.y, a.pixels.y + a.pixels.ny, a.read_top) for a in self.amplifiers}
        return tuple(sorted(pieces))

    @property
    def unread_pixels(self) -> Bool:
        """Mask, bool[ny, nx], that is True for the pixels of the detector that no amplifier reads."""
        out = np.ones((self.ny, self.nx), bool)
        for amplifier in self.amplifiers:
            out[amplifier.pixels.slices] = False
        return out

    def split(self, frame: npt.NDArray[Number]) -> npt.NDArray[Number]:
        """Split a frame [ny, nx] into planes [amplifier, row, column], in which the pixel at [0, 0] is read first.

        Prescan and overscan are 0. Pixels that no amplifier reads are lost.

        Raises
        ------
        BadInput
            If the shape of the frame is not (ny, nx).
        """
        if frame.shape != (self.ny, self.nx):
            raise BadInput(f"frame has the shape {frame.shape}, but the amplifiers cover {self.ny} x {self.nx} pixels")
        out = np.zeros(self.planes_shape, frame.dtype)
        for plane, amplifier in zip(out, self.amplifiers, strict=True):
            plane[self.pixels_in_plane] = _flip_to_readout_order(frame[amplifier.pixels.slices], amplifier)
        return out

    @property
    def planes_shape(self) -> tuple[int, int, int]:
        """Numbers of amplifiers, rows and columns of the result of `split`."""
        return len(self.amplifiers), self.height + self.scan_rows, self.scan_columns + self.width

    @property
    def pixels_in_plane(self) -> tuple[slice, slice]:
        """Rows and columns of the detector's pixels in the plane of an amplifier, in readout order."""
        rows, columns = self.prescan_rows, self.prescan
        return slice(rows, rows + self.height), slice(columns, columns + self.width)

    def readout_places(self, rows: Int, columns: Int) -> Int:
        """Return where n pixels of the detector are in the result of `split`.

        `rows` and `columns` are int64[n]. The result, int64[n, 3], has the amplifier, the row and the column of each
        pixel. They are -1 for pixels that no amplifier reads.
        """
        out = np.full((len(rows), 3), -1)
        for number, amplifier in enumerate(self.amplifiers):
            pixels = amplifier.pixels
            row, column = rows - pixels.y, columns - pixels.x
            is_inside = (row >= 0) & (row < pixels.ny) & (column >= 0) & (column < pixels.nx)
            row, column = row[is_inside], column[is_inside]
            out[is_inside, 0] = number
            out[is_inside, 1] = self.prescan_rows + (pixels.ny - 1 - row if amplifier.read_top else row)
            out[is_inside, 2] = self.prescan + (pixels.nx - 1 - column if amplifier.read_right else column)
        return out

    def assemble(self, planes: npt.NDArray[Number]) -> npt.NDArray[Number]:
        """Join planes [amplifier, row, column], the result of `split`, to a frame [ny, nx].

        Prescan and overscan are removed. Pixels that no amplifier reads are 0.
        """
        out = np.zeros((self.ny, self.nx), planes.dtype)
        for plane, amplifier in zip(planes, self.amplifiers, strict=True):
            out[amplifier.pixels.slices] = _flip_to_readout_order(plane[self.pixels_in_plane], amplifier)
        return out

    @property
    def data_section(self) -> Section | None:
        """Rectangle of the raw file with the detector's pixels; None if prescan or overscan lies between them."""
        sections = [self.amplifier_data_section(number) for number in range(len(self.amplifiers))]
        shifts = {(s.x - a.pixels.x, s.y - a.pixels.y) for s, a in zip(sections, self.amplifiers, strict=True)}
        return Section(*shifts.pop(), self.nx, self.ny) if len(shifts) == 1 else None

    @property
    def raw_shape(self) -> tuple[int, int]:
        """Number of rows and columns of the raw file, with prescan and overscan."""
        across, up = (len(starts) for starts in self._starts)
        nx, ny = (across * self.width, up * self.height) if self.is_interleaved else (self.nx, self.ny)
        return ny + up * self.scan_rows, nx + across * self.scan_columns

    def amplifier_data_section(self, number: int) -> Section:
        """Return the rectangle of the raw file with the pixels of an amplifier, given by its index."""
        return self._raw_section(number, _PIXELS, _PIXELS)

    def amplifier_bias_section(self, number: int) -> Section:
        """Return the rectangle of the raw file with an amplifier's overscan columns, which measure its bias level.

        It covers the rows of the amplifier's pixels. An amplifier without overscan columns has the prescan columns
        instead. `number` is the index of the amplifier.
        """
        return self._raw_section(number, _AFTER if self.overscan else _BEFORE, _PIXELS)

    def amplifier_prescan_section(self, number: int) -> Section:
        """Return the rectangle of the raw file with the prescan columns of an amplifier, in the rows of its pixels."""
        return self._raw_section(number, _BEFORE, _PIXELS)

    def amplifier_overscan_section(self, number: int) -> Section:
        """Return the rectangle of the raw file with the overscan rows of an amplifier, in the columns of its pixels."""
        return self._raw_section(number, _PIXELS, _AFTER)

    def amplifier_raw_section(self, number: int) -> Section:
        """Return the rectangle of the raw file with the columns that an amplifier reads, in the rows of its pixels.

        For an amplifier whose prescan or overscan does not lie next to its pixels, it contains what lies in between.
        `number` is the index of the amplifier.
        """
        parts = [self._raw_section(number, columns, _PIXELS) for columns in (_BEFORE, _PIXELS, _AFTER)]
        parts = [part for part in parts if part.nx]
        first, past = min(part.x for part in parts), max(part.x + part.nx for part in parts)
        return Section(first, parts[0].y, past - first, parts[0].ny)

    def _raw_section(self, number: int, of_columns: int, of_rows: int) -> Section:
        """Return the rectangle of the raw file with a part of the columns and rows of an amplifier.

        `number` is the index of the amplifier. Each part is `_BEFORE` (prescan), `_PIXELS` or `_AFTER` (overscan).
        """
        columns, rows = (
            segments[part] for segments, part in zip(self._segments(number), (of_columns, of_rows), strict=True)
        )
        return Section(columns.target, rows.target, columns.size, rows.size)

    def to_detector_axes(self, plane: npt.NDArray[Number], number: int) -> npt.NDArray[Number]:
        """Flip an amplifier's plane from readout order (pixel [0, 0] read first) to the axes of the detector.

        `number` is the index of the amplifier.
        """
        return _flip_to_readout_order(plane, self.amplifiers[number])

    def amplifier_sections(self, number: int) -> Sections:
        """Return the sections for the FITS header of a plane in readout order: pixels, their place, and bias columns.

        The bias columns are the overscan, or the prescan if there is no overscan, in all rows. `number` is the index of
        the amplifier.
        """
        amplifier = self.amplifiers[number]
        data = Section(self.prescan, self.prescan_rows, self.width, self.height)
        first, count = (self.prescan + self.width, self.overscan) if self.overscan else (0, self.prescan)
        bias = Section(first, 0, count, self.height + self.scan_rows) if count else None
        steps = (-1 if amplifier.read_right else 1, -1 if amplifier.read_top else 1)
        return Sections(data, amplifier.pixels, bias, steps)

    def to_raw_image(self, planes: npt.NDArray[Number]) -> npt.NDArray[Number]:
        """Arrange planes [amplifier, row, column], whose pixel [0, 0] is read first, as the image of the raw file."""
        out = np.zeros(self.raw_shape, planes.dtype)
        for number, (plane, amplifier) in enumerate(zip(planes, self.amplifiers, strict=True)):
            flipped = _flip_to_readout_order(plane, amplifier)
            columns, rows = self._segments(number)
            for row in rows:
                for column in columns:
                    block = flipped[row.source : row.source + row.size, column.source : column.source + column.size]
                    out[row.target : row.target + row.size, column.target : column.target + column.size] = block
        return out

    @property
    def _starts(self) -> tuple[list[int], list[int]]:
        """First columns of the amplifiers' pixels on the detector, and their first rows, sorted without duplicates."""
        places = [amplifier.pixels for amplifier in self.amplifiers]
        return sorted({place.x for place in places}), sorted({place.y for place in places})

    def _segments(self, number: int) -> tuple[_Parts, _Parts]:
        """Return prescan, pixels and overscan of an amplifier along its columns, and the same along its rows.

        `number` is the index of the amplifier.
        """
        amplifier, (across, up) = self.amplifiers[number], self._starts
        of_columns = (self.prescan, self.width, self.overscan), amplifier.read_right
        of_rows = (self.prescan_rows, self.height, self.overscan_rows), amplifier.read_top
        pixels, i, j = amplifier.pixels, across.index(amplifier.pixels.x), up.index(amplifier.pixels.y)
        if self.is_interleaved:
            return (
                _interleaved_segments(*of_columns, i * (self.width + self.scan_columns)),
                _interleaved_segments(*of_rows, j * (self.height + self.scan_rows)),
            )
        # Numbers of columns and rows of amplifiers whose prescan and overscan lie to the left of or below all pixels.
        n_left, n_below = len(across) // 2, len(up) // 2
        if len(up) == 1 and all(a.read_top for a in self.amplifiers):
            n_below = 1
        return (
            _outer_segments(
                *of_columns,
                n_left * self.scan_columns + pixels.x,
                i * self.scan_columns + (self.nx if i >= n_left else 0),
            ),
            _outer_segments(
                *of_rows,
                n_below * self.scan_rows + pixels.y,
                j * self.scan_rows + (self.ny if j >= n_below else 0),
            ),
        )


def _flip_to_readout_order(plane: npt.NDArray[Number], amplifier: Amplifier) -> npt.NDArray[Number]:
    """Flip an amplifier's plane from readout order (pixel [0, 0] read first) to the axes of the detector, or back."""
    return plane[:: -1 if amplifier.read_top else 1, :: -1 if amplifier.read_right else 1]


def _outer_segments(counts: tuple[int, int, int], is_flipped: bool, pixels_start: int, scan_start: int) -> _Parts:
    """Return where prescan, pixels and overscan of an amplifier are along one axis, in its plane and in the raw file.

    `counts` are their lengths. `is_flipped` is True if the last pixel of the plane, in the axes of the detector, is
    read first. `pixels_start` is the position of the first pixel in the file, and `scan_start` the position of the
    first prescan or overscan pixel. All prescan and overscan pixels lie next to each other.
    """
    prescan, pixels, overscan = _interleaved_segments(counts, is_flipped, 0)
    return (
        prescan._replace(target=scan_start + (overscan.size if is_flipped else 0)),
        pixels._replace(target=pixels_start),
        overscan._replace(target=scan_start + (0 if is_flipped else prescan.size)),
    )


def _interleaved_segments(counts: tuple[int, int, int], is_flipped: bool, start: int) -> _Parts:
    """Return the same as `_outer_segments` if all pixels of the amplifier lie next to each other in the raw file.

    `start` is the position of the first one in the file.
    """
    n_before, pixels, n_after = counts
    sources = (n_after + pixels, n_after, 0) if is_flipped else (0, n_before, n_before + pixels)
    prescan, inside, overscan = (
        _Part(source, start + source, size) for source, size in zip(sources, counts, strict=True)
    )
    return prescan, inside, overscan


@lru_cache(maxsize=256)
def layout(detector: Detector, mission: MissionConfiguration) -> Layout | None:
    """Return the amplifiers of a ground camera's detector.

    The result is None if the mission database has no table of amplifiers for the camera, or a table without the column
    `prescan`, as for cameras with a special readout. It is also None if the table has no amplifiers for the type of the
    detector.

    Raises
    ------
    BadInput
        If the detector has fewer columns or rows than amplifiers along them.

    Notes
    -----
    A detector that is smaller or larger than the detectors of its type in the mission database is divided in the same
    way, in whole pixels. The remainder is not read.
    """
    rows = [row for row in _table(detector.section, mission) if row["type"] == detector.kind]
    if not rows:
        return None
    first = rows[0]
    prescan, overscan, overscan_rows = (int(first[key]) for key in ("prescan", "overscan", "overscan_rows"))
    across, up = (sorted({int(row[axis]) for row in rows}) for axis in "xy")
    width, height = int(first["nx"]), int(first["ny"])
    if (detector.nx, detector.ny) != full_size(detector, mission):
        width, height = detector.nx // len(across), detector.ny // len(up)
        across, up = [i * width for i in range(len(across))], [j * height for j in range(len(up))]
    if not (width and height):
        raise BadInput(
            f"detector {detector.name}: {detector.nx} x {detector.ny} pixels are too few for {len(rows)} amplifiers"
        )
    places = [sorted({int(row[axis]) for row in rows}) for axis in "xy"]
    reference = _table(detector.section, mission)[0]
    measured = _measured_ratios(detector.section, mission)
    amplifiers = tuple(
        Amplifier(
            row["amplifier"],
            Section(across[places[0].index(int(row["x"]))], up[places[1].index(int(row["y"]))], width, height),
            row["read_right"] == "1",
            row["read_top"] == "1",
            measured.get((detector.name, row["amplifier"]))
            or (*(float(row[key]) / float(reference[key]) for key in ("gain", "read_noise")), 1.0, 1.0),
        )
        for row in rows
    )
    return Layout(
        detector.nx,
        detector.ny,
        prescan,
        overscan,
        overscan_rows,
        amplifiers,
        int(first.get("prescan_rows", "0")),
        first.get("interleaved", "0") == "1",
    )


def _table(section: str, mission: MissionConfiguration) -> tuple[Mapping[str, str], ...]:
    """Return the rows of a ground camera's table of amplifiers in the mission database.

    The result is () if there is no table, or if the table has no column `prescan`.
    """
    key = f"{section}.amplifiers"
    rows = mission.rows(key) if section.startswith("ext.") and key in mission else ()
    return rows if rows and "prescan" in rows[0] else ()


@lru_cache(maxsize=16)
def _measured_ratios(section: str, mission: MissionConfiguration) -> Mapping[tuple[str, str], tuple[float, ...]]:
    """Return gain, read noise, bias level and full well of each amplifier of a camera, divided by the medians of all.

    The keys are the names of detector and amplifier. A number that the table lacks has the ratio 1. The result is empty
    if the mission database has no table with the values of each amplifier of the camera.
    """
    key = f"{section}.amplifier_values"
    rows = mission.rows(key) if key in mission else ()
    if not rows:
        return {}
    numbers = np.array([[float(row.get(name, 1.0)) for name in _RELATIVE] for row in rows])
    ratios = numbers / np.median(numbers, axis=0)
    places = ((row["detector"], row["amplifier"]) for row in rows)
    return {place: tuple(values_of_place) for place, values_of_place in zip(places, ratios.tolist(), strict=True)}


def full_size(detector: Detector, mission: MissionConfiguration) -> tuple[int, int]:
    """Return the numbers of columns and rows of a detector type of a ground camera, from the mission database.

    `detector` may be smaller, if only a part of a detector is simulated. If the type is unknown, the size of `detector`
    is returned.
    """
    of_kind = (row for row in mission.rows(f"{detector.section}.layout") if row["type"] == detector.kind)
    return next(((int(row["nx"]), int(row["ny"])) for row in of_kind), (detector.nx, detector.ny))


# Parameters that may have a value for each amplifier in the camera's tables of amplifiers, with their index in
# `Amplifier.ratios_to_first` (values of an amplifier divided by those of the first amplifier).
_RELATIVE = {key: index for index, key in enumerate(detector_overrides.AMPLIFIER_COLUMNS)}


@lru_cache(maxsize=1024)
def values(
    key: str, unit: str, detector: Detector, mission: MissionConfiguration, detector_layout: Layout | None = None
) -> float | Float:
    """Return the values of a parameter for all amplifiers of a detector, with their differences.

    Parameters
    ----------
    key : str
        Name of the parameter without the prefix of the camera, such as "gain".
    unit : str
        Unit of the result.
    detector : Detector
        The detector.
    mission : MissionConfiguration
        Mission database.
    detector_layout : Layout, optional
        Amplifiers of the detector. None for a detector that is read in quadrants or as one frame; its amplifiers have
        no random deviations.

    Returns
    -------
    float or float array, shape (n_amplifiers,)
        Values in the order of `detector_layout.amplifiers`, or of the camera's table of amplifiers. One number if all
        are equal.

    Notes
    -----
    The parameter `key` is the value without random deviations, and `key` + "_spread" the rms of the deviations (0 if
    the database has none). For gain and read noise, `key` is the value of the first amplifier in the camera's table;
    for other amplifiers it is multiplied by their ratio to the first one. If the database has a table with values
    for each amplifier of the camera, `key` is the median, and is multiplied by the ratio of the amplifier to the
    median; this also holds for bias level and full well. The random deviations are a property of the hardware and
    therefore the same in all simulations.

    If the request of the user sets the parameter for the whole camera, it is used without ratio and random deviations,
    unless the request also sets the spread. A value that the request sets for a detector or an amplifier is always used
    as it is.
    """
    name, spread = f"{detector.section}.{key}", f"{detector.section}.{key}_spread"
    rms = mission.value(spread, unit) if detector_layout is not None and spread in mission else 0.0
    exact = name in mission.overridden and spread not in mission.overridden
    if detector_layout is not None:
        ratios = {amplifier.name: amplifier.ratios_to_first for amplifier in detector_layout.amplifiers}
    else:
        measured = _measured_ratios(detector.section, mission)
        # A camera without amplifiers in the mission database has a single one, without a name.
        names = detector_overrides.amplifiers(detector.section, mission) or ("",)
        ratios = {name: measured.get((detector.name, name), (1.0,) * len(_RELATIVE)) for name in names}
    results = np.empty(len(ratios))
    for number, amplifier in enumerate(ratios):
        place = DetectorPlace(detector.name, amplifier)
        results[number] = mission.value(name, unit, place)
        if not exact and not mission.is_overridden_at(name, place):
            deviation = float(rng.stream(0, name, detector.name, amplifier).standard_normal())
            relative = ratios[amplifier][_RELATIVE[key]] if key in _RELATIVE else 1.0
            results[number] = relative * results[number] + rms * float(
                np.clip(deviation, -_MAX_DEVIATION, _MAX_DEVIATION)
            )
    results.setflags(write=False)
    return results if np.ptp(results) > 0.0 else float(results[0])


# Unit and smallest allowed value of the gain and of the read noise of any amplifier, checked by `refuse_spread`. The
# file bounds.csv of the mission database has the same limits for the means over amplifiers.
_MIN_VALUES = {"gain": ("electron / adu", 1e-3), "read_noise": ("electron", 0.0)}


def refuse_spread(detectors: Sequence[Detector], mission: MissionConfiguration) -> None:
    """Check that the random differences between amplifiers give none of them too low a gain or read noise.

    BadInput is raised for the first detector with an amplifier below the limit, which is 0.001 electrons per ADU for
    gain and 0 electrons for read noise. The message names the amplifier of this detector with the lowest value.
    """
    for detector in detectors:
        detector_layout = layout(detector, mission)
        for key, (unit, minimum) in _MIN_VALUES.items() if detector_layout else ():
            assert detector_layout is not None
            name = f"{detector.section}.{key}_spread"
            rms = mission.value(name, unit) if name in mission else 0.0
            mean = mission.value(f"{detector.section}.{key}", unit)
            lowest = mean * min(amplifier.ratios_to_first[_RELATIVE[key]] for amplifier in detector_layout.amplifiers)
            if lowest - _MAX_DEVIATION * rms >= minimum:
                continue
            amplifier_values = np.broadcast_to(
                values(key, unit, detector, mission, detector_layout), len(detector_layout.amplifiers)
            )
            worst = int(np.argmin(amplifier_values))
            if amplifier_values[worst] < minimum:
                label = f"amplifier {detector_layout.amplifiers[worst].name} of detector {detector.name}"
                value = f"{amplifier_values[worst]:.3g} {unit}, at least {minimum:g} is allowed"
                raise BadInput(f"mission: {name} = {rms:g}: {label} would have {value}")


def measured_crosstalk(detector: Detector, detector_layout: Layout, mission: MissionConfiguration) -> Float | None:
    """Return the measured crosstalk coefficients between the amplifiers of a detector.

    Parameters
    ----------
    detector : Detector
        The detector.
    detector_layout : Layout
        Its amplifiers.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float array, shape (n_amplifiers, n_amplifiers), or None
        Element [i, j] is the fraction of the ADU of amplifier j that appears in amplifier i, and can be negative. A
        pair that was not measured has 0. None if the mission database has no table for the camera, or if the request
        sets its crosstalk.
    """
    key = f"{detector.section}.crosstalk_pairs"
    is_set = any(f"{detector.section}.{name}" in mission.overridden for name in ("crosstalk", "crosstalk_max"))
    if is_set or key not in mission:
        return None
    pairs = {
        (row["victim"], row["source"]): float(row["coefficient"])
        for row in mission.rows(key)
        if row["detector"] in (detector.name, "all")
    }
    names = [amplifier.name for amplifier in detector_layout.amplifiers]
    return np.array([[pairs.get((victim, source), 0.0) for source in names] for victim in names])


def crosstalk_couplings(median: float, largest: float, detector: Detector, detector_layout: Layout) -> Float:
    """Return the crosstalk coefficients between the amplifiers of a detector, with random differences.

    Parameters
    ----------
    median : float
        Median coefficient of neighbouring amplifiers, as a fraction of the signal.
    largest : float
        Largest coefficient, as a fraction of the signal. If it is below `median`, all neighbours have the median.
    detector : Detector
        The detector.
    detector_layout : Layout
        Its amplifiers.

    Returns
    -------
    float array, shape (n_amplifiers, n_amplifiers)
        Element [i, j] is the fraction of the signal in amplifier j that appears in amplifier i; 0 on the diagonal.

    Notes
    -----
    The coefficients of neighbours have a log-normal distribution about the median, with `largest` at 3 sigma. They fall
    off with distance and are 0 beyond 4 amplifiers. They are a property of the camera, and the same in all simulations.
    """
    places = np.array(
        [[a.pixels.x / detector_layout.width, a.pixels.y / detector_layout.height] for a in detector_layout.amplifiers]
    )
    distance = np.hypot(*(places[:, None] - places[None, :]).T)
    top = np.array([a.read_top for a in detector_layout.amplifiers])
    distance = distance + _OPPOSITE_END_DISTANCE * (top[:, None] != top[None, :])
    spread = np.log(max(largest / median, 1.0)) / _MAX_DEVIATION if median > 0.0 else 0.0
    normal_draws = rng.stream(0, f"{detector.section}.crosstalk", detector.name).standard_normal(distance.shape)
    pairs = np.minimum(median * np.exp(spread * normal_draws), max(median, largest))
    in_range = (distance > 0.0) & (distance <= _MAX_DISTANCE)
    return np.asarray(np.where(in_range, pairs / np.maximum(distance, 1.0) ** _FALLOFF_POWER, 0.0))
