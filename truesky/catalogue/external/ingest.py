"""Galaxies of a finished catalogue: read once, checked, and laid out by order-5 cell for the workers.

files    what a request names, as a list of files, and the sha256 that stand for them
split    one pass over all files: every value checked, no identifier twice; pieces in the cache
rows     what is there of a generation cell
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
from truesky.numerics.code_keys import code_key

# Rows that are held before they are written to the pieces of their cells.
_MOST_HELD = 2_000_000
# Identifiers are compared in so many lots, each of which fits into memory.
_LOTS = 64
_SEEN = np.dtype([("id", np.int64), ("file", np.int32), ("row", np.int64)])
_ABOUT = "about.json"
# Columns of positions, the observed ones last.
_PLACES = (("ra", "dec"), ("ra_lensed", "dec_lensed"))


@dataclass(frozen=True, slots=True)
class Split:
    """A catalogue laid out by cell.

    folder : of the pieces;  sums : their CRC-32 by name;  rows : of all files;  z_max, ebv_max : the largest
    """

    folder: Path
    sums: Mapping[str, int]
    rows: int
    z_max: float
    ebv_max: float


def files(given: Sequence[Path], columns: Columns) -> tuple[list[Path], list[str]]:
    """(files in the order in which they are named, sha256 of each and of what stands beside it)."""
    found, every = listed(given, columns)
    return found, [file_sha256(file) for file in every]


def listed(given: Sequence[Path], columns: Columns) -> tuple[list[Path], list[Path]]:
    """(files in the order in which they are named, the same with what stands beside them)."""
    found = [file for path in given for file in external_rows.files(path)]
    if columns.beside:
        # A folder of such a set holds the other files, and tables of other things, as well.
        other = columns.beside[1]
        found = [f for f in found if f.name.startswith(columns.beside[0]) and not f.name.startswith(other)]
        if not found:
            raise BadInput(f"{given[0]}: no file whose name begins with {columns.beside[0]}")
    every = found + [mapping.file_beside(file, columns.beside) for file in found if columns.beside]
    for file in every:
        external_rows.looked_at(file)
    return found, every


def split(found: Sequence[Path], sha256: Sequence[str], columns: Columns) -> Split:
    """The pieces of a catalogue, from the cache or made now.

    Errors: BadInput or Damaged names file, column and row of what cannot be used
    """
    about = json.dumps([sorted((key, repr(field)) for key, field in columns.fields.items()), columns.beside])
    folder = cache_dir() / f"ingest-{content_key(code_key(__name__), about, *sha256)[:32]}"
    sums = _usable(folder)
    if sums is None:
        folder.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        try:
            facts = _made(made, found, columns)
            (made / _ABOUT).write_text(json.dumps(facts))
            cache.seal(made, sorted(path.relative_to(made).as_posix() for path in made.rglob("*") if path.is_file()))
            _publish(made, folder)
        finally:
            shutil.rmtree(made, ignore_errors=True)
        sums = _usable(folder)
    if sums is None:
        raise BadInput(f"cache {folder}: what was just written cannot be read")
    return Split(folder, sums, **json.loads((folder / _ABOUT).read_text()))


def _usable(folder: Path) -> dict[str, int] | None:
    sums = cache.sealed(folder)
    if sums is not None and not cache.is_whole(folder / _ABOUT, sums.get(_ABOUT, -1)):
        cache.discard(folder, f"{_ABOUT} is not what was written")
        return None
    return sums


def rows(given: Split, cell: int) -> dict[str, Array]:
    """Values by key of a generation cell's galaxies, with `index` (order-29), sorted by it, then by origin_id.

    Errors : Damaged where a piece is not what was written; they are made again by whoever next asks for the split
    """
    here = f"{cell >> 2 * (GENERATION_ORDER - FILE_ORDER)}/"
    pieces = [given.folder / name for name in sorted(given.sums) if name.startswith(here)]
    first, last = sky.cell_range(GENERATION_ORDER, cell)
    tables = []
    for piece in pieces:
        if not cache.is_whole(piece, given.sums[piece.relative_to(given.folder).as_posix()]):
            cache.discard(given.folder, f"{piece.name} is not what was written")
            raise Damaged(f"{piece} is not what was written; run again to have it made again")
        # Sorted by index: only what the cell wants is copied.
        table = feather.read_table(piece, memory_map=True)
        index = table["index"].to_numpy()
        tables.append(table.slice(*_extent(np.searchsorted(index, [first, last]))))
    if not tables:
        return {}
    found = {name: column.to_numpy() for name, column in zip(*_columns(pa.concat_tables(tables)), strict=True)}
    order = np.lexsort((found.get("origin_id", np.zeros(len(found["index"]), np.int64)), found["index"]))
    return {name: values[order] for name, values in found.items()}


def _extent(edges: Array) -> tuple[int, int]:
    return int(edges[0]), int(edges[1] - edges[0])


def _columns(table: pa.Table) -> tuple[list[str], list[pa.ChunkedArray]]:
    return table.column_names, table.columns


def _publish(made: Path, folder: Path) -> None:
    while True:
        try:
            return os.rename(made, folder)
        except FileExistsError:
            pass
        except OSError as error:
            if error.errno != errno.ENOTEMPTY:
                raise
        # Another process was as fast, or an older one died before it was done; then what is there is removed.
        if _usable(folder) is not None:
            return None


def _made(folder: Path, found: Sequence[Path], columns: Columns) -> dict[str, Any]:
    held: list[Rows] = []
    number = count = written = 0
    z_max = ebv_max = 0.0
    seen = _Seen(folder / "seen")
    for piece in mapping.read(found, columns):
        size = len(piece.values["ra"])
        if size:
            z_max = max(z_max, *(float(piece.values[k].max()) for k in ("z_true", "z_obs") if k in piece.values))
            ebv_max = max([ebv_max, *(float(piece.values[k].max()) for k in ("ebv", "ebv_1") if k in piece.values)])
        if "origin_id" in piece.values:
            seen.add(found.index(piece.file), piece)
        held.append(piece)
        number, count = number + size, count + size
        if number > _MOST_HELD:
            _write(folder, held, written)
            held, number, written = [], 0, written + 1
    _write(folder, held, written)
    seen.refuse_twice(found, columns.fields["origin_id"].column if "origin_id" in columns.fields else "")
    return {"rows": count, "z_max": z_max, "ebv_max": ebv_max}


def _write(folder: Path, held: Sequence[Rows], number: int) -> None:
    """Rows of every cell, that in which they are seen -> a piece of its own, sorted by index."""
    if not sum(len(piece.values["ra"]) for piece in held):
        return
    values = {name: np.concatenate([piece.values[name] for piece in held]) for name in held[0].values}
    for ra, dec in _PLACES:
        if ra in values:
            values[ra], values[dec] = sky.checked(values[ra], values[dec])
            # By where it is seen, where the catalogue says so.
            values["index"] = sky.healpix_29(values[ra], values[dec])
    order = np.argsort(values["index"], kind="stable")
    cells = values["index"][order] >> 2 * (sky.DEEPEST - FILE_ORDER)
    for cell in np.unique(cells).tolist():
        part = order[slice(*np.searchsorted(cells, [cell, cell + 1]))]
        (folder / str(cell)).mkdir(exist_ok=True)
        table = pa.table({name: column[part] for name, column in values.items()})
        feather.write_feather(table, folder / str(cell) / f"{number:06d}.arrow", compression="uncompressed")


class _Seen:
    """Identifiers with their file and row, in lots on disc: a catalogue has more than memory holds."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()

    def add(self, file: int, piece: Rows) -> None:
        """Remember the identifiers of some rows."""
        own = piece.values["origin_id"]
        entries = np.empty(own.size, _SEEN)
        entries["id"], entries["file"], entries["row"] = own, file, piece.first + np.arange(own.size)
        lot = (own % _LOTS).astype(np.int64)
        for one in np.unique(lot).tolist():
            with (self.folder / str(one)).open("ab") as stream:
                stream.write(entries[lot == one].tobytes())

    def refuse_twice(self, found: Sequence[Path], column: str) -> None:
        """Raise BadInput where one stands twice; the lots are removed."""
        for path in sorted(self.folder.iterdir()):
            entries = np.sort(np.fromfile(path, _SEEN), order=("id", "file", "row"))
            same = np.flatnonzero(entries["id"][1:] == entries["id"][:-1])
            if same.size:
                first, second = entries[same[0]], entries[same[0] + 1]
                here, there = (f"row {entry['row']} of {found[entry['file']]}" for entry in (second, first))
                raise BadInput(
                    f"{found[second['file']]}: column {column}: {second['id']} stands in {here} and in {there}"
                )
        shutil.rmtree(self.folder)
