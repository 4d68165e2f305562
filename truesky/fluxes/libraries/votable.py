"""What an external VOTable may have, counted before astropy makes room for any of it.

An XML parser that keeps nothing goes over the text first. Refused is what takes astropy a square of the time (tables,
columns of one name), what it makes room for at once (arrays of a fixed size in every row), and what it would unpack or
look for elsewhere.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from xml.parsers import expat

# Elements beside those of rows, elements within one another, characters of an attribute, numbers in a cell and in all
# rows. A passband has some 50 elements, two columns and at most some ten thousand rows.
_MAX_ELEMENTS, _MAX_DEPTH, _MAX_ATTRIBUTE_LENGTH, _MAX_CELL_SIZE, _MAX_NUMBERS = 1000, 32, 1000, 999, 4_000_000
_ENCODINGS = {None, "utf-8", "us-ascii"}
_OTHER_SERIALISATIONS = {"BINARY", "BINARY2", "FITS", "STREAM", "PARQUET"}
_ROWS = {"TR", "TD"}


class _SizeCounter:
    """The handlers of a pass over a VOTable."""

    def __init__(self) -> None:
        self.depth = self.elements = self.rows = self.row_size = 0

    def start(self, name: str, attributes: Mapping[str, str]) -> None:
        name = name.rpartition(":")[2]
        self.depth += 1
        self.elements += name not in _ROWS
        self.rows += name == "TR"
        if self.elements > _MAX_ELEMENTS:
            raise ValueError(f"has more than {_MAX_ELEMENTS} elements beside its rows")
        if self.depth > _MAX_DEPTH:
            raise ValueError(f"has more than {_MAX_DEPTH} elements within one another")
        if name in _OTHER_SERIALISATIONS or "encoding" in attributes:
            raise ValueError("has rows that are no plain TABLEDATA")
        for key, value in attributes.items():
            if len(value) > _MAX_ATTRIBUTE_LENGTH:
                raise ValueError(f"an attribute of {name} has more than {_MAX_ATTRIBUTE_LENGTH} characters")
            if key in ("arraysize", "width", "precision") and _cell_size(value) > _MAX_CELL_SIZE:
                raise ValueError(f"{key} = {value[:40]!r} of {name} is more than {_MAX_CELL_SIZE}")
        if name == "FIELD":
            self.row_size += _cell_size(attributes.get("arraysize", ""))
        if self.rows * self.row_size > _MAX_NUMBERS:
            raise ValueError(f"has more than {_MAX_NUMBERS} numbers")

    def end(self, name: str) -> None:
        self.depth -= 1


def _cell_size(text: str) -> int:
    """Numbers that a cell of that size has room for: 6 for "2x3"; what may be of any length counts as 1."""
    return math.prod(map(int, re.findall(r"\d+", text)))


def _check_declaration(version: str, encoding: str | None, standalone: int) -> None:
    if encoding is not None and encoding.lower() not in _ENCODINGS:
        raise ValueError(f"is said to be in {encoding[:40]!r}, not in UTF-8")


def _refuse_doctype(*_: object) -> None:
    raise ValueError("has a DOCTYPE")


def refuse_large(text: str) -> None:
    """Errors : ValueError says what a VOTable has that no curve needs; expat.ExpatError where it is no XML."""
    counter = _SizeCounter()
    parser = expat.ParserCreate("utf-8")
    parser.StartElementHandler, parser.EndElementHandler = counter.start, counter.end
    parser.XmlDeclHandler, parser.StartDoctypeDeclHandler = _check_declaration, _refuse_doctype
    parser.Parse(text.encode(), True)
