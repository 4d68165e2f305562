"""Write VOTables of any number of rows piece by piece, for answers of TAP.

References
----------
IVOA Recommendation VOTable 1.4
DALI 1.1, section 4.4 (QUERY_STATUS)
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import pyarrow as pa

from lake_schema.errors import BadInput

_OPEN = (
    '<?xml version="1.0" encoding="UTF-8"?>\n<VOTABLE version="1.4" xmlns="http://www.ivoa.net/xml/VOTable/v1.3">\n'
    '<RESOURCE type="results">\n'
)
_ROWS_A_PIECE = 8192
_CLOSE = "</RESOURCE>\n</VOTABLE>\n"
_TYPES = {
    pa.bool_(): "boolean", pa.int8(): "short", pa.int16(): "short", pa.int32(): "int", pa.int64(): "long",
    pa.uint8(): "short", pa.uint16(): "int", pa.uint32(): "long", pa.uint64(): "long",
    pa.float32(): "float", pa.float64(): "double",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Facts:
    """Metadata of a field, in addition to its name and type."""

    unit: str = ""
    ucd: str = ""
    description: str = ""
    xtype: str = ""
    utype: str = ""


@dataclass(slots=True)
class RowLimit:
    """Largest number of rows to send.

    Attributes
    ----------
    max_rows : int, optional
        Largest number of rows; None for all.
    overflowed : bool
        True if there were more rows; set when the last piece has been made.
    """

    max_rows: int | None = None
    overflowed: bool = field(default=False)


def pieces(
    batches: Iterable[pa.RecordBatch], row_limit: RowLimit | None = None, infos: Sequence[str] = ()
) -> Iterator[bytes]:
    """Yield a VOTable, serialised as TABLEDATA, piece by piece.

    Parameters
    ----------
    batches : iterable of RecordBatch
        Rows, at least one batch; the first is read before the first piece is yielded.
    row_limit : RowLimit, optional
        Largest number of rows; it also records if there were more.
    infos : sequence of str
        Further INFO elements, XML.

    Yields
    ------
    bytes
        Piece of the VOTable.
    """
    row_limit = row_limit or RowLimit()
    remaining_batches = iter(batches)
    batch = next(remaining_batches, None)
    schema = batch.schema if batch is not None else pa.schema([])
    status = '<INFO name="QUERY_STATUS" value="OK"/>\n'
    fields = "".join(_field(column) for column in schema)
    yield f"{_OPEN}{status}{''.join(infos)}<TABLE>\n{fields}<DATA><TABLEDATA>\n".encode()
    sent = 0
    while batch is not None:
        remaining = batch.num_rows if row_limit.max_rows is None else max(row_limit.max_rows - sent, 0)
        row_limit.overflowed |= batch.num_rows > remaining
        limited = batch.slice(0, remaining)
        # Batches are divided, since Python values as text take many times their size.
        for first in range(0, limited.num_rows, _ROWS_A_PIECE):
            yield _rows(limited.slice(first, _ROWS_A_PIECE))
        sent += min(remaining, batch.num_rows)
        batch = next(remaining_batches, None)
    tail = '<INFO name="QUERY_STATUS" value="OVERFLOW"/>\n' if row_limit.overflowed else ""
    yield f"</TABLEDATA></DATA>\n</TABLE>\n{tail}{_CLOSE}".encode()


def refusal(message: str) -> bytes:
    """Return a VOTable with an error message."""
    return f'{_OPEN}<INFO name="QUERY_STATUS" value="ERROR">{_text(message)}</INFO>\n{_CLOSE}'.encode()


def field_facts(column: pa.Field) -> Facts:
    """Return the unit, UCD, description, xtype and utype of a field."""
    metadata = {key.decode(): value.decode() for key, value in (column.metadata or {}).items()}
    return Facts(*(metadata.get(key, "") for key in ("unit", "ucd", "description", "xtype", "utype")))


def python_values(column: pa.Array, name: str = "") -> list[Any]:
    """Return the values of a column as Python objects.

    Raises
    ------
    BadInput
        If Python cannot represent a value, such as a time before the year 1 or after 9999.
    """
    try:
        values: list[Any] = column.to_pylist()
    except (ValueError, OverflowError, pa.ArrowException) as error:
        raise BadInput(f"column {name}: a value cannot be shown; CAST it AS VARCHAR: {error}") from None
    return values


def datatype(kind: pa.DataType) -> tuple[str, str]:
    """Return the VOTable datatype and arraysize ("" for a scalar) of an Arrow type."""
    if pa.types.is_list(kind):
        inner, size = datatype(kind.value_type)
        # VOTable cannot represent arrays of texts.
        return ("char", "*") if size else (inner, "*")
    if kind in _TYPES:
        return _TYPES[kind], ""
    return ("double", "") if pa.types.is_decimal(kind) else ("char", "*")


def _field(column: pa.Field) -> str:
    facts = field_facts(column)
    kind, size = datatype(column.type)
    attributes = {"name": column.name, "datatype": kind, "arraysize": size, "unit": facts.unit, "ucd": facts.ucd}
    attributes |= {"xtype": facts.xtype, "utype": facts.utype}
    words = " ".join(f"{key}={_quote_attribute(value)}" for key, value in attributes.items() if value)
    null = f'<VALUES null="{_NULLS[kind]}"/>' if kind in _NULLS else ""
    description = f"<DESCRIPTION>{_text(facts.description)}</DESCRIPTION>" if facts.description else ""
    return f"<FIELD {words}>{description}{null}</FIELD>\n"


# Values for missing integers; VOTable 1.4 also allows empty cells, which older readers take as zero.
_NULLS = {"short": -32768, "int": -2147483648, "long": -9223372036854775808}


def _rows(batch: pa.RecordBatch) -> bytes:
    cells = [_cells(column, field.name) for column, field in zip(batch.columns, batch.schema, strict=True)]
    return "".join(f"<TR>{''.join(row)}</TR>\n" for row in zip(*cells, strict=True)).encode()


def _cells(column: pa.Array, name: str) -> list[str]:
    format_value = _formatter(column.type)
    null = f"<TD>{_NULLS.get(datatype(column.type)[0], '')}</TD>" if not datatype(column.type)[1] else "<TD/>"
    return [null if value is None else f"<TD>{format_value(value)}</TD>" for value in python_values(column, name)]


def _formatter(kind: pa.DataType) -> Callable[[Any], str]:
    if pa.types.is_list(kind) and not datatype(kind.value_type)[1]:
        inner, null_text = _formatter(kind.value_type), str(_NULLS.get(datatype(kind.value_type)[0], "NaN"))
        return lambda values: " ".join(null_text if value is None else inner(value) for value in values)
    if pa.types.is_boolean(kind):
        return lambda value: "T" if value else "F"
    if pa.types.is_integer(kind):
        return str
    if pa.types.is_float32(kind):
        return lambda value: _number(value, ".9g")
    if pa.types.is_floating(kind) or pa.types.is_decimal(kind):
        return lambda value: _number(float(value), ".17g") if value == value else "NaN"
    return lambda value: _text(str(value))


def _number(value: float, form: str) -> str:
    if math.isfinite(value):
        return repr(value) if form == ".17g" else format(value, form)
    return "NaN" if math.isnan(value) else ("+Inf" if value > 0 else "-Inf")


# Characters that XML 1.0 does not allow.
_NO_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def _text(text: str) -> str:
    """Escape a text; characters that XML does not allow are replaced."""
    return escape(_NO_XML.sub("\N{REPLACEMENT CHARACTER}", text))


def _quote_attribute(text: str) -> str:
    return quoteattr(_text(text).replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&"))
