"""Print tables that fit the terminal, or the same rows as JSON."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Collection, Mapping, Sequence
from typing import Any

# Text columns that are too wide for the terminal are not made narrower than this number of characters.
_LEAST_WIDTH = 16
_SEPARATOR = "  "


def format_table(headings: Sequence[str], rows: Sequence[Sequence[str]], numbers: Collection[str] = ()) -> list[str]:
    """Return a table as lines of text with aligned columns.

    Parameters
    ----------
    headings : sequence of str
        Heading of each column.
    rows : sequence of sequence of str
        Cells of each row.
    numbers : collection of str, optional
        Headings of the columns that are aligned to the right and are never shortened.

    Returns
    -------
    list of str
        Heading and rows. If stdout is a terminal and the table is too wide for it, long texts end in "…". If it is
        still too wide, the columns are divided into several tables, one below the other, each with the first column.
    """
    table = [tuple(headings), *map(tuple, rows)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    total = terminal_width()
    if total:
        _shorten_columns(widths, [i for i, heading in enumerate(headings) if heading not in numbers], total)
    lines: list[str] = []
    for block in _blocks(widths, total):
        lines += [""] if lines else []
        for row in table:
            cells = [_fit(row[i], widths[i], headings[i] in numbers) for i in block]
            lines.append(_SEPARATOR.join(cells).rstrip())
    return lines


def terminal_width() -> int:
    """Return the number of columns of the terminal ($COLUMNS if it is set), or 0 if stdout is not a terminal."""
    return shutil.get_terminal_size((0, 0)).columns


def _shorten_columns(widths: list[int], text_columns: Sequence[int], total: int) -> None:
    """Reduce the widths of the widest text columns in place until the table fits.

    If this would make a column too narrow, only columns that do not fit next to the first one are made narrower.
    """
    least_widths = [min(width, _LEAST_WIDTH) if i in text_columns else width for i, width in enumerate(widths)]
    if sum(least_widths) + len(_SEPARATOR) * (len(widths) - 1) > total:
        room = total - widths[0] - len(_SEPARATOR)
        widths[1:] = [max(min(width, room), low) for width, low in zip(widths[1:], least_widths[1:], strict=True)]
        return
    while sum(widths) + len(_SEPARATOR) * (len(widths) - 1) > total:
        widths[max(text_columns, key=lambda i: widths[i])] -= 1


def _blocks(widths: Sequence[int], total: int) -> list[list[int]]:
    """Divide the columns into groups that fit the terminal, each with the first column; one group if `total` is 0."""
    blocks = [[0]]
    for i in range(1, len(widths)):
        width = sum(widths[j] + len(_SEPARATOR) for j in blocks[-1]) + widths[i]
        if total and width > total and len(blocks[-1]) > 1:
            blocks.append([0])
        blocks[-1].append(i)
    return blocks


def _fit(cell: str, width: int, is_number: bool) -> str:
    text = cell if len(cell) <= width else f"{cell[: width - 1]}…"
    return text.rjust(width) if is_number else text.ljust(width)


def print_json(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print rows as a JSON list with one object per row and line. Numbers that are not finite become null."""
    lines = (json.dumps({name: _json_value(value) for name, value in row.items()}, default=str) for row in rows)
    print("[" + ",\n ".join(lines) + "]")


def _json_value(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return [_json_value(item) for item in value] if isinstance(value, list | tuple) else value
