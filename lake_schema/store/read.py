"""Read published tables of a lake; every byte is compared with the checksums in the manifest before it is decoded.

Each publication of a table is a new version, an immutable folder with a manifest (list of its files). A reader selects
a version once. If another version is published later, the reader still gets the rows of the selected one.
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
from lake_schema.errors import BadInput, Damaged, OutOfRange, VersionMismatch
from lake_schema.store import layout, manifest, parquet, request_links
from lake_schema.store.object_storage.s3 import Folder, ObjectPath
from lake_schema.store.provenance import digest
from lake_schema.texts import spelling

# Positions of a catalogue's sources by which rows can be selected: with and without the deflection by lensing.
POSITION_KINDS = ("observed", "true")
# Largest number of ranges of the column _healpix_29 in the filter with which a file is read. Rows in the ranges but
# outside the requested cells are removed after reading.
_MAX_RANGES = 16
# Safety margin (deg) added to the radius of a search around true positions, above the rounding error of deflections.
_ROUNDING_DEG = 1e-9
# Commands of truesky that make the inputs of later commands, in their order, with the tables.
_COMMANDS = {
    "build": ("galaxies", "halos", "halo_limits", "stars"),
    "fluxes": ("galaxy_fluxes", "star_fluxes"),
    "plan": ("mission", "exposures", "tasks"),
}
# Commands that make optional tables.
OPTIONAL_TABLES = {
    "strong_lenses": "lenses", "transients": "transients", "active_nuclei": "nuclei", "lensed_images": "lensed",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Version:
    """One published version of a table, opened for reading.

    Parameters
    ----------
    folder : Path or ObjectPath
        Folder of the version.
    manifest : Manifest
        Manifest of the version: its files with checksums, and the facts from which it was made.
    schema : pyarrow.Schema
        Schema of the rows; the metadata of its fields contain units and descriptions.
    """

    folder: Folder
    manifest: manifest.Manifest
    schema: pa.Schema

    def __hash__(self) -> int:
        return hash((self.folder, self.key))

    @property
    def table(self) -> str:
        """Name of the table, such as "galaxies"."""
        return str(self.manifest["table"])

    @property
    def key(self) -> str:
        """Key of the version: 16 hexadecimal digits of a hash of everything from which it was made.

        Tables that are made from this version record the key as one of their inputs.
        """
        return str(self.manifest["key"])

    @property
    def fingerprint(self) -> str:
        """Hexadecimal sha256 of the list of all files, each with its path and its own sha256.

        Unlike the key, it is equal for two versions that have equal files but were made from different inputs.
        """
        return digest({entry["path"]: entry["sha256"] for entry in self.manifest["files"]})

    @property
    def num_rows(self) -> int:
        """Number of rows in all partitions."""
        return int(self.manifest["rows"])

    @property
    def partitions(self) -> list[str]:
        """Names of the partitions (Parquet files), in the order in which the manifest lists them."""
        return [str(entry["name"]) for entry in self.manifest["parts"]]

    def partition_path(self, partition: str) -> Path:
        """Return the path of a partition's Parquet file, for programs other than truesky.

        Only its size is compared with the manifest. On object storage, the file is copied to a temporary folder, and
        its sha256 is compared.

        Parameters
        ----------
        partition : str
            Name of the partition.

        Returns
        -------
        Path
            Path of a file on this machine.

        Raises
        ------
        BadInput
            If the version has no such partition.
        Damaged
            If the file differs from the manifest.
        """
        path = manifest.check_size(self.folder, self._partition_entry(partition))
        return path.download(self.partition_sha256(partition)) if isinstance(path, ObjectPath) else path

    def partition_sha256(self, partition: str) -> str:
        """Return the sha256 of a partition's Parquet file according to the manifest; the file is not read.

        Parameters
        ----------
        partition : str
            Name of the partition.

        Returns
        -------
        str
            The sha256, 64 hexadecimal digits.

        Raises
        ------
        BadInput
            If the version has no such partition.
        """
        return str(self._partition_entry(partition)["sha256"])

    def partition_rows(self, partition: str) -> int:
        """Return the number of rows of a partition according to the manifest.

        Parameters
        ----------
        partition : str
            Name of the partition.

        Returns
        -------
        int
            Number of rows.

        Raises
        ------
        BadInput
            If the version has no such partition.
        """
        return int(self._partition_entry(partition)["rows"])

    def _partition_entry(self, partition: str) -> dict[str, Any]:
        entries = self._entries_by_path()
        for prefix in (f"{self.table}/dataset/", "dataset/"):
            if (entry := entries.get(prefix + partition)) is not None:
                return entry
        raise BadInput(f"table {self.table}: version {self.key} has no partition {partition}")

    def sidecar_path(self, relative: str) -> Path:
        """Return the path of a file of the version that is not a partition, such as an image.

        The sha256 of the file is first compared with the manifest. On object storage, the file is copied to a temporary
        folder, which is removed when no object in memory refers to the opened lake any more.

        Parameters
        ----------
        relative : str
            Path of the file in the folder of the version.

        Returns
        -------
        Path
            Path of a file on this machine.

        Raises
        ------
        BadInput
            If the manifest does not list the file.
        Damaged
            If the file is missing or differs from the manifest.
        """
        return manifest.check_contents(self.folder, self._file_entry(relative))

    def sidecar_paths(self, relatives: Sequence[str]) -> list[Path]:
        """Return the paths of files that must lie in one folder, such as an image and its head file.

        Each file is verified as in `sidecar_path`. On object storage, all are copied to the same temporary folder.

        Parameters
        ----------
        relatives : sequence of str
            Paths of the files in the folder of the version, at least one.

        Returns
        -------
        list of Path
            Paths of files on this machine, in the same order.

        Raises
        ------
        BadInput, Damaged
            As for `sidecar_path`.
        """
        copies = [self.sidecar_path(relative) for relative in relatives]
        if isinstance(self.folder, Path):
            return copies
        folder = (self.folder / relatives[0]).parent.gather_copies(copies)
        return [folder / copy.name for copy in copies]

    def sidecar_folder(self, relative: str) -> Path:
        """Return the path of a folder of the version, such as its folder of images.

        The files in a folder on disc are not checked. On object storage, all files in the folder are copied to a
        temporary folder after their sha256 have been compared.

        Parameters
        ----------
        relative : str
            Path of the folder in the folder of the version.

        Returns
        -------
        Path
            Path of a folder on this machine.

        Raises
        ------
        Damaged
            If the folder or a folder above it in the version is a symbolic link, or a copied file differs from the
            manifest.
        """
        if isinstance(self.folder, Path):
            manifest.refuse_links(self.folder, relative)
            return self.folder / relative
        copies = [self.sidecar_path(path) for path in self._entries_by_path() if path.startswith(f"{relative}/")]
        return (self.folder / relative).gather_copies(copies)

    def has_file(self, relative: str) -> bool:
        """Return True if the manifest lists a file.

        Parameters
        ----------
        relative : str
            Path of the file in the folder of the version.

        Returns
        -------
        bool
            True if the manifest lists the path; whether the file exists is not checked.
        """
        return relative in self._entries_by_path()

    def file_sha256(self, relative: str) -> str:
        """Return the sha256 of a file according to the manifest; the file is not read.

        Parameters
        ----------
        relative : str
            Path of the file in the folder of the version.

        Returns
        -------
        str
            The sha256, 64 hexadecimal digits.

        Raises
        ------
        BadInput
            If the manifest does not list the file.
        """
        return str(self._file_entry(relative)["sha256"])

    def _file_entry(self, relative: str) -> dict[str, Any]:
        entry = self._entries_by_path().get(relative)
        if entry is None:
            raise BadInput(f"table {self.table}: version {self.key} has no file {relative}")
        return entry

    def _entries_by_path(self) -> dict[str, dict[str, Any]]:
        return self.manifest.by_path

    def dataset(self, partitions: Iterable[str] | None = None) -> parquet.Dataset:
        """Return the files of all or some partitions as an Arrow dataset, which verifies all bytes that it reads.

        Parameters
        ----------
        partitions : iterable of str, optional
            Names of partitions; by default all.

        Returns
        -------
        Dataset
            The dataset, with the partitions in the given order.

        Raises
        ------
        BadInput
            If the version has no such partition.
        Damaged
            If a file is missing, or its size or footer differs from the manifest.
        """
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
        """Raise Damaged in place of an error of Arrow or of the operating system in the body of the `with` statement.

        Arrow raises such an error if it cannot decode a file, or if a checksum differs.
        """
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
        """Return the rows of all or some partitions, in the order of the partitions and of their rows.

        Parameters
        ----------
        columns : sequence of str, optional
            Names of columns; by default all.
        partitions : iterable of str, optional
            Names of partitions (Parquet files); by default all.
        where : pyarrow.dataset.Expression, optional
            Condition that the rows must satisfy; by default all rows are returned.

        Returns
        -------
        pyarrow.Table
            The rows.

        Raises
        ------
        BadInput
            If a column of `columns` or a partition does not exist.
        Damaged
            If a file differs from the manifest, or Arrow cannot apply `where`, for example because it names a column
            that does not exist.
        """
        self._check_columns(columns or ())
        with self._errors_as_damaged():
            return self.dataset(partitions).to_table(columns=None if columns is None else list(columns), filter=where)

    def read_margin(self, partition: str, columns: Sequence[str] | None = None) -> pa.Table:
        """Return the margin of a partition of a catalogue: the rows of other partitions close to its HEALPix cell.

        All rows up to 10 arcsec from the edge of the cell are returned, and some rows farther out.

        Parameters
        ----------
        partition : str
            Name of the partition.
        columns : sequence of str, optional
            Names of columns; by default all.

        Returns
        -------
        pyarrow.Table
            The rows, which may be an empty table.

        Raises
        ------
        BadInput
            If the partition or a column does not exist.
        Damaged
            If the file of the margin differs from the manifest.
        """
        self._check_columns(columns or ())
        entry = self._file_entry(f"{self.table}_margin/dataset/{partition}")
        with self._errors_as_damaged():
            return self._open_dataset([entry], self.schema).to_table(columns=None if columns is None else list(columns))

    def read_sidecar(self, relative: str) -> pa.Table:
        """Return the rows of a Parquet file in the folder of the version that is not a partition of the table.

        Parameters
        ----------
        relative : str
            Path of the file in the folder of the version.

        Returns
        -------
        pyarrow.Table
            All rows and columns of the file.

        Raises
        ------
        BadInput
            If the manifest does not list the file.
        Damaged
            If the file differs from the manifest.
        """
        entry = self._file_entry(relative)
        manifest.check_size(self.folder, entry)
        with self._errors_as_damaged():
            return parquet.read(self.folder, entry)

    def _check_columns(self, columns: Sequence[str]) -> None:
        """Raise BadInput if the table does not have all of the columns; the message names all missing ones."""
        existing = self.schema.names
        missing = [name for name in dict.fromkeys(columns) if name not in existing]
        questions = [spelling.did_you_mean(name, existing) for name in missing]
        if len(missing) == 1:
            remedy = questions[0] or f"it has {', '.join(existing)}"
            raise BadInput(f"table {self.table} has no column {missing[0]}; {remedy}")
        if missing:
            named = [
                f"{name} ({question})" if question else name for name, question in zip(missing, questions, strict=True)
            ]
            listed = "" if all(questions) else f"; it has {', '.join(existing)}"
            raise BadInput(f"table {self.table} has no column {spelling.join_words(named, 'and')}{listed}")

    def rows_in_cells(
        self,
        cells: Sequence[int],
        order: int,
        columns: Sequence[str] | None = None,
        where: ds.Expression | None = None,
    ) -> pa.Table:
        """Return the rows of a catalogue in some HEALPix cells; only files and row groups that may match are read.

        Parameters
        ----------
        cells : sequence of int
            Nested cells in any order; duplicates are ignored. Without cells, the result is empty.
        order : int
            HEALPix order of the cells.
        columns : sequence of str, optional
            Names of columns; by default all.
        where : pyarrow.dataset.Expression, optional
            Condition that the rows must satisfy; by default all rows are returned.

        Returns
        -------
        pyarrow.Table
            The rows, in the order of the partitions. BadInput is raised for an unknown column or a table without
            positions, Damaged for a changed file.
        """
        unique_cells = np.unique(np.asarray(cells, np.int64))
        names = None if columns is None else list(dict.fromkeys([*columns, "_healpix_29"]))
        empty = self.schema.empty_table()
        self._check_columns(names or ())
        pieces = [empty if names is None else empty.select(names)]
        for partition in self.partitions:
            cells_in_partition = _cells_in_partition(partition, unique_cells, order)
            if cells_in_partition.size:
                in_cells = _range_filter(_ranges(cells_in_partition, order))
                pieces.append(self.rows(names, [partition], in_cells if where is None else in_cells & where))
        rows = pa.concat_tables(pieces)
        inside = np.isin(sky.parent(rows["_healpix_29"].to_numpy(), sky.MAX_ORDER, order), unique_cells)
        rows = rows.filter(pa.array(inside))
        return rows if columns is None else rows.select(list(columns))

    def cone(
        self, ra: float, dec: float, radius: float, columns: Sequence[str] | None = None, on: str = "observed"
    ) -> pa.Table:
        """Return the rows of a catalogue inside or on the edge of a circle on the sky.

        Parameters
        ----------
        ra, dec : float
            Centre of the circle in deg.
        radius : float
            Radius in deg, 0 to 180.
        columns : sequence of str, optional
            Names of columns; by default all.
        on : str, optional
            Positions that are compared with the circle: "observed" (with the deflection by lensing) or "true".

        Returns
        -------
        pyarrow.Table
            The rows; an empty table if no row is in the circle.

        Raises
        ------
        BadInput
            If a coordinate or the radius is not a number within its bounds, a column does not exist, the table has no
            positions, or `on` has another value.
        Damaged
            If a file differs from the manifest.
        """
        radius = arguments.check_degrees("radius", radius, 0.0, 180.0)
        try:
            sky.check_positions(arguments.check_degrees("ra", ra), arguments.check_degrees("dec", dec))
        except OutOfRange as error:
            raise error.with_question(arguments.exchanged_question(ra, dec)) from None
        position_names = self.position_columns(on)
        self._check_columns([*position_names, "_healpix_29"])
        # Files are sorted by observed positions. Enlarge the circle by the largest deflection, so that it contains the
        # observed position of every source whose true position is inside.
        padded = radius if position_names == ("ra", "dec") else radius + self.max_deflection() + _ROUNDING_DEG
        order = sky.cover_order(padded)
        names = None if columns is None else list(dict.fromkeys([*columns, *position_names]))
        rows = self.rows_in_cells(sky.cells_in_cone(ra, dec, min(padded, 180.0), order).tolist(), order, names)
        lon, lat = (rows[name].to_numpy() for name in position_names)
        rows = rows.filter(pa.array(sky.separation(lon, lat, ra, dec) <= radius))
        return rows if columns is None else rows.select(list(columns))

    def position_columns(self, on: str = "observed") -> tuple[str, str]:
        """Return the names of the columns with the observed or true positions.

        Parameters
        ----------
        on : str, optional
            "observed" (with the deflection by lensing) or "true".

        Returns
        -------
        tuple of str
            Names of the columns of right ascension and declination. For "true" they are ra_true and dec_true, or ra and
            dec if the table has no such columns, because its sources are not lensed.

        Raises
        ------
        BadInput
            If `on` is not one of `POSITION_KINDS`.
        """
        if on not in POSITION_KINDS:
            raise BadInput(f"on = {on!r} is not one of {', '.join(POSITION_KINDS)}")
        return ("ra_true", "dec_true") if on == "true" and "ra_true" in self.schema.names else ("ra", "dec")

    def max_deflection(self) -> float:
        """Return the largest distance between the observed and the true position of a source.

        Returns
        -------
        float
            Distance from the manifest, deg.

        Raises
        ------
        BadInput
            If the manifest does not contain it, as for tables without true positions.
        """
        if "deflection_deg" not in self.manifest:
            raise BadInput(f"table {self.table}: the manifest of version {self.key} has no largest deflection")
        return float(self.manifest["deflection_deg"])


def _cells_in_partition(partition: str, cells: Int, order: int) -> Int:
    """Return the nested cells of the given order that overlap the HEALPix cell of a partition.

    `partition` is the path of its file, which contains the order and number of its cell.
    """
    file_order, cell = layout.cell_of_file(partition)
    if file_order <= order:
        inside: Int = cells[sky.parent(cells, order, file_order) == cell]
    else:
        inside = cells[cells == cell >> (2 * (file_order - order))]
    return inside


def _ranges(cells: Int, order: int) -> list[tuple[int, int]]:
    """Return half-open ranges of order-29 HEALPix indices that cover the given nested cells, which must be sorted.

    At most `_MAX_RANGES` ranges are returned. If the cells have more gaps, the narrower gaps are covered, too.
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


# ------------------------------------- selecting and opening a version of a table


def version(root: Folder, name: str, key: str | None = None, request: str | None = None) -> Version:
    """Open a published version of a table for reading.

    It is selected by its key, else by a request (named set of settings for which tables are made), else it is the
    version that was published last.

    Parameters
    ----------
    root : Path or ObjectPath
        Root of the lake.
    name : str
        Name of the table.
    key : str, optional
        Key of the version, 16 hexadecimal digits. It takes precedence over `request`.
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
        If a link leads to a version that is missing, or the manifest is missing, broken or belongs to another version.
    VersionMismatch
        If the columns with which the version was written differ from the table's declaration in this code.
    """
    selected_key = key or _select_key(root, name, request)
    if selected_key is None:
        names = layout.table_names(root) if request is None else request_links.tables_of_request(root, request)
        raise layout.missing_table(root, name, names, f" of request {request}" if request else "")
    return _open_version(root, name, selected_key, is_requested=key is not None, link=_link(root, name, request))


def input_version(root: Folder, name: str, request: str) -> Version:
    """Open the version of a table that is the input when another table of a request is made.

    It is the version that belongs to the request (named set of settings). If the request has none or does not exist, it
    is the version that was published last, so that requests can share a catalogue.

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
    BadInput
        If the lake has no such table, or a name is not valid. The message lists the requests of the lake.
    Damaged
        If a link leads to a version that is missing, or the manifest is missing, broken or belongs to another version.
    VersionMismatch
        If the columns of the version differ from the table's declaration in this code.
    """
    if request_links.linked_key(root, request, name) is not None:
        return version(root, name, request=request)
    if layout.current_key(root, name) is None:
        raise _missing_input(root, name, request)
    return latest_version(root, name)


def _missing_input(root: Folder, name: str, request: str) -> BadInput:
    """Return the error for a missing input of a job, with the commands that make it."""
    last_command = next((i for i, tables in enumerate(_COMMANDS.values(), 1) if name in tables), len(_COMMANDS))
    commands = spelling.join_words(list(_COMMANDS)[:last_command], "and")
    remedy = f"run truesky run REQUEST {root}, or first truesky {commands}"
    if not layout.table_names(root):
        return BadInput(f"lake {root} has no tables: {remedy}")
    if name in OPTIONAL_TABLES:
        remedy = f"run truesky {OPTIONAL_TABLES[name]} REQUEST {root}"
    existing = ", ".join(request_links.request_names(root)) or "none"
    return BadInput(f"lake {root} has no table {name} of request {request}: {remedy}; requests of the lake: {existing}")


def latest_version(root: Folder, name: str) -> Version:
    """Open the version of a table that was published last, whatever the settings for which it was made.

    Parameters
    ----------
    root : Path or ObjectPath
        Root of the lake.
    name : str
        Name of the table.

    Returns
    -------
    Version
        The version.

    Raises
    ------
    BadInput
        If the table has never been published.
    Damaged
        If the version is missing, or its manifest is broken.
    VersionMismatch
        If the columns of the version differ from the table's declaration in this code.
    """
    current_key = layout.current_key(root, name)
    if current_key is None:
        raise layout.missing_table(root, name, layout.table_names(root))
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
    """Return a copy of a version with the schema that its table declares, including units and descriptions.

    Parameters
    ----------
    published : Version
        The version.
    table : Table
        Declaration of its table.

    Returns
    -------
    Version
        The version with the schema of the declaration.

    Raises
    ------
    VersionMismatch
        If the stored columns differ from the declaration in name, type or unit, or if the version was written with
        another version number of the declaration. The message names the first differing column, or both numbers.
    """
    # Units are part of the cache key of `_declared_schema`, because Arrow ignores metadata when it compares schemas.
    units = tuple((column.metadata or {}).get(b"unit", b"") for column in published.schema)
    return replace(
        published, schema=_declared_schema(published.schema, units, int(published.manifest["version"]), table)
    )


@lru_cache(maxsize=64)
def _declared_schema(stored: pa.Schema, units: tuple[bytes, ...], stored_version: int, table: Table) -> pa.Schema:
    if stored_version != table.version:
        # Do not say which of the two declarations is newer: their version numbers need not increase during development.
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
    """Return the names of the tables that have been published in a lake.

    Parameters
    ----------
    root : Path or ObjectPath
        Root of the lake.

    Returns
    -------
    list of str
        Sorted names, [] for a lake that does not exist. A table is also listed if its files are damaged or have been
        removed.
    """
    return layout.table_names(root)


def find_faults(published: Version, deep: bool = False) -> list[str]:
    """Compare the files of a version with its manifest (list of files).

    Parameters
    ----------
    published : Version
        The version.
    deep : bool, optional
        Compare the sha256 of every file, and check that the rows of each file of a catalogue lie in the HEALPix cell of
        the file, sorted by position. By default, only sizes and the footers of Parquet files are compared.

    Returns
    -------
    list of str
        One sentence per fault; [] for a version without faults.
    """
    return manifest.faults(published.folder, published.manifest, deep)
