"""Read Parquet files of other programs in a separate process with limited memory and time.

A hostile or damaged file can crash its reader or fill the memory. Therefore a separate process reads it, and sends the
rows as a stream of Arrow batches::

    python -m lake_schema.external.files FILE NUMBER COLUMN ... >stream

The first NUMBER columns must exist; the other ones are sent if they exist. Without columns, the names of the file's
columns are sent as one column of texts.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import pyarrow as pa
import pyarrow.parquet as pq

from lake_schema import command, user_files
from lake_schema.errors import BadInput
from lake_schema.texts import synonyms

# First and last four bytes of a Parquet file.
_MAGIC = b"PAR1"
# Largest number of bytes of the footer of a Parquet file.
_MAX_FOOTER_BYTES = 32 << 20
# Largest length of a list in the footer: it limits the numbers of columns and row groups, and the nesting of columns.
_MAX_ENTRIES = 5000
# Largest uncompressed size in bytes of the selected columns of a row group; the number of its rows has the same limit.
_MAX_GROUP_BYTES = 256 << 20
# Largest size in bytes of the dictionary of a column of texts in a batch.
_MAX_DICTIONARY_BYTES = 1 << 20
# Largest size in bytes of a column of texts without a dictionary in a batch: 64 bytes per row.
_MAX_TEXT_BYTES = 4 << 20
# Largest number of rows in a batch.
_ROWS_PER_BATCH = 65_536
# Largest address space of the reading process, in bytes.
_MAX_MEMORY = 3 << 29
# CPU time in s that the reading process may use for a small file.
_MIN_SECONDS = 10
# Size of a file in bytes for which the reading process may use one more second of CPU time.
_BYTES_PER_SECOND = 10_000_000
# Exit status of the reading process if it refuses the file; its stderr then contains the message.
_REFUSED_STATUS = 2
_ROOT = Path(__file__).resolve().parents[2]


def read_batches(path: Path, columns: Sequence[str], text_columns: Sequence[str] = ()) -> Iterator[pa.RecordBatch]:
    """Yield the rows of some columns of a Parquet file in batches, in the order of the file.

    Parameters
    ----------
    path : Path
        The file.
    columns : sequence of str
        Names of columns that must exist, with one number, boolean or text per row. Texts are dictionary-encoded, to
        save memory.
    text_columns : sequence of str, optional
        Names of further columns, with the same types, whose texts are not dictionary-encoded. Columns that do not exist
        are left out.

    Yields
    ------
    pyarrow.RecordBatch
        Up to 65,536 rows.

    Raises
    ------
    BadInput
        If the file is not Parquet, is damaged, or exceeds the limits of size, memory or time, or if a column is missing
        or has another type.
    """
    _refuse_large_footer(path)
    yield from read_in_subprocess(__name__, path, columns, text_columns)


def column_names(path: Path) -> list[str]:
    """Return the names of the columns of a Parquet file; raise BadInput if it cannot be read."""
    _refuse_large_footer(path)
    return column_names_from_subprocess(__name__, path)


def column_names_from_subprocess(module: str, path: Path) -> list[str]:
    """Return the names of a file's columns, which `module` reads in a separate process (see `read_in_subprocess`)."""
    return [name for batch in read_in_subprocess(module, path, ()) for name in batch.column(0).to_pylist()]


def read_in_subprocess(
    module: str, path: Path, columns: Sequence[str], text_columns: Sequence[str] = ()
) -> Iterator[pa.RecordBatch]:
    """Run a module in a separate process that reads a file, and yield the batches of rows that it sends.

    Parameters
    ----------
    module : str
        Name of a module that calls `main` of this module with a function that reads its file format.
    path : Path
        The file.
    columns : sequence of str
        Names of required columns; () to get the names of all columns instead of rows.
    text_columns : sequence of str, optional
        Names of columns that are sent if they exist.

    Yields
    ------
    pyarrow.RecordBatch
        Rows, or names of columns.

    Raises
    ------
    BadInput
        If the process refuses the file, or ends with another error. Rows that it sent before have been yielded.
    """
    command = [sys.executable, "-m", module, str(path.resolve()), str(len(columns)), *columns, *text_columns]
    environment = {**os.environ, "ARROW_DEFAULT_MEMORY_POOL": "system"}
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, cwd=_ROOT, env=environment, **pipes) as reader:
        try:
            yield from _receive_batches(path, reader)
        finally:
            reader.kill()


def _receive_batches(path: Path, reader: subprocess.Popen[bytes]) -> Iterator[pa.RecordBatch]:
    try:
        with pa.ipc.open_stream(reader.stdout) as stream:
            yield from stream
    except (OSError, pa.ArrowException):
        # The stream is incomplete, because the process has ended with an error. Its stderr is reported below.
        pass
    _, stderr = reader.communicate()
    if reader.returncode == _REFUSED_STATUS:
        raise BadInput(stderr.decode(errors="replace").strip())
    if reader.returncode:
        raise BadInput(f"{path}: the process that read it failed with status {reader.returncode}")


def _refuse_large_footer(path: Path) -> None:
    with user_files.open_file(path, "catalogue") as stream:
        first = stream.read(4)
        size = stream.seek(0, os.SEEK_END)
        stream.seek(max(size - 8, 0))
        length, last = int.from_bytes(stream.read(4), "little"), stream.read(4)
    if size < 12 or first != _MAGIC or last != _MAGIC:
        raise BadInput(f"{path}: is not a Parquet file")
    if not 0 < length <= min(size - 12, _MAX_FOOTER_BYTES):
        raise BadInput(
            f"{path}: its footer has a length of {length} bytes, which must fit in {size} and be at most "
            f"{_MAX_FOOTER_BYTES}"
        )


# ------------------------------------- functions that run in the separate process


def main(argv: Sequence[str], sender: Callable[[Path, Sequence[str], Sequence[str], IO[bytes]], None]) -> int:
    """Limit the memory and CPU time of this process, read a file, and write its rows to stdout as an Arrow stream.

    `argv` is FILE NUMBER COLUMN ..., of which the first NUMBER columns must exist. `sender` reads the file and writes
    the stream; its arguments are the path, the required columns, the other columns and the output file. Return the exit
    status: 0, or 2 if `sender` raises BadInput, whose message is then written to stderr.
    """
    path, required_count, columns = Path(argv[0]), int(argv[1]), list(argv[2:])
    seconds = _MIN_SECONDS + path.stat().st_size // _BYTES_PER_SECOND
    command.limit_resource("RLIMIT_AS", _MAX_MEMORY)
    command.limit_resource("RLIMIT_CPU", seconds)
    command.limit_resource("RLIMIT_CORE", 0)
    pa.set_cpu_count(1)
    try:
        with os.fdopen(1, "wb", closefd=False) as out:
            sender(path, columns[:required_count], columns[required_count:], out)
    except BadInput as error:
        print(error, file=sys.stderr)
        return _REFUSED_STATUS
    return 0


def send_batches(path: Path, required: Sequence[str], text_columns: Sequence[str], out: IO[bytes]) -> None:
    """Read some columns of a Parquet file, and write their rows as a stream of Arrow batches.

    Parameters
    ----------
    path : Path
        A Parquet file of another program.
    required : sequence of str
        Names of columns that must exist.
    text_columns : sequence of str
        Names of columns that are left out if they do not exist. If there is no column to read, the names of all columns
        are written instead of rows.
    out : binary file
        File to which the stream is written.

    Raises
    ------
    BadInput
        If the file exceeds the limits of its size, a required column is missing or has an unsuitable type, or Arrow
        cannot read the file.
    """
    try:
        with _open_file(path, required, text_columns) as (file, columns):
            if columns:
                _send(path, file, columns, out)
            else:
                send_names([file.schema.column(i).path for i in range(len(file.schema))], out)
    except BadInput:
        raise
    except Exception as error:
        raise BadInput(f"{path}: {' '.join(str(error).split())[:300] or type(error).__name__}") from None


def send_names(names: Sequence[str], out: IO[bytes]) -> None:
    """Write the names of a file's columns to a binary file, as an Arrow stream with one column of texts."""
    batch = pa.record_batch([pa.array(names, pa.string())], names=["name"])
    with pa.ipc.new_stream(out, batch.schema) as stream:
        stream.write_batch(batch)


def _send(path: Path, file: pq.ParquetFile, columns: list[str], out: IO[bytes]) -> None:
    rows, stream = 0, None
    for batch in file.iter_batches(_ROWS_PER_BATCH, columns=columns, use_threads=False):
        rows += batch.num_rows
        stream = stream or pa.ipc.new_stream(out, batch.schema)
        stream.write_batch(_check_text_size(path, batch))
    if rows != file.metadata.num_rows:
        raise BadInput(f"{path}: holds {rows} rows, but its footer promises {file.metadata.num_rows}")
    if stream is not None:
        stream.close()


@contextmanager
def _open_file(
    path: Path, required: Sequence[str], text_columns: Sequence[str]
) -> Iterator[tuple[pq.ParquetFile, list[str]]]:
    """Open a Parquet file, and yield it and the names of those columns to read that exist.

    Raise BadInput if a required column is missing, or a column or row group is not suitable.
    """
    limits: dict[str, Any] = {
        "thrift_container_size_limit": _MAX_ENTRIES,
        "thrift_string_size_limit": _MAX_FOOTER_BYTES,
        "page_checksum_verification": True,
        "arrow_extensions_enabled": False,
    }
    with pq.ParquetFile(path, **limits) as file:
        names = [file.schema.column(i).path for i in range(len(file.schema))]
        columns = [*required, *(column for column in text_columns if column in names)]
        _check_columns(path, file, names, columns)
    with pq.ParquetFile(path, read_dictionary=list(required), **limits) as file:
        yield file, columns


def check_column_names(path: Path, names: Sequence[str], columns: Sequence[str]) -> None:
    """Raise BadInput if required columns are missing from a file or occur more than once.

    Parameters
    ----------
    path : Path
        The file, for the message.
    names : sequence of str
        Names of all columns of the file.
    columns : sequence of str
        Names of the required columns.

    Raises
    ------
    BadInput
        If a required column is missing or occurs more than once. The message lists all missing columns, with similar
        names that the file has.
    """
    count = Counter(names)
    if missing := [column for column in dict.fromkeys(columns) if not count[column]]:
        has = " ".join(", ".join(names).split())[:300]
        absent = ", ".join(f"{column}{synonyms.suggest_title(column, names)}" for column in missing)
        raise BadInput(f"{path} has no column {absent}; it has {has}")
    for column in columns:
        if count[column] > 1:
            raise BadInput(f"{path}: has column {column} more than once")


def _check_columns(path: Path, file: pq.ParquetFile, names: Sequence[str], columns: Sequence[str]) -> None:
    check_column_names(path, names, columns)
    metadata, schema = file.metadata, file.schema
    indices = {name: i for i, name in enumerate(names)}
    for column in columns:
        kind = file.schema_arrow.field(column).type
        if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind) or _is_text(kind)):
            raise BadInput(f"{path}: column {column} is {kind}, but must have numbers, booleans or texts")
        if schema.column(indices[column]).max_repetition_level:
            raise BadInput(f"{path}: column {column} is a list")
    for number in range(metadata.num_row_groups):
        group = metadata.row_group(number)
        size = sum(group.column(indices[column]).total_uncompressed_size for column in columns)
        if not 0 <= size <= _MAX_GROUP_BYTES or not 0 <= group.num_rows <= _MAX_GROUP_BYTES:
            raise BadInput(f"{path}: row group {number} has {group.num_rows} rows of {size} bytes: too large")


def _is_text(kind: pa.DataType) -> bool:
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


def _check_text_size(path: Path, batch: pa.RecordBatch) -> pa.RecordBatch:
    for name, column in zip(batch.schema.names, batch.columns, strict=True):
        size, limit = 0, _MAX_TEXT_BYTES
        if pa.types.is_dictionary(column.type):
            size, limit = column.dictionary.nbytes, _MAX_DICTIONARY_BYTES
        elif _is_text(column.type):
            size = column.nbytes
        if size > limit:
            raise BadInput(f"{path}: column {name} holds texts of {size} bytes: too large")
    return batch


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], send_batches))
