"""How a published table is read: through its manifest, never a glob, every byte compared before it is decoded.

version(root, name)     a published version (resolved once: a later publication does not mix in)
for_request             the one that a request's next table is made of
Version.dataset, .rows  its files as an Arrow dataset; rows of some columns or parts
Version.beside, .file   rows of a Parquet file that is not of its table; any other file, such as an image
Version.margin, .in_cells, .cone  rows just outside a part's cell, in HEALPix cells, in a circle by either position
verify                  is a version what its manifest says?
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache, reduce
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds

from lake_schema import arguments, sky
from lake_schema import tables as declarations
from lake_schema.arrays import Int
from lake_schema.columns import Table
from lake_schema.errors import BadInput, Damaged, VersionMismatch
from lake_schema.store import layout, manifest, parquet, request_links
from lake_schema.store.object_storage.s3 import Folder, ObjectPath
from lake_schema.store.provenance import digest

# Which positions of a catalogue's sources a selection goes by.
POSITION_KINDS = ("observed", "true")
# So many stretches of _healpix_29 go into the filter of one file; the rest of its rows are left out after reading.
_MAX_RANGES = 16
# Added to a padded radius: more than the rounding of the largest deflection.
_ROUNDING_DEG = 1e-9


@dataclass(frozen=True, slots=True)
class Version:
    """One published version of a table.

    schema : of its rows, with units and descriptions in the fields' metadata
    """

    folder: Folder
    manifest: manifest.Manifest
    schema: pa.Schema

    def __hash__(self) -> int:
        return hash((self.folder, self.key))

    @property
    def table(self) -> str:
        return str(self.manifest["table"])

    @property
    def key(self) -> str:
        """What stands for this version in the plan of a table made from it."""
        return str(self.manifest["key"])

    @property
    def fingerprint(self) -> str:
        """sha256 over the sha256 of every file, hexadecimal: what the version holds, whatever it was made from."""
        return digest({entry["path"]: entry["sha256"] for entry in self.manifest["files"]})

    @property
    def num_rows(self) -> int:
        return int(self.manifest["rows"])

    @property
    def partitions(self) -> list[str]:
        return [str(entry["name"]) for entry in self.manifest["parts"]]

    def partition_path(self, partition: str) -> Path:
        """A part's Parquet file for a reader of somebody else's: only its size is compared; or a copy, as of `file`."""
        path = manifest.check_size(self.folder, self._partition_entry(partition))
        return path.download(self.partition_sha256(partition)) if isinstance(path, ObjectPath) else path

    def partition_sha256(self, partition: str) -> str:
        """sha256 of a part's Parquet file, as it was published."""
        return str(self._partition_entry(partition)["sha256"])

    def partition_rows(self, partition: str) -> int:
        """Number of rows of a part."""
        return int(self._partition_entry(partition)["rows"])

    def _partition_entry(self, partition: str) -> dict[str, Any]:
        entries = self._entries_by_path()
        for prefix in (f"{self.table}/dataset/", "dataset/"):
            if (entry := entries.get(prefix + partition)) is not None:
                return entry
        raise BadInput(f"table {self.table}: version {self.key} has no part {partition}")

    def sidecar_path(self, relative: str) -> Path:
        """Any other file, such as an image; Damaged where its sha256 is not what the manifest says.

        Of a lake on object storage it is a copy, in a temporary folder that goes with the process.
        """
        return manifest.check_contents(self.folder, self._file_entry(relative))

    def sidecar_folder(self, relative: str) -> Path:
        """A folder of files beside the table; of a lake on object storage one with copies of them.  Errors: Damaged"""
        folder = self.folder / relative
        if isinstance(folder, Path):
            return folder
        copies = [self.sidecar_path(path) for path in self._entries_by_path() if path.startswith(f"{relative}/")]
        return folder.gather_copies(copies)

    def has_file(self, relative: str) -> bool:
        """Whether there is such a file."""
        return relative in self._entries_by_path()

    def file_sha256(self, relative: str) -> str:
        """sha256 of such a file, as it was published."""
        return str(self._file_entry(relative)["sha256"])

    def _file_entry(self, relative: str) -> dict[str, Any]:
        entry = self._entries_by_path().get(relative)
        if entry is None:
            raise BadInput(f"table {self.table}: version {self.key} has no file {relative}")
        return entry

    def _entries_by_path(self) -> dict[str, dict[str, Any]]:
        return self.manifest.by_path

    def dataset(self, partitions: Iterable[str] | None = None) -> parquet.Dataset:
        """The version's files (or those parts') as an Arrow dataset that refuses what is not as it was written."""
        entries = [
            self._partition_entry(partition) for partition in (self.partitions if partitions is None else partitions)
        ]
        return self._open_dataset(entries, self.schema)

    def _open_dataset(self, entries: Sequence[dict[str, Any]], schema: pa.Schema) -> parquet.Dataset:
        for entry in entries:
            manifest.check_size(self.folder, entry)
        with self._errors_as_damaged():
            return parquet.open_dataset(self.folder, entries, schema)

    @contextmanager
    def _errors_as_damaged(self) -> Iterator[None]:
        """What Arrow cannot read although it is as it was written."""
        try:
            yield
        except (OSError, pa.ArrowInvalid) as error:
            raise Damaged(f"table {self.table}: version {self.key}: {error}") from None

    def rows(
        self,
        columns: Sequence[str] | None = None,
        partitions: Iterable[str] | None = None,
        where: ds.Expression | None = None,
    ) -> pa.Table:
        """Rows in file order.

        columns : names, None = all;  parts : names of parts, None = all;  where : an Arrow filter
        """
        self._check_columns(columns or ())
        with self._errors_as_damaged():
            return self.dataset(partitions).to_table(columns=None if columns is None else list(columns), filter=where)

    def read_margin(self, partition: str, columns: Sequence[str] | None = None) -> pa.Table:
        """Rows of a catalogue beside a part's cell, within 10" of it and a little farther."""
        self._check_columns(columns or ())
        entry = self._file_entry(f"{self.table}_margin/dataset/{partition}")
        with self._errors_as_damaged():
            return self._open_dataset([entry], self.schema).to_table(columns=None if columns is None else list(columns))

    def read_sidecar(self, relative: str) -> pa.Table:
        """Rows of a Parquet file of the version that is no part of its table."""
        entry = self._file_entry(relative)
        manifest.check_size(self.folder, entry)
        with self._errors_as_damaged():
            return parquet.read(self.folder, entry)

    def _check_columns(self, columns: Sequence[str]) -> None:
        """Raise BadInput if the table lacks one of the columns."""
        for name in columns:
            if name not in self.schema.names:
                raise BadInput(f"table {self.table} has no column {name}")

    def rows_in_cells(self, cells: Sequence[int], order: int, columns: Sequence[str] | None = None) -> pa.Table:
        """Rows of a catalogue inside cells of an order (nested), reading only files and row groups that can hold some.

        cells : int[n]
        """
        unique_cells = np.unique(np.asarray(cells, np.int64))
        names = None if columns is None else list(dict.fromkeys([*columns, "_healpix_29"]))
        empty = self.schema.empty_table()
        self._check_columns(names or ())
        pieces = [empty if names is None else empty.select(names)]
        for partition in self.partitions:
            cells_in_partition = _cells_in_partition(partition, unique_cells, order)
            if cells_in_partition.size:
                pieces.append(self.rows(names, [partition], _range_filter(_ranges(cells_in_partition, order))))
        rows = pa.concat_tables(pieces)
        inside = np.isin(sky.parent(rows["_healpix_29"].to_numpy(), sky.MAX_ORDER, order), unique_cells)
        rows = rows.filter(pa.array(inside))
        return rows if columns is None else rows.select(list(columns))

    def cone(
        self, ra: float, dec: float, radius: float, columns: Sequence[str] | None = None, on: str = "observed"
    ) -> pa.Table:
        """Rows of a catalogue within `radius` of a place, its edge included.

        ra, dec, radius : deg
        on              : "observed" or "true", which of a source's positions counts
        columns         : that are wanted; None: all of them
        Errors          : BadInput for a place or radius outside its bounds, or a column that is not there
        """
        radius = arguments.check_number("radius", radius, 0.0, 180.0)
        sky.check_positions(arguments.check_number("ra", ra), arguments.check_number("dec", dec))
        position_names = self.position_columns(on)
        self._check_columns([*position_names, "_healpix_29"])
        # Files go by observed positions: a source may lie so far beyond the cells of its true one.
        padded = radius if position_names == ("ra", "dec") else radius + self.max_deflection() + _ROUNDING_DEG
        order = sky.cover_order(padded)
        names = None if columns is None else list(dict.fromkeys([*columns, *position_names]))
        rows = self.rows_in_cells(sky.cells_in_cone(ra, dec, min(padded, 180.0), order).tolist(), order, names)
        lon, lat = (rows[name].to_numpy() for name in position_names)
        rows = rows.filter(pa.array(sky.separation(lon, lat, ra, dec) <= radius))
        return rows if columns is None else rows.select(list(columns))

    def position_columns(self, on: str = "observed") -> tuple[str, str]:
        """Columns of ra and dec of a catalogue's observed or true positions: the same ones if nothing lenses it.

        on : one of ON;  Errors : BadInput for another
        """
        if on not in POSITION_KINDS:
            raise BadInput(f"on = {on!r} is not one of {', '.join(POSITION_KINDS)}")
        return ("ra_true", "dec_true") if on == "true" and "ra_true" in self.schema.names else ("ra", "dec")

    def max_deflection(self) -> float:
        """Largest distance of a lensed from its true position, deg, as it was when the version was published."""
        if "deflection_deg" not in self.manifest:
            raise BadInput(f"table {self.table}: version {self.key} does not say how far positions are lensed")
        return float(self.manifest["deflection_deg"])


def _cells_in_partition(partition: str, cells: Int, order: int) -> Int:
    """Those of the cells that a part's cell overlaps."""
    file_order, cell = layout.cell_of_file(partition)
    if file_order <= order:
        inside: Int = cells[sky.parent(cells, order, file_order) == cell]
    else:
        inside = cells[cells == cell >> (2 * (file_order - order))]
    return inside


def _ranges(cells: Int, order: int) -> list[tuple[int, int]]:
    """Half-open stretches of order-29 indices that cover sorted cells: at most _MOST_RANGES, widest gaps left out."""
    gaps = np.diff(cells)
    cuts = np.flatnonzero(gaps > 1)
    if cuts.size >= _MAX_RANGES:
        cuts = np.sort(cuts[np.argsort(gaps[cuts])[-_MAX_RANGES + 1 :]])
    firsts, lasts = cells[np.append(0, cuts + 1)], cells[np.append(cuts, -1)]
    return [
        (sky.cell_range(order, int(first))[0], sky.cell_range(order, int(last))[1])
        for first, last in zip(firsts, lasts, strict=True)
    ]


def _range_filter(ranges: Sequence[tuple[int, int]]) -> ds.Expression:
    index = pc.field("_healpix_29")
    return reduce(lambda a, b: a | b, [(index >= first) & (index < last) for first, last in ranges])


# ------------------------------------------------------------------------------------------------ versions


def version(root: Folder, name: str, key: str | None = None, request: str | None = None) -> Version:
    """A published version of a table: the one of a key, or of a request; without these, the one published last.

    root : of the lake;  name : of the table

    Errors : BadInput where the lake has no such table, version or request, or where several requests have versions of
             their own and none is named; Damaged where its manifest is missing, broken or another's; VersionMismatch
             where it was written with a declaration that this code cannot read
    """
    selected_key = key or _select_key(root, name, request)
    if selected_key is None:
        raise BadInput(f"lake {root} has no table {name}" + (f" of request {request}" if request else ""))
    return _open_version(root, name, selected_key, is_requested=key is not None, link=_link(root, name, request))


def input_version(root: Folder, name: str, request: str) -> Version:
    """What the next table of a request is made of: its own version of a table, else the one that was published last.

    The second is for requests that share a catalogue.  Errors: as `version`
    """
    request_key = request_links.linked_key(root, request, name)
    return latest_version(root, name) if request_key is None else version(root, name, request=request)


def latest_version(root: Folder, name: str) -> Version:
    """The version that `current` leads to, whichever request it belongs to.  Errors: as `version`"""
    current_key = layout.current_key(root, name)
    if current_key is None:
        raise BadInput(f"lake {root} has no table {name}")
    return _open_version(root, name, current_key, is_requested=False, link=layout.current_link(root, name))


def _select_key(root: Folder, name: str, request: str | None) -> str | None:
    if request is not None:
        return request_links.linked_key(root, request_links.check_request(root, request), name)
    if len(set((keys_by_request := request_links.keys_by_request(root, name)).values())) > 1:
        requests = f"requests {', '.join(keys_by_request)} have versions of their own of table {name}"
        raise BadInput(f"lake {root}: {requests}: name one of them")
    return layout.current_key(root, name)


def _link(root: Folder, name: str, request: str | None) -> Folder:
    return layout.current_link(root, name) if request is None else layout.request_link(root, request, name)


def _open_version(root: Folder, name: str, key: str, is_requested: bool, link: Folder) -> Version:
    folder = layout.version_folder(root, name, key)
    if not folder.exists():
        if is_requested:
            raise BadInput(f"lake {root} has no table {name} of version {key}")
        raise Damaged(f"{link} leads to {folder.name}, which is missing")
    published = Version(folder, manifest.load(folder, name), pa.schema([]))
    if published.partitions:
        entry = published._partition_entry(published.partitions[0])
        path = manifest.check_size(folder, entry)
        with published._errors_as_damaged():
            state = manifest.file_state(path) if isinstance(path, Path) else ()
            if (schema := published.manifest.schemas.get(state)) is None:
                schema = published.manifest.schemas[state] = parquet.read_schema(folder, entry)
        published = replace(published, schema=schema)
    declaration = declarations.find_table(name, published.schema.names)
    return published if declaration is None else with_declared_schema(published, declaration)


def with_declared_schema(published: Version, table: Table) -> Version:
    """The version with the schema that `table` declares.

    Errors : VersionMismatch, naming both versions or the first column that differs
    """
    # To Arrow schemas are equal whatever their units.
    units = tuple((column.metadata or {}).get(b"unit", b"") for column in published.schema)
    return replace(
        published, schema=_declared_schema(published.schema, units, int(published.manifest["version"]), table)
    )


@lru_cache(maxsize=64)
def _declared_schema(stored: pa.Schema, units: tuple[bytes, ...], stored_version: int, table: Table) -> pa.Schema:
    if stored_version != table.version:
        # Numbers of development versions do not tell which is the later one.
        raise VersionMismatch(
            f"table {table.name}: another version of truesky wrote it: "
            f"its declaration is of version {stored_version}, this truesky reads version {table.version}"
        )
    if stored.names and (fault := _difference(stored, table)):
        raise VersionMismatch(f"table {table.name}: {fault}: another truesky wrote it")
    return table.arrow_schema()


def _difference(stored: pa.Schema, table: Table) -> str:
    for name in stored.names:
        if name not in table.names:
            return f"column {name} is not declared"
    for column in table.columns:
        if column.name not in stored.names:
            return f"column {column.name} is missing"
        have, want = stored.field(column.name), column.field()
        if have.type != want.type or (have.nullable and not want.nullable):
            return f"column {column.name} is {have}, wanted {want}"
        unit = (have.metadata or {}).get(b"unit", b"").decode()
        if unit != column.unit:
            return f"column {column.name} has unit {unit!r}, wanted {column.unit!r}"
    return ""


def table_names(root: Folder) -> list[str]:
    """Names of the published tables, those that are damaged among them."""
    return layout.table_names(root)


def find_faults(published: Version, deep: bool = False) -> list[str]:
    """What is wrong with a version: a list of sentences, empty where all is well.

    deep : also the sha256 of every file, and that each cell holds only its own rows, sorted
    """
    return manifest.faults(published.folder, published.manifest, deep)
