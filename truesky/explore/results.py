"""Convert results of SQL queries (Arrow tables) to pandas or astropy, or write them to files.

The files are CSV, Parquet, FITS or VOTable.
"""

from __future__ import annotations

import io
import itertools
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from lake_schema import user_files
from lake_schema.columns import Column, Table
from lake_schema.errors import BadInput

# Largest size in bytes of a FITS file that `stream_file` yields. Other file types have no limit there, because they are
# sent while rows are read. The function `write` has no limit.
MAX_FITS_BYTES = 8 << 30
# Number of bytes of a FITS file that are sent at a time.
_PIECE = 1 << 20
# Largest number of characters of a value in a text table.
_MAX_CELL = 50
INTO = ("pandas", "astropy", "arrow")
# Types of columns that get a pandas type for missing values. By default pandas would convert such integers to floats,
# which would round identifiers.
_NULLABLE = {
    pa.bool_(): "boolean",
    **{
        pa.type_for_alias(kind.lower()): kind
        for kind in ("Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32", "UInt64")
    },
}


def convert(rows: pa.Table, into: str) -> Any:
    """Return rows as a pandas DataFrame, an astropy Table with units, or an Arrow table.

    `into` is "pandas", "astropy" or "arrow".

    Raises
    ------
    BadInput
        If `into` is another text, or two columns have the same name, which an astropy Table cannot represent.
    """
    if into == "pandas":
        return _pandas(rows)
    if into == "arrow":
        return rows
    if into == "astropy":
        return _astropy(rows)
    raise BadInput(f"into = {into!r} is not one of {', '.join(INTO)}")


def _pandas(rows: pa.Table) -> Any:
    # The import is delayed, because it takes longer than most answers.
    import pandas as pd

    gaps = {column.type for column in rows.columns if column.null_count} & _NULLABLE.keys()
    types = {kind: pd.api.types.pandas_dtype(_NULLABLE[kind]) for kind in gaps}
    return rows.to_pandas(types_mapper=types.get)


def to_cells(rows: pa.Table, max_rows: int) -> tuple[list[str], list[list[str]]]:
    """Return the names of columns and the values of rows as texts, with "..." between the first and last rows.

    Parameters
    ----------
    rows : pyarrow.Table
        Rows.
    max_rows : int
        Largest number of rows that are returned. If there are more, half of them are the first and half the last ones.

    Returns
    -------
    names : list of str
        Names of the columns.
    cells : list of list of str
        Values of each row. Floats have 10 significant digits (7 for 32 bits), a missing value is "<NA>", and longer
        values than 50 characters are cut.
    """
    half = max_rows // 2
    is_cut = rows.num_rows > max_rows
    pieces = [rows.slice(0, half), rows.slice(rows.num_rows - half)] if is_cut else [rows]
    columns = []
    for number, field in enumerate(rows.schema):
        digits = 10 if field.type == pa.float64() else 7
        cells = [[_cell(value, digits) for value in piece.column(number).to_pylist()] for piece in pieces]
        columns.append([*cells[0], *(["...", *cells[1]] if is_cut else [])])
    return list(rows.schema.names), [list(line) for line in zip(*columns, strict=True)]


def _cell(value: Any, digits: int) -> str:
    if value is None:
        return "<NA>"
    if isinstance(value, float):
        number = f"{value:.{digits}g}"
        # A float has a point, as in Python, so that it differs from an integer.
        return f"{number}.0" if number.lstrip("-").isdigit() else number
    text = " ".join(str(value).split())
    return text if len(text) <= _MAX_CELL else f"{text[: _MAX_CELL - 3]}..."


def _astropy(rows: pa.Table) -> Any:
    from astropy.table import Column as AstropyColumn
    from astropy.table import MaskedColumn
    from astropy.table import Table as AstropyTable

    _refuse_same_names(rows)
    table = AstropyTable()
    for field, values in zip(rows.schema, rows.columns, strict=True):
        facts = _facts(field)
        attributes: dict[str, Any] = {"unit": facts.get("unit") or None, "description": facts.get("description")}
        # The UCD goes to meta["ucd"], where astropy also stores the UCD of columns that it reads from a VOTable.
        attributes |= {"meta": {"ucd": facts["ucd"]}} if facts.get("ucd") else {}
        if values.null_count:
            filled = values.fill_null(pa.scalar(0).cast(field.type)) if field.type in _NULLABLE else values
            table[field.name] = MaskedColumn(filled.to_numpy(), mask=values.is_null().to_numpy(), **attributes)
        else:
            table[field.name] = AstropyColumn(values.to_numpy(), **attributes)
    return table


def _facts(field: pa.Field) -> dict[str, str]:
    return {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}


def write(rows: pa.Table, path: Path) -> None:
    """Write rows to a .csv, .parquet, .fits or .vot file.

    An existing file is replaced only after the new one has been written completely.

    Raises
    ------
    BadInput
        If the path has another ending, two columns have the same name, or the file type cannot hold a column. The
        message names the ending or the column.
    OSError
        If writing fails.
    """
    writer = _WRITERS[user_files.check_target(path, ENDINGS).suffix.lower()]
    _refuse_same_names(rows)
    with user_files.replace_atomically(path) as temporary:
        if error := _refusal(writer, rows, temporary):
            column = next((name for name in rows.column_names if _refusal(writer, rows.select([name]), temporary)), "")
            raise BadInput(f"{path}: column {column}: {' '.join(str(error).split())[:300]}") from None


def _refusal(writer: Callable[[pa.Table, Path], None], rows: pa.Table, path: Path) -> Exception | None:
    """Write rows to a file, and return the error if the file type cannot hold them, else None."""
    try:
        writer(rows, path)
    except (pa.ArrowException, ValueError, TypeError, OverflowError) as error:
        return error
    return None


def _refuse_same_names(rows: pa.Table) -> None:
    names = rows.column_names
    if len(set(names)) != len(names):
        repeated = next(name for name in names if names.count(name) > 1)
        raise BadInput(f"two columns of the result are called {repeated}: rename one with AS")


def _csv(rows: pa.Table, path: Path) -> None:
    pa.csv.write_csv(rows, path)


def _parquet(rows: pa.Table, path: Path) -> None:
    pq.write_table(rows, path, compression="zstd", write_page_checksum=True)


def _fits(rows: pa.Table, path: Path) -> None:
    # The import is delayed, because it takes longer than most answers that need no FITS file.
    from lake_schema.fits.tables import table_to_fits

    declared = _declare_table(rows.schema)
    table_to_fits(path, rows.cast(declared.arrow_schema()), declared)


def _declare_table(schema: pa.Schema) -> Table:
    return Table("result", 1, tuple(_column(field) for field in schema), "Result of a query.", key=())


def _column(field: pa.Field) -> Column:
    """Convert an Arrow field to a `Column`, which carries its name, type, unit, UCD and description to the file."""
    facts, kind = _facts(field), _kind(field.type)
    return Column(
        field.name, kind, facts.get("unit", ""), facts.get("ucd", ""), facts.get("description", ""), nullable=True
    )


def _kind(kind: pa.DataType) -> str:
    if pa.types.is_list(kind):
        inner = _kind(kind.value_type)
        return f"list<{'int64' if inner.startswith('int') else inner}>"
    if pa.types.is_integer(kind):
        return str(kind) if pa.types.is_signed_integer(kind) else "int64"
    if pa.types.is_floating(kind):
        return "float64" if kind == pa.float64() else "float32"
    return "bool" if pa.types.is_boolean(kind) else "string"


def _votable(rows: pa.Table, path: Path) -> None:
    from truesky.explore import votables

    with path.open("wb") as file:
        for piece in votables.pieces([pa.RecordBatch.from_pylist([], rows.schema), *rows.to_batches()]):
            file.write(piece)


_WRITERS: dict[str, Callable[[pa.Table, Path], None]] = {
    ".csv": _csv, ".parquet": _parquet, ".fits": _fits, ".vot": _votable,
}  # fmt: skip
ENDINGS = tuple(_WRITERS)


def stream_file(batches: Iterator[pa.RecordBatch], ending: str) -> Iterator[bytes]:
    """Yield the bytes of a .csv, .parquet, .vot or .fits file while its rows are read.

    `batches` contains the rows, in at least one batch. `ending` includes the dot, for example ".csv". For FITS all
    batches are read before the first bytes are yielded, since the header contains the number of rows.

    Raises
    ------
    BadInput
        If the ending is another one, two columns have the same name, or the file type cannot hold the result. A FITS
        file must not have more than 8 GiB.
    """
    from truesky.explore import votables

    first = next(batches)
    _refuse_same_names(pa.Table.from_batches([first]))
    all_batches = itertools.chain([first], batches)
    if ending == ".vot":
        yield from votables.pieces(all_batches)
    elif ending == ".csv":
        yield from _write_pieces(all_batches, lambda sink: pa.csv.CSVWriter(sink, first.schema))
    elif ending == ".parquet":
        yield from _write_pieces(all_batches, lambda sink: _parquet_writer(sink, first.schema))
    elif ending == ".fits":
        yield from _fits_pieces(all_batches, first.schema)
    else:
        raise BadInput(f"a {ending} file cannot be written piece by piece")


def _fits_pieces(batches: Iterator[pa.RecordBatch], schema: pa.Schema) -> Iterator[bytes]:
    """Yield the bytes of a FITS file with the rows of all batches.

    The rows are first written to a temporary file, since the header needs the number of rows and the longest text.
    """
    from lake_schema.fits.tables import stream_to_fits

    declared = _declare_table(schema)
    with tempfile.TemporaryFile() as spool, tempfile.TemporaryFile() as file:
        _spool(batches, spool, declared.arrow_schema())

        def reread() -> Iterator[pa.RecordBatch]:
            spool.seek(0)
            yield from pa.ipc.open_stream(spool)

        stream_to_fits(file, reread, declared, MAX_FITS_BYTES)
        file.seek(0)
        while piece := file.read(_PIECE):
            yield piece


def _spool(batches: Iterator[pa.RecordBatch], spool: IO[bytes], schema: pa.Schema) -> None:
    """Convert batches of rows to the types of a schema, and write them to the file `spool` as an Arrow stream.

    BadInput is raised if a value cannot be converted, or if the file has more than 8 GiB.
    """
    with pa.ipc.new_stream(spool, schema) as writer:
        for batch in batches:
            columns = []
            for field, values in zip(schema, batch.columns, strict=True):
                try:
                    columns.append(values.cast(field.type))
                except pa.ArrowException as error:
                    message = " ".join(str(error).split())[:300]
                    raise BadInput(f"column {field.name}: FITS cannot hold it: {message}") from None
            writer.write_batch(pa.RecordBatch.from_arrays(columns, schema=schema))
            if spool.tell() > MAX_FITS_BYTES:
                raise BadInput(
                    f"the result has more than {MAX_FITS_BYTES / 1e9:.3g} GB: ask for less, or another file type"
                )


def _parquet_writer(sink: Any, schema: pa.Schema) -> pq.ParquetWriter:
    return pq.ParquetWriter(sink, schema, compression="zstd", write_page_checksum=True)


def _write_pieces(batches: Iterator[pa.RecordBatch], open_writer: Callable[[Any], Any]) -> Iterator[bytes]:
    """Yield the bytes that a writer of Arrow batches produces, as soon as they are written.

    `open_writer` opens the writer for a file object. BadInput is raised if the file type cannot hold the rows.
    """
    sink = _Sink()
    try:
        writer = open_writer(sink)
        for batch in batches:
            writer.write_batch(batch)
            if piece := sink.take():
                yield piece
    except (pa.ArrowException, TypeError) as error:
        raise BadInput(f"this file type cannot hold the result: {' '.join(str(error).split())[:300]}") from None
    writer.close()
    yield sink.take()


class _Sink(io.RawIOBase):
    """File object in memory that keeps written bytes until `take` returns them."""

    def __init__(self) -> None:
        self._buffer, self._position = bytearray(), 0

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self._buffer += data
        self._position += len(data)
        return len(data)

    def tell(self) -> int:
        return self._position

    def take(self) -> bytes:
        """Return the bytes written since the last call of `take`, b"" if nothing was written."""
        piece = bytes(self._buffer)
        self._buffer.clear()
        return piece
