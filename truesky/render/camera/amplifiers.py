"""Amplifiers of a ground camera's detector: which pixels each reads, and where its raw file has them.

In the file the pixels lie side by side as on the detector, so that one WCS holds for all; each amplifier's pre- and
overscan columns lie beside them, those of the left half on the left, and its overscan rows above or below, as in the
files of DECam and MegaCam.

Amplifier      a part of a detector, and its output
Layout         all of a detector, with pre- and overscan; None of a camera that has no table of them
layout         of a detector, from the mission database;  full_size : of a whole one
values         a parameter of each amplifier
refuse_spread  gains and noises of amplifiers that differ too much
couplings      crosstalk of each pair

Readout order, as everywhere: [amplifier, row, column], where [0, 0] is read first. Columns: prescan, pixels, overscan;
rows: pixels, overscan.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Bool, Float
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.detector_overrides import DetectorPlace
from truesky.randomness import rng
from truesky.render.camera.detectors import Detector
from truesky.render.camera.sections import Section, Sections

Number = TypeVar("Number", bound=np.generic)

# Standard deviations at which an amplifier's own value ends: none is far off.
_MAX_DEVIATION = 3.0
# Crosstalk falls off with the distance of two outputs, in amplifiers, as so high a power, up to so many; outputs at the
# other end of the columns are as much farther away (as measured in LSSTCam: less than 5e-5 beyond the neighbours).
_FALLOFF_POWER, _MAX_DISTANCE, _OPPOSITE_END_DISTANCE = 2.6, 4.0, 2.0


@dataclass(frozen=True, slots=True)
class Amplifier:
    """A part of a detector.

    pixels     : of the detector
    read_right : whether its first column to be read is the last;  read_top : likewise its row
    relative   : its gain and its read noise over those of the table's first amplifier
    """

    name: str
    pixels: Section
    read_right: bool
    read_top: bool
    ratios_to_first: tuple[float, float] = (1.0, 1.0)


@dataclass(frozen=True, slots=True)
class Layout:
    """A detector's amplifiers, all of one size, in the order in which arrays have them.

    nx, ny            : of the detector
    prescan, overscan : columns that an amplifier reads before its pixels, and after them;  rows : after them
    """

    nx: int
    ny: int
    prescan: int
    overscan: int
    overscan_rows: int
    amplifiers: tuple[Amplifier, ...]

    @property
    def width(self) -> int:
        """Columns of an amplifier's pixels."""
        return self.amplifiers[0].pixels.nx

    @property
    def height(self) -> int:
        """Rows of them."""
        return self.amplifiers[0].pixels.ny

    @property
    def scan_columns(self) -> int:
        """Columns that are no pixels, of an amplifier."""
        return self.prescan + self.overscan

    @property
    def column_segments(self) -> tuple[tuple[int, int, bool], ...]:
        """First row, the one past the last, and whether the register lies above them: of each piece of a column."""
        pieces = {(a.pixels.y, a.pixels.y + a.pixels.ny, a.read_top) for a in self.amplifiers}
        return tuple(sorted(pieces))

    @property
    def unread_pixels(self) -> Bool:
        """[ny, nx] where no amplifier reads."""
        out = np.ones((self.ny, self.nx), bool)
        for amplifier in self.amplifiers:
            out[amplifier.pixels.slices] = False
        return out

    def split(self, frame: npt.NDArray[Number]) -> npt.NDArray[Number]:
        """[ny, nx] -> [q, rows, columns] in readout order, 0 in pre- and overscan."""
        if frame.shape != (self.ny, self.nx):
            raise BadInput(f"a frame of {frame.shape} pixels for amplifiers of {self.ny} x {self.nx}")
        shape = len(self.amplifiers), self.height + self.overscan_rows, self.scan_columns + self.width
        out = np.zeros(shape, frame.dtype)
        for plane, amplifier in zip(out, self.amplifiers, strict=True):
            plane[: self.height, self.prescan : self.prescan + self.width] = _flip_to_readout_order(
                frame[amplifier.pixels.slices], amplifier
            )
        return out

    def assemble(self, planes: npt.NDArray[Number]) -> npt.NDArray[Number]:
        """[q, rows, columns] in readout order -> [ny, nx], 0 where no amplifier reads."""
        out = np.zeros((self.ny, self.nx), planes.dtype)
        for plane, amplifier in zip(planes, self.amplifiers, strict=True):
            pixels = plane[: self.height, self.prescan : self.prescan + self.width]
            out[amplifier.pixels.slices] = _flip_to_readout_order(pixels, amplifier)
        return out

    @property
    def data_section(self) -> Section:
        """The pixels of the detector in its raw file."""
        across, up = (len(starts) for starts in self._starts)
        return Section((across // 2) * self.scan_columns, (up // 2) * self.overscan_rows, self.nx, self.ny)

    @property
    def raw_shape(self) -> tuple[int, int]:
        """ny, nx of the raw file."""
        across, up = (len(starts) for starts in self._starts)
        return self.ny + up * self.overscan_rows, self.nx + across * self.scan_columns

    def amplifier_data_section(self, number: int) -> Section:
        """An amplifier's pixels in the raw file."""
        pixels, data = self.amplifiers[number].pixels, self.data_section
        return Section(data.x + pixels.x, data.y + pixels.y, pixels.nx, pixels.ny)

    def amplifier_bias_section(self, number: int) -> Section:
        """Its overscan columns beside its pixels in the raw file; its prescan where it has no others."""
        first, count = (self.prescan, self.overscan) if self.overscan else (0, self.prescan)
        return self._scan_columns_section(number, first, count)

    def amplifier_prescan_section(self, number: int) -> Section:
        """Its columns that are read before its pixels, in the raw file."""
        return self._scan_columns_section(number, 0, self.prescan)

    def amplifier_overscan_section(self, number: int) -> Section:
        """The rows that are read after its pixels, in the columns of these, in the raw file."""
        pixels, (_, scan_y) = self.amplifier_data_section(number), self._scan_origin(number)
        return Section(pixels.x, scan_y, pixels.nx, self.overscan_rows)

    def _scan_columns_section(self, number: int, first: int, count: int) -> Section:
        """So many of what of an amplifier is no pixel, from one on as they are read."""
        amplifier, (scan_x, _) = self.amplifiers[number], self._scan_origin(number)
        if amplifier.read_right:
            first = self.scan_columns - first - count
        return Section(scan_x + first, self.amplifier_data_section(number).y, count, self.height)

    def to_detector_axes(self, plane: npt.NDArray[Number], number: int) -> npt.NDArray[Number]:
        """What an amplifier reads [rows, columns] in readout order -> as it lies on the detector."""
        return _flip_to_readout_order(plane, self.amplifiers[number])

    def amplifier_sections(self, number: int) -> Sections:
        """Of an amplifier's pixels with their pre- and overscan, as `placed` has them."""
        amplifier = self.amplifiers[number]
        x = self.overscan if amplifier.read_right else self.prescan
        data = Section(x, self.overscan_rows if amplifier.read_top else 0, self.width, self.height)
        prescan, overscan = (0, self.prescan), (self.prescan + self.width, self.overscan)
        first, count = overscan if self.overscan else prescan
        if amplifier.read_right:
            first = self.scan_columns + self.width - first - count
        bias = Section(first, 0, count, self.height + self.overscan_rows) if count else None
        return Sections(data, amplifier.pixels, bias)

    def to_raw_image(self, planes: npt.NDArray[Number]) -> npt.NDArray[Number]:
        """[q, rows, columns] in readout order -> the raw file's image."""
        out = np.zeros(self.raw_shape, planes.dtype)
        for number, (plane, amplifier) in enumerate(zip(planes, self.amplifiers, strict=True)):
            pixels, (scan_x, scan_y) = self.amplifier_data_section(number), self._scan_origin(number)
            # In readout order, each with its place in the file.
            flipped = _flip_to_readout_order(plane, amplifier)
            columns = _scan_segments(self.prescan, self.width, self.overscan, pixels.x, scan_x, amplifier.read_right)
            rows = _scan_segments(0, self.height, self.overscan_rows, pixels.y, scan_y, amplifier.read_top)
            for source_y, target_y, count_y in rows:
                for source_x, target_x, count_x in columns:
                    block = flipped[source_y : source_y + count_y, source_x : source_x + count_x]
                    out[target_y : target_y + count_y, target_x : target_x + count_x] = block
        return out

    @property
    def _starts(self) -> tuple[list[int], list[int]]:
        """First columns, and first rows, of the amplifiers' pixels."""
        places = [amplifier.pixels for amplifier in self.amplifiers]
        return sorted({place.x for place in places}), sorted({place.y for place in places})

    def _scan_origin(self, number: int) -> tuple[int, int]:
        """First column and row in the raw file of what of an amplifier is no pixel."""
        pixels, (across, up) = self.amplifiers[number].pixels, self._starts
        i, j = across.index(pixels.x), up.index(pixels.y)
        x = i * self.scan_columns + (self.nx if i >= len(across) // 2 else 0)
        y = j * self.overscan_rows + (self.ny if j >= len(up) // 2 else 0)
        return x, y


def _flip_to_readout_order(plane: npt.NDArray[Number], amplifier: Amplifier) -> npt.NDArray[Number]:
    """In readout order -> as it lies on the detector, and back."""
    return plane[:: -1 if amplifier.read_top else 1, :: -1 if amplifier.read_right else 1]


def _scan_segments(
    n_before: int, pixels: int, n_after: int, pixels_start: int, scan_start: int, is_flipped: bool
) -> list[tuple[int, int, int]]:
    """(first in the plane, first in the file, how many) of what lies before the pixels, of them, of what is after."""
    parts = [(n_before, scan_start), (pixels, pixels_start), (n_after, scan_start + n_before)]
    if is_flipped:
        parts = [(n_after, scan_start), (pixels, pixels_start), (n_before, scan_start + n_after)]
    segments, source = [], 0
    for count, target in parts:
        segments.append((source, target, count))
        source += count
    return segments


@lru_cache(maxsize=256)
def layout(detector: Detector, mission: MissionConfiguration) -> Layout | None:
    """The amplifiers of a detector; None of a camera that has no table of them, or whose readout is its own.

    A detector of another size than its kind's is divided alike, as far as it goes: what is left over is not read.
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
        raise BadInput(f"detector {detector.name}: {detector.nx} x {detector.ny} pixels for {len(rows)} amplifiers")
    places = [sorted({int(row[axis]) for row in rows}) for axis in "xy"]
    reference = _table(detector.section, mission)[0]
    amplifiers = tuple(
        Amplifier(
            row["amplifier"],
            Section(across[places[0].index(int(row["x"]))], up[places[1].index(int(row["y"]))], width, height),
            row["read_right"] == "1",
            row["read_top"] == "1",
            (float(row["gain"]) / float(reference["gain"]), float(row["read_noise"]) / float(reference["read_noise"])),
        )
        for row in rows
    )
    return Layout(detector.nx, detector.ny, prescan, overscan, overscan_rows, amplifiers)


def _table(section: str, mission: MissionConfiguration) -> tuple[Mapping[str, str], ...]:
    """Rows of the amplifiers of a ground camera."""
    key = f"{section}.amplifiers"
    rows = mission.rows(key) if section.startswith("ext.") and key in mission else ()
    return rows if rows and "prescan" in rows[0] else ()


def full_size(detector: Detector, mission: MissionConfiguration) -> tuple[int, int]:
    """nx, ny of a ground camera's detectors of this kind, of which this one may be a part."""
    of_kind = (row for row in mission.rows(f"{detector.section}.layout") if row["type"] == detector.kind)
    return next(((int(row["nx"]), int(row["ny"])) for row in of_kind), (detector.nx, detector.ny))


# Of these the table has how an amplifier compares with the first.
_RELATIVE = {"gain": 0, "read_noise": 1}


@lru_cache(maxsize=1024)
def values(
    key: str, unit: str, detector: Detector, mission: MissionConfiguration, detector_layout: Layout
) -> float | Float:
    """A parameter of each amplifier [q]; one number where all agree.

    Of the parameters `key` and `key`_spread: mean, and rms between amplifiers, which differ in the same way in every
    lake: they are hardware. A value that a request gives is taken as it is.

    key, unit : within the camera's section;  detector, mission : whose;  own : the detector's amplifiers
    """
    name, spread = f"{detector.section}.{key}", f"{detector.section}.{key}_spread"
    rms = mission.value(spread, unit) if spread in mission else 0.0
    exact = name in mission.overridden and spread not in mission.overridden
    results = np.empty(len(detector_layout.amplifiers))
    for number, amplifier in enumerate(detector_layout.amplifiers):
        place = DetectorPlace(detector.name, amplifier.name)
        results[number] = mission.value(name, unit, place)
        if not exact and not mission.is_overridden_at(name, place):
            deviation = float(rng.stream(0, name, detector.name, amplifier.name).standard_normal())
            relative = amplifier.ratios_to_first[_RELATIVE[key]] if key in _RELATIVE else 1.0
            results[number] = relative * results[number] + rms * float(
                np.clip(deviation, -_MAX_DEVIATION, _MAX_DEVIATION)
            )
    results.setflags(write=False)
    return results if np.ptp(results) > 0.0 else float(results[0])


# What an amplifier's own value may not be below: as bounds.csv has it of the mean.
_MIN_VALUES = {"gain": ("electron / adu", 1e-3), "read_noise": ("electron", 0.0)}


def refuse_spread(detectors: Sequence[Detector], mission: MissionConfiguration) -> None:
    """BadInput names the first amplifier of a camera that would have no gain, or less than no noise."""
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
                raise BadInput(f"mission: {name} = {rms:g}: {label} would have {amplifier_values[worst]:.3g} {unit}")


def crosstalk_couplings(median: float, largest: float, detector: Detector, detector_layout: Layout) -> Float:
    """Crosstalk [q, q] of signal from the second index into the first, 0 on the diagonal.

    Of neighbours log-normal about the median, 3 sigma at the largest; it falls off with distance, and is the camera's
    own: the same in every lake.

    median, largest : of the signal
    detector, own   : whose
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
