"""Parquet files of other programs: nothing in them is believed, everything is bounded before and while it is read.

batches     the rows of some flat columns, a bounded piece at a time

A file can be made so that its reader crashes, so it is read by a process of its own, which has little memory and time
and hands over plain Arrow batches: python -m lake_schema.external.files FILE NEEDED COLUMN ... >stream
(so many columns are needed, the others are sent where they are there)
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

_MAGIC = b"PAR1"
# A footer larger than this describes no table of ours; columns and row groups are bounded by the length of any list in
# it, and with them how deep columns can nest.
_MOST_FOOTER_BYTES = 32 << 20
_MOST_ENTRIES = 5000
# What one row group may hold, uncompressed; the largest that is written here is a tenth of it.
_MOST_GROUP_BYTES = 256 << 20
# Of a column in a batch: as a dictionary, and where each row has a text of its own, 64 bytes each.
_MOST_TEXT_BYTES, _MOST_OWN_BYTES = 1 << 20, 4 << 20
_ROWS_A_BATCH = 65_536
# Of the reading process: address space; CPU time at the least, and bytes of the file for each second more.
_MOST_MEMORY = 3 << 29
_LEAST_SECONDS, _BYTES_A_SECOND = 10, 10_000_000
_REFUSED = 2
_ROOT = Path(__file__).resolve().parents[2]


def batches(path: Path, columns: Sequence[str], texts: Sequence[str] = ()) -> Iterator[pa.RecordBatch]:
    """Rows of some columns of a file, in its order; texts come as dictionaries, so that a repeated one is held once.

    columns : names of flat columns of numbers, booleans or texts
    texts   : more of them, sent as they are, each left out where the file has none
    Errors  : BadInput, one line, where the file is not Parquet, is damaged, or asks for more than is reasonable
    """
    _refuse_large_footer(path)
    yield from read_apart(__name__, path, columns, texts)


def read_apart(module: str, path: Path, columns: Sequence[str], texts: Sequence[str] = ()) -> Iterator[pa.RecordBatch]:
    """The batches that a module sends, run by a process of its own.

    module  : name of one that calls `main` with its reader
    path    : of the file
    columns : names of those that are needed;  texts : of those that are sent where they are there
    """
    command = [sys.executable, "-m", module, str(path.resolve()), str(len(columns)), *columns, *texts]
    environment = {**os.environ, "ARROW_DEFAULT_MEMORY_POOL": "system"}
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, cwd=_ROOT, env=environment, **pipes) as reader:
        try:
            yield from _received(path, reader)
        finally:
            reader.kill()


def _received(path: Path, reader: subprocess.Popen[bytes]) -> Iterator[pa.RecordBatch]:
    try:
        with pa.ipc.open_stream(reader.stdout) as stream:
            yield from stream
    except (OSError, pa.ArrowException):
        # It ended early, and says why.
        pass
    _, said = reader.communicate()
    if reader.returncode == _REFUSED:
        raise BadInput(said.decode(errors="replace").strip())
    if reader.returncode:
        raise BadInput(f"{path}: its reader died of it, status {reader.returncode}")


def _refuse_large_footer(path: Path) -> None:
    with user_files.opened(path, "catalogue") as stream:
        first = stream.read(4)
        size = stream.seek(0, os.SEEK_END)
        stream.seek(max(size - 8, 0))
        length, last = int.from_bytes(stream.read(4), "little"), stream.read(4)
    if size < 12 or first != _MAGIC or last != _MAGIC:
        raise BadInput(f"{path}: is not a Parquet file")
    if not 0 < length <= min(size - 12, _MOST_FOOTER_BYTES):
        raise BadInput(f"{path}: its footer says {length} bytes, of {size} and at most {_MOST_FOOTER_BYTES}")


# ----------------------------------------------------------------------------------------- in a process of its own


def main(argv: Sequence[str], sender: Callable[[Path, Sequence[str], Sequence[str], IO[bytes]], None]) -> int:
    """Write the batches of a file to stdout as an Arrow stream; a refusal goes to stderr.

    argv : FILE NEEDED COLUMN ...;  sender : what writes them
    """
    path, needed, columns = Path(argv[0]), int(argv[1]), list(argv[2:])
    seconds = _LEAST_SECONDS + path.stat().st_size // _BYTES_A_SECOND
    command.limit_resource("RLIMIT_AS", _MOST_MEMORY)
    command.limit_resource("RLIMIT_CPU", seconds)
    command.limit_resource("RLIMIT_CORE", 0)
    pa.set_cpu_count(1)
    try:
        with os.fdopen(1, "wb", closefd=False) as out:
            sender(path, columns[:needed], columns[needed:], out)
    except BadInput as error:
        print(error, file=sys.stderr)
        return _REFUSED
    return 0


def send(path: Path, needed: Sequence[str], texts: Sequence[str], out: IO[bytes]) -> None:
    """Write the batches of a file as an Arrow stream; BadInput, whatever Arrow's reader trips over.

    path   : a Parquet file of another program
    needed : columns that have to be there;  texts : columns that are left out where they are not
    out    : where the stream goes
    """
    try:
        with _opened(path, needed, texts) as (file, found):
            _send(path, file, found, out)
    except BadInput:
        raise
    except Exception as error:
        raise BadInput(f"{path}: {' '.join(str(error).split())[:300] or type(error).__name__}") from None


def _send(path: Path, file: pq.ParquetFile, columns: list[str], out: IO[bytes]) -> None:
    rows, stream = 0, None
    for batch in file.iter_batches(_ROWS_A_BATCH, columns=columns, use_threads=False):
        rows += batch.num_rows
        stream = stream or pa.ipc.new_stream(out, batch.schema)
        stream.write_batch(_bounded(path, batch))
    if rows != file.metadata.num_rows:
        raise BadInput(f"{path}: holds {rows} rows and says {file.metadata.num_rows}")
    if stream is not None:
        stream.close()


@contextmanager
def _opened(path: Path, needed: Sequence[str], texts: Sequence[str]) -> Iterator[tuple[pq.ParquetFile, list[str]]]:
    """The file, and the columns that are to be read."""
    limits: dict[str, Any] = {
        "thrift_container_size_limit": _MOST_ENTRIES,
        "thrift_string_size_limit": _MOST_FOOTER_BYTES,
        "page_checksum_verification": True,
        "arrow_extensions_enabled": False,
    }
    with pq.ParquetFile(path, **limits) as file:
        titles = [file.schema.column(i).path for i in range(len(file.schema))]
        columns = [*needed, *(name for name in texts if name in titles)]
        _check_columns(path, file, titles, columns)
    with pq.ParquetFile(path, read_dictionary=list(needed), **limits) as file:
        yield file, columns


def check_titles(path: Path, titles: Sequence[str], columns: Sequence[str]) -> None:
    """Refuse a file in which columns are not there, or one twice; BadInput names all that are missing."""
    count = Counter(titles)
    if missing := [name for name in dict.fromkeys(columns) if not count[name]]:
        has = " ".join(", ".join(titles).split())[:300]
        raise BadInput(f"{path}: has no column {', '.join(missing)}; it has {has}")
    for name in columns:
        if count[name] > 1:
            raise BadInput(f"{path}: has column {name} more than once")


def _check_columns(path: Path, file: pq.ParquetFile, titles: Sequence[str], columns: Sequence[str]) -> None:
    check_titles(path, titles, columns)
    about, schema = file.metadata, file.schema
    places = {title: i for i, title in enumerate(titles)}
    for name in columns:
        kind = file.schema_arrow.field(name).type
        if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind) or _is_text(kind)):
            raise BadInput(f"{path}: column {name} is {kind}, wanted numbers, booleans or texts")
        if schema.column(places[name]).max_repetition_level:
            raise BadInput(f"{path}: column {name} is a list")
    for number in range(about.num_row_groups):
        group = about.row_group(number)
        size = sum(group.column(places[name]).total_uncompressed_size for name in columns)
        if not 0 <= size <= _MOST_GROUP_BYTES or not 0 <= group.num_rows <= _MOST_GROUP_BYTES:
            raise BadInput(f"{path}: row group {number} says {group.num_rows} rows of {size} bytes: too large")


def _is_text(kind: pa.DataType) -> bool:
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


def _bounded(path: Path, batch: pa.RecordBatch) -> pa.RecordBatch:
    for name, column in zip(batch.schema.names, batch.columns, strict=True):
        size, most = 0, _MOST_OWN_BYTES
        if pa.types.is_dictionary(column.type):
            size, most = column.dictionary.nbytes, _MOST_TEXT_BYTES
        elif _is_text(column.type):
            size = column.nbytes
        if size > most:
            raise BadInput(f"{path}: column {name} holds texts of {size} bytes: too large")
    return batch


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], send))
