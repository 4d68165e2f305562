"""Find the lines of a request file in which the keys with mistakes are."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from lake_schema import user_files
from lake_schema.errors import BadInput, bad_input
from truesky.request.toml_values import LIST_KEYS

# A line that begins a section, such as "[area]" or "[[pointing]]", and the part of a line before the value of a key.
_SECTION = re.compile(r"\s*(?P<brackets>\[\[?)(?P<name>[^\[\],=]+)\]\]?\s*(?:#.*)?$")
_KEY = re.compile(r"""(?P<name>(?:[\w.\s-]|"[^"]*"|'[^']*')+)=""")
# Path of a key at the start of a message, such as "pointing[0].band", and its last part. Indices count from 0.
_PATH = re.compile(r"[^\s:=]+")
_LAST_PART = re.compile(r"(?:\.[^.\[\]]*|\[\d+\]|\A[^.\[\]]*)\Z")


def with_request_file(error: BadInput, path: Path) -> BadInput:
    """Return an error whose lines begin with the name of the request file.

    A line that begins with the path of a key also gives the number of the line with this key in the file, such as
    "request a.toml line 23: pointing[1].band: ..". If a key is missing, it is the line that begins its section.
    """
    name = f"request {user_files.format_path(path)}"
    try:
        lines = _lines_of_keys(user_files.read_text(path, "request").splitlines())
    except BadInput:
        lines = {}
    messages = []
    for message in error.messages:
        number = _line_number(lines, message)
        messages.append(f"{name}{f' line {number}' if number else ''}: {message}")
    return bad_input(messages)


def _lines_of_keys(texts: Sequence[str]) -> dict[str, int]:
    """Return the number of the first line of each key and section of a request, by its path as messages name it.

    The keys of a table in braces are not listed: a message about them gets the line of the table.
    """
    lines: dict[str, int] = {}
    counts = dict.fromkeys(LIST_KEYS, 0)
    section = ""
    for number, text in enumerate(texts, 1):
        if header := _SECTION.match(text):
            section = _without_quotes(header["name"])
            top, dot, rest = section.partition(".")
            if top in counts:
                counts[top] += header["brackets"] == "[[" and not dot
                # A section such as [observation.area] belongs to the last [[observation]] before it.
                section = f"{top}[{counts[top] - 1}]{dot}{rest}" if counts[top] else section
            path = section
        elif key := _KEY.match(text):
            path = ".".join(filter(None, (section, _without_quotes(key["name"]))))
        else:
            continue
        lines.setdefault(path, number)
        # [fluxes.stars] may be the only line that mentions the section fluxes.
        while (path := _without_last_part(path)) and path not in LIST_KEYS:
            lines.setdefault(path, number)
    return lines


def _without_quotes(name: str) -> str:
    return re.sub(r"""["'\s]""", "", name)


def _without_last_part(path: str) -> str:
    shorter = _LAST_PART.sub("", path)
    # A key in quotes can have brackets, so that the path does not end with one of its parts.
    return "" if shorter == path else shorter


def _line_number(lines: dict[str, int], message: str) -> int:
    """Return the line of the key at the start of a message, or of its section, 0 if neither is found."""
    match = _PATH.match(message)
    path = match[0] if match else ""
    while path and path not in lines:
        path = _without_last_part(path)
    return lines.get(path, 0)
