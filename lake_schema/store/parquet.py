"""Parquet files as the lake writes and reads them: declared encodings, sorted rows, every byte compared when read.

A changed byte goes through pyarrow's, Spark's, pandas', DuckDB's and lsdb's own readers as a wrong number. Here a file
is known by its entry in a manifest or receipt, and read by nothing but `blocks.Checked`: the decoder sees no byte that
was not compared, be it of a page, of its header, or of the footer that says where pages are.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from lake_schema import votable
from lake_schema.columns import Table
from lake_schema.errors import Damaged
from lake_schema.store import blocks
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.store.plan import Json

# Sorted by position, 65,536 rows a group is where small cones are fast and the footer still small (tried: 4k to 262k).
ROWS_PER_GROUP = 65_536

_FORMAT = ds.ParquetFileFormat()


def write(path: Path, rows: pa.Table, table: Table) -> None:
    """One file with the table's encodings, and its columns as a VOTable too; the same rows give the same bytes."""
    with pq.ParquetWriter(path, rows.schema, **table.parquet_options()) as file:
        file.write_table(rows, row_group_size=ROWS_PER_GROUP)
        file.add_key_value_metadata(votable.footer_metadata(rows, table))


def file_checksums(path: Path) -> dict[str, Any]:
    """Size, sha256 and blocks of a file that was just written; a block holds the pages of one column of a row group,
    with their headers, or of several small ones; the last one holds the page index and the footer.
    """
    metadata = pq.read_metadata(path)
    starts, end = [], 4  # the magic number
    for group in range(metadata.num_row_groups):
        for column in range(metadata.num_columns):
            chunk = metadata.row_group(group).column(column)
            starts.append(chunk.dictionary_page_offset if chunk.has_dictionary_page else chunk.data_page_offset)
            end = max(end, starts[-1] + chunk.total_compressed_size)
    return blocks.file_checksums(path, [*sorted(starts), end])


class Dataset(ds.FileSystemDataset):  # type: ignore[misc]
    """Files of a lake as an Arrow dataset.

    read_from : its files, in the order of its fragments
    """

    verified_files: Sequence[blocks.VerifiedFile] = ()

    @property
    def fault(self) -> str:
        """Why one of the files was refused, "" where none was."""
        return next((file.fault for file in self.verified_files if file.fault), "")


def open_dataset(folder: Folder, entries: Sequence[Json], schema: pa.Schema) -> Dataset:
    """Files below a folder as one Arrow dataset, in the order given.

    entries : of the manifest
    Errors  : Damaged names the file that has another footer, or other than the manifest's number of rows; whoever reads
              the dataset meets it for what comes before the footer
    """
    files = [blocks.VerifiedFile(folder / entry["path"], entry) for entry in entries]
    fragments = [_FORMAT.make_fragment(file) for file in files]
    merged = Dataset(fragments, schema, _FORMAT)
    merged.verified_files = files
    if len(fragments) > 1:
        # Reads the footers, several at a time.
        merged.count_rows()
    for file, fragment, entry in zip(files, fragments, entries, strict=True):
        rows = fragment.metadata.num_rows
        if rows != entry.get("rows", rows):
            raise Damaged(f"{file.path} has {rows} rows, the manifest says {entry['rows']}")
    return merged


def read(folder: Folder, entry: Json, columns: Sequence[str] | None = None) -> pa.Table:
    """The rows of one file, in the types that it was written with.  Errors: Damaged names the file."""
    with blocks.VerifiedFile(folder / entry["path"], entry) as file:
        return pq.read_table(file, columns=None if columns is None else list(columns))


def read_schema(folder: Folder, entry: Json) -> pa.Schema:
    """What columns a file has.  Errors: Damaged names the file."""
    with blocks.VerifiedFile(folder / entry["path"], entry) as file:
        return pq.read_schema(file)
