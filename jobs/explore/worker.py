"""The process that runs queries: python -m jobs.explore.worker LAKE MEMORY TABLE=KEY|@FILE ...; answers on stdout.

DuckDB counts neither the memory of every function nor its result, and some functions do not stop when told to; a
process has a limit of memory that holds, and can be killed.  A query is a line of JSON on stdin; an answer is a line of
JSON, then, if it is a result, an Arrow stream.
"""

from __future__ import annotations

import json
import os
import resource
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any, TypeAlias

import duckdb
import pyarrow as pa
import pyarrow.dataset as ds

from jobs.explore.guard import Query, checked, one_line
from lake_schema.errors import BadInput, Damaged, LakeError
from lake_schema.store import layout, read

_MACROS = (
    # Great-circle distance by the haversine, deg.
    """CREATE MACRO separation(ra1, dec1, ra2, dec2) AS degrees(2 * asin(least(1.0, sqrt(
       pow(sin(radians(dec2 - dec1) / 2), 2)
       + cos(radians(dec1)) * cos(radians(dec2)) * pow(sin(radians(ra2 - ra1) / 2), 2)))))""",
    # AB magnitude of f_nu in microjansky, NULL where there is no flux.
    "CREATE MACRO mag_ab(f_nu) AS 23.9 - 2.5 * log10(CASE WHEN f_nu > 0 THEN f_nu END)",
)
# From here on the session can reach nothing but what was registered, and can change nothing of this.
_LOCKS = (
    "SET python_enable_replacements = false",
    "SET autoload_known_extensions = false",
    "SET autoinstall_known_extensions = false",
    "SET allow_community_extensions = false",
    "SET enable_external_access = false",
    "SET lock_configuration = true",
)
_ROWS_A_BATCH = 65_536
Opened: TypeAlias = read.Version | ds.Dataset
# What Python and the libraries take before any query, and the part of the rest that DuckDB may fill.
_BASE_BYTES, _SHARE = 1 << 30, 0.5


def main(argv: Sequence[str]) -> int:
    """Answer queries until stdin ends.

    argv : lake, most bytes of memory, TABLE=KEY or REQUEST.TABLE=KEY of each table, =?REQUEST of one that could not be
           opened, TABLE=@FILE of rows in an Arrow file
    """
    root, memory = layout.lake(argv[0]), int(argv[1])
    resource.setrlimit(resource.RLIMIT_DATA, (memory + _BASE_BYTES, memory + _BASE_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    versions = dict(entry.split("=", 1) for entry in argv[2:])
    # Whatever a library prints must not get between the answers.
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    for line in sys.stdin:
        _answer(out, root, versions, memory, json.loads(line))
    return 0


def _answer(out: IO[bytes], root: Path, versions: dict[str, str], memory: int, question: dict[str, Any]) -> None:
    try:
        query = checked(question["sql"], versions)
        opened = {name: _table(root, name, versions[name]) for name in query.tables}
        found = _with_units(_run(query, opened, memory, question["parameters"]), query, opened)
    except LakeError as error:
        kind = "Damaged" if isinstance(error, Damaged) else "BadInput"
        out.write(json.dumps({"error": str(error), "kind": kind}).encode() + b"\n")
    except MemoryError:
        out.write(json.dumps({"error": _TOO_LARGE, "kind": "BadInput"}).encode() + b"\n")
    else:
        out.write(b"{}\n")
        with pa.ipc.new_stream(out, found.schema) as stream:
            stream.write_table(found)
    out.flush()


def _table(root: Path, name: str, what: str) -> Opened:
    if what.startswith("@"):
        return ds.dataset(what[1:], format="ipc")
    table = name.rpartition(".")[2]
    if what.startswith("?"):
        # Whatever was wrong with it is said again.
        return read.version(root, table, request=what[1:] or None)
    return read.version(root, table, what)


def _registered(session: duckdb.DuckDBPyConnection, name: str, rows: ds.Dataset) -> None:
    """A table by its name, one of a request in a schema of the request's name."""
    session.register(name, rows)
    if "." in name:
        request, _, table = name.partition(".")
        session.execute(f'CREATE SCHEMA IF NOT EXISTS "{request}"')
        session.execute(f'CREATE VIEW "{request}"."{table}" AS SELECT * FROM "{name}"')


_TOO_LARGE = "SQL: the query or its result needs more memory than it may have: ask for less"


def _run(query: Query, opened: Mapping[str, Opened], memory: int, parameters: dict[str, Any]) -> pa.Table:
    most = int(memory * _SHARE)
    config: dict[str, str | bool | int | float | list[str]] = {
        "memory_limit": f"{most // 1_000_000}MB",
        "temp_directory": "",
        "threads": os.cpu_count() or 1,
    }
    datasets = {n: rows.dataset() if isinstance(rows, read.Version) else rows for n, rows in opened.items()}
    with duckdb.connect(":memory:", config=config) as session:
        try:
            for name, rows in datasets.items():
                _registered(session, name, rows)
            for command in (*_MACROS, *_LOCKS):
                session.execute(command)
            relation = session.sql(query.text, params=parameters or None)
            if relation is None:
                raise BadInput("SQL: gives no rows")
            return _collected(pa.RecordBatchReader.from_stream(relation), most)
        except duckdb.OutOfMemoryException:
            raise BadInput(_TOO_LARGE) from None
        except (duckdb.Error, OSError, pa.ArrowException) as error:
            # Arrow and DuckDB pass the refusal of a file on as an error of their own.
            if fault := next((fault for rows in datasets.values() if (fault := getattr(rows, "fault", ""))), ""):
                raise Damaged(fault) from None
            raise BadInput(f"SQL: {one_line(error)}") from None


def _collected(batches: pa.RecordBatchReader, most: int) -> pa.Table:
    kept, size = [], 0
    for batch in batches:
        size += batch.nbytes
        if size > most:
            raise BadInput(_TOO_LARGE)
        kept.append(batch)
    table = pa.Table.from_batches(kept, batches.schema)
    columns = [_exportable(name, column) for name, column in zip(table.column_names, table.columns, strict=True)]
    return pa.Table.from_arrays(columns, table.column_names)


def _exportable(name: str, column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Sums of integers come as 128-bit decimals, which no file format of astronomy has."""
    if not pa.types.is_decimal(column.type):
        return column
    try:
        return column.cast(pa.float64() if column.type.scale else pa.int64())
    except pa.ArrowInvalid:
        raise BadInput(f"SQL: column {name} holds integers beyond 64 bits; make it {name}::DOUBLE") from None


def _with_units(found: pa.Table, query: Query, opened: Mapping[str, Opened]) -> pa.Table:
    """Give the columns that came unchanged from a table its unit and description."""
    fields = []
    for field in found.schema:
        name = field.name.lower()
        columns = [column for version in opened.values() for column in version.schema if column.name.lower() == name]
        own = [dict(c.metadata or {}).items() for c in columns if _kind(c.type) == _kind(field.type)]
        # Which of several tables it is from is not known: what they all say holds.
        facts = dict(set.intersection(*map(set, own))) if own and name in query.columns else None
        fields.append(field.with_metadata(facts) if facts else field)
    return pa.Table.from_arrays(found.columns, schema=pa.schema(fields))


def _kind(kind: pa.DataType) -> pa.DataType:
    """A type without the name that the elements of a list have: DuckDB has one of its own."""
    return pa.list_(_kind(kind.value_type)) if pa.types.is_list(kind) else kind


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
