"""Describe the columns of Parquet files by a VOTable header in the footer, for clients that do not read Arrow metadata.

The header is a VOTable without data whose fields are the columns of the file, with unit and UCD. It follows the
VOParquet convention. The archives of Rubin and IRSA write it, and astropy (`Table.read(file,
format="parquet.votable")`), TOPCAT and hats read it.

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
    """Return the VOTable entries for the footer of a Parquet file that contains these rows of a table.

    The header is that of the declared table. The rows are only needed for the longest text of each text column.
    """
    texts = [column.name for column in table.columns if column.type == "string"]
    # astropy's VOTable reader takes a text of unknown length for an object, but its Parquet reader does not.
    text_lengths = tuple((name, pc.max(pc.utf8_length(rows[name])).as_py() or 1) for name in texts)
    return {VERSION: "1.0", CONTENT: table_header(table, text_lengths)}


@lru_cache(maxsize=64)
def table_header(table: Table, text_lengths: tuple[tuple[str, int], ...] = ()) -> str:
    """Return the columns of a table as a VOTable without data, in XML.

    Parameters
    ----------
    table : Table
        Declaration of the table.
    text_lengths : tuple of (str, int), optional
        Largest number of characters of each text column.

    Returns
    -------
    str
        The VOTable.
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
