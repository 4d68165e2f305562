"""Check the size of a user's VOTable before astropy reads it, because a small file may need much time or memory.

A streaming XML parser reads the text first. Tables are refused if astropy would need quadratic time (many tables, or
columns with the same name) or much memory (arrays of fixed size in every row). They are also refused if their data are
compressed, binary or stored elsewhere.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from xml.parsers import expat

# The limits below are far above the needs of a passband, which has about 50 XML elements, two columns and up to about
# ten thousand rows.

# Largest number of XML elements outside rows.
_MAX_ELEMENTS = 1000
# Largest number of elements nested in each other.
_MAX_DEPTH = 32
# Largest number of characters in an attribute of an element.
_MAX_ATTRIBUTE_LENGTH = 1000
# Largest number of values in a cell of the table.
_MAX_CELL_SIZE = 999
# Largest number of values in all rows.
_MAX_NUMBERS = 4_000_000
_ENCODINGS = {None, "utf-8", "us-ascii"}
_OTHER_SERIALISATIONS = {"BINARY", "BINARY2", "FITS", "STREAM", "PARQUET"}
_ROWS = {"TR", "TD"}


class _SizeCounter:
    """Handlers of the XML parser, which count elements, rows and numbers; they raise ValueError above a limit."""

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
    """Return the number of values in a cell from an attribute `arraysize`, for example 6 for "2x3".

    An empty text or a variable length ("*") counts as 1.
    """
    return math.prod(map(int, re.findall(r"\d+", text)))


def _check_declaration(version: str, encoding: str | None, standalone: int) -> None:
    if encoding is not None and encoding.lower() not in _ENCODINGS:
        raise ValueError(f"has encoding {encoding[:40]!r}: it must be UTF-8")


def _refuse_doctype(*_: object) -> None:
    raise ValueError("has a DOCTYPE")


def refuse_large(text: str) -> None:
    """Check that the XML text of a VOTable contains no more than a spectrum, extinction curve or passband needs.

    Raises
    ------
    ValueError
        If the table exceeds a limit of this module, has a DOCTYPE, is not in UTF-8, or has rows that are not plain
        TABLEDATA.
    expat.ExpatError
        If the text is not XML.
    """
    counter = _SizeCounter()
    parser = expat.ParserCreate("utf-8")
    parser.StartElementHandler, parser.EndElementHandler = counter.start, counter.end
    parser.XmlDeclHandler, parser.StartDoctypeDeclHandler = _check_declaration, _refuse_doctype
    parser.Parse(text.encode(), True)
