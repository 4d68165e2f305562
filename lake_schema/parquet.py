"""Parquet files as the lake writes and reads them: declared encodings, sorted rows, page checksums on both ways.

A changed byte goes through pyarrow's, Spark's, pandas', DuckDB's and lsdb's own readers as a wrong number; through
`dataset` here, after its tail was compared with the manifest's, it is an error that names the file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
from pyarrow.fs import LocalFileSystem

from lake_schema.columns import Table
from lake_schema.errors import Damaged

# Sorted by position, 65,536 rows a group is where small cones are fast and the footer still small (tried: 4k to 262k).
ROWS_A_GROUP = 65_536

_FORMAT = ds.ParquetFileFormat(
    default_fragment_scan_options=ds.ParquetFragmentScanOptions(page_checksum_verification=True)
)


def write(path: Path, rows: pa.Table, table: Table) -> None:
    """One file with the table's encodings; the same rows give the same bytes."""
    pq.write_table(rows, path, row_group_size=ROWS_A_GROUP, **table.parquet())


def dataset(paths: Sequence[Path], schema: pa.Schema) -> ds.FileSystemDataset:
    """The files as one Arrow dataset, in the order given, every page checked as it is read."""
    names = [str(path) for path in paths]
    return ds.FileSystemDataset.from_paths(names, schema=schema, format=_FORMAT, filesystem=LocalFileSystem())


def read(path: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """The rows of one file, every page checked.  Errors: Damaged names the file."""
    names = None if columns is None else list(columns)
    try:
        return pq.read_table(path, columns=names, partitioning=None, page_checksum_verification=True)
    except (OSError, pa.ArrowInvalid) as error:
        raise Damaged(f"{path}: {error}") from None


def tail_start(path: Path) -> int:
    """Where the pages of a file end, and the page index and the footer begin."""
    about = pq.read_metadata(path)
    ends = [4]  # the magic number
    for group in range(about.num_row_groups):
        for column in range(about.num_columns):
            chunk = about.row_group(group).column(column)
            first = chunk.dictionary_page_offset if chunk.has_dictionary_page else chunk.data_page_offset
            ends.append(first + chunk.total_compressed_size)
    return max(ends)


def tail_sha256(path: Path, start: int) -> str:
    """sha256 of a file from a byte on, hexadecimal."""
    with path.open("rb") as stream:
        stream.seek(start)
        return hashlib.file_digest(stream, "sha256").hexdigest()
