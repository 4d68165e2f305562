"""What becomes of a result: pandas, astropy or Arrow in a notebook, a file on disc."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from lake_schema.columns import Column, Table
from lake_schema.errors import BadInput
from lake_schema.fits import table_to_fits

INTO = ("pandas", "astropy", "arrow")


def converted(rows: pa.Table, into: str) -> Any:
    """The rows as a pandas DataFrame, an astropy Table with units, or as they are."""
    if into == "pandas":
        return rows.to_pandas()
    if into == "arrow":
        return rows
    if into == "astropy":
        return _astropy(rows)
    raise BadInput(f"into = {into!r} is not one of {', '.join(INTO)}")


def _astropy(rows: pa.Table) -> Any:
    from astropy.table import Column as AstropyColumn
    from astropy.table import MaskedColumn
    from astropy.table import Table as AstropyTable

    table = AstropyTable()
    for field, values in zip(rows.schema, rows.columns, strict=True):
        facts = _facts(field)
        about = {"unit": facts.get("unit") or None, "description": facts.get("description")}
        if values.null_count:
            filled = values.fill_null(0) if pa.types.is_integer(field.type) else values
            table[field.name] = MaskedColumn(filled.to_numpy(), mask=values.is_null().to_numpy(), **about)
        else:
            table[field.name] = AstropyColumn(values.to_numpy(), **about)
    return table


def _facts(field: pa.Field) -> dict[str, str]:
    return {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}


def write(rows: pa.Table, path: Path) -> None:
    """Write rows to a file of the kind that its ending says: .csv, .parquet or .fits; replaced in one rename.

    Errors : BadInput for another ending; OSError where the disc refuses
    """
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise BadInput(f"{path}: the ending is not one of {', '.join(_WRITERS)}")
    if len(set(rows.column_names)) != rows.num_columns:
        raise BadInput(f"{path}: two columns have the same name; give one of them another with AS")
    temporary = path.with_name(f".{os.getpid()}.tmp.{path.name}")
    try:
        writer(rows, temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _csv(rows: pa.Table, path: Path) -> None:
    pa.csv.write_csv(_without_lists(rows), path)


def _parquet(rows: pa.Table, path: Path) -> None:
    pq.write_table(rows, path, compression="zstd", write_page_checksum=True)


def _fits(rows: pa.Table, path: Path) -> None:
    kept = _without_lists(rows)
    declared = Table("result", 1, tuple(_column(field) for field in kept.schema), "Result of a query.", key=())
    table_to_fits(path, kept.cast(declared.arrow()), declared)


def _without_lists(rows: pa.Table) -> pa.Table:
    return rows.drop_columns([field.name for field in rows.schema if pa.types.is_nested(field.type)])


def _column(field: pa.Field) -> Column:
    """A declaration that suits a result's column."""
    facts, kind = _facts(field), str(field.type)
    if pa.types.is_integer(field.type):
        kind = kind if kind.startswith("int") else "int64"
    elif pa.types.is_floating(field.type):
        kind = kind if kind in ("float", "double") else "float"
        kind = {"float": "float32", "double": "float64"}[kind]
    elif not pa.types.is_boolean(field.type):
        kind = "string"
    return Column(
        field.name, kind, facts.get("unit", ""), facts.get("ucd", ""), facts.get("description", ""), nullable=True
    )


_WRITERS: dict[str, Callable[[pa.Table, Path], None]] = {".csv": _csv, ".parquet": _parquet, ".fits": _fits}
