"""Check the size of an external VOTable before astropy allocates memory for it.

A streaming XML parser reads the text first. It refuses tables for which astropy needs quadratic time (many tables, or
columns with the same name), large allocations (arrays of fixed size in every row), and data that astropy would unpack
or load from elsewhere.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from xml.parsers import expat

# Largest number of elements outside rows, of nested elements, of characters in an attribute, of numbers in a cell and
# of numbers in all rows. A passband has about 50 elements, two columns and up to about ten thousand rows.
_MAX_ELEMENTS, _MAX_DEPTH, _MAX_ATTRIBUTE_LENGTH, _MAX_CELL_SIZE, _MAX_NUMBERS = 1000, 32, 1000, 999, 4_000_000
_ENCODINGS = {None, "utf-8", "us-ascii"}
_OTHER_SERIALISATIONS = {"BINARY", "BINARY2", "FITS", "STREAM", "PARQUET"}
_ROWS = {"TR", "TD"}


class _SizeCounter:
    """Handlers of the XML parser that count elements, rows and numbers."""

    def __init__(self) -> None:
        self.depth = self.elements = self.rows = self.row_size = 0

    def start(self, name: str, attributes: Mapping[str, str]) -> None:
        name = name.rpartition(":")[2]
        self.depth += 1
        self.elements += name not in _ROWS
        self.rows += name == "TR"
        if self.elements > _MAX_ELEMENTS:
            raise ValueError(f"has more than {_MAX_ELEMENTS} elements outside its rows")
        if self.depth > _MAX_DEPTH:
            raise ValueError(f"has more than {_MAX_DEPTH} nested elements")
        if name in _OTHER_SERIALISATIONS or "encoding" in attributes:
            raise ValueError("has rows that are not plain TABLEDATA")
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
    """Return the number of values in a cell of an array size, for example 6 for "2x3"; variable lengths count as 1."""
    return math.prod(map(int, re.findall(r"\d+", text)))


def _check_declaration(version: str, encoding: str | None, standalone: int) -> None:
    if encoding is not None and encoding.lower() not in _ENCODINGS:
        raise ValueError(f"has encoding {encoding[:40]!r}: it must be UTF-8")


def _refuse_doctype(*_: object) -> None:
    raise ValueError("has a DOCTYPE")


def refuse_large(text: str) -> None:
    """Check that a VOTable contains no more than a curve needs.

    Raises
    ------
    ValueError
        If the table is too large or has a feature that a curve does not need.
    expat.ExpatError
        If the text is not XML.
    """
    counter = _SizeCounter()
    parser = expat.ParserCreate("utf-8")
    parser.StartElementHandler, parser.EndElementHandler = counter.start, counter.end
    parser.XmlDeclHandler, parser.StartDoctypeDeclHandler = _check_declaration, _refuse_doctype
    parser.Parse(text.encode(), True)
