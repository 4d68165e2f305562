"""DuckDB session that runs SQL queries over the tables of a lake.

The session can reach nothing but these tables. It stays open between queries, and yields results in batches of rows.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from typing import TypeAlias

import duckdb
import pyarrow as pa
import pyarrow.dataset as ds

from lake_schema import tables as declarations
from lake_schema.errors import BadInput, Damaged, LakeError
from lake_schema.store import read
from lake_schema.store.object_storage.s3 import Folder
from truesky.explore import adql, requested_area, shared_columns, suggestions
from truesky.explore.guard import TOO_LARGE, Query, check_expression, check_query, one_line, parser

_MACROS = (
    # Angle between two positions in deg, computed with the haversine formula; the arguments are in deg.
    """CREATE MACRO separation(ra1, dec1, ra2, dec2) AS degrees(2 * asin(least(1.0, sqrt(
       pow(sin(radians(dec2 - dec1) / 2), 2)
       + cos(radians(dec1)) * cos(radians(dec2)) * pow(sin(radians(ra2 - ra1) / 2), 2)))))""",
    # AB magnitude of the flux density f_nu in microjansky; NULL if f_nu is not positive.
    "CREATE MACRO mag_ab(f_nu) AS 23.9 - 2.5 * log10(CASE WHEN f_nu > 0 THEN f_nu END)",
)
# After these commands a query can only read the tables that Python registered, and cannot change the settings.
_LOCKS = (
    "SET python_enable_replacements = false",
    "SET autoload_known_extensions = false",
    "SET autoinstall_known_extensions = false",
    "SET allow_community_extensions = false",
    "SET enable_external_access = false",
    "SET lock_configuration = true",
)
# Fraction of the memory limit of a query that DuckDB may fill; the rest is for the result.
_SHARE = 0.5
# Largest number of missing columns that a message names.
_MAX_MISSING = 6
OpenTable: TypeAlias = read.Version | ds.Dataset


class Session:
    """DuckDB session that runs one query after another. After an error all tables are closed and opened again.

    Parameters
    ----------
    root : Folder
        Folder of the lake.
    tables : mapping of str to str
        Where each table is, by its name NAME or REQUEST.NAME: the key (hash) of a version of the table, @FILE for the
        rows of an Arrow file, or ?REQUEST for a table that could not be opened (a query of it raises the error again).
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
        """Parse a query and return it with the tables that it reads.

        BadInput is raised if it is not a single SELECT over the tables of the session.
        """
        return check_query(text, self.table_keys, self._parser)

    def check_expression(self, text: str) -> None:
        """Raise BadInput if a text is not exactly one SQL expression."""
        check_expression(text, self._parser)

    def close(self) -> None:
        """Close the database and all tables; the next query opens the tables that it reads again."""
        self.open_tables.clear()
        self._rows.clear()
        if self._database is not None:
            self._database.close()
            self._database = None

    def run(self, query: Query, parameters: Mapping[str, object]) -> Iterator[pa.RecordBatch]:
        """Yield the rows of a query in batches; the first batch is empty and defines the columns.

        `parameters` contains the values of the query's parameters by name. A result column that is an unchanged copy of
        a table's column has the unit and the description of that column.

        Raises
        ------
        BadInput
            If the query fails or needs too much memory; some batches may have been yielded before.
        Damaged
            If the content of a file does not agree with its checksum; some batches may have been yielded before.
        """
        finished = False
        try:
            for name in query.tables:
                self._open(name)
                for file in getattr(self._rows[name], "verified_files", ()):
                    file.forget()
            columns = {name: rows.schema.names for name, rows in self._rows.items()}
            text = shared_columns.qualify(query.text, query.tree, columns)
            relation = self._connect().sql(text, params=dict(parameters) or None)
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
            # If a file is damaged, the error of Arrow or DuckDB does not tell it. The attribute `fault` of the object
            # that reads the damaged table contains the reason.
            if fault := next((fault for rows in self._rows.values() if (fault := getattr(rows, "fault", ""))), ""):
                raise Damaged(fault) from None
            raise BadInput(f"SQL: {self._explain(error, query)}") from None
        finally:
            if not finished:
                self.close()

    def _explain(self, error: Exception, query: Query) -> str:
        """Return the message of an error, or a message with suggestions if columns of the query do not exist."""
        columns = {table: self._rows[table].schema.names for table in query.tables if table in self._rows}
        message = str(error) if isinstance(error, duckdb.BinderException) else ""
        first, first_entry = suggestions.missing_column(message), suggestions.missing_entry(message)
        if (first is None and first_entry is None) or not columns:
            return one_line(self._explain_code(error, query) or suggestions.plain_message(str(error)))
        texts = {text.lower(): text for text in shared_columns.quoted_texts(query.text, query.tree)}
        unrelated = shared_columns.unrelated_fluxes(columns)
        requests = {table.rpartition(".")[0] for table in columns}
        other_tables = {
            name: names
            for name in self.table_keys
            for request, _, table in [name.rpartition(".")]
            if name not in columns
            and request in requests
            and table not in unrelated
            and (names := self._column_names(name))
        }
        missing = suggestions.MissingColumns(
            shared_columns.entries_of_from(query.tree, columns), columns, other_tables, message
        )
        references = list(self._missing_names(query, columns))
        if first is not None and first not in [name for _, name in references]:
            references = [("", first)]
        problems = [*missing.explain_entries(shared_columns.unknown_entries(query.tree, columns))]
        problems += [
            f"\"{texts[name]}\" means a column, because it is in double quotes: write '{texts[name]}' for the text"
            if name in texts and not entry
            else missing.explain(name, entry)
            for entry, name in references
        ]
        return _join(problems[:_MAX_MISSING]) or one_line(suggestions.plain_message(message))

    def _explain_code(self, error: Exception, query: Query) -> str:
        """Return a message if an error is about a text that is compared with a column of codes or angles, else ""."""
        if (text := suggestions.refused_text(str(error))) is None:
            return ""
        for name, sign in shared_columns.compared_columns(query.tree, text):
            for table in query.tables:
                if table in self.open_tables and name in self.open_tables[table].schema.names:
                    facts = self.open_tables[table].schema.field(name).metadata or {}
                    if codes := facts.get(b"codes", b"").decode():
                        return suggestions.explain_code(name, sign, text, codes)
                    if facts.get(b"unit") == b"deg" and (problem := suggestions.explain_angle(name, text)):
                        return problem
        return ""

    def _missing_names(self, query: Query, columns: Mapping[str, Sequence[str]]) -> Iterator[tuple[str, str]]:
        """Yield the entry of FROM, "" for none, and the name of each column of a query that does not exist.

        DuckDB reports only one of them.
        """
        for entry, name in shared_columns.unknown_columns(query.tree, columns):
            # Some names, such as current_date, need no column.
            try:
                if not entry:
                    self._connect().sql(f'SELECT {shared_columns.quote([name])} FROM "{query.tables[0]}"')
                    continue
            except duckdb.BinderException:
                pass
            except duckdb.Error:
                return
            yield entry, name

    def _column_names(self, name: str) -> Sequence[str]:
        """Return the names of the columns of a table of the lake, [] for others and if the table cannot be opened."""
        table = name.rpartition(".")[2]
        declaration = declarations.find_table(table)
        if declaration is None or not (table.endswith("_fluxes") or table == "stars"):
            return [] if declaration is None else list(declaration.names)
        try:
            # The declaration does not contain the passbands of the lake, and the columns of variable stars.
            return list(_open_table(self.root, name, self.table_keys[name]).schema.names)
        except LakeError:
            return []

    def _connect(self) -> duckdb.DuckDBPyConnection:
        if self._database is None:
            config: dict[str, str | bool | int | float | list[str]] = {
                "memory_limit": f"{self.max_bytes // 1_000_000}MB",
                "temp_directory": "",
                "threads": os.cpu_count() or 1,
            }
            self._database = duckdb.connect(":memory:", config=config)
            for command in (*_MACROS, *adql.MACROS, *requested_area.macros(self.root, self.table_keys), *_LOCKS):
                self._database.execute(command)
        return self._database

    def _open(self, name: str) -> None:
        """Make a table known to DuckDB, unless it is already open.

        A table REQUEST.NAME becomes the view NAME in a schema REQUEST.
        """
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
        """Add the unit, description and other metadata of table columns to result columns that are unchanged copies."""
        fields = []
        for field in schema:
            name = field.name.lower()
            tables = [self.open_tables[table].schema for table in query.tables]
            columns = [column for table in tables for column in table if column.name.lower() == name]
            candidate_facts = [dict(c.metadata or {}).items() for c in columns if _kind(c.type) == _kind(field.type)]
            # If several tables have a column of this name and type, only metadata with equal values in all are used.
            facts = (
                dict(set.intersection(*map(set, candidate_facts)))
                if candidate_facts and name in query.columns
                else None
            )
            fields.append(field.with_metadata(facts) if facts else field)
        return pa.schema(fields)


def _join(problems: Sequence[str]) -> str:
    """Join messages about missing columns. A list of columns that several of them contain is written once."""
    texts: list[str] = []
    lists = {""}
    for problem in dict.fromkeys(problems):
        beginning, _, columns = problem.partition(suggestions.LIST)
        texts.append(problem if columns not in lists or not columns else beginning)
        lists.add(columns)
    return "; ".join(texts)


def _open_table(root: Folder, name: str, key: str) -> OpenTable:
    if key.startswith("@"):
        return ds.dataset(key[1:], format="ipc")
    table = name.rpartition(".")[2]
    if key.startswith("?"):
        # The key ?REQUEST marks a table that could not be opened before; opening it again raises the reason.
        return read.version(root, table, request=key[1:] or None)
    return read.version(root, table, key)


def _exportable(schema: pa.Schema) -> pa.Schema:
    """Replace the 128-bit decimals in a schema: int64 if they have no decimal places, else float64.

    DuckDB returns sums of integers as such decimals, which file formats of astronomy do not have.
    """
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
    """Return an Arrow type without the name of the elements of a list, so that types can be compared.

    DuckDB gives another name to these elements.
    """
    return pa.list_(_kind(kind.value_type)) if pa.types.is_list(kind) else kind
