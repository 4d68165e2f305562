"""Write and read the Parquet files of a lake, with declared encodings and with checksums of every byte.

Other readers (pyarrow, Spark, pandas, DuckDB, lsdb) return a changed byte as a wrong number. Here a file is read
through `blocks.VerifiedFile` with its entry in a manifest or receipt. The decoder sees only verified bytes, including
page headers and the footer.
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

# With this number of rows per group, small cone searches are fast and the footer is small (tried: 4k to 262k).
ROWS_PER_GROUP = 65_536

_FORMAT = ds.ParquetFileFormat()


def write(path: Path, rows: pa.Table, table: Table) -> None:
    """Write a Parquet file with the table's encodings and a VOTable header; equal rows give equal bytes.

    Parameters
    ----------
    path : Path
        File to write.
    rows : pyarrow.Table
        Rows.
    table : Table
        Declaration of the table.
    """
    with pq.ParquetWriter(path, rows.schema, **table.parquet_options()) as file:
        file.write_table(rows, row_group_size=ROWS_PER_GROUP)
        file.add_key_value_metadata(votable.footer_metadata(rows, table))


def file_checksums(path: Path) -> dict[str, Any]:
    """Return size, sha256 and blocks of a Parquet file that was just written.

    A block contains the pages of one column of a row group with their headers. Small pieces share a block with the
    next piece, and large pieces are divided into several blocks. The page index and the footer come last. The entry
    `blocks` contains sizes and CRC-32 of the blocks as base64 text, see `blocks.file_checksums`.
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

    Attributes
    ----------
    verified_files : sequence of VerifiedFile
        Its files, in the order of its fragments.
    """

    verified_files: Sequence[blocks.VerifiedFile] = ()

    @property
    def fault(self) -> str:
        """Reason why one of the files was refused, "" if none was."""
        return next((file.fault for file in self.verified_files if file.fault), "")


def open_dataset(folder: Folder, entries: Sequence[Json], schema: pa.Schema) -> Dataset:
    """Open files in a folder as one Arrow dataset, in the given order.

    Parameters
    ----------
    folder : Path or ObjectPath
        Folder of the version.
    entries : sequence of mapping
        Entries of the files in the manifest.
    schema : pyarrow.Schema
        Schema of the dataset.

    Returns
    -------
    Dataset
        The dataset. Reading it raises an error if other parts of a file than its footer are damaged.

    Raises
    ------
    Damaged
        If the footer of a file or its number of rows differs from the manifest. The message names the file.
    """
    files = [blocks.VerifiedFile(folder / entry["path"], entry) for entry in entries]
    fragments = [_FORMAT.make_fragment(file) for file in files]
    merged = Dataset(fragments, schema, _FORMAT)
    merged.verified_files = files
    if len(fragments) > 1:
        # This reads several footers at a time.
        merged.count_rows()
    for file, fragment, entry in zip(files, fragments, entries, strict=True):
        rows = fragment.metadata.num_rows
        if rows != entry.get("rows", rows):
            raise Damaged(f"{file.path} has {rows} rows, the manifest says {entry['rows']}")
    return merged


def read(folder: Folder, entry: Json, columns: Sequence[str] | None = None) -> pa.Table:
    """Read the rows of one file, with the types with which they were written.

    Parameters
    ----------
    folder : Path or ObjectPath
        Folder of the version.
    entry : mapping
        Entry of the file in the manifest.
    columns : sequence of str, optional
        Names of columns; by default all.

    Returns
    -------
    pyarrow.Table
        The rows.

    Raises
    ------
    Damaged
        If the file differs from the manifest. The message names the file.
    """
    with blocks.VerifiedFile(folder / entry["path"], entry) as file:
        return pq.read_table(file, columns=None if columns is None else list(columns))


def read_schema(folder: Folder, entry: Json) -> pa.Schema:
    """Return the schema of a file.

    Raises
    ------
    Damaged
        If the file differs from the manifest. The message names the file.
    """
    with blocks.VerifiedFile(folder / entry["path"], entry) as file:
        return pq.read_schema(file)
