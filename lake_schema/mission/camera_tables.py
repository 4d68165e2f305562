"""Tables of a camera's folder: columns, rows with their line numbers, and checks of layouts and amplifiers."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lake_schema import user_files
from lake_schema.errors import BadInput

PARAMETERS, LAYOUT, AMPLIFIERS, BANDS, WAVEFRONT = (
    f"{name}.csv" for name in ("parameters", "layout", "amplifiers", "bands", "wavefront")
)
KIND = "table of a camera"
NAME = re.compile(r"[a-z][a-z0-9_]{0,39}", re.ASCII)
_DETECTOR = re.compile(r"\w[\w-]{0,39}", re.ASCII)
_MOST_PIXELS = 65_536
# Parameters of a band, with the columns of bands.csv and their units; those of the second list may be blank.
OF_BAND = {
    "zero_point": "mag",
    "sky_brightness": "mag / arcsec2",
    "seeing": "arcsec",
    "extinction": "mag",
}
OPTIONAL_OF_BAND = {"fringes": ""}
# Parameters of the amplifiers, with the columns of amplifiers.csv and their units.
OF_AMPLIFIERS = {"gain": "electron / adu", "read_noise": "electron", "full_well": "electron"}
COLUMNS = {
    PARAMETERS: ("name", "value", "unit", "source"),
    LAYOUT: ("detector", "type", "nx", "ny", "x_mm", "y_mm", "rotation_deg"),
    AMPLIFIERS: (
        "type", "amplifier", "x", "y", "nx", "ny", "read_right", "read_top", "prescan", "overscan", "overscan_rows",
        *OF_AMPLIFIERS,
    ),
    BANDS: ("band", "curve", "medium", *OF_BAND, *OPTIONAL_OF_BAND),
    WAVEFRONT: ("noll", "x_power", "y_power", "coefficient_nm"),
}  # fmt: skip
_LONGEST_TEXT = 1000


@dataclass(frozen=True, slots=True)
class Row:
    """A row of a table.

    Attributes
    ----------
    place : str
        File and line, for messages.
    values : mapping of str to str
        Texts by column.
    """

    place: str
    values: Mapping[str, str]

    def text(self, column: str) -> str:
        """Text of a column; BadInput if it is blank."""
        value = self.values[column].strip()
        if not value:
            raise BadInput(f"{self.place}: {column} is missing")
        return value

    def number(self, column: str, low: float = -math.inf, high: float = math.inf) -> float:
        """Finite number of a column; BadInput for any other text, or outside the bounds."""
        text = self.text(column)
        try:
            value = float(text)
        except ValueError:
            raise BadInput(f"{self.place}: {column} = {text!r} is not a number") from None
        if not (math.isfinite(value) and low <= value <= high):
            raise BadInput(f"{self.place}: {column} = {text} is not between {low:g} and {high:g}")
        return value

    def integer(self, column: str, low: int, high: int) -> int:
        """Whole number of a column; BadInput for any other text, or outside the bounds."""
        value = self.number(column, low, high)
        if value % 1.0:
            raise BadInput(f"{self.place}: {column} = {value:g} is not a whole number")
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
        If the table cannot be read, or a column is missing, unknown or given twice.
    """
    path = folder / file
    shown = user_files.shown(path)
    lines = user_files.text(path, KIND).splitlines()
    numbered = [(number, line) for number, line in enumerate(lines, start=1) if line and not line.startswith("#")]
    expected = COLUMNS[file]
    try:
        table = list(csv.reader(io.StringIO("\n".join(line for _, line in numbered)), strict=True))
    except csv.Error as error:
        raise BadInput(f"{shown}: {error}") from None
    if len(table) != len(numbered):
        raise BadInput(f"{shown}: a text goes over several lines")
    header = [column.strip() for column in table[0]] if table else []
    if unknown := [column for column in header if column not in expected]:
        raise BadInput(f"{shown}: unknown column {unknown[0]!r}, the columns are {', '.join(expected)}")
    if missing := [column for column in expected if column not in header]:
        raise BadInput(f"{shown}: column {missing[0]} is missing")
    if len(header) != len(expected):
        raise BadInput(f"{shown}: a column is given twice")
    found = []
    for (number, _), row in zip(numbered[1:], table[1:], strict=True):
        place = f"{shown} line {number}"
        if len(row) != len(header):
            raise BadInput(f"{place}: has {len(row)} values for {len(header)} columns")
        if any(len(value) > _LONGEST_TEXT or not value.isprintable() for value in row):
            raise BadInput(f"{place}: a text is too long or has characters that cannot be printed")
        found.append(Row(place, dict(zip(header, row, strict=True))))
    if not found:
        raise BadInput(f"{shown}: has no rows")
    return found


def refuse_repeated(rows: Sequence[Row], name_of: Callable[[Row], str]) -> None:
    """Raise BadInput if two rows have one name, which `name_of` returns for a row."""
    seen: set[str] = set()
    for row in rows:
        name = name_of(row)
        if name in seen:
            raise BadInput(f"{row.place}: {name} is given twice")
        seen.add(name)


def check_layout(folder: Path) -> None:
    """Raise BadInput if layout.csv has a wrong name or number, or a detector twice."""
    rows = read_rows(folder, LAYOUT)
    refuse_repeated(rows, lambda row: row.text("detector"))
    for row in rows:
        if _DETECTOR.fullmatch(row.text("detector")) is None:
            raise BadInput(f"{row.place}: detector = {row.text('detector')!r}: a name has letters, digits, _ and -")
        row.text("type")
        for axis in ("nx", "ny"):
            row.integer(axis, 1, _MOST_PIXELS)
        for axis in ("x_mm", "y_mm"):
            row.number(axis, -1e4, 1e4)
        row.number("rotation_deg", -360.0, 360.0)


def checked_amplifiers(folder: Path) -> list[Row]:
    """Rows of amplifiers.csv; BadInput if they do not fit the detectors of layout.csv or one another."""
    rows, detectors = read_rows(folder, AMPLIFIERS), read_rows(folder, LAYOUT)
    refuse_repeated(rows, lambda row: f"amplifier {row.text('amplifier')} of {row.text('type')}")
    sizes = {row.text("type"): (int(row.text("nx")), int(row.text("ny"))) for row in detectors}
    for row in detectors:
        if (int(row.text("nx")), int(row.text("ny"))) != sizes[row.text("type")]:
            raise BadInput(f"{row.place}: detectors of type {row.text('type')} differ in size")
    described = {row.text("type") for row in rows}
    if missing := sorted(set(sizes) - described):
        raise BadInput(f"{user_files.shown(folder / AMPLIFIERS)}: detectors of type {missing[0]} have no amplifier")
    if unused := sorted(described - set(sizes)):
        raise BadInput(f"{user_files.shown(folder / AMPLIFIERS)}: no detector has type {unused[0]}")
    for kind, size in sizes.items():
        _check_parts([row for row in rows if row.text("type") == kind], size)
    for row in rows:
        if row.number("full_well") != rows[0].number("full_well"):
            raise BadInput(f"{row.place}: full_well differs from the first amplifier: a camera has one")
    return rows


def _check_parts(rows: Sequence[Row], size: tuple[int, int]) -> None:
    """Refuse amplifiers of a type that lie outside the detector, overlap, or differ in size or overscan."""
    places: list[tuple[int, int]] = []
    for row in rows:
        if _DETECTOR.fullmatch(row.text("amplifier")) is None:
            raise BadInput(f"{row.place}: amplifier = {row.text('amplifier')!r}: a name has letters, digits, _ and -")
        for column in ("read_right", "read_top"):
            row.integer(column, 0, 1)
        for column in ("prescan", "overscan", "overscan_rows"):
            row.integer(column, 0, _MOST_PIXELS)
        if row.number("gain", 0.0, 1e3) < 1e-3:
            raise BadInput(f"{row.place}: gain = {row.text('gain')} is not between 0.001 and 1000")
        if not row.number("read_noise", 0.0, 1e4):
            raise BadInput(f"{row.place}: read_noise = {row.text('read_noise')} is not positive")
        row.number("full_well", 1.0, 1e8)
        x, y = (row.integer(axis, 0, _MOST_PIXELS) for axis in "xy")
        nx, ny = (row.integer(axis, 1, _MOST_PIXELS) for axis in ("nx", "ny"))
        if x + nx > size[0] or y + ny > size[1]:
            raise BadInput(f"{row.place}: reaches beyond the detector of {size[0]} x {size[1]} pixels")
        for other, (left, low) in zip(rows, places, strict=False):
            if abs(left - x) < nx and abs(low - y) < ny:
                raise BadInput(f"{row.place}: overlaps amplifier {other.text('amplifier')}")
        for column in ("nx", "ny", "prescan", "overscan", "overscan_rows"):
            if row.number(column) != rows[0].number(column):
                raise BadInput(f"{row.place}: {column} differs from the first amplifier of the type")
        places.append((x, y))


def check_wavefront(folder: Path) -> None:
    """Raise BadInput if wavefront.csv has a wrong number."""
    for row in read_rows(folder, WAVEFRONT):
        row.integer("noll", 4, 66)
        for column in ("x_power", "y_power"):
            row.integer(column, 0, 10)
        row.number("coefficient_nm", -1e4, 1e4)
