"""Write units and descriptions of columns as a VOTable header into the footer of Parquet files.

The header is a VOTable without data, whose fields are the columns of the file with unit and UCD. It follows the
VOParquet convention, which the archives of Rubin and IRSA use. astropy (`Table.read(file, format="parquet.votable")`)
and TOPCAT read it, and hats can write it. They do not read units from Arrow metadata.

References
----------
IVOA Note "VOParquet", 1.0
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from xml.etree import ElementTree

import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.columns import Column, Table

VERSION, CONTENT = "IVOA.VOTable-Parquet.version", "IVOA.VOTable-Parquet.content"
_NAMESPACE = "http://www.ivoa.net/xml/VOTable/v1.3"
_TYPES = {
    "int64": "long", "int32": "int", "int16": "short", "int8": "short", "float64": "double", "float32": "float",
    "bool": "boolean", "string": "char",
}  # fmt: skip


def footer_metadata(rows: pa.Table, table: Table) -> dict[str, str]:
    """Return the key-value metadata that the footer of a Parquet file needs: version of VOParquet, and VOTable header.

    The header describes the columns that `table` declares. `rows` are the rows of the file; only the length of the
    longest text in each text column is taken from them.
    """
    texts = [column.name for column in table.columns if column.type == "string"]
    # Give the largest length of texts in the header. For a text of unknown length, astropy would make a column of
    # Python objects.
    text_lengths = tuple((name, pc.max(pc.utf8_length(rows[name])).as_py() or 1) for name in texts)
    return {VERSION: "1.0", CONTENT: table_header(table, text_lengths)}


@lru_cache(maxsize=64)
def table_header(table: Table, text_lengths: tuple[tuple[str, int], ...] = ()) -> str:
    """Return a VOTable in XML that describes the columns of a table and has no data.

    Parameters
    ----------
    table : Table
        Declaration of the table.
    text_lengths : tuple of (str, int), optional
        Name of a text column and the number of characters of its longest text. Columns that are not listed have an
        unknown length.

    Returns
    -------
    str
        The XML text of the VOTable.
    """
    root = ElementTree.Element("VOTABLE", {"version": "1.4", "xmlns": _NAMESPACE})
    table_element = ElementTree.SubElement(ElementTree.SubElement(root, "RESOURCE"), "TABLE", {"name": table.name})
    ElementTree.SubElement(table_element, "DESCRIPTION").text = table.doc
    lengths = dict(text_lengths)
    for column in table.columns:
        field = ElementTree.SubElement(table_element, "FIELD", _field(column, lengths))
        ElementTree.SubElement(field, "DESCRIPTION").text = column.doc
    return ElementTree.tostring(root, encoding="unicode")


def _field(column: Column, lengths: Mapping[str, int]) -> dict[str, str]:
    kind = _TYPES[column.type.removeprefix("list<").removesuffix(">")]
    facts = {"name": column.name, "datatype": kind}
    if column.type.startswith("list<") or kind == "char":
        facts["arraysize"] = f"{lengths.get(column.name, '')}*"
    return facts | {key: text for key, text in (("unit", column.unit), ("ucd", column.ucd)) if text}
