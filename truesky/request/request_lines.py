"""Find the lines of a request file in which the pointings and observations with mistakes are."""

from __future__ import annotations

import re
from pathlib import Path

from lake_schema import user_files
from lake_schema.errors import BadInput, bad_input

_TABLE = re.compile(r"\s*\[\[\s*(pointing|observation)\s*\]\]")
_SECTION = re.compile(r"\s*\[")
# Start of a message about a pointing or an observation, such as "pointing[0].band"; indices count from 0.
_PLACE = re.compile(r"(pointing|observation)\[(\d+)\](?:\.(\w+))?")


def with_request_file(error: BadInput, path: Path) -> BadInput:
    """Return an error whose lines begin with the name of the request file.

    A line about a pointing or an observation also gives the number of its line in the file, such as "request a.toml
    line 23: pointing[1].band: ..".
    """
    name = f"request {user_files.format_path(path)}"
    try:
        lines = user_files.read_text(path, "request").splitlines()
    except BadInput:
        lines = []
    messages = []
    for message in error.messages:
        place = _PLACE.match(message)
        number = _line_number(lines, place[1], int(place[2]), place[3]) if place else 0
        messages.append(f"{name}{f' line {number}' if number else ''}: {message}")
    return bad_input(messages)


def _line_number(lines: list[str], table: str, index: int, key: str | None) -> int:
    """Return the number of the line of a key, or of the line that begins its table; 0 if it is not found."""
    headers = [i for i, line in enumerate(lines) if (match := _TABLE.match(line)) and match[1] == table]
    if index >= len(headers):
        return 0
    first = headers[index]
    for i in range(first + 1, len(lines)):
        if _SECTION.match(lines[i]):
            break
        if key and re.match(rf"\s*{key}\s*=", lines[i]):
            return i + 1
    return first + 1
