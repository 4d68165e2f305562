"""Tables that the TAP service adds to the tables of the lake: TAP_SCHEMA and ivoa.obscore.

TAP_SCHEMA lists all tables and columns, and ivoa.obscore contains one row per image.

References
----------
IVOA Recommendations TAP 1.1, section 4; ObsCore 1.1, table 1 and appendix B
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import feather

from lake_schema.store import read
from truesky.explore.votables import datatype, field_facts

LAKE = "lake"
_METRES_PER_ANGSTROM = 1e-10
Json = dict[str, Any]


def _f(name: str, kind: pa.DataType, ucd: str, description: str) -> pa.Field:
    facts = {"ucd": ucd, "description": description}
    return pa.field(name, kind, metadata={key: value for key, value in facts.items() if value})


_S, _I = pa.string(), pa.int32()
_SCHEMAS: dict[str, tuple[str, pa.Schema]] = {
    "tap_schema.schemas": ("The schemas.", pa.schema([
        _f("schema_name", _S, "meta.id", "name of the schema"), _f("utype", _S, "", "utype"),
        _f("description", _S, "", "description of the schema"), _f("schema_index", _I, "", "order in lists"),
    ])),
    "tap_schema.tables": ("The tables.", pa.schema([
        _f("schema_name", _S, "", "schema of the table"), _f("table_name", _S, "", "name to use in a query"),
        _f("table_type", _S, "", "table or view"), _f("utype", _S, "", "utype"),
        _f("description", _S, "", "description of the table"), _f("table_index", _I, "", "order in lists"),
    ])),
    "tap_schema.columns": ("The columns.", pa.schema([
        _f("table_name", _S, "", "table of the column"), _f("column_name", _S, "", "name to use in a query"),
        _f("datatype", _S, "", "type in a VOTable"), _f("arraysize", _S, "", "shape in a VOTable"),
        _f("xtype", _S, "", "extended type of a string"), _f("size", _I, "", "length, deprecated"),
        _f("description", _S, "", "meaning"), _f("utype", _S, "", "utype"), _f("unit", _S, "", "unit"),
        _f("ucd", _S, "", "UCD"), _f("indexed", _I, "", "1 if conditions on the column are fast"),
        _f("principal", _I, "", "1 if the column is among the most important"),
        _f("std", _I, "", "1 if a standard defines the column"),
        _f("column_index", _I, "", "order in lists"),
    ])),
    "tap_schema.keys": ("The foreign keys.", pa.schema([
        _f("key_id", _S, "", "identifier of the key"), _f("from_table", _S, "", "table with the key"),
        _f("target_table", _S, "", "table that the key refers to"), _f("description", _S, "", "meaning"),
        _f("utype", _S, "", "utype"),
    ])),
    "tap_schema.key_columns": ("The columns of the foreign keys.", pa.schema([
        _f("key_id", _S, "", "identifier of the key"), _f("from_column", _S, "", "column with the key"),
        _f("target_column", _S, "", "column that the key refers to"),
    ])),
}  # fmt: skip


def _obscore_schema() -> pa.Schema:
    """Read the columns of the table ivoa.obscore with their types and metadata from obscore.csv.

    They are the mandatory columns of ObsCore 1.1, table 1, its optional column dataproduct_subtype, and two more:
    band_name (the passband) and detector.
    """
    with Path(__file__).with_name("obscore.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    metadata_keys = ("unit", "ucd", "utype", "xtype", "description")
    return pa.schema(
        [
            pa.field(
                row["name"],
                pa.type_for_alias(row["type"]),
                metadata={key: row[key] for key in metadata_keys if row[key]},
            )
            for row in rows
        ]
    )


_SCHEMAS["ivoa.obscore"] = ("The images, as ObsCore describes observations.", _obscore_schema())


@dataclass(frozen=True, slots=True)
class TableEntry:
    """A table as it is listed in TAP_SCHEMA and in the VOSI document of tables.

    `name` is the name to use in an ADQL query, in quotes if necessary. `is_standard` is True if an IVOA standard
    defines the table.
    """

    schema: str
    name: str
    description: str
    fields: pa.Schema
    is_standard: bool


def list_tables(versions: Mapping[str, read.Version]) -> list[TableEntry]:
    """Return all tables of the TAP service: the tables of the lake, then those of TAP_SCHEMA and ivoa.obscore.

    `versions` contains the versions of the lake's tables by name, such as "products" or "demo.products". Tables without
    columns are left out.
    """
    lake_tables = [
        TableEntry(
            name.rpartition(".")[0] or LAKE, ".".join(map(column_name, name.split("."))),
            (version.schema.metadata or {}).get(b"description", b"").decode(), version.schema, False,
        )
        for name, version in versions.items()
        if version.schema.names
    ]  # fmt: skip
    return lake_tables + [
        TableEntry(name.partition(".")[0], name, description, fields, True)
        for name, (description, fields) in _SCHEMAS.items()
    ]


_RESERVED = {
    "value", "distance", "size", "values", "point", "circle", "area", "box", "region", "contains", "date", "time",
    "year", "month", "day", "zone", "user", "order", "group", "key", "position", "session", "current", "constant",
    "level", "section", "names", "column", "table", "schema", "from", "to", "select", "where", "top", "by", "in",
    "is", "on", "or", "and", "not", "min", "max", "sum", "count", "avg", "log", "exp", "power", "mod", "floor",
    "ceiling", "round", "sign", "character", "language", "second", "minute", "hour", "timestamp", "interval",
    "first", "last", "next", "exposure", "read", "source",
}  # fmt: skip


def column_name(name: str) -> str:
    """Return the name of a column or table as it must be written in ADQL.

    The name is put in quotes if it has special characters, does not begin with a letter, or is a reserved word.
    """
    plain = name.isascii() and name.replace("_", "a").isalnum() and name[0].isalpha()
    return name if plain and name.lower() not in _RESERVED else f'"{name}"'


def describe_columns(table: TableEntry) -> Iterator[Json]:
    """Yield the columns of a table as rows of the table TAP_SCHEMA.columns (values by column)."""
    for number, field in enumerate(table.fields, start=1):
        metadata = field_facts(field)
        datatype_name, size = datatype(field.type)
        yield {
            "table_name": table.name, "column_name": column_name(field.name), "datatype": datatype_name,
            "arraysize": size or None,
            "xtype": metadata.xtype or None, "size": None, "description": metadata.description or None,
            "utype": metadata.utype or None,
            "unit": metadata.unit or None, "ucd": metadata.ucd or None,
            "indexed": int(field.name in ("_healpix_29",)), "principal": int(number <= 12),
            "std": int(table.is_standard), "column_index": number,
        }  # fmt: skip


# Foreign keys between the tables of TAP_SCHEMA: name of the key, table, column, table and column to which they refer.
FOREIGN_KEYS = (
    ("tables_schema", "tap_schema.tables", "schema_name", "tap_schema.schemas", "schema_name"),
    ("columns_table", "tap_schema.columns", "table_name", "tap_schema.tables", "table_name"),
    ("keys_from", "tap_schema.keys", "from_table", "tap_schema.tables", "table_name"),
    ("keys_target", "tap_schema.keys", "target_table", "tap_schema.tables", "table_name"),
    ("key_columns_key", "tap_schema.key_columns", "key_id", "tap_schema.keys", "key_id"),
)
SCHEMA_DESCRIPTIONS = {
    LAKE: "Tables that all requests of the lake share.",
    "tap_schema": "Descriptions of all schemas, tables and columns.",
    "ivoa": "Tables of the Virtual Observatory.",
}


def write_tables(versions: Mapping[str, read.Version], images: list[Json], folder: Path) -> list[str]:
    """Write the tables of TAP_SCHEMA and ivoa.obscore as Arrow files, which the query processes read.

    Parameters
    ----------
    versions : mapping of str to Version
        Versions of the lake's tables by name, which TAP_SCHEMA describes.
    images : list of dict
        Rows of ivoa.obscore: values by column for each image.
    folder : Path
        Existing folder in which the files are written.

    Returns
    -------
    list of str
        NAME=@FILE for every table with the path of its file, the form that `Explorer.process` requires.
    """
    tables = list_tables(versions)
    names = list(dict.fromkeys(table.schema for table in tables))
    rows: dict[str, list[Json]] = {
        "tap_schema.schemas": [
            {
                "schema_name": name,
                "description": SCHEMA_DESCRIPTIONS.get(name, f"Tables of request {name}."),
                "schema_index": k,
            }
            for k, name in enumerate(names, start=1)
        ],
        "tap_schema.tables": [
            {
                "schema_name": table.schema,
                "table_name": table.name,
                "table_type": "table",
                "description": table.description,
                "table_index": k,
            }
            for k, table in enumerate(tables, start=1)
        ],
        "tap_schema.columns": [column for table in tables for column in describe_columns(table)],
        "tap_schema.keys": [{"key_id": key, "from_table": a, "target_table": b} for key, a, _, b, _ in FOREIGN_KEYS],
        "tap_schema.key_columns": [
            {"key_id": key, "from_column": a, "target_column": b} for key, _, a, _, b in FOREIGN_KEYS
        ],
        "ivoa.obscore": images,
    }
    table_files = []
    for name, (_, schema) in _SCHEMAS.items():
        file = folder / f"{name}.arrow"
        feather.write_feather(pa.Table.from_pylist(rows[name], schema), file, compression="uncompressed")
        table_files.append(f"{name}=@{file}")
    return table_files


def obscore_row(number: int, row: Mapping[str, Any], exposure: Mapping[str, Any], file: Mapping[str, Any]) -> Json:
    """Return the row of the table ivoa.obscore that describes an image.

    Parameters
    ----------
    number : int
        Number of the image; not used.
    row : mapping
        Row of the image file in the table `products`.
    exposure : mapping
        Row of the exposure in the table `exposures`, or {} if there is no such row.
    file : mapping
        Further properties of the file: `url`, `kbyte` (size, KiB), `nx`, `ny` (shape), `fov` (diameter of the field,
        deg), `resolution` (FWHM of stars in arcsec, or None), `wavelengths` (shortest and longest in angstrom, or
        None), `version` (key of the version of `products`), and `exposure` (an identifier of the exposure that is
        unique in the lake).

    Returns
    -------
    dict
        Values by column of ivoa.obscore; None for unknown values. Wavelengths are in metres.
    """
    start, seconds = exposure.get("mjd"), exposure.get("exposure_time_s")
    wavelengths = file["wavelengths"] or (None, None)
    return {
        "dataproduct_type": "image",
        "dataproduct_subtype": row["content"],
        "calib_level": 1,
        "obs_collection": exposure.get("survey") or "truesky",
        "obs_id": file["exposure"],
        "obs_publisher_did": f"ivo://truesky.local/{file['version']}?{row['path']}",
        "access_url": file["url"],
        "access_format": "application/fits",
        "access_estsize": file["kbyte"],
        "target_name": None,
        "s_ra": row["ra"],
        "s_dec": row["dec"],
        "s_fov": file["fov"],
        "s_region": row["s_region"],
        "s_resolution": file["resolution"],
        "s_xel1": file["nx"],
        "s_xel2": file["ny"],
        "t_min": start,
        "t_max": None if start is None or seconds is None else start + seconds / 86400.0,
        "t_exptime": seconds,
        "t_resolution": seconds,
        "t_xel": 1,
        "em_min": wavelengths[0] and wavelengths[0] * _METRES_PER_ANGSTROM,
        "em_max": wavelengths[1] and wavelengths[1] * _METRES_PER_ANGSTROM,
        "em_res_power": None,
        "em_xel": 1,
        "o_ucd": "phot.count",
        "pol_states": None,
        "pol_xel": None,
        "facility_name": "Euclid" if not str(row["channel"]).startswith("EXT") else str(exposure.get("camera", "")),
        "instrument_name": str(exposure.get("camera") or row["channel"]),
        "band_name": row["band"],
        "detector": row["detector"],
    }
