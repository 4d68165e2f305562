"""Read published tables through their manifests; every byte is verified before it is decoded.

A version is resolved once, so a later publication does not change what is read.
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

# Positions of a catalogue's sources by which rows can be selected.
POSITION_KINDS = ("observed", "true")
# Largest number of ranges of _healpix_29 in the filter of one file; other rows outside the region are removed later.
_MAX_RANGES = 16
# Safety margin of a padded radius (deg), larger than the rounding error of the largest deflection.
_ROUNDING_DEG = 1e-9


@dataclass(frozen=True, slots=True)
class Version:
    """One published version of a table.

    Attributes
    ----------
    folder : Path or ObjectPath
        Folder of the version.
    manifest : Manifest
        Contents of its manifest.
    schema : pyarrow.Schema
        Schema of its rows; the metadata of its fields contain units and descriptions.
    """

    folder: Folder
    manifest: manifest.Manifest
    schema: pa.Schema

    def __hash__(self) -> int:
        return hash((self.folder, self.key))

    @property
    def table(self) -> str:
        """Name of the table."""
        return str(self.manifest["table"])

    @property
    def key(self) -> str:
        """Key of the version; plans of tables made from this version contain it."""
        return str(self.manifest["key"])

    @property
    def fingerprint(self) -> str:
        """sha256 (hexadecimal) of the sha256 of all files: it depends on the version's contents, not on its inputs."""
        return digest({entry["path"]: entry["sha256"] for entry in self.manifest["files"]})

    @property
    def num_rows(self) -> int:
        """Number of rows."""
        return int(self.manifest["rows"])

    @property
    def partitions(self) -> list[str]:
        """Names of the partitions in the order of the plan."""
        return [str(entry["name"]) for entry in self.manifest["parts"]]

    def partition_path(self, partition: str) -> Path:
        """Return the path of a partition's Parquet file for other readers; only its size is compared.

        On object storage, the file is copied and its sha256 is compared.
        """
        path = manifest.check_size(self.folder, self._partition_entry(partition))
        return path.download(self.partition_sha256(partition)) if isinstance(path, ObjectPath) else path

    def partition_sha256(self, partition: str) -> str:
        """Return the sha256 of a partition's Parquet file when it was published."""
        return str(self._partition_entry(partition)["sha256"])

    def partition_rows(self, partition: str) -> int:
        """Return the number of rows of a partition."""
        return int(self._partition_entry(partition)["rows"])

    def _partition_entry(self, partition: str) -> dict[str, Any]:
        entries = self._entries_by_path()
        for prefix in (f"{self.table}/dataset/", "dataset/"):
            if (entry := entries.get(prefix + partition)) is not None:
                return entry
        raise BadInput(f"table {self.table}: version {self.key} has no partition {partition}")

    def sidecar_path(self, relative: str) -> Path:
        """Return the path of another file of the version, such as an image, after comparing its sha256.

        On object storage, it is copied to a temporary folder that is removed when the process ends.

        Raises
        ------
        Damaged
            If the file differs from the manifest.
        """
        return manifest.check_contents(self.folder, self._file_entry(relative))

    def sidecar_folder(self, relative: str) -> Path:
        """Return a folder with further files of the version; on object storage, they are copied to a temporary folder.

        Raises
        ------
        Damaged
            If a copied file differs from the manifest.
        """
        folder = self.folder / relative
        if isinstance(folder, Path):
            return folder
        copies = [self.sidecar_path(path) for path in self._entries_by_path() if path.startswith(f"{relative}/")]
        return folder.gather_copies(copies)

    def has_file(self, relative: str) -> bool:
        """Return True if the version contains a file of this relative path."""
        return relative in self._entries_by_path()

    def file_sha256(self, relative: str) -> str:
        """Return the sha256 of a file when it was published."""
        return str(self._file_entry(relative)["sha256"])

    def _file_entry(self, relative: str) -> dict[str, Any]:
        entry = self._entries_by_path().get(relative)
        if entry is None:
            raise BadInput(f"table {self.table}: version {self.key} has no file {relative}")
        return entry

    def _entries_by_path(self) -> dict[str, dict[str, Any]]:
        return self.manifest.by_path

    def dataset(self, partitions: Iterable[str] | None = None) -> parquet.Dataset:
        """Return the files of all or some partitions as an Arrow dataset that verifies what it reads."""
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
        """Turn errors of Arrow into Damaged; they occur if it cannot decode a file that matches the manifest."""
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
        """Return rows in the order of the files.

        Parameters
        ----------
        columns : sequence of str, optional
            Names of columns; by default all.
        partitions : iterable of str, optional
            Names of partitions; by default all.
        where : pyarrow.dataset.Expression, optional
            Filter of the rows.

        Returns
        -------
        pyarrow.Table
            The rows.

        Raises
        ------
        BadInput
            If a column or partition does not exist.
        Damaged
            If a file differs from the manifest.
        """
        self._check_columns(columns or ())
        with self._errors_as_damaged():
            return self.dataset(partitions).to_table(columns=None if columns is None else list(columns), filter=where)

    def read_margin(self, partition: str, columns: Sequence[str] | None = None) -> pa.Table:
        """Return the rows of a catalogue outside a partition's cell, up to 10" or slightly more from its edge."""
        self._check_columns(columns or ())
        entry = self._file_entry(f"{self.table}_margin/dataset/{partition}")
        with self._errors_as_damaged():
            return self._open_dataset([entry], self.schema).to_table(columns=None if columns is None else list(columns))

    def read_sidecar(self, relative: str) -> pa.Table:
        """Return the rows of a Parquet file of the version that does not belong to its table."""
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
        """Return the rows of a catalogue in HEALPix cells; only matching files and row groups are read.

        Parameters
        ----------
        cells : sequence of int
            Nested cells.
        order : int
            HEALPix order of the cells.
        columns : sequence of str, optional
            Names of columns; by default all.

        Returns
        -------
        pyarrow.Table
            The rows.
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
        """Return the rows of a catalogue within a circle, including its edge.

        Parameters
        ----------
        ra, dec : float
            Centre of the circle in deg.
        radius : float
            Radius in deg, 0 to 180.
        columns : sequence of str, optional
            Names of columns; by default all.
        on : str, optional
            Positions that are compared: "observed" or "true".

        Returns
        -------
        pyarrow.Table
            The rows.

        Raises
        ------
        BadInput
            If a coordinate or the radius is outside its bounds, or a column does not exist.
        """
        radius = arguments.check_number("radius", radius, 0.0, 180.0)
        sky.check_positions(arguments.check_number("ra", ra), arguments.check_number("dec", dec))
        position_names = self.position_columns(on)
        self._check_columns([*position_names, "_healpix_29"])
        # Files are sorted by observed positions, so a source can be this far from the cells of its true position.
        padded = radius if position_names == ("ra", "dec") else radius + self.max_deflection() + _ROUNDING_DEG
        order = sky.cover_order(padded)
        names = None if columns is None else list(dict.fromkeys([*columns, *position_names]))
        rows = self.rows_in_cells(sky.cells_in_cone(ra, dec, min(padded, 180.0), order).tolist(), order, names)
        lon, lat = (rows[name].to_numpy() for name in position_names)
        rows = rows.filter(pa.array(sky.separation(lon, lat, ra, dec) <= radius))
        return rows if columns is None else rows.select(list(columns))

    def position_columns(self, on: str = "observed") -> tuple[str, str]:
        """Return the columns of ra and dec of observed or true positions; both are equal in a table without lensing.

        Raises
        ------
        BadInput
            If `on` is not one of `POSITION_KINDS`.
        """
        if on not in POSITION_KINDS:
            raise BadInput(f"on = {on!r} is not one of {', '.join(POSITION_KINDS)}")
        return ("ra_true", "dec_true") if on == "true" and "ra_true" in self.schema.names else ("ra", "dec")

    def max_deflection(self) -> float:
        """Return the largest distance (deg) between observed and true positions when the version was published."""
        if "deflection_deg" not in self.manifest:
            raise BadInput(f"table {self.table}: the manifest of version {self.key} has no largest deflection")
        return float(self.manifest["deflection_deg"])


def _cells_in_partition(partition: str, cells: Int, order: int) -> Int:
    """Return the cells that overlap a partition's cell."""
    file_order, cell = layout.cell_of_file(partition)
    if file_order <= order:
        inside: Int = cells[sky.parent(cells, order, file_order) == cell]
    else:
        inside = cells[cells == cell >> (2 * (file_order - order))]
    return inside


def _ranges(cells: Int, order: int) -> list[tuple[int, int]]:
    """Return half-open ranges of order-29 indices that cover sorted cells.

    At most `_MAX_RANGES` ranges are returned, so only the widest gaps between the cells are left out.
    """
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
    """Return a published version of a table: by key or by request, else the one published last.

    Parameters
    ----------
    root : Path or ObjectPath
        Root of the lake.
    name : str
        Name of the table.
    key : str, optional
        Key of the version. It takes precedence over `request`.
    request : str, optional
        Name of the request whose version is returned.

    Returns
    -------
    Version
        The version.

    Raises
    ------
    BadInput
        If the lake has no such table, version or request, or if requests have different versions and neither a key nor
        a request is given.
    Damaged
        If the manifest is missing, broken or belongs to another version.
    VersionMismatch
        If this code cannot read the declaration with which the version was written.
    """
    selected_key = key or _select_key(root, name, request)
    if selected_key is None:
        raise BadInput(f"lake {root} has no table {name}" + (f" of request {request}" if request else ""))
    return _open_version(root, name, selected_key, is_requested=key is not None, link=_link(root, name, request))


def input_version(root: Folder, name: str, request: str) -> Version:
    """Return the version of a table from which a request's next table is made.

    This is the request's version, else the version that was published last (for requests that share a catalogue).

    Parameters
    ----------
    root : Path or ObjectPath
        Root of the lake.
    name : str
        Name of the table.
    request : str
        Name of the request.

    Returns
    -------
    Version
        The version.

    Raises
    ------
    BadInput, Damaged, VersionMismatch
        As in `version`.
    """
    request_key = request_links.linked_key(root, request, name)
    return latest_version(root, name) if request_key is None else version(root, name, request=request)


def latest_version(root: Folder, name: str) -> Version:
    """Return the version that was published last, of any request; it raises the errors of `version`."""
    current_key = layout.current_key(root, name)
    if current_key is None:
        raise BadInput(f"lake {root} has no table {name}")
    return _open_version(root, name, current_key, is_requested=False, link=layout.current_link(root, name))


def _select_key(root: Folder, name: str, request: str | None) -> str | None:
    if request is not None:
        return request_links.linked_key(root, request_links.check_request(root, request), name)
    if len(set((keys_by_request := request_links.keys_by_request(root, name)).values())) > 1:
        requests = f"requests {', '.join(keys_by_request)} have different versions of table {name}"
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
    """Return the version with the schema that `table` declares.

    Raises
    ------
    VersionMismatch
        If the declarations differ. The message names both versions or the first column that differs.
    """
    # Arrow ignores units when it compares schemas, so they are compared separately.
    units = tuple((column.metadata or {}).get(b"unit", b"") for column in published.schema)
    return replace(
        published, schema=_declared_schema(published.schema, units, int(published.manifest["version"]), table)
    )


@lru_cache(maxsize=64)
def _declared_schema(stored: pa.Schema, units: tuple[bytes, ...], stored_version: int, table: Table) -> pa.Schema:
    if stored_version != table.version:
        # Version numbers during development do not show which one is later.
        raise VersionMismatch(
            f"table {table.name}: written by another version of truesky: "
            f"it has version {stored_version} of the declaration, but this truesky reads version {table.version}"
        )
    if stored.names and (fault := _difference(stored, table)):
        raise VersionMismatch(f"table {table.name}: {fault}: written by another version of truesky")
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
            return f"column {column.name} is {have}, but must be {want}"
        unit = (have.metadata or {}).get(b"unit", b"").decode()
        if unit != column.unit:
            return f"column {column.name} has unit {unit!r}, but must have {column.unit!r}"
    return ""


def table_names(root: Folder) -> list[str]:
    """Return the names of the published tables, including damaged ones."""
    return layout.table_names(root)


def find_faults(published: Version, deep: bool = False) -> list[str]:
    """Return the faults of a version as sentences, empty for a sound version.

    If `deep`, the sha256 of every file is compared, and each cell is checked to contain only its own rows, sorted.
    """
    return manifest.faults(published.folder, published.manifest, deep)
