"""Write and read the Parquet files of a lake's tables, with checksums of every byte.

Other readers (pyarrow, Spark, pandas, DuckDB, lsdb) return a changed byte as a wrong number. Here a file is read
through `blocks.VerifiedFile`, which compares it with checksums that were recorded when the file was written. The
decoder gets only verified bytes, including page headers and the footer.
"""

from __future__ import annotations

import atexit
import threading
import time
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from lake_schema import votable
from lake_schema.columns import Table
from lake_schema.errors import BadInput, Damaged
from lake_schema.store import blocks
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.store.plan import Json

# Number of rows per Parquet row group. Compared with other values (4,000 to 262,000), it gives fast searches in small
# circles on the sky and a small footer.
ROWS_PER_GROUP = 65_536

# Largest size in bytes of the numbers in a Parquet file after decoding, and of the texts. A compressed file can be a
# million times smaller than its contents, so the size of the file does not limit the memory that reading it takes.
MAX_DECODED_BYTES = 4 << 30
# Texts are measured only if they may be larger than this, because they must be decoded for it.
_MIN_MEASURED_BYTES = 64 << 20
# Bytes per decoded number, by physical type of the column. The other types have values of different lengths.
_WIDTHS = {"BOOLEAN": 1, "INT32": 4, "FLOAT": 4, "INT64": 8, "DOUBLE": 8, "INT96": 12}
_TEXT = "BYTE_ARRAY"
_FORMAT = ds.ParquetFileFormat()
# Linux folder with one folder per thread of this process.
_THREADS = Path("/proc/self/task")
# Longest time in s that the end of the process waits for threads, and time between two looks at them.
_LONGEST_WAIT_S, _STEP_S = 1.0, 0.005


def write(path: Path, rows: pa.Table, table: Table) -> None:
    """Write rows to a Parquet file, with a VOTable header in its footer; equal rows give equal bytes.

    Parameters
    ----------
    path : Path
        File to write. An existing file is overwritten.
    rows : pyarrow.Table
        Rows. They are not compared with the declaration.
    table : Table
        Declaration of the table, which sets the compression and encoding of each column.

    Raises
    ------
    BadInput
        If the rows take more memory than the limit of a file.
    """
    if rows.nbytes > MAX_DECODED_BYTES:
        raise BadInput(f"table {table.name}: {rows.num_rows} rows of one file need {_describe_excess(rows.nbytes)}")
    with pq.ParquetWriter(path, rows.schema, **table.parquet_options()) as file:
        file.write_table(rows, row_group_size=ROWS_PER_GROUP)
        file.add_key_value_metadata(votable.footer_metadata(rows, table))


def file_checksums(path: Path) -> dict[str, Any]:
    """Return size, sha256 and checksums of the blocks of a Parquet file that was just written.

    A block is a range of bytes that is verified as a whole: the pages of one column of a row group with their headers.
    A small column shares its block with the next column, and a large column is divided into several blocks. The last
    blocks contain the page index and the footer. The result is that of `blocks.file_checksums`.

    BadInput is raised if the numbers in the file take more memory than `MAX_DECODED_BYTES`.
    """
    metadata = pq.read_metadata(path)
    if (size := _size_of_numbers(metadata)) > MAX_DECODED_BYTES:
        raise BadInput(f"{path} needs {_describe_excess(size)}")
    starts, end = [], 4  # A Parquet file begins with a magic number of 4 bytes.
    for group in range(metadata.num_row_groups):
        for column in range(metadata.num_columns):
            chunk = metadata.row_group(group).column(column)
            starts.append(chunk.dictionary_page_offset if chunk.has_dictionary_page else chunk.data_page_offset)
            end = max(end, starts[-1] + chunk.total_compressed_size)
    return blocks.file_checksums(path, [*sorted(starts), end])


class Dataset(ds.FileSystemDataset):  # type: ignore[misc]
    """Parquet files of a lake as one Arrow dataset, which verifies the checksums of all bytes that it reads.

    Attributes
    ----------
    verified_files : sequence of VerifiedFile
        The opened files, one per Arrow fragment of the dataset, in the same order.
    """

    verified_files: Sequence[blocks.VerifiedFile] = ()

    @property
    def fault(self) -> str:
        """Message about the first file that differs from its checksums or cannot be read, "" without such a file."""
        return next((file.fault for file in self.verified_files if file.fault), "")

    def to_table(self, columns: Sequence[str] | None = None, **options: Any) -> pa.Table:
        """Return the rows as `pyarrow.dataset.Dataset.to_table` does, with the same arguments.

        Damaged is raised if the texts of a file take more memory than `MAX_DECODED_BYTES`.
        """
        for file, fragment in zip(self.verified_files, self.get_fragments(), strict=True):
            _refuse_large_texts(file, fragment.metadata, columns)
        return super().to_table(columns=columns, **options)


def open_dataset(folder: Folder, entries: Sequence[Json], schema: pa.Schema) -> Dataset:
    """Open Parquet files of a version of a table as one Arrow dataset, in the given order.

    Parameters
    ----------
    folder : Path or ObjectPath
        Folder of the version.
    entries : sequence of mapping
        Entries of the files in the manifest (the list of the version's files with their sizes and checksums).
    schema : pyarrow.Schema
        Schema of the dataset.

    Returns
    -------
    Dataset
        The dataset. Only the footers of the files have been verified. The other bytes are verified when rows are read,
        which raises an error if they have changed.

    Raises
    ------
    Damaged
        If the footer of a file or its number of rows differs from the manifest, or the numbers in the file take more
        memory than `MAX_DECODED_BYTES`. The message names the file.
    """
    _register_end_of_reads()
    files = [blocks.VerifiedFile(folder / entry["path"], entry) for entry in entries]
    fragments = [_FORMAT.make_fragment(file) for file in files]
    merged = Dataset(fragments, schema, _FORMAT)
    merged.verified_files = files
    if len(fragments) > 1:
        # Count the rows only because Arrow then reads all footers in parallel; the loop below would read one by one.
        merged.count_rows()
    for file, fragment, entry in zip(files, fragments, entries, strict=True):
        rows = fragment.metadata.num_rows
        if rows != entry.get("rows", rows):
            raise Damaged(f"{file.path} has {rows} rows, the manifest says {entry['rows']}")
        _refuse_large_numbers(file, fragment.metadata)
    return merged


def _refuse_large_numbers(file: blocks.VerifiedFile, metadata: pq.FileMetaData) -> None:
    if (size := _size_of_numbers(metadata)) > MAX_DECODED_BYTES:
        raise Damaged(f"{file.path} needs {_describe_excess(size)}")


def _size_of_numbers(metadata: pq.FileMetaData) -> int:
    """Return the size in bytes of all decoded numbers of a file, from the numbers of values in its footer."""
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    num_rows: int = sum(group.num_rows for group in groups)
    size = 0
    for i in range(metadata.num_columns):
        column = metadata.schema.column(i)
        if column.physical_type == _TEXT:
            continue
        is_list = column.max_repetition_level > 0
        count: int = sum(group.column(i).num_values for group in groups) if is_list else num_rows
        width: int = _WIDTHS.get(column.physical_type, column.length)
        size += count * width
    return size


def _refuse_large_texts(
    file: blocks.VerifiedFile, metadata: pq.FileMetaData, columns: Sequence[str] | None = None
) -> None:
    """Raise Damaged if the texts in some columns (by default all) take more memory than `MAX_DECODED_BYTES`."""
    size = 0
    for i in range(metadata.num_columns):
        column = metadata.schema.column(i)
        if column.physical_type == _TEXT and (columns is None or column.path.partition(".")[0] in columns):
            size += _size_of_texts(file, metadata, i)
            if size > MAX_DECODED_BYTES:
                raise Damaged(f"{file.path} needs {_describe_excess(size)}")


def _size_of_texts(file: blocks.VerifiedFile, metadata: pq.FileMetaData, number: int) -> int:
    """Return the size in bytes of the decoded texts in a column, or an upper limit if it is small."""
    chunks = [metadata.row_group(i).column(number) for i in range(metadata.num_row_groups)]
    # A text in a dictionary is stored once for any number of rows, so that each row can have the size of the chunk.
    size: int = sum(
        max(chunk.total_uncompressed_size, chunk.total_compressed_size)
        * (chunk.num_values if chunk.has_dictionary_page else 1)
        for chunk in chunks
    )
    if size <= _MIN_MEASURED_BYTES:
        return size
    path = metadata.schema.column(number).path
    reader, size = pq.ParquetFile(file, metadata=metadata, read_dictionary=[path]), 0
    for group in range(metadata.num_row_groups):
        # Texts that are read as a dictionary are not repeated in memory.
        for texts in reader.read_row_group(group, columns=[path]).column(0).chunks:
            size += _num_bytes(texts)
        if size > MAX_DECODED_BYTES:
            break
    return size


def _num_bytes(texts: pa.Array) -> int:
    while pa.types.is_list(texts.type):
        texts = pc.list_flatten(texts)
    if pa.types.is_dictionary(texts.type):
        lengths = pc.binary_length(texts.dictionary).take(texts.indices)
    else:
        lengths = pc.binary_length(texts)
    return int(pc.sum(lengths).as_py() or 0)


def _describe_excess(size: int) -> str:
    return f"{size / 1e9:.3g} GB of memory, more than the limit of {MAX_DECODED_BYTES / 1e9:.3g} GB"


def read(folder: Folder, entry: Json, columns: Sequence[str] | None = None) -> pa.Table:
    """Read the rows of one Parquet file of a version, with the types with which they were written.

    Parameters
    ----------
    folder : Path or ObjectPath
        Folder of the version.
    entry : mapping
        Entry of the file in the manifest (path, size and checksums).
    columns : sequence of str, optional
        Names of the columns to read; by default all. pyarrow.ArrowInvalid is raised for an unknown name.

    Returns
    -------
    pyarrow.Table
        The rows.

    Raises
    ------
    Damaged
        If the file is missing, its bytes differ from the manifest, or its numbers or the texts in the columns take more
        memory than `MAX_DECODED_BYTES`. The message names the file.
    """
    _register_end_of_reads()
    with blocks.VerifiedFile(folder / entry["path"], entry) as file:
        metadata = pq.read_metadata(file)
        _refuse_large_numbers(file, metadata)
        _refuse_large_texts(file, metadata, columns)
        return pq.read_table(file, columns=None if columns is None else list(columns))


def read_schema(folder: Folder, entry: Json) -> pa.Schema:
    """Return the Arrow schema of a Parquet file in the folder of a version.

    `entry` is the file's entry in the manifest: path, size and checksums. Only the footer is read.

    Raises
    ------
    Damaged
        If the file is missing or its footer differs from the manifest. The message names the file.
    """
    with blocks.VerifiedFile(folder / entry["path"], entry) as file:
        return pq.read_schema(file)


@cache
def _register_end_of_reads() -> None:
    """Make the end of the process wait for Arrow's threads, which may still release the bytes that they have read.

    The bytes are Python objects. If a thread of Arrow releases one while Python shuts down, Python ends the thread in
    the middle of C++ code, and the process aborts ("terminate called without an active exception").
    """
    atexit.register(_wait_for_threads)


def _wait_for_threads() -> None:
    """Wait until the other threads of this process have been idle twice in a row, but at most `_LONGEST_WAIT_S`."""
    idle_looks, end = 0, time.monotonic() + _LONGEST_WAIT_S
    while idle_looks < 2 and time.monotonic() < end:
        # Threads that wait for the interpreter can go on while this one sleeps.
        time.sleep(_STEP_S)
        idle_looks = 0 if _is_any_thread_running() else idle_looks + 1


def _is_any_thread_running() -> bool:
    """Return True if a thread of this process other than the current one runs; always False without Linux."""
    current = str(threading.get_native_id())
    return any(_state(path) == "R" for path in _THREADS.glob("*") if path.name != current)


def _state(thread: Path) -> str:
    """Return the letter with which Linux describes the state of a thread, "" if it has ended."""
    try:
        # The name of the thread, in brackets, may contain spaces. The state follows it.
        return (thread / "stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return ""
