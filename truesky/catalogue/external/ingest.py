"""Read and check the galaxies of a user's catalogue once, and store them by order-5 cell for the workers.

One pass over all files checks every value, and that no identifier occurs twice. The rows are stored in the cache.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import feather

from lake_schema import sky
from lake_schema.arrays import Array
from lake_schema.errors import BadInput, Damaged
from lake_schema.external import rows as external_rows
from lake_schema.ids import FILE_ORDER, GENERATION_ORDER
from lake_schema.store.provenance import file_sha256
from truesky.catalogue.external import mapping
from truesky.catalogue.external.mapping import Columns, Rows
from truesky.numerics import cache
from truesky.numerics.cache import cache_dir, content_key
from truesky.numerics.code_fingerprints import code_key

# Number of rows in memory before they are written to the files of their cells.
_MAX_BUFFERED_ROWS = 2_000_000
# Number of groups in which identifiers are compared; each group fits into memory.
_LOT_COUNT = 64
_ID_ENTRY = np.dtype([("id", np.int64), ("file", np.int32), ("row", np.int64)])
_SUMMARY_FILE = "about.json"
# Columns of positions; the observed positions are last.
_POSITION_COLUMNS = (("ra", "dec"), ("ra_lensed", "dec_lensed"))


@dataclass(frozen=True, slots=True)
class Split:
    """A catalogue that is stored by cell.

    Attributes
    ----------
    folder : Path
        Folder of the pieces.
    checksums : mapping of str to int
        CRC-32 of each piece by name.
    rows : int
        Number of rows of all files.
    z_max, ebv_max : float
        Largest redshift, and largest E(B-V) in mag.
    """

    folder: Path
    checksums: Mapping[str, int]
    rows: int
    z_max: float
    ebv_max: float


def files_with_checksums(paths: Sequence[Path], columns: Columns) -> tuple[list[Path], list[str]]:
    """Return the catalogue files in the order of the request, and the SHA-256 of each file and companion file."""
    files, all_files = list_files(paths, columns)
    return files, [file_sha256(file) for file in all_files]


def list_files(paths: Sequence[Path], columns: Columns) -> tuple[list[Path], list[Path]]:
    """Return the catalogue files in the order of the request, and the same list followed by the companion files."""
    files = [file for path in paths for file in external_rows.find_files(path)]
    if columns.companion_prefixes:
        # The folder also contains the companion files and unrelated tables.
        other_prefix = columns.companion_prefixes[1]
        files = [
            f for f in files if f.name.startswith(columns.companion_prefixes[0]) and not f.name.startswith(other_prefix)
        ]
        if not files:
            raise BadInput(f"{paths[0]}: must contain a file whose name begins with {columns.companion_prefixes[0]}")
    all_files = files + [
        mapping.companion_file(file, columns.companion_prefixes) for file in files if columns.companion_prefixes
    ]
    for file in all_files:
        external_rows.check_format(file)
    return files, all_files


def split_by_cell(files: Sequence[Path], sha256: Sequence[str], columns: Columns) -> Split:
    """Return a catalogue stored by cell, from the cache or made now.

    Parameters
    ----------
    files : sequence of Path
        Files of the catalogue.
    sha256 : sequence of str
        SHA-256 of all files, which identify the cached copy.
    columns : Columns
        Mapping of the columns.

    Returns
    -------
    Split
        The stored catalogue.

    Raises
    ------
    BadInput, Damaged
        If a value cannot be used; the message names the file, the column and the row.
    """
    columns_json = json.dumps(
        [sorted((key, repr(field)) for key, field in columns.fields.items()), columns.companion_prefixes]
    )
    folder = cache_dir() / f"ingest-{content_key(code_key(__name__), columns_json, *sha256)[:32]}"
    checksums = _read_checksums(folder)
    if checksums is None:
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        try:
            summary = _write_pieces(temporary, files, columns)
            (temporary / _SUMMARY_FILE).write_text(json.dumps(summary))
            cache.store_checksums(
                temporary,
                sorted(path.relative_to(temporary).as_posix() for path in temporary.rglob("*") if path.is_file()),
            )
            _publish(temporary, folder)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
        checksums = _read_checksums(folder)
    if checksums is None:
        raise BadInput(f"cache {folder}: the files written by this process cannot be read")
    return Split(folder, checksums, **json.loads((folder / _SUMMARY_FILE).read_text()))


def _read_checksums(folder: Path) -> dict[str, int] | None:
    checksums = cache.stored_checksums(folder)
    if checksums is not None and not cache.is_intact(folder / _SUMMARY_FILE, checksums.get(_SUMMARY_FILE, -1)):
        cache.discard(folder, f"{_SUMMARY_FILE} is not what was written")
        return None
    return checksums


def rows_of_cell(split: Split, cell: int) -> dict[str, Array]:
    """Return the galaxies of a generation cell.

    Parameters
    ----------
    split : Split
        The stored catalogue.
    cell : int
        Nested index of an order-8 cell.

    Returns
    -------
    dict of str to array, shape (n,)
        Values by name of the column, with `index` (the order-29 cell), sorted by index, then by origin_id.

    Raises
    ------
    Damaged
        If the stored file of this cell has changed on disk. The cached copy is deleted, and the next call of
        `split_by_cell` makes it again.
    """
    prefix = f"{cell >> 2 * (GENERATION_ORDER - FILE_ORDER)}/"
    pieces = [split.folder / name for name in sorted(split.checksums) if name.startswith(prefix)]
    first, last = sky.cell_range(GENERATION_ORDER, cell)
    tables = []
    for piece in pieces:
        if not cache.is_intact(piece, split.checksums[piece.relative_to(split.folder).as_posix()]):
            cache.discard(split.folder, f"{piece.name} is not what was written")
            raise Damaged(f"{piece} has changed on disk and was deleted; run again to rebuild it")
        # Pieces are sorted by index, so only the rows of the cell are copied.
        table = feather.read_table(piece, memory_map=True)
        index = table["index"].to_numpy()
        tables.append(table.slice(*_offset_and_length(np.searchsorted(index, [first, last]))))
    if not tables:
        return {}
    columns = {
        name: column.to_numpy() for name, column in zip(*_names_and_columns(pa.concat_tables(tables)), strict=True)
    }
    order = np.lexsort((columns.get("origin_id", np.zeros(len(columns["index"]), np.int64)), columns["index"]))
    return {name: values[order] for name, values in columns.items()}


def _offset_and_length(edges: Array) -> tuple[int, int]:
    return int(edges[0]), int(edges[1] - edges[0])


def _names_and_columns(table: pa.Table) -> tuple[list[str], list[pa.ChunkedArray]]:
    return table.column_names, table.columns


def _publish(temporary: Path, folder: Path) -> None:
    while True:
        try:
            return os.rename(temporary, folder)
        except FileExistsError:
            pass
        except OSError as error:
            if error.errno != errno.ENOTEMPTY:
                raise
        # Another process has published the folder, or has left an incomplete one, which _read_checksums deletes.
        if _read_checksums(folder) is not None:
            return None


def _write_pieces(folder: Path, files: Sequence[Path], columns: Columns) -> dict[str, Any]:
    buffered: list[Rows] = []
    buffered_rows = count = piece_number = 0
    z_max = ebv_max = 0.0
    identifiers = _IdentifierStore(folder / "seen")
    for piece in mapping.read(files, columns):
        size = len(piece.values["ra"])
        if size:
            z_max = max(z_max, *(float(piece.values[k].max()) for k in ("z_true", "z_obs") if k in piece.values))
            ebv_max = max([ebv_max, *(float(piece.values[k].max()) for k in ("ebv", "ebv_1") if k in piece.values)])
        if "origin_id" in piece.values:
            identifiers.add(files.index(piece.file), piece)
        buffered.append(piece)
        buffered_rows, count = buffered_rows + size, count + size
        if buffered_rows > _MAX_BUFFERED_ROWS:
            _write_cells(folder, buffered, piece_number)
            buffered, buffered_rows, piece_number = [], 0, piece_number + 1
    _write_cells(folder, buffered, piece_number)
    identifiers.refuse_duplicates(files, columns.fields["origin_id"].column if "origin_id" in columns.fields else "")
    return {"rows": count, "z_max": z_max, "ebv_max": ebv_max}


def _write_cells(folder: Path, pieces: Sequence[Rows], piece_number: int) -> None:
    """Write the rows of every cell to a new piece, sorted by index."""
    if not sum(len(piece.values["ra"]) for piece in pieces):
        return
    values = {name: np.concatenate([piece.values[name] for piece in pieces]) for name in pieces[0].values}
    for ra, dec in _POSITION_COLUMNS:
        if ra in values:
            values[ra], values[dec] = sky.check_positions(values[ra], values[dec])
            # If the catalogue has observed positions, they determine the cell.
            values["index"] = sky.healpix_29(values[ra], values[dec])
    order = np.argsort(values["index"], kind="stable")
    cells = values["index"][order] >> 2 * (sky.MAX_ORDER - FILE_ORDER)
    for cell in np.unique(cells).tolist():
        members = order[slice(*np.searchsorted(cells, [cell, cell + 1]))]
        (folder / str(cell)).mkdir(exist_ok=True)
        table = pa.table({name: column[members] for name, column in values.items()})
        feather.write_feather(table, folder / str(cell) / f"{piece_number:06d}.arrow", compression="uncompressed")


class _IdentifierStore:
    """Identifiers with their file and row, in groups on disk, because they may not fit into memory."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()

    def add(self, file: int, piece: Rows) -> None:
        """Store the identifiers of rows."""
        identifiers = piece.values["origin_id"]
        entries = np.empty(identifiers.size, _ID_ENTRY)
        entries["id"], entries["file"], entries["row"] = identifiers, file, piece.first + np.arange(identifiers.size)
        lot = (identifiers % _LOT_COUNT).astype(np.int64)
        for lot_number in np.unique(lot).tolist():
            with (self.folder / str(lot_number)).open("ab") as stream:
                stream.write(entries[lot == lot_number].tobytes())

    def refuse_duplicates(self, files: Sequence[Path], column: str) -> None:
        """Raise BadInput if an identifier occurs twice; then delete the groups."""
        for path in sorted(self.folder.iterdir()):
            entries = np.sort(np.fromfile(path, _ID_ENTRY), order=("id", "file", "row"))
            duplicates = np.flatnonzero(entries["id"][1:] == entries["id"][:-1])
            if duplicates.size:
                first, second = entries[duplicates[0]], entries[duplicates[0] + 1]
                second_place, first_place = (
                    f"row {entry['row']} of {files[entry['file']]}" for entry in (second, first)
                )
                raise BadInput(
                    f"{files[second['file']]}: column {column}: {second['id']} is in {second_place} and in "
                    f"{first_place}"
                )
        shutil.rmtree(self.folder)
