"""Read the CSV tables in which a user describes a ground camera, and check its detectors and amplifiers."""

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

# Names of the files in the folder of a camera.
PARAMETERS, LAYOUT, AMPLIFIERS, BANDS, WAVEFRONT = (
    f"{name}.csv" for name in ("parameters", "layout", "amplifiers", "bands", "wavefront")
)
# Type of the CSV files of a camera, a key of `user_files.MAX_BYTES`, which limits their size.
FILE_KIND = "table of a camera"
# Pattern of the name of a camera or a band.
NAME_PATTERN = re.compile(r"[a-z][a-z0-9_]{0,39}", re.ASCII)
# Pattern of the name of a detector or an amplifier.
_DETECTOR_PATTERN = re.compile(r"\w[\w-]{0,39}", re.ASCII)
# Largest number of columns or rows of a detector.
_MAX_PIXELS = 65_536
# Largest number of prescan or overscan columns or rows; real amplifiers have at most about 100.
_MAX_SCAN = 512
# Units of the columns of numbers in bands.csv that must not be blank. Only the strength of fringes is optional.
BAND_UNITS = {
    "zero_point": "mag",
    "sky_brightness": "mag / arcsec2",
    "extinction": "mag",
}
OPTIONAL_BAND_UNITS = {"fringes": ""}
# Units of the numbers of an amplifier in the columns of amplifiers.csv.
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
# Columns that a file may have in addition. Without one, its numbers are 0 and its texts blank.
OPTIONAL_COLUMNS = {LAYOUT: ("flip", "serial"), AMPLIFIERS: ("prescan_rows", "interleaved")}
# Lowest and highest allowed value of each column of whole numbers, in any of the files.
INTEGER_BOUNDS = {
    "nx": (1, _MAX_PIXELS),
    "ny": (1, _MAX_PIXELS),
    "x": (0, _MAX_PIXELS),
    "y": (0, _MAX_PIXELS),
    "read_right": (0, 1),
    "read_top": (0, 1),
    "prescan": (0, _MAX_SCAN),
    "overscan": (0, _MAX_SCAN),
    "overscan_rows": (0, _MAX_SCAN),
    "prescan_rows": (0, _MAX_SCAN),
    "interleaved": (0, 1),
    "flip": (0, 1),
    "noll": (4, 66),
    "x_power": (0, 12),
    "y_power": (0, 12),
}
# The same of columns of numbers that need not be whole.
NUMBER_BOUNDS = {
    "x_mm": (-1e4, 1e4),
    "y_mm": (-1e4, 1e4),
    "rotation_deg": (-360.0, 360.0),
    "gain": (1e-3, 1e3),
    "read_noise": (0.0, 1e4),
    "full_well": (1.0, 1e8),
    "coefficient_nm": (-1e6, 1e6),
}
# Largest number of characters of an entry of a table.
_MAX_TEXT_LENGTH = 1000
# Largest number of rows of a table of a camera.
_MAX_ROWS = 10_000


@dataclass(frozen=True, slots=True)
class Row:
    """A row of a CSV table in the folder of a camera.

    Attributes
    ----------
    location : str
        File and line number, for error messages.
    values : mapping of str to str
        Entries by name of the column, in the order of `COLUMNS` and `OPTIONAL_COLUMNS`, without blanks around them.
        Entries of columns of whole numbers consist of digits only.
    """

    location: str
    values: Mapping[str, str]

    def text(self, column: str) -> str:
        """Return the entry of a column as text; raise BadInput if it is blank."""
        value = self.values[column]
        if not value:
            raise BadInput(f"{self.location}: {column} is missing")
        return value

    def number(self, column: str) -> float:
        """Return the entry of a column as a finite number.

        Raise BadInput if the text is blank or is not a finite number, or is outside the allowed range of this column.
        The message names the file and the line.
        """
        text = self.text(column)
        try:
            value = float(text)
        except ValueError:
            raise BadInput(f"{self.location}: {column} = {text!r} is not a number") from None
        if not math.isfinite(value):
            raise BadInput(f"{self.location}: {column} = {text} is not finite")
        low, high = INTEGER_BOUNDS.get(column) or NUMBER_BOUNDS.get(column, (-math.inf, math.inf))
        if not low <= value <= high:
            raise BadInput(f"{self.location}: {column} = {text} is not between {low:g} and {high:g}")
        return value

    def integer(self, column: str) -> int:
        """Return the entry of a column of whole numbers, such as nx; 300.0 and 3e2 are accepted, too.

        Raise BadInput if the entry is not a whole number, or outside the allowed range of this column.
        """
        value = self.number(column)
        if value % 1.0:
            raise BadInput(f"{self.location}: {column} = {value:g} is not a whole number")
        return int(value)


def read_rows(folder: Path, file: str) -> list[Row]:
    """Read a CSV table of a camera, which must have exactly the expected columns and may have optional ones.

    The columns may be in any order.

    Blank lines, and lines that begin with #, are ignored.

    Parameters
    ----------
    folder : Path
        Folder of the camera.
    file : str
        Name of the file, a key of `COLUMNS`, such as "layout.csv".

    Returns
    -------
    list of Row
        Rows, at least one.

    Raises
    ------
    BadInput
        If the file cannot be read or has no rows or more than 10,000, a column is missing, unknown or given twice, or
        an entry of a column of whole numbers is wrong. The message names the file, and the line if it is known.
    """
    path = folder / file
    path_text = user_files.format_path(path)
    lines = user_files.read_text(path, FILE_KIND).splitlines()
    numbered = [
        (number, line) for number, line in enumerate(lines, start=1) if line.strip() and not line.startswith("#")
    ]
    if len(numbered) > _MAX_ROWS + 1:
        raise BadInput(f"{path_text}: has more than {_MAX_ROWS} rows")
    expected, optional = COLUMNS[file], OPTIONAL_COLUMNS.get(file, ())
    try:
        table = list(csv.reader(io.StringIO("\n".join(line for _, line in numbered)), strict=True))
    except csv.Error as error:
        raise BadInput(f"{path_text}: {error}") from None
    if len(table) != len(numbered):
        raise BadInput(f"{path_text}: a text spans several lines")
    header = [column.strip() for column in table[0]] if table else []
    if unknown := [column for column in header if column not in (*expected, *optional)]:
        extra = f", and may be {', '.join(optional)}" if optional else ""
        raise BadInput(f"{path_text}: unknown column {unknown[0]!r}, the columns must be {', '.join(expected)}{extra}")
    if missing := [column for column in expected if column not in header]:
        raise BadInput(f"{path_text}: column {missing[0]} is missing")
    if len(header) != len(set(header)):
        raise BadInput(f"{path_text}: a column is given twice")
    rows = []
    for (number, _), entries in zip(numbered[1:], table[1:], strict=True):
        location, cells = f"{path_text} line {number}", [entry.strip() for entry in entries]
        if len(cells) != len(header):
            raise BadInput(f"{location}: has {len(cells)} values for {len(header)} columns")
        if any(len(value) > _MAX_TEXT_LENGTH or not value.isprintable() for value in cells):
            raise BadInput(f"{location}: a text is longer than {_MAX_TEXT_LENGTH} or has unprintable characters")
        texts = dict(zip(header, cells, strict=True))
        values = {column: texts[column] for column in (*expected, *optional) if column in texts}
        rows.append(_with_integers(Row(location, values)))
    if not rows:
        raise BadInput(f"{path_text}: has no rows")
    return rows


def _with_integers(row: Row) -> Row:
    """Return a row in which whole numbers such as 300.0 and 3e2 are written as 300.

    The code that uses the tables later converts these entries with int(), which accepts only this form.
    """
    integers = {column: str(row.integer(column)) for column in row.values if column in INTEGER_BOUNDS}
    return Row(row.location, {**row.values, **integers})


def csv_text(rows: Sequence[Row]) -> str:
    """Return rows of a table as CSV text, with a line of column names; every entry is in quotes.

    `rows` must contain at least one row.
    """
    stream = io.StringIO()
    # Quote all entries: a line that begins with # would otherwise be read as a comment.
    writer = csv.writer(stream, lineterminator="\n", quoting=csv.QUOTE_ALL)
    writer.writerows([list(rows[0].values), *(list(row.values.values()) for row in rows)])
    return stream.getvalue()


def refuse_repeated(rows: Sequence[Row], name_of: Callable[[Row], str]) -> None:
    """Raise BadInput if the function `name_of` returns the same name for two rows; the message names the second one."""
    used_names: set[str] = set()
    for row in rows:
        name = name_of(row)
        if name in used_names:
            raise BadInput(f"{row.location}: {name} is given twice")
        used_names.add(name)


def read_layout(folder: Path, pixel_mm: float) -> list[Row]:
    """Read and check layout.csv, the table of the positions of a camera's detectors in its focal plane.

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
        If the file cannot be read, a name or number is not allowed, or a detector is given twice or overlaps another
        one. The message names the line.
    """
    rows = read_rows(folder, LAYOUT)
    refuse_repeated(rows, lambda row: row.text("detector"))
    for row in rows:
        if _DETECTOR_PATTERN.fullmatch(row.text("detector")) is None:
            name = row.text("detector")
            raise BadInput(f"{row.location}: detector = {name!r}: a name must have letters, digits, _ and -")
        row.text("type")
        for column in ("x_mm", "y_mm", "rotation_deg"):
            row.number(column)
    for first, second in find_overlaps([row.values for row in rows], pixel_mm):
        names = f"{rows[first].text('detector')} and {rows[second].text('detector')}"
        raise BadInput(f"{rows[second].location}: detectors {names} overlap")
    return rows


def find_overlaps(rows: Sequence[Mapping[str, str]], pixel_mm: float) -> Iterator[tuple[int, int]]:
    """Yield the pairs of detectors that overlap; each detector is taken as a rectangle along the focal plane's axes.

    Rotations are rounded to multiples of 90 deg.

    Parameters
    ----------
    rows : sequence of mapping of str to str
        Rows of a table layout.csv, one per detector: x_mm and y_mm (centre), nx and ny (pixels), and rotation_deg.
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
    """Read and check amplifiers.csv, the table of the areas of a detector that different amplifiers read.

    `detectors` are the rows of layout.csv. Raise BadInput if a type of detector has no amplifier or differs in size, if
    amplifiers overlap or reach beyond the detector, or if a number is not allowed. The full well must be equal for all.
    """
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
    """Raise BadInput if the amplifiers of one type of detector are not possible.

    They must not overlap or reach beyond the detector of `size` (columns, rows), and interleaved ones must reach its
    last column and row. Their areas, prescans and overscans must have equal sizes, and their gain, read noise and full
    well must be within bounds.
    """
    corners: list[tuple[int, int]] = []
    for row in rows:
        if _DETECTOR_PATTERN.fullmatch(row.text("amplifier")) is None:
            raise BadInput(
                f"{row.location}: amplifier = {row.text('amplifier')!r}: a name must have letters, digits, _ and -"
            )
        row.number("gain")
        if not row.number("read_noise"):
            raise BadInput(f"{row.location}: read_noise = {row.text('read_noise')} is not positive")
        row.number("full_well")
        x, y, nx, ny = (row.integer(column) for column in ("x", "y", "nx", "ny"))
        if x + nx > size[0] or y + ny > size[1]:
            raise BadInput(f"{row.location}: reaches beyond the detector of {size[0]} x {size[1]} pixels")
        for other, (other_x, other_y) in zip(rows, corners, strict=False):
            if abs(other_x - x) < nx and abs(other_y - y) < ny:
                raise BadInput(f"{row.location}: overlaps amplifier {other.text('amplifier')}")
        optional = tuple(column for column in OPTIONAL_COLUMNS[AMPLIFIERS] if column in row.values)
        for column in ("nx", "ny", "prescan", "overscan", "overscan_rows", *optional):
            if row.number(column) != rows[0].number(column):
                raise BadInput(f"{row.location}: {column} differs from the first amplifier of the type")
        corners.append((x, y))
    ends = [max(corner[axis] for corner in corners) + rows[0].integer(name) for axis, name in enumerate(("nx", "ny"))]
    if "interleaved" in rows[0].values and rows[0].integer("interleaved") and tuple(ends) != size:
        # A raw file has no card with the size of a detector whose pixels do not lie side by side.
        raise BadInput(f"{rows[0].location}: interleaved amplifiers must reach the last column and row of the detector")


def read_wavefront(folder: Path) -> list[Row]:
    """Read wavefront.csv, the table of the telescope's aberrations: Zernike coefficients in nm across the field.

    Raise BadInput if the file cannot be read or a number is not allowed.
    """
    rows = read_rows(folder, WAVEFRONT)
    for row in rows:
        row.number("coefficient_nm")
    return rows
