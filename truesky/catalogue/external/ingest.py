"""Read and check the galaxies of a user's catalogue once, and store them by sky cell in the disc cache.

One pass over all files checks every value, and that no identifier occurs twice. The rows are stored in one Arrow file
or more per HEALPix cell of order 5. Each worker process then reads only the rows of its cells.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import feather

from lake_schema import sky, user_files
from lake_schema.arrays import Array
from lake_schema.errors import BadInput, Damaged
from lake_schema.external import rows as external_rows
from lake_schema.ids import FILE_ORDER, GENERATION_ORDER
from lake_schema.store.provenance import file_sha256
from truesky.catalogue.external import mapping, reading
from truesky.catalogue.external.mapping import Columns
from truesky.catalogue.external.reading import Rows
from truesky.cosmology import Cosmology
from truesky.fluxes.libraries import templates
from truesky.numerics import cache, cache_entries
from truesky.numerics.cache import cache_dir, content_key
from truesky.numerics.code_fingerprints import code_key
from truesky.request.area import Area
from truesky.request.files import Catalogue

# Number of rows that are collected in memory before they are written to the files of their cells.
_MAX_BUFFERED_ROWS = 2_000_000
# Number of groups into which identifiers are divided to find duplicates; each group must fit into memory.
_LOT_COUNT = 64
_ID_ENTRY = np.dtype([("id", np.int64), ("file", np.int32), ("row", np.int64)])
_SUMMARY_FILE = "about.json"
# Limits of right ascensions and declinations in radians.
_MAX_RADIANS = (6.3, 1.6)
# Columns (ra, dec) of true and of observed positions. The observed positions must be last, because `_write_cells` uses
# the last pair that a catalogue has.
_POSITION_COLUMNS = (("ra", "dec"), ("ra_lensed", "dec_lensed"))


@dataclass(frozen=True, slots=True)
class Split:
    """A user's catalogue of galaxies that is stored by HEALPix cell of order 5.

    Attributes
    ----------
    folder : Path
        Folder of the stored files, in the disc cache.
    checksums : mapping of str to int
        CRC-32 of each stored file by its path in the folder, such as "4711/000000.arrow" for the cell 4711.
    rows : int
        Number of rows of the whole catalogue.
    z_max, ebv_max : float
        Largest redshift, and largest E(B-V) in mag, of the whole catalogue; 0 without values.
    """

    folder: Path
    checksums: Mapping[str, int]
    rows: int
    z_max: float
    ebv_max: float


def galaxy_columns(catalogue: Catalogue, replaces_lensing: bool, cosmology: Cosmology) -> Columns:
    """Return which columns of a user's catalogue give which properties of galaxies, for the built-in templates.

    Parameters
    ----------
    catalogue : Catalogue
        Format and columns of the catalogue.
    replaces_lensing : bool
        True if the request replaces the lensing of the catalogue; columns with lensed positions are then left out.
    cosmology : Cosmology
        Parameters of the universe in which distances follow from redshifts.

    Returns
    -------
    Columns
        The mapping.

    Raises
    ------
    BadInput
        If the mapping in the request is wrong.
    """
    columns = mapping.galaxy_columns(catalogue.format, dict(catalogue.columns), cosmology)
    columns = mapping.with_last_template(columns, templates.galaxy_library().flux.shape[0] - 1)
    return mapping.drop_lensed_positions(columns) if replaces_lensing else columns


def files_with_checksums(paths: Sequence[Path], columns: Columns) -> tuple[list[Path], list[str]]:
    """Return the files of a user's catalogue, and the SHA-256 of each file, then of each companion file.

    A companion file contains further columns of the same rows. The files are in the order of `list_files`.
    """
    files, all_files = list_files(paths, columns)
    return files, [file_sha256(file) for file in all_files]


def list_files(paths: Sequence[Path], columns: Columns) -> tuple[list[Path], list[Path]]:
    """Return the files of a user's catalogue, and the same list followed by their companion files.

    A companion file contains further columns of the same rows. The files are in the order of `paths`; a folder stands
    for the files in it. Raises BadInput if there are no files or a file has a format that cannot be read.
    """
    files = [file for path in paths for file in external_rows.find_files(path)]
    if columns.companion_prefixes:
        # The folder also contains the companion files and unrelated tables: select by the beginning of the name.
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
    """Read and check a user's catalogue, and store its rows by sky cell, unless the disc cache already contains them.

    Parameters
    ----------
    files : sequence of Path
        Files of the catalogue, without companion files.
    sha256 : sequence of str
        SHA-256 of all files and companion files, by which the cache recognises the catalogue.
    columns : Columns
        Mapping from the columns of the files to the properties of galaxies.

    Returns
    -------
    Split
        The stored catalogue.

    Raises
    ------
    BadInput, Damaged
        If a file cannot be read, or has a missing, wrong or repeated value; the message names the file, the column and
        the row. Also if the stored files cannot be read back.
    """
    folder = cache_dir() / f"ingest-{_content_key(sha256, columns)[:32]}"
    checksums = _read_checksums(folder)
    if checksums is None:
        with cache.lock(folder):
            # Another process may have stored the catalogue while this one waited.
            if _read_checksums(folder) is None:
                _store(folder, files, columns)
            checksums = _read_checksums(folder)
    if checksums is None:
        raise BadInput(f"cache {folder}: the files written by this process cannot be read")
    return Split(folder, checksums, **json.loads((folder / _SUMMARY_FILE).read_text()))


def unit_hint(ra_limits: tuple[float, float], dec_limits: tuple[float, float], area: Area) -> str:
    """Return words that ask for degrees if the positions of all rows would fit hours or radians, or "".

    Parameters
    ----------
    ra_limits, dec_limits : (float, float)
        Smallest and largest coordinates of the rows.
    area : Area
        Area of the request. Right ascensions fit hours if they are then near it.

    Returns
    -------
    str
        The words, which continue an error message.
    """
    ra, dec, radius = area.bounding_circle()
    width = radius / max(float(np.cos(np.radians(dec))), 1e-3)
    in_deg, in_hours = (factor * ra_limits[0] - width <= ra <= factor * ra_limits[1] + width for factor in (1.0, 15.0))
    near_dec = dec_limits[0] - radius <= dec <= dec_limits[1] + radius
    if in_hours and not in_deg and near_dec and max(ra_limits) <= 24.0:
        return "; if the right ascensions are in hours, write ra = { column = .., scale = 15 }"
    fit = max(map(abs, ra_limits)) < _MAX_RADIANS[0] and max(map(abs, dec_limits)) < _MAX_RADIANS[1]
    return "; if the positions are in radians, convert them to degrees" if fit else ""


def check_area(split: Split, files: Sequence[Path], columns: Columns, area: Area) -> None:
    """Check that a stored catalogue has a galaxy in the area of a request.

    Parameters
    ----------
    split : Split
        The stored catalogue.
    files : sequence of Path
        Files of the catalogue.
    columns : Columns
        Mapping from the columns of the files to the properties of galaxies.
    area : Area
        Area of the request. Galaxies in the order-8 cells that it touches are used.

    Raises
    ------
    BadInput
        If no galaxy is in the area. The message names the file, the area and the range of the positions.
    """
    pieces = [name for name in sorted(split.checksums) if name.endswith(".arrow")]
    cells = np.asarray(area.cells(GENERATION_ORDER), np.int64)
    parents = set((cells >> 2 * (GENERATION_ORDER - FILE_ORDER)).tolist())

    def values(piece: str, column: str) -> Array:
        return np.asarray(feather.read_table(split.folder / piece, [column], memory_map=True)[column])

    for piece in pieces:
        if int(piece.partition("/")[0]) in parents:
            occupied = values(piece, "index") >> 2 * (sky.MAX_ORDER - GENERATION_ORDER)
            if np.isin(occupied, cells).any():
                return
    if not pieces:
        return
    keys = next(keys for keys in reversed(_POSITION_COLUMNS) if keys[0] in columns.fields)
    limits = []
    for key in keys:
        column = [values(piece, key) for piece in pieces]
        limits.append((min(float(part.min()) for part in column), max(float(part.max()) for part in column)))
    raise _outside_area(files, columns, keys, limits, area)


def _outside_area(
    files: Sequence[Path],
    columns: Columns,
    keys: Sequence[str],
    limits: Sequence[tuple[float, float]],
    area: Area,
) -> BadInput:
    """Return the error about a catalogue without rows in the area; `limits` are the ranges of its positions (deg)."""
    titles = [reading.column_titles(columns, key) for key in keys]
    ranges = " and ".join(f"{title} from {lo:g} to {hi:g}" for title, (lo, hi) in zip(titles, limits, strict=True))
    hint = unit_hint(limits[0], limits[1], area)
    more_files = f" and {len(files) - 1} more file{'s' if len(files) > 2 else ''}" if len(files) > 1 else ""
    place = f"{user_files.format_path(files[0])}{more_files}"
    return BadInput(f"{place}: no row is in the area, {area.describe()}: the rows have {ranges} deg{hint}")


def check_rows(files: Sequence[Path], sha256: Sequence[str], columns: Columns, area: Area | None = None) -> None:
    """Check every row of a user's catalogue, unless the disc cache says that the same files have been checked before.

    Parameters
    ----------
    files : sequence of Path
        Files of the catalogue, without companion files.
    sha256 : sequence of str
        SHA-256 of all files and companion files, by which the cache recognises the catalogue.
    columns : Columns
        Mapping from the columns of the files to properties.
    area : Area, optional
        Area of the request, in which at least one row must be; None for a table without positions.

    Raises
    ------
    BadInput
        If a file cannot be read, has a missing, wrong or repeated value, or if there are no rows, or none in the area.
        The message names the file, the column and the row.
    """
    keys = _POSITION_COLUMNS[0]

    def count_rows() -> dict[str, Array]:
        cells, lows, highs = [np.zeros(0, np.int64)], [], []
        cache_dir().mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=cache_entries.MAKING, dir=cache_dir()) as folder:
            identifiers, rows = _IdentifierStore(Path(folder) / "seen"), 0
            for piece in reading.read(files, columns):
                rows += len(next(iter(piece.values.values())))
                if "origin_id" in piece.values:
                    identifiers.add(files.index(piece.file), piece)
                if keys[0] in piece.values and piece.values[keys[0]].size:
                    ra, dec = (piece.values[key] for key in keys)
                    cells.append(np.unique(sky.cell_at(sky.wrap_angle(ra), dec, GENERATION_ORDER)))
                    lows.append((ra.min(), dec.min()))
                    highs.append((ra.max(), dec.max()))
            identifiers.refuse_duplicates(files, _identifier_title(columns))
        if not rows:
            raise _no_rows(files)
        limits = np.array([np.min(lows, axis=0), np.max(highs, axis=0)]) if lows else np.zeros((2, 2))
        return {"rows": np.array([rows]), "cells": np.unique(np.concatenate(cells)), "limits": limits}

    checked = cache.cached_arrays("checked_rows", _content_key(sha256, columns), count_rows)
    if area is not None and not np.isin(checked["cells"], area.cells(GENERATION_ORDER)).any():
        raise _outside_area(files, columns, keys, [tuple(pair) for pair in checked["limits"].T.tolist()], area)


def _no_rows(files: Sequence[Path]) -> BadInput:
    return BadInput(f"{user_files.format_path(files[0])}: the table has no rows")


def _content_key(sha256: Sequence[str], columns: Columns) -> str:
    fields = sorted((key, repr(field)) for key, field in columns.fields.items())
    settings = [columns.companion_prefixes, columns.ellipticity, columns.frame]
    bounds = sorted((key, *map(float, limits)) for key, limits in columns.bounds.items())
    cosmology = columns.cosmology.fingerprint()
    return content_key(code_key(__name__), json.dumps([fields, settings, bounds]), cosmology, *sha256)


def _identifier_title(columns: Columns) -> str:
    return columns.fields["origin_id"].column if "origin_id" in columns.fields else ""


def _read_checksums(folder: Path) -> dict[str, int] | None:
    checksums = cache.stored_checksums(folder)
    if checksums is not None and not cache.is_intact(folder / _SUMMARY_FILE, checksums.get(_SUMMARY_FILE, -1)):
        cache.discard(folder, f"{_SUMMARY_FILE} is not what was written")
        return None
    return checksums


def rows_of_cell(split: Split, cell: int) -> dict[str, Array]:
    """Return the galaxies of a stored catalogue whose positions are in a HEALPix cell of order 8.

    Parameters
    ----------
    split : Split
        The stored catalogue.
    cell : int
        Nested index of the order-8 cell.

    Returns
    -------
    dict of str to array, shape (n,)
        Values by name of the property, with `index` (the order-29 cell of the position), sorted by index, then by
        origin_id (the identifier in the user's catalogue). An empty dict if the catalogue has no galaxies in the
        order-5 cell around the cell.

    Raises
    ------
    Damaged
        If a stored file of this part of the sky has changed on disk. The stored catalogue is then deleted, and the next
        call of `split_by_cell` makes it again.
    """
    prefix = f"{cell >> 2 * (GENERATION_ORDER - FILE_ORDER)}/"
    pieces = [split.folder / name for name in sorted(split.checksums) if name.startswith(prefix)]
    first, last = sky.cell_range(GENERATION_ORDER, cell)
    tables = []
    for piece in pieces:
        if not cache.is_intact(piece, split.checksums[piece.relative_to(split.folder).as_posix()]):
            cache.discard(split.folder, f"{piece.name} is not what was written")
            raise Damaged(f"{piece} has changed on disk and was deleted; run again to rebuild it")
        # The rows of a stored file are sorted by index, so the rows of the cell are one slice of the memory map.
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


def _store(folder: Path, files: Sequence[Path], columns: Columns) -> None:
    with cache_entries.staging_folder(folder) as staged:
        summary = _write_pieces(staged, files, columns)
        (staged / _SUMMARY_FILE).write_text(json.dumps(summary))
        cache.store_checksums(
            staged, sorted(path.relative_to(staged).as_posix() for path in staged.rglob("*") if path.is_file())
        )
        cache.publish(staged, folder)


def _write_pieces(folder: Path, files: Sequence[Path], columns: Columns) -> dict[str, Any]:
    buffered: list[Rows] = []
    buffered_rows = count = piece_number = 0
    z_max = ebv_max = 0.0
    identifiers = _IdentifierStore(folder / "seen")
    for piece in reading.read(files, columns):
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
    identifiers.refuse_duplicates(files, _identifier_title(columns))
    if not count:
        raise _no_rows(files)
    return {"rows": count, "z_max": z_max, "ebv_max": ebv_max}


def _write_cells(folder: Path, pieces: Sequence[Rows], piece_number: int) -> None:
    """Write the rows of each order-5 cell to a new Arrow file in the folder of the cell, sorted by position.

    The position is `index`, the nested index of the order-29 cell. `piece_number` is the name of the new files.
    """
    if not sum(len(piece.values["ra"]) for piece in pieces):
        return
    values = {name: np.concatenate([piece.values[name] for piece in pieces]) for name in pieces[0].values}
    for ra, dec in _POSITION_COLUMNS:
        if ra in values:
            values[ra], values[dec] = sky.check_positions(values[ra], values[dec])
            # The observed positions, which come last, determine the cell if the catalogue has them.
            values["index"] = sky.healpix_29(values[ra], values[dec])
    order = np.argsort(values["index"], kind="stable")
    cells = values["index"][order] >> 2 * (sky.MAX_ORDER - FILE_ORDER)
    for cell in np.unique(cells).tolist():
        members = order[slice(*np.searchsorted(cells, [cell, cell + 1]))]
        (folder / str(cell)).mkdir(exist_ok=True)
        table = pa.table({name: column[members] for name, column in values.items()})
        feather.write_feather(table, folder / str(cell) / f"{piece_number:06d}.arrow", compression="uncompressed")


class _IdentifierStore:
    """Store of all identifiers of a catalogue with their file and row, in order to find duplicates.

    They are stored in groups in a folder, because together they may not fit into memory.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()

    def add(self, file: int, piece: Rows) -> None:
        """Store the identifiers of rows; `file` is the number of the file that contains the rows."""
        identifiers = piece.values["origin_id"]
        entries = np.empty(identifiers.size, _ID_ENTRY)
        entries["id"], entries["file"], entries["row"] = identifiers, file, piece.first + np.arange(identifiers.size)
        lot = (identifiers % _LOT_COUNT).astype(np.int64)
        for lot_number in np.unique(lot).tolist():
            with (self.folder / str(lot_number)).open("ab") as stream:
                stream.write(entries[lot == lot_number].tobytes())

    def refuse_duplicates(self, files: Sequence[Path], column: str) -> None:
        """Raise BadInput if an identifier occurs twice in the catalogue; otherwise delete the folder of the groups."""
        for path in sorted(self.folder.iterdir()):
            entries = np.sort(np.fromfile(path, _ID_ENTRY), order=("id", "file", "row"))
            duplicates = np.flatnonzero(entries["id"][1:] == entries["id"][:-1])
            if duplicates.size:
                first, second = entries[duplicates[0]], entries[duplicates[0] + 1]
                file = user_files.format_path(files[second["file"]])
                if first["file"] == second["file"]:
                    places = f"rows {first['row']} and {second['row']}"
                else:
                    other = user_files.format_path(files[first["file"]])
                    places = f"row {second['row']} and in row {first['row']} of {other}"
                problem = f"the value {second['id']} is in {places}, but every value must be different"
                raise BadInput(f"{file}: column {column}: {problem}")
        shutil.rmtree(self.folder)
