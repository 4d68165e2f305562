"""DuckDB session over the tables of a lake: locked, kept open between queries, and read in batches."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from typing import TypeAlias

import duckdb
import pyarrow as pa
import pyarrow.dataset as ds

from lake_schema.errors import BadInput, Damaged
from lake_schema.store import read
from lake_schema.store.object_storage.s3 import Folder
from truesky.explore import adql
from truesky.explore.guard import Query, check_expression, check_query, one_line, parser

_MACROS = (
    # Great-circle distance with the haversine formula, deg.
    """CREATE MACRO separation(ra1, dec1, ra2, dec2) AS degrees(2 * asin(least(1.0, sqrt(
       pow(sin(radians(dec2 - dec1) / 2), 2)
       + cos(radians(dec1)) * cos(radians(dec2)) * pow(sin(radians(ra2 - ra1) / 2), 2)))))""",
    # AB magnitude of f_nu in microjansky, NULL if the flux is not positive.
    "CREATE MACRO mag_ab(f_nu) AS 23.9 - 2.5 * log10(CASE WHEN f_nu > 0 THEN f_nu END)",
)
# After these commands the session can only reach registered tables, and cannot change its configuration.
_LOCKS = (
    "SET python_enable_replacements = false",
    "SET autoload_known_extensions = false",
    "SET autoinstall_known_extensions = false",
    "SET allow_community_extensions = false",
    "SET enable_external_access = false",
    "SET lock_configuration = true",
)
# Fraction of the memory of a query that DuckDB may fill; the same fraction is for its result.
_SHARE = 0.5
TOO_LARGE = "SQL: the query or its result needs more memory than its limit: ask for less"
OpenTable: TypeAlias = read.Version | ds.Dataset


class Session:
    """Session that answers queries one after another; after an error it starts again.

    Parameters
    ----------
    root : Folder
        Folder of the lake.
    tables : mapping of str to str
        NAME or REQUEST.NAME -> key of a version, ?REQUEST for a table that could not be opened, @FILE for Arrow rows.
    memory : int
        Memory limit of a query and its result together, bytes.
    """

    def __init__(self, root: Folder, tables: Mapping[str, str], memory: int) -> None:
        self.root, self.table_keys = root, tables
        self.max_bytes = int(memory * _SHARE)
        self.open_tables: dict[str, OpenTable] = {}
        self._rows: dict[str, ds.Dataset] = {}
        self._database: duckdb.DuckDBPyConnection | None = None
        self._parser = parser()

    def check_query(self, text: str) -> Query:
        """Return the query if it may run; raise BadInput otherwise."""
        return check_query(text, self.table_keys, self._parser)

    def check_expression(self, text: str) -> None:
        """Raise BadInput if a text is not exactly one expression."""
        check_expression(text, self._parser)

    def close(self) -> None:
        """Close all tables; the next query opens those that it uses."""
        self.open_tables.clear()
        self._rows.clear()
        if self._database is not None:
            self._database.close()
            self._database = None

    def run(self, query: Query, parameters: Mapping[str, object]) -> Iterator[pa.RecordBatch]:
        """Yield the rows of a query in batches, at least one, which may be empty.

        Columns that are unchanged columns of a table have its units.

        Raises
        ------
        BadInput
            If the query cannot be run; some batches may have been returned before.
        Damaged
            If a file is not as it was written; some batches may have been returned before.
        """
        finished = False
        try:
            for name in query.tables:
                self._open(name)
                for file in getattr(self._rows[name], "verified_files", ()):
                    file.forget()
            relation = self._connect().sql(query.text, params=dict(parameters) or None)
            if relation is None:
                raise BadInput("SQL: the query returns no rows")
            batches = pa.RecordBatchReader.from_stream(relation)
            schema = self._with_units(_exportable(batches.schema), query)
            yield pa.RecordBatch.from_pylist([], schema)
            for batch in batches:
                yield _cast(batch, schema)
            finished = True
        except duckdb.OutOfMemoryException:
            raise BadInput(TOO_LARGE) from None
        except (duckdb.Error, OSError, pa.ArrowException) as error:
            # Arrow and DuckDB hide the error of a damaged file in their own errors.
            if fault := next((fault for rows in self._rows.values() if (fault := getattr(rows, "fault", ""))), ""):
                raise Damaged(fault) from None
            raise BadInput(f"SQL: {one_line(error)}") from None
        finally:
            if not finished:
                self.close()

    def _connect(self) -> duckdb.DuckDBPyConnection:
        if self._database is None:
            config: dict[str, str | bool | int | float | list[str]] = {
                "memory_limit": f"{self.max_bytes // 1_000_000}MB",
                "temp_directory": "",
                "threads": os.cpu_count() or 1,
            }
            self._database = duckdb.connect(":memory:", config=config)
            for command in (*_MACROS, *adql.MACROS, *_LOCKS):
                self._database.execute(command)
        return self._database

    def _open(self, name: str) -> None:
        """Open a table by its name; a table of a request goes into a schema with the name of the request."""
        if name in self._rows:
            return
        source = _open_table(self.root, name, self.table_keys[name])
        self.open_tables[name] = source
        self._rows[name] = source.dataset() if isinstance(source, read.Version) else source
        database = self._connect()
        database.register(name, self._rows[name])
        if "." in name:
            request, _, table = name.partition(".")
            database.execute(f'CREATE SCHEMA IF NOT EXISTS "{request}"')
            database.execute(f'CREATE OR REPLACE VIEW "{request}"."{table}" AS SELECT * FROM "{name}"')

    def _with_units(self, schema: pa.Schema, query: Query) -> pa.Schema:
        """Add unit and description of table columns to result columns that are unchanged."""
        fields = []
        for field in schema:
            name = field.name.lower()
            tables = [self.open_tables[table].schema for table in query.tables]
            columns = [column for table in tables for column in table if column.name.lower() == name]
            candidate_facts = [dict(c.metadata or {}).items() for c in columns if _kind(c.type) == _kind(field.type)]
            # If several tables have this column, only facts that they share are used.
            facts = (
                dict(set.intersection(*map(set, candidate_facts)))
                if candidate_facts and name in query.columns
                else None
            )
            fields.append(field.with_metadata(facts) if facts else field)
        return pa.schema(fields)


def _open_table(root: Folder, name: str, key: str) -> OpenTable:
    if key.startswith("@"):
        return ds.dataset(key[1:], format="ipc")
    table = name.rpartition(".")[2]
    if key.startswith("?"):
        # Opening it raises the same error again.
        return read.version(root, table, request=key[1:] or None)
    return read.version(root, table, key)


def _exportable(schema: pa.Schema) -> pa.Schema:
    """Replace 128-bit decimals, which are sums of integers, by types that file formats of astronomy have."""
    return pa.schema(
        [
            field.with_type(pa.float64() if field.type.scale else pa.int64())
            if pa.types.is_decimal(field.type)
            else field
            for field in schema
        ]
    )


def _cast(batch: pa.RecordBatch, schema: pa.Schema) -> pa.RecordBatch:
    columns = []
    for field, column in zip(schema, batch.columns, strict=True):
        try:
            columns.append(column.cast(field.type) if pa.types.is_decimal(column.type) else column)
        except pa.ArrowInvalid:
            name = field.name
            raise BadInput(f"SQL: column {name} holds integers beyond 64 bits; make it {name}::DOUBLE") from None
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def _kind(kind: pa.DataType) -> pa.DataType:
    """Type without the name of list elements, which differs in DuckDB."""
    return pa.list_(_kind(kind.value_type)) if pa.types.is_list(kind) else kind
