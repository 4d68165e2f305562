"""Amplifiers of a ground camera's detector: the pixels that each one reads, and their positions in the raw file.

In the raw file the pixels lie side by side as on the detector, so that one WCS is valid for all amplifiers. Pre- and
overscan columns of amplifiers in the left half of the detector lie to the left of the pixels, the other ones to the
right. Overscan rows lie below or above the pixels, as in the files of DECam and MegaCam.

Planes in readout order have the axes [amplifier, row, column], where [0, 0] is read first. Columns are prescan, pixels
and overscan; rows are pixels and overscan.
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

# Deviations of single amplifiers from the mean are clipped at this number of standard deviations.
_MAX_DEVIATION = 3.0
# Crosstalk falls off with this power of the distance between two outputs, in amplifiers, and is 0 beyond the maximum.
# Outputs at opposite ends of the columns are farther apart by the last number. In LSSTCam, crosstalk beyond the
# neighbours was measured to be below 5e-5.
_FALLOFF_POWER, _MAX_DISTANCE, _OPPOSITE_END_DISTANCE = 2.6, 4.0, 2.0


@dataclass(frozen=True, slots=True)
class Amplifier:
    """An amplifier and the pixels that it reads.

    Attributes
    ----------
    name : str
        Name of the amplifier.
    pixels : Section
        Its pixels on the detector.
    read_right : bool
        True if its last column is read first.
    read_top : bool
        True if its last row is read first.
    ratios_to_first : (float, float)
        Its gain and its read noise, relative to the first amplifier in the camera's table.
    """

    name: str
    pixels: Section
    read_right: bool
    read_top: bool
    ratios_to_first: tuple[float, float] = (1.0, 1.0)


@dataclass(frozen=True, slots=True)
class Layout:
    """Amplifiers of a detector, all with the same number of pixels, in the order in which arrays contain them.

    Attributes
    ----------
    nx, ny : int
        Columns and rows of the detector.
    prescan, overscan : int
        Columns that an amplifier reads before and after its pixels.
    overscan_rows : int
        Rows that it reads after its pixels.
    amplifiers : tuple of Amplifier
        The amplifiers.
    """

    nx: int
    ny: int
    prescan: int
    overscan: int
    overscan_rows: int
    amplifiers: tuple[Amplifier, ...]

    @property
    def width(self) -> int:
        """Number of pixel columns per amplifier."""
        return self.amplifiers[0].pixels.nx

    @property
    def height(self) -> int:
        """Number of pixel rows per amplifier."""
        return self.amplifiers[0].pixels.ny

    @property
    def scan_columns(self) -> int:
        """Number of prescan and overscan columns per amplifier."""
        return self.prescan + self.overscan

    @property
    def column_segments(self) -> tuple[tuple[int, int, bool], ...]:
        """First row, row after the last, and True if the register lies above, for each segment of a column."""
        pieces = {(a.pixels.y, a.pixels.y + a.pixels.ny, a.read_top) for a in self.amplifiers}
        return tuple(sorted(pieces))

    @property
    def unread_pixels(self) -> Bool:
        """Mask [ny, nx] of the pixels that no amplifier reads."""
        out = np.ones((self.ny, self.nx), bool)
        for amplifier in self.amplifiers:
            out[amplifier.pixels.slices] = False
        return out

    def split(self, frame: npt.NDArray[Number]) -> npt.NDArray[Number]:
        """Split a frame [ny, nx] into planes [amplifier, row, column] in readout order, with 0 in pre- and overscan.

        Raises
        ------
        BadInput
            If the shape of the frame is not (ny, nx).
        """
        if frame.shape != (self.ny, self.nx):
            raise BadInput(f"frame has the shape {frame.shape}, but the amplifiers cover {self.ny} x {self.nx} pixels")
        shape = len(self.amplifiers), self.height + self.overscan_rows, self.scan_columns + self.width
        out = np.zeros(shape, frame.dtype)
        for plane, amplifier in zip(out, self.amplifiers, strict=True):
            plane[: self.height, self.prescan : self.prescan + self.width] = _flip_to_readout_order(
                frame[amplifier.pixels.slices], amplifier
            )
        return out

    def assemble(self, planes: npt.NDArray[Number]) -> npt.NDArray[Number]:
        """Join planes [amplifier, row, column] in readout order to a frame [ny, nx]; pixels that are not read are 0."""
        out = np.zeros((self.ny, self.nx), planes.dtype)
        for plane, amplifier in zip(planes, self.amplifiers, strict=True):
            pixels = plane[: self.height, self.prescan : self.prescan + self.width]
            out[amplifier.pixels.slices] = _flip_to_readout_order(pixels, amplifier)
        return out

    @property
    def data_section(self) -> Section:
        """Pixels of the detector in its raw file."""
        across, up = (len(starts) for starts in self._starts)
        return Section((across // 2) * self.scan_columns, (up // 2) * self.overscan_rows, self.nx, self.ny)

    @property
    def raw_shape(self) -> tuple[int, int]:
        """Rows and columns of the raw file."""
        across, up = (len(starts) for starts in self._starts)
        return self.ny + up * self.overscan_rows, self.nx + across * self.scan_columns

    def amplifier_data_section(self, number: int) -> Section:
        """Pixels of an amplifier in the raw file."""
        pixels, data = self.amplifiers[number].pixels, self.data_section
        return Section(data.x + pixels.x, data.y + pixels.y, pixels.nx, pixels.ny)

    def amplifier_bias_section(self, number: int) -> Section:
        """Overscan columns in the rows of an amplifier's pixels, in the raw file; its prescan if it has no overscan."""
        first, count = (self.prescan, self.overscan) if self.overscan else (0, self.prescan)
        return self._scan_columns_section(number, first, count)

    def amplifier_prescan_section(self, number: int) -> Section:
        """Prescan columns of an amplifier in the raw file."""
        return self._scan_columns_section(number, 0, self.prescan)

    def amplifier_overscan_section(self, number: int) -> Section:
        """Overscan rows of an amplifier, in the columns of its pixels, in the raw file."""
        pixels, (_, scan_y) = self.amplifier_data_section(number), self._scan_origin(number)
        return Section(pixels.x, scan_y, pixels.nx, self.overscan_rows)

    def _scan_columns_section(self, number: int, first: int, count: int) -> Section:
        """Return `count` pre- or overscan columns of an amplifier in the raw file, from `first` in readout order."""
        amplifier, (scan_x, _) = self.amplifiers[number], self._scan_origin(number)
        if amplifier.read_right:
            first = self.scan_columns - first - count
        return Section(scan_x + first, self.amplifier_data_section(number).y, count, self.height)

    def to_detector_axes(self, plane: npt.NDArray[Number], number: int) -> npt.NDArray[Number]:
        """Convert an amplifier's plane [row, column] from readout order to the orientation on the detector."""
        return _flip_to_readout_order(plane, self.amplifiers[number])

    def amplifier_sections(self, number: int) -> Sections:
        """Sections of an array with an amplifier's pixels, pre- and overscan, oriented as by `to_detector_axes`."""
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
        """Convert planes [amplifier, row, column] in readout order to the image of the raw file."""
        out = np.zeros(self.raw_shape, planes.dtype)
        for number, (plane, amplifier) in enumerate(zip(planes, self.amplifiers, strict=True)):
            pixels, (scan_x, scan_y) = self.amplifier_data_section(number), self._scan_origin(number)
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
        """First columns and first rows of the amplifiers' pixels, each in increasing order."""
        places = [amplifier.pixels for amplifier in self.amplifiers]
        return sorted({place.x for place in places}), sorted({place.y for place in places})

    def _scan_origin(self, number: int) -> tuple[int, int]:
        """First pre- or overscan column, and first overscan row, of an amplifier in the raw file."""
        pixels, (across, up) = self.amplifiers[number].pixels, self._starts
        i, j = across.index(pixels.x), up.index(pixels.y)
        x = i * self.scan_columns + (self.nx if i >= len(across) // 2 else 0)
        y = j * self.overscan_rows + (self.ny if j >= len(up) // 2 else 0)
        return x, y


def _flip_to_readout_order(plane: npt.NDArray[Number], amplifier: Amplifier) -> npt.NDArray[Number]:
    """Convert a plane from readout order to the orientation on the detector, or back."""
    return plane[:: -1 if amplifier.read_top else 1, :: -1 if amplifier.read_right else 1]


def _scan_segments(
    n_before: int, pixels: int, n_after: int, pixels_start: int, scan_start: int, is_flipped: bool
) -> list[tuple[int, int, int]]:
    """Return (start in the plane, start in the file, length) of prescan, pixels and overscan along one axis."""
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
    """Amplifiers of a detector, or None if its camera has no table of amplifiers or has a special readout.

    Raises
    ------
    BadInput
        If the detector is too small for its amplifiers.

    Notes
    -----
    A detector that is smaller or larger than its type is divided in the same way, in whole pixels. The remainder is not
    read.
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
    """Rows of a ground camera's table of amplifiers, () if it has none with prescans."""
    key = f"{section}.amplifiers"
    rows = mission.rows(key) if section.startswith("ext.") and key in mission else ()
    return rows if rows and "prescan" in rows[0] else ()


def full_size(detector: Detector, mission: MissionConfiguration) -> tuple[int, int]:
    """Columns and rows of a ground camera's detectors of this type; `detector` may be a part of one."""
    of_kind = (row for row in mission.rows(f"{detector.section}.layout") if row["type"] == detector.kind)
    return next(((int(row["nx"]), int(row["ny"])) for row in of_kind), (detector.nx, detector.ny))


# Parameters for which the table has a value per amplifier, and their index in `Amplifier.ratios_to_first`.
_RELATIVE = {"gain": 0, "read_noise": 1}


@lru_cache(maxsize=1024)
def values(
    key: str, unit: str, detector: Detector, mission: MissionConfiguration, detector_layout: Layout
) -> float | Float:
    """Values of a parameter for each amplifier of a detector.

    Parameters
    ----------
    key : str
        Parameter within the camera's section, such as "gain".
    unit : str
        Unit of the parameter.
    detector : Detector
        The detector.
    mission : MissionConfiguration
        Mission database.
    detector_layout : Layout
        Amplifiers of the detector.

    Returns
    -------
    float or float array, shape (n_amplifiers,)
        The values; one number if all are equal.

    Notes
    -----
    The parameter `key` is the mean and `key` + "_spread" the rms between amplifiers. The deviations are a property of
    the hardware and therefore the same in every lake. A value that a request sets is used without deviations.
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


# Unit and smallest allowed value for each amplifier, the same as the limits of the mean in bounds.csv.
_MIN_VALUES = {"gain": ("electron / adu", 1e-3), "read_noise": ("electron", 0.0)}


def refuse_spread(detectors: Sequence[Detector], mission: MissionConfiguration) -> None:
    """Raise BadInput with the first amplifier whose gain or read noise would be below its limit."""
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


def crosstalk_couplings(median: float, largest: float, detector: Detector, detector_layout: Layout) -> Float:
    """Crosstalk coefficients between the amplifiers of a detector.

    Parameters
    ----------
    median : float
        Median coefficient of neighbouring amplifiers, as a fraction of the signal.
    largest : float
        Largest coefficient, as a fraction of the signal.
    detector : Detector
        The detector.
    detector_layout : Layout
        Its amplifiers.

    Returns
    -------
    float array, shape (n_amplifiers, n_amplifiers)
        Fraction of the signal in the amplifier of the second index that appears in that of the first; 0 on the
        diagonal.

    Notes
    -----
    Coefficients of neighbours are log-normal about the median, with the largest at 3 sigma. They fall off with
    distance. They are a property of the camera, and the same in every lake.
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
