"""How a published table is read: through its manifest, never a glob, with every page's checksum verified.

version(root, name)     the published version (resolved once: a later publication does not mix in)
Version.dataset         its files as an Arrow dataset
Version.rows            rows of some columns, cells or sky
verify                  is a version what its manifest says?
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from lake_schema import layout, parquet, sky
from lake_schema.errors import BadInput, Damaged
from lake_schema.hats_files import cell_of_part
from lake_schema.provenance import file_sha256
from lake_schema.publish import MANIFEST


@dataclass(frozen=True, slots=True)
class Version:
    """One published version of a table."""

    folder: Path
    manifest: dict[str, Any]

    @property
    def table(self) -> str:
        return str(self.manifest["table"])

    @property
    def key(self) -> str:
        """What stands for this version in the plan of a table made from it."""
        return str(self.manifest["key"])

    @property
    def num_rows(self) -> int:
        return int(self.manifest["rows"])

    @property
    def parts(self) -> list[str]:
        return [str(part["name"]) for part in self.manifest["parts"]]

    def path(self, part: str) -> Path:
        """A part's Parquet file; Damaged where its size is not what the manifest says."""
        for prefix in (f"{self.table}/dataset/", "dataset/"):
            entry = self._files().get(prefix + part)
            if entry is not None:
                return self._checked(entry)
        raise BadInput(f"table {self.table}: version {self.key} has no part {part}")

    def file(self, relative: str) -> Path:
        """Any other file of the version, such as an image."""
        entry = self._files().get(relative)
        if entry is None:
            raise BadInput(f"table {self.table}: version {self.key} has no file {relative}")
        return self._checked(entry)

    def _files(self) -> dict[str, dict[str, Any]]:
        return {entry["path"]: entry for entry in self.manifest["files"]}

    def _checked(self, entry: dict[str, Any]) -> Path:
        path = self.folder / entry["path"]
        if not path.is_file():
            raise Damaged(f"{path} is missing")
        if path.stat().st_size != entry["bytes"]:
            raise Damaged(f"{path} has {path.stat().st_size} bytes, the manifest says {entry['bytes']}")
        return path

    def schema(self) -> pa.Schema:
        """Arrow schema of the rows, with units and descriptions in the fields' metadata."""
        return pq.read_schema(self.path(self.parts[0])) if self.parts else pa.schema([])

    def dataset(self, parts: Iterable[str] | None = None) -> ds.FileSystemDataset:
        """The version's files (or those parts') as an Arrow dataset with verified pages."""
        names = self.parts if parts is None else list(parts)
        return parquet.dataset([self.path(name) for name in names], self.schema())

    def rows(
        self, columns: Sequence[str] | None = None, parts: Iterable[str] | None = None, where: ds.Expression | None = None
    ) -> pa.Table:
        """Rows in file order.

        columns : names, None = all;  parts : names of parts, None = all;  where : an Arrow filter
        """
        names = list(columns) if columns is not None else None
        try:
            return self.dataset(parts).to_table(columns=names, filter=where)
        except (OSError, pa.ArrowInvalid) as error:
            raise Damaged(f"table {self.table}: version {self.key}: {error}") from None

    def in_cells(self, cells: Sequence[int], order: int, columns: Sequence[str] | None = None) -> pa.Table:
        """Rows of a catalogue inside cells of an order (nested), reading only the files and row groups that can hold some.

        cells : int[n]
        """
        wanted = np.unique(np.asarray(cells, np.int64))
        parts = [part for part in self.parts if _overlaps(part, wanted, order)]
        if not parts or not wanted.size:
            return self.rows(columns, self.parts[:1], pc.scalar(False))
        first, last = sky.cell_range(order, int(wanted[0]))[0], sky.cell_range(order, int(wanted[-1]))[1]
        index = pc.field("_healpix_29")
        names = None if columns is None else list(dict.fromkeys([*columns, "_healpix_29"]))
        rows = self.rows(names, parts, (index >= first) & (index < last))
        inside = np.isin(sky.parent(rows["_healpix_29"].to_numpy(), sky.DEEPEST, order), wanted)
        rows = rows.filter(pa.array(inside))
        return rows if columns is None else rows.select(list(columns))


def _overlaps(part: str, cells: sky.Int, order: int) -> bool:
    file_order, cell = cell_of_part(part)
    if file_order <= order:
        return bool((sky.parent(cells, order, file_order) == cell).any())
    return bool((cells == cell >> (2 * (file_order - order))).any())


def version(root: Path, name: str, key: str | None = None) -> Version:
    """The published version of a table, or the one of a key.

    Errors : BadInput where the lake has no such table or version; Damaged where its manifest cannot be read
    """
    link = layout.current(root, name) if key is None else layout.version(root, name, key)
    if not link.exists():
        raise BadInput(f"lake {root} has no table {name}" + (f" of version {key}" if key else ""))
    folder = link.resolve()
    try:
        manifest = json.loads((folder / MANIFEST).read_text())
    except (OSError, json.JSONDecodeError) as error:
        raise Damaged(f"{folder / MANIFEST}: {error}") from None
    return Version(folder, manifest)


def tables(root: Path) -> list[str]:
    """Names of the published tables."""
    return sorted(path.parent.name for path in root.glob("*/current"))


def verify(published: Version, deep: bool = False) -> list[str]:
    """What is wrong with a version: a list of sentences, empty where all is well.

    deep : also the sha256 of every file, and that each cell holds only its own rows, sorted
    """
    found = []
    listed = published.manifest["files"]
    names = {entry["path"] for entry in listed}
    here = {p.relative_to(published.folder).as_posix() for p in published.folder.rglob("*") if p.is_file()}
    found += [f"{published.folder / extra} is not in the manifest" for extra in sorted(here - names - {MANIFEST})]
    for entry in listed:
        path = published.folder / entry["path"]
        if not path.is_file():
            found.append(f"{path} is missing")
        elif path.stat().st_size != entry["bytes"]:
            found.append(f"{path} has {path.stat().st_size} bytes, the manifest says {entry['bytes']}")
        elif deep and file_sha256(path) != entry["sha256"]:
            found.append(f"{path} has other contents than the manifest says")
        elif deep and "rows" in entry:
            found += _verify_rows(path, entry)
    total = sum(entry.get("rows", 0) for entry in listed)
    if total != published.num_rows:
        found.append(f"{published.folder / MANIFEST}: {published.num_rows} rows in all, {total} in the files")
    return found


def _verify_rows(path: Path, entry: dict[str, Any]) -> list[str]:
    file = pq.ParquetFile(path, page_checksum_verification=True)
    if file.metadata.num_rows != entry["rows"]:
        return [f"{path} has {file.metadata.num_rows} rows, the manifest says {entry['rows']}"]
    if "_healpix_29" not in file.schema_arrow.names or "Npix=" not in path.name:
        return []
    index = file.read(columns=["_healpix_29"])["_healpix_29"].to_numpy()
    order, cell = cell_of_part("/".join(path.parts[-3:]))
    first, last = sky.cell_range(order, cell)
    if index.size and (index.min() < first or index.max() >= last):
        return [f"{path} holds rows of another cell"]
    return [f"{path} is not sorted by _healpix_29"] if (index[1:] < index[:-1]).any() else []
