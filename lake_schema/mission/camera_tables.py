"""Read the CSV tables of a camera's folder, and check layouts and amplifiers."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lake_schema import user_files
from lake_schema.errors import BadInput

PARAMETERS, LAYOUT, AMPLIFIERS, BANDS, WAVEFRONT = (
    f"{name}.csv" for name in ("parameters", "layout", "amplifiers", "bands", "wavefront")
)
FILE_KIND = "table of a camera"
NAME_PATTERN = re.compile(r"[a-z][a-z0-9_]{0,39}", re.ASCII)
_DETECTOR_PATTERN = re.compile(r"\w[\w-]{0,39}", re.ASCII)
_MAX_PIXELS = 65_536
# Real amplifiers have at most about 100 prescan and overscan columns or rows.
_MAX_SCAN = 512
# Units of the parameters in the columns of bands.csv; optional parameters may be blank.
BAND_UNITS = {
    "zero_point": "mag",
    "sky_brightness": "mag / arcsec2",
    "seeing": "arcsec",
    "extinction": "mag",
}
OPTIONAL_BAND_UNITS = {"fringes": ""}
# Units of the parameters in the columns of amplifiers.csv.
AMPLIFIER_UNITS = {"gain": "electron / adu", "read_noise": "electron", "full_well": "electron"}
COLUMNS = {
    PARAMETERS: ("name", "value", "unit", "source"),
    LAYOUT: ("detector", "type", "nx", "ny", "x_mm", "y_mm", "rotation_deg"),
    AMPLIFIERS: (
        "type", "amplifier", "x", "y", "nx", "ny", "read_right", "read_top", "prescan", "overscan", "overscan_rows",
        *AMPLIFIER_UNITS,
    ),
    BANDS: ("band", "curve", "medium", *BAND_UNITS, *OPTIONAL_BAND_UNITS),
    WAVEFRONT: ("noll", "x_power", "y_power", "coefficient_nm"),
}  # fmt: skip
# Lowest and highest value of each column of whole numbers.
_INTEGER_BOUNDS = {
    "nx": (1, _MAX_PIXELS),
    "ny": (1, _MAX_PIXELS),
    "x": (0, _MAX_PIXELS),
    "y": (0, _MAX_PIXELS),
    "read_right": (0, 1),
    "read_top": (0, 1),
    "prescan": (0, _MAX_SCAN),
    "overscan": (0, _MAX_SCAN),
    "overscan_rows": (0, _MAX_SCAN),
    "noll": (4, 66),
    "x_power": (0, 10),
    "y_power": (0, 10),
}
_MAX_TEXT_LENGTH, _MAX_ROWS = 1000, 10_000


@dataclass(frozen=True, slots=True)
class Row:
    """A row of a table.

    Attributes
    ----------
    location : str
        File and line, for messages.
    values : mapping of str to str
        Texts by column, in the order of `COLUMNS`, without blanks around them. Whole numbers consist of digits only.
    """

    location: str
    values: Mapping[str, str]

    def text(self, column: str) -> str:
        """Return the text of a column; raise BadInput if it is blank."""
        value = self.values[column]
        if not value:
            raise BadInput(f"{self.location}: {column} is missing")
        return value

    def number(self, column: str, low: float = -math.inf, high: float = math.inf) -> float:
        """Return the finite number of a column.

        Parameters
        ----------
        column : str
            Name of the column.
        low, high : float, optional
            Smallest and largest number that is allowed.

        Returns
        -------
        float
            The number.

        Raises
        ------
        BadInput
            If the text is blank or is not a finite number within the bounds. The message names the file and the line.
        """
        text = self.text(column)
        try:
            value = float(text)
        except ValueError:
            raise BadInput(f"{self.location}: {column} = {text!r} is not a number") from None
        if not math.isfinite(value):
            raise BadInput(f"{self.location}: {column} = {text} is not finite")
        if not low <= value <= high:
            raise BadInput(f"{self.location}: {column} = {text} is not between {low:g} and {high:g}")
        return value

    def integer(self, column: str) -> int:
        """Return the whole number of a column in `_INTEGER_BOUNDS`; raise BadInput for other texts or out of bounds."""
        value = self.number(column, *_INTEGER_BOUNDS[column])
        if value % 1.0:
            raise BadInput(f"{self.location}: {column} = {value:g} is not a whole number")
        return int(value)


def read_rows(folder: Path, file: str) -> list[Row]:
    """Read a table that has exactly the expected columns, in any order.

    Parameters
    ----------
    folder : Path
        Folder of the camera.
    file : str
        Name of the table, a key of `COLUMNS`.

    Returns
    -------
    list of Row
        Rows, at least one.

    Raises
    ------
    BadInput
        If the table cannot be read, a column is missing, unknown or given twice, or a whole number is wrong.
    """
    path = folder / file
    path_text = user_files.format_path(path)
    lines = user_files.read_text(path, FILE_KIND).splitlines()
    numbered = [
        (number, line) for number, line in enumerate(lines, start=1) if line.strip() and not line.startswith("#")
    ]
    if len(numbered) > _MAX_ROWS + 1:
        raise BadInput(f"{path_text}: has more than {_MAX_ROWS} rows")
    expected = COLUMNS[file]
    try:
        table = list(csv.reader(io.StringIO("\n".join(line for _, line in numbered)), strict=True))
    except csv.Error as error:
        raise BadInput(f"{path_text}: {error}") from None
    if len(table) != len(numbered):
        raise BadInput(f"{path_text}: a text spans several lines")
    header = [column.strip() for column in table[0]] if table else []
    if unknown := [column for column in header if column not in expected]:
        raise BadInput(f"{path_text}: unknown column {unknown[0]!r}, the columns must be {', '.join(expected)}")
    if missing := [column for column in expected if column not in header]:
        raise BadInput(f"{path_text}: column {missing[0]} is missing")
    if len(header) != len(expected):
        raise BadInput(f"{path_text}: a column is given twice")
    rows = []
    for (number, _), entries in zip(numbered[1:], table[1:], strict=True):
        location, cells = f"{path_text} line {number}", [entry.strip() for entry in entries]
        if len(cells) != len(header):
            raise BadInput(f"{location}: has {len(cells)} values for {len(header)} columns")
        if any(len(value) > _MAX_TEXT_LENGTH or not value.isprintable() for value in cells):
            raise BadInput(f"{location}: a text is longer than {_MAX_TEXT_LENGTH} or has unprintable characters")
        texts = dict(zip(header, cells, strict=True))
        rows.append(_with_integers(Row(location, {column: texts[column] for column in expected})))
    if not rows:
        raise BadInput(f"{path_text}: has no rows")
    return rows


def _with_integers(row: Row) -> Row:
    """Write 300.0 and 3e2 as 300, because readers of the mission database expect whole numbers in this form."""
    integers = {column: str(row.integer(column)) for column in row.values if column in _INTEGER_BOUNDS}
    return Row(row.location, {**row.values, **integers})


def csv_text(rows: Sequence[Row]) -> str:
    """Return rows as a CSV text for the mission database: columns in their order, no comments, every text in quotes."""
    stream = io.StringIO()
    # Without quotes, a text that begins with # would be a comment.
    writer = csv.writer(stream, lineterminator="\n", quoting=csv.QUOTE_ALL)
    writer.writerows([list(rows[0].values), *(list(row.values.values()) for row in rows)])
    return stream.getvalue()


def refuse_repeated(rows: Sequence[Row], name_of: Callable[[Row], str]) -> None:
    """Raise BadInput if `name_of` returns the same name for two rows."""
    used_names: set[str] = set()
    for row in rows:
        name = name_of(row)
        if name in used_names:
            raise BadInput(f"{row.location}: {name} is given twice")
        used_names.add(name)


def read_layout(folder: Path, pixel_mm: float) -> list[Row]:
    """Read and check layout.csv.

    Parameters
    ----------
    folder : Path
        Folder of the camera.
    pixel_mm : float
        Size of a pixel in mm.

    Returns
    -------
    list of Row
        Rows, one per detector.

    Raises
    ------
    BadInput
        If a name or number is wrong, or a detector is given twice or overlaps another. The message names the line.
    """
    rows = read_rows(folder, LAYOUT)
    refuse_repeated(rows, lambda row: row.text("detector"))
    for row in rows:
        if _DETECTOR_PATTERN.fullmatch(row.text("detector")) is None:
            name = row.text("detector")
            raise BadInput(f"{row.location}: detector = {name!r}: a name must have letters, digits, _ and -")
        row.text("type")
        for axis in ("x_mm", "y_mm"):
            row.number(axis, -1e4, 1e4)
        row.number("rotation_deg", -360.0, 360.0)
    for first, second in find_overlaps([row.values for row in rows], pixel_mm):
        names = f"{rows[first].text('detector')} and {rows[second].text('detector')}"
        raise BadInput(f"{rows[second].location}: detectors {names} overlap")
    return rows


def find_overlaps(rows: Sequence[Mapping[str, str]], pixel_mm: float) -> Iterator[tuple[int, int]]:
    """Yield the pairs of detectors that overlap, as rectangles along the axes of the focal plane.

    Parameters
    ----------
    rows : sequence of mapping of str to str
        Rows of a layout.
    pixel_mm : float
        Size of a pixel in mm.

    Yields
    ------
    tuple of (int, int)
        Indices of two rows, the lower one first.
    """
    centre = np.array([[float(row["x_mm"]), float(row["y_mm"])] for row in rows])
    size = np.array([[int(row["nx"]), int(row["ny"])] for row in rows]) * pixel_mm
    is_rotated = np.array([round(float(row["rotation_deg"]) / 90.0) % 2 == 1 for row in rows])
    size[is_rotated] = size[is_rotated, ::-1]
    for index in range(len(rows)):
        is_close = np.abs(centre[index + 1 :] - centre[index]) < 0.5 * (size[index + 1 :] + size[index])
        yield from ((index, index + 1 + int(offset)) for offset in np.flatnonzero(is_close.all(axis=1)))


def read_amplifiers(folder: Path, detectors: Sequence[Row]) -> list[Row]:
    """Read amplifiers.csv; raise BadInput if amplifiers do not fit each other or the detectors (rows of layout.csv)."""
    rows = read_rows(folder, AMPLIFIERS)
    refuse_repeated(rows, lambda row: f"amplifier {row.text('amplifier')} of {row.text('type')}")
    sizes = {row.text("type"): (row.integer("nx"), row.integer("ny")) for row in detectors}
    for row in detectors:
        if (row.integer("nx"), row.integer("ny")) != sizes[row.text("type")]:
            raise BadInput(f"{row.location}: detectors of type {row.text('type')} differ in size")
    described = {row.text("type") for row in rows}
    if missing := sorted(set(sizes) - described):
        raise BadInput(
            f"{user_files.format_path(folder / AMPLIFIERS)}: detectors of type {missing[0]} have no amplifier"
        )
    if unused := sorted(described - set(sizes)):
        raise BadInput(f"{user_files.format_path(folder / AMPLIFIERS)}: no detector has type {unused[0]}")
    for detector_type, size in sizes.items():
        _check_amplifiers([row for row in rows if row.text("type") == detector_type], size)
    for row in rows:
        if row.number("full_well") != rows[0].number("full_well"):
            raise BadInput(f"{row.location}: full_well differs from the first amplifier: a camera has a single value")
    return rows


def _check_amplifiers(rows: Sequence[Row], size: tuple[int, int]) -> None:
    """Raise BadInput if amplifiers of a type lie outside the detector, overlap, or differ in size or overscan."""
    corners: list[tuple[int, int]] = []
    for row in rows:
        if _DETECTOR_PATTERN.fullmatch(row.text("amplifier")) is None:
            raise BadInput(
                f"{row.location}: amplifier = {row.text('amplifier')!r}: a name must have letters, digits, _ and -"
            )
        row.number("gain", 1e-3, 1e3)
        if not row.number("read_noise", 0.0, 1e4):
            raise BadInput(f"{row.location}: read_noise = {row.text('read_noise')} is not positive")
        row.number("full_well", 1.0, 1e8)
        x, y, nx, ny = (row.integer(column) for column in ("x", "y", "nx", "ny"))
        if x + nx > size[0] or y + ny > size[1]:
            raise BadInput(f"{row.location}: reaches beyond the detector of {size[0]} x {size[1]} pixels")
        for other, (other_x, other_y) in zip(rows, corners, strict=False):
            if abs(other_x - x) < nx and abs(other_y - y) < ny:
                raise BadInput(f"{row.location}: overlaps amplifier {other.text('amplifier')}")
        for column in ("nx", "ny", "prescan", "overscan", "overscan_rows"):
            if row.number(column) != rows[0].number(column):
                raise BadInput(f"{row.location}: {column} differs from the first amplifier of the type")
        corners.append((x, y))


def read_wavefront(folder: Path) -> list[Row]:
    """Read wavefront.csv; raise BadInput if a number is wrong."""
    rows = read_rows(folder, WAVEFRONT)
    for row in rows:
        row.number("coefficient_nm", -1e4, 1e4)
    return rows
