"""Write VOTables (XML tables of the Virtual Observatory) while their rows are read, for answers of the TAP service.

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
from xml.sax import saxutils

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
    """Metadata of a FIELD (column) of a VOTable, in addition to its name and type; "" means that it is not given."""

    unit: str = ""
    ucd: str = ""
    description: str = ""
    xtype: str = ""
    utype: str = ""


@dataclass(slots=True)
class RowLimit:
    """Largest number of rows of a VOTable.

    Attributes
    ----------
    max_rows : int, optional
        Rows after this number are left out; None for no limit.
    overflowed : bool
        True if rows were left out. `pieces` sets it; the value is final after the last bytes have been yielded.
    """

    max_rows: int | None = None
    overflowed: bool = field(default=False)


def pieces(
    batches: Iterable[pa.RecordBatch], row_limit: RowLimit | None = None, infos: Sequence[str] = ()
) -> Iterator[bytes]:
    """Yield the XML of a VOTable in the serialisation TABLEDATA, while its rows are read.

    Parameters
    ----------
    batches : iterable of pyarrow.RecordBatch
        Rows. The first batch, which may be empty, defines the columns; without any batch the table has no columns.
    row_limit : RowLimit, optional
        Largest number of rows. Its attribute `overflowed` is set to True if there are more. By default all rows are
        written.
    infos : sequence of str, optional
        Further INFO elements for the header, as XML, which is not checked.

    Yields
    ------
    bytes
        Consecutive parts of the VOTable: the header, up to 8192 rows each, and the end.

    Notes
    -----
    BadInput is raised if Python cannot represent a value, see `python_values`; the header has been yielded before.
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
        # Batches are divided, since their values as Python objects and text need many times the memory.
        for first in range(0, limited.num_rows, _ROWS_A_PIECE):
            yield _rows(limited.slice(first, _ROWS_A_PIECE))
        sent += min(remaining, batch.num_rows)
        batch = next(remaining_batches, None)
    tail = '<INFO name="QUERY_STATUS" value="OVERFLOW"/>\n' if row_limit.overflowed else ""
    yield f"</TABLEDATA></DATA>\n</TABLE>\n{tail}{_CLOSE}".encode()


def refusal(message: str) -> bytes:
    """Return a VOTable without rows that reports an error to a client of TAP, with `message` as its text."""
    return f'{_OPEN}<INFO name="QUERY_STATUS" value="ERROR">{escape(message)}</INFO>\n{_CLOSE}'.encode()


def field_facts(column: pa.Field) -> Facts:
    """Return the unit, UCD, description, xtype and utype in the metadata of an Arrow field, "" if they are missing."""
    metadata = {key.decode(): value.decode() for key, value in (column.metadata or {}).items()}
    return Facts(*(metadata.get(key, "") for key in ("unit", "ucd", "description", "xtype", "utype")))


def python_values(column: pa.Array, name: str = "") -> list[Any]:
    """Return the values of a column as Python objects; NULL becomes None.

    Raises
    ------
    BadInput
        If Python cannot represent a value, such as a time before the year 1 or after 9999. The message contains `name`,
        the name of the column.
    """
    try:
        values: list[Any] = column.to_pylist()
    except (ValueError, OverflowError, pa.ArrowException) as error:
        raise BadInput(f"column {name}: a value cannot be shown; CAST it AS VARCHAR: {error}") from None
    return values


def datatype(kind: pa.DataType) -> tuple[str, str]:
    """Return the attributes datatype and arraysize of a VOTable field for an Arrow type.

    The arraysize is "*" for texts and lists, and "" for scalars. Decimals become "double". Lists of texts and all other
    types become texts.
    """
    if pa.types.is_list(kind):
        inner, size = datatype(kind.value_type)
        # VOTable cannot represent arrays of texts, so a list of texts becomes one text.
        return ("char", "*") if size else (inner, "*")
    if kind in _TYPES:
        return _TYPES[kind], ""
    return ("double", "") if pa.types.is_decimal(kind) else ("char", "*")


def _field(column: pa.Field) -> str:
    facts = field_facts(column)
    kind, size = datatype(column.type)
    attributes = {"name": column.name, "datatype": kind, "arraysize": size, "unit": facts.unit, "ucd": facts.ucd}
    attributes |= {"xtype": facts.xtype, "utype": facts.utype}
    words = " ".join(f"{key}={quote_attribute(value)}" for key, value in attributes.items() if value)
    null = f'<VALUES null="{_NULLS[kind]}"/>' if kind in _NULLS else ""
    description = f"<DESCRIPTION>{escape(facts.description)}</DESCRIPTION>" if facts.description else ""
    return f"<FIELD {words}>{description}{null}</FIELD>\n"


# Integers that represent a missing value, by VOTable datatype. VOTable 1.4 also allows empty cells, which older readers
# take as zero.
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
    return lambda value: escape(str(value))


def _number(value: float, form: str) -> str:
    if math.isfinite(value):
        return repr(value) if form == ".17g" else format(value, form)
    return "NaN" if math.isnan(value) else ("+Inf" if value > 0 else "-Inf")


# A character that XML 1.0 does not allow, such as a control character or a lone surrogate.
NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def escape(text: str) -> str:
    """Escape a text for XML; characters that XML 1.0 does not allow become U+FFFD, the replacement character."""
    return saxutils.escape(NOT_XML.sub("\N{REPLACEMENT CHARACTER}", text))


def quote_attribute(text: str) -> str:
    """Return a text in quotes, as the value of an XML attribute, with the same replacements as `escape`."""
    return saxutils.quoteattr(NOT_XML.sub("\N{REPLACEMENT CHARACTER}", text))
