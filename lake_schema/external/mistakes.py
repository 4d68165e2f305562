"""Collect the wrong values of a user's tables, to report all of them at once: one line per column and kind of mistake.

A line names the file, the column, the first row with such a value (the first row of a file is 1), the value and the
allowed values, and gives the number of further rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lake_schema import user_files
from lake_schema.arrays import Array, Bool
from lake_schema.errors import BadInput, refuse_mistakes


@dataclass(slots=True)
class _WrongRows:
    """Rows with the same mistake: text about the first one, number of rows, and the files in which they are."""

    text: str
    count: int
    files: set[Path]

    def message(self) -> str:
        if self.count == 1:
            return self.text
        rows = f"{self.count - 1} more row{'s' if self.count > 2 else ''}"
        return f"{self.text} ({rows}{f' in {len(self.files)} files' if len(self.files) > 1 else ''})"


class TableMistakes:
    """TableMistakes in the files of one table, in the order in which they were found first."""

    def __init__(self) -> None:
        self._entries: dict[tuple[str, str], _WrongRows] = {}

    def __bool__(self) -> bool:
        return bool(self._entries)

    def add(self, error: BadInput) -> None:
        """Add the messages of an error that was raised by a reader."""
        for message in error.messages:
            self._entries.setdefault(("", message), _WrongRows(message, 1, set()))

    def add_row(self, file: Path, column: str, kind: str, text: str) -> None:
        """Add a wrong value of one row.

        Parameters
        ----------
        file : Path
            File of the row.
        column, kind : str
            Name of the column, and kind of the mistake. All rows with the same column and kind are reported in one
            line.
        text : str
            Message if this is the first such row.
        """
        entry = self._entries.setdefault((column, kind), _WrongRows(text, 0, set()))
        entry.count += 1
        entry.files.add(file)

    def add_rows(
        self,
        file: Path,
        first_row: int,
        column: str,
        is_wrong: Bool,
        values: Array | str,
        allowed: str,
        noun: str = "column",
    ) -> None:
        """Add those rows of a batch that have a wrong value.

        Parameters
        ----------
        file : Path
            File of the batch.
        first_row : int
            Number of the first row of the batch in the file.
        column : str
            Name of the column.
        is_wrong : bool array, shape (n,)
            True for the rows with a wrong value.
        values : array, shape (n,), or str
            The values; or a text about the row that replaces "is <value>", such as "are near a caustic".
        allowed : str
            What is allowed, such as "must be from 0 to 1". It is also the kind of the mistake: all rows of a column
            with the same text are reported in one line.
        noun : str, optional
            Words before the name of the column, such as "the sum of columns".
        """
        count = int(np.count_nonzero(is_wrong))
        if not count:
            return
        if (entry := self._entries.get((column, allowed))) is None:
            row = int(np.argmax(is_wrong))
            problem = values if isinstance(values, str) else f"is {format_number(values[row])}"
            place = f"{user_files.format_path(file)}: {noun} {column} of row {first_row + row}"
            text = f"{place} {problem}, but {allowed}"
            self._entries[column, allowed] = _WrongRows(text, count, {file})
        else:
            entry.count += count
            entry.files.add(file)

    def refuse(self) -> None:
        """Raise BadInput with a line for each mistake; without mistakes do nothing."""
        refuse_mistakes(entry.message() for entry in self._entries.values())


def find_out_of_bounds(
    file: Path, columns: Mapping[str, Array], bounds: Mapping[str, tuple[float, float]]
) -> TableMistakes:
    """Find the values of a table that are NaN or out of bounds; the bounds are included.

    Parameters
    ----------
    file : Path
        The file, for the messages.
    columns : mapping of str to array, shape (n,)
        Values of all rows of the file, by name of the column.
    bounds : mapping of str to (float, float)
        Smallest and largest value that is allowed, by name of the column.

    Returns
    -------
    TableMistakes
        The wrong values.
    """
    mistakes = TableMistakes()
    for column, values in columns.items():
        low, high = bounds[column]
        is_wrong = ~((values >= low) & (values <= high))
        mistakes.add_rows(file, 1, column, is_wrong, values, f"must be {format_range(low, high)}")
    return mistakes


def format_number(value: float) -> str:
    """Return a number for an error message; a missing value is "NaN"."""
    return "NaN" if value != value else f"{value:g}"


def format_range(low: float, high: float, unit: str = "") -> str:
    """Return the allowed range of a number for an error message.

    Parameters
    ----------
    low, high : float
        Smallest and largest number that is allowed.
    unit : str, optional
        Unit of the number.

    Returns
    -------
    str
        Text such as "a number from -90 to 90 deg".
    """
    return f"a number from {low:g} to {high:g}{' ' if unit else ''}{unit}"
