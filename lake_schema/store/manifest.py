"""Manifests of versions: their files with sizes and sha256, their inputs, and a digest of the manifest itself."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, lru_cache
from pathlib import Path, PurePosixPath
from typing import Any
from uuid import uuid4

import pyarrow as pa

from lake_schema import sky
from lake_schema.errors import Damaged
from lake_schema.store import blocks, layout, parquet
from lake_schema.store.object_storage.s3 import MANIFEST, Folder, ObjectPath
from lake_schema.store.plan import Json
from lake_schema.store.provenance import canonical, digest, file_sha256

# Types of the entries of every manifest, and of its entry of each file.
_FACT_TYPES = {"table": str, "version": int, "key": str, "facts": dict, "parts": list, "rows": int, "files": list}
_ENTRY_TYPES = {"path": str, "bytes": int, "sha256": str}
_TEMPORARY = re.compile(r"\.[0-9a-f]{12}\.tmp\.")


def write(folder: Path, facts: Json) -> None:
    """Write the facts of a version and their digest as its manifest, and sync it to disc."""
    plain = json.loads(canonical(facts))
    write_json(folder / MANIFEST, {**plain, "digest": digest(plain)})


def load(folder: Folder, table: str) -> Manifest:
    """Return the manifest of a version's folder.

    Raises
    ------
    Damaged
        If the manifest is missing, incomplete, changed, or belongs to another version or table.
    """
    path = folder / MANIFEST
    try:
        facts = _read_manifest(path) if isinstance(path, ObjectPath) else _read_once(path, *file_state(path))
    except (OSError, ValueError, KeyError, AttributeError, RecursionError) as error:
        raise Damaged(f"{path}: {type(error).__name__}: {error}") from None
    if facts["table"] != table or folder.name != f"v-{facts['key']}":
        raise Damaged(f"{path} belongs to table {facts['table']}, version {facts['key']}")
    return facts


class Manifest(dict[str, Any]):
    """Contents of a manifest; they must not be changed."""

    @cached_property
    def by_path(self) -> dict[str, dict[str, Any]]:
        """Entries of the files by path."""
        return {entry["path"]: entry for entry in self["files"]}

    @cached_property
    def schemas(self) -> dict[tuple[int, ...], pa.Schema]:
        """Cache of the schema of the first partition by `file_state` of its file, filled by readers."""
        return {}


def file_state(path: Path) -> tuple[int, int, int, int]:
    """Return inode, size in bytes, and times of modification and change in ns of a file.

    While they are equal, the file is unchanged and need not be read again.
    """
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


@lru_cache(maxsize=16)
def _read_once(path: Path, *state: int) -> Manifest:
    """Return a cached manifest while its file is unchanged; manifests may be large, and tasks share them."""
    return _read_manifest(path)


def _read_manifest(path: Folder) -> Manifest:
    facts = json.loads(path.read_bytes())
    seal = facts.pop("digest")
    if digest(facts) != seal:
        raise Damaged(f"{path} has changed since it was written: its digest differs")
    if not _is_manifest(facts):
        raise Damaged(f"{path} is not a valid manifest")
    return Manifest(facts)


def _is_manifest(facts: Any) -> bool:
    return (
        _has_types(facts, _FACT_TYPES)
        and type(facts.get("deflection_deg", 0.0)) is float
        and all(_has_types(part, {"name": str}) for part in facts["parts"])
        and all(_is_entry(entry) for entry in facts["files"])
    )


def _is_entry(entry: Any) -> bool:
    if not _has_types(entry, _ENTRY_TYPES) or type(entry.get("rows", 0)) is not int:
        return False
    path = PurePosixPath(entry["path"])
    if path.suffix == ".parquet" or "blocks" in entry:
        try:
            blocks.decode_blocks(entry)
        except (LookupError, TypeError, ValueError):
            return False
    return not path.is_absolute() and ".." not in path.parts


def _has_types(value: Any, types: dict[str, type]) -> bool:
    return isinstance(value, dict) and all(type(value.get(key)) is expected for key, expected in types.items())


def file_entry(path: Path, relative: str) -> dict[str, Any]:
    """Return a file's entry in the manifest: path, size, sha256, and for a Parquet file the checksums of its blocks.

    The blocks cover the whole file, so that any part of it can be verified when it is read.
    """
    if relative.endswith(".parquet"):
        return {"path": relative, **parquet.file_checksums(path)}
    return {"path": relative, "bytes": path.stat().st_size, "sha256": file_sha256(path)}


def check_size(folder: Folder, entry: Json) -> Folder:
    """Return the path of a listed file after comparing its size with the manifest; the contents are not read.

    The size of an object on object storage is compared when it is opened.

    Raises
    ------
    Damaged
        If the file is missing or its size differs.
    """
    path: Folder = folder / entry["path"]
    if isinstance(path, ObjectPath):
        return path
    if fault := _size_fault(path, entry):
        raise Damaged(fault)
    return path


def check_contents(folder: Folder, entry: Json) -> Path:
    """Return the path of a listed file after comparing its sha256; an object on object storage is copied first.

    Raises
    ------
    Damaged
        If the file is missing or its contents differ.
    """
    path = check_size(folder, entry)
    if isinstance(path, ObjectPath):
        return path.download(entry["sha256"])
    _check_sha256(path, entry)
    return path


def _check_sha256(path: Folder, entry: Json) -> None:
    """Read a whole file, and raise Damaged if its sha256 differs from the manifest."""
    try:
        if file_sha256(path) == entry["sha256"]:
            return
    except OSError as error:
        raise Damaged(f"{path} cannot be read: {error.strerror or error}") from None
    raise Damaged(f"{path} has other contents than the manifest says")


def _size_fault(path: Path, entry: Json) -> str:
    try:
        return _size_difference(path, entry)
    except FileNotFoundError:
        # The whole version has been removed since.
        return f"{path} is missing"
    except OSError as error:
        return f"{path} cannot be read: {error.strerror}"


def _size_difference(path: Path, entry: Json) -> str:
    if not path.is_file() or path.is_symlink():
        return f"{path} is missing"
    size = path.stat().st_size
    if size != entry["bytes"]:
        return f"{path} has {size} bytes, the manifest says {entry['bytes']}"
    return ""


def faults(folder: Folder, facts: Json, deep: bool = False) -> list[str]:
    """Return the faults of a version.

    Parameters
    ----------
    folder : Path or ObjectPath
        Folder of the version.
    facts : mapping
        Its manifest.
    deep : bool, optional
        True to compare the sha256 of every file, and to check that each cell contains only its own rows, sorted.

    Returns
    -------
    list of str
        One sentence per fault, empty for a sound version.
    """
    entries = facts["files"]
    names = {entry["path"] for entry in entries}
    try:
        sizes = _file_sizes(folder)
    except OSError as error:
        return [f"{folder} cannot be read: {error}"]
    messages = [f"{folder / extra} is not in the manifest" for extra in sorted(sizes.keys() - names - {MANIFEST})]
    # Hashing releases Python's global lock, so threads use all cores.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for file_messages in pool.map(
            lambda entry: _file_faults(folder, entry, sizes.get(entry["path"], 0), deep), entries
        ):
            messages += file_messages
    total = sum(entry.get("rows", 0) for entry in entries)
    if total != facts["rows"]:
        messages.append(f"{folder / MANIFEST}: {facts['rows']} rows in total, but {total} in the files")
    return messages


def _file_sizes(folder: Folder) -> Mapping[str, int]:
    """Return the size in bytes of each file below a folder, by relative path (0 for a symbolic link)."""
    if isinstance(folder, ObjectPath):
        return folder.sizes()
    # Ignore temporary files of a duplicate task that was still writing when the version was published.
    permanent = (path for path in folder.rglob("*") if not is_temporary(path))
    files = [path for path in permanent if path.is_symlink() or not path.is_dir()]
    return {path.relative_to(folder).as_posix(): 0 if path.is_symlink() else path.stat().st_size for path in files}


def _file_faults(folder: Folder, entry: Json, size: int, deep: bool) -> list[str]:
    """Return the faults of a file; `size` is its size according to a listing of the folder."""
    path = folder / entry["path"]
    if isinstance(path, ObjectPath) and size != entry["bytes"]:
        return [f"{path} has {size} bytes, the manifest says {entry['bytes']}" if size else f"{path} is missing"]
    try:
        if deep:
            _check_sha256(check_size(folder, entry), entry)
            return _row_faults(folder, entry) if "rows" in entry else []
        check_size(folder, entry)
        if PurePosixPath(entry["path"]).suffix == ".parquet":
            # This verifies the footer.
            parquet.read_schema(folder, entry)
    except Damaged as error:
        return [str(error)]
    except (OSError, pa.ArrowInvalid) as error:
        return [f"{folder / entry['path']}: {error}"]
    return []


def _row_faults(folder: Folder, entry: Json) -> list[str]:
    path, schema = folder / entry["path"], parquet.read_schema(folder, entry)
    # This refuses a wrong number of rows.
    rows = parquet.open_dataset(folder, [entry], schema)
    if "_healpix_29" not in schema.names or "Npix=" not in path.name:
        return []
    index = rows.to_table(columns=["_healpix_29"])["_healpix_29"].to_numpy()
    first, last = sky.cell_range(*layout.cell_of_file("/".join(path.parts[-3:])))
    if index.size and (index.min() < first or index.max() >= last):
        return [f"{path} holds rows of another cell"]
    return [f"{path} is not sorted by _healpix_29"] if (index[1:] < index[:-1]).any() else []


# ------------------------------------------------------------------------------------------------ files that last


def write_json(path: Path, value: Json) -> None:
    """Replace a JSON file in one rename, and sync it to disc."""
    path.parent.mkdir(parents=True, exist_ok=True)
    staged = temporary_path(path)
    try:
        with staged.open("w") as stream:
            stream.write(_json_text(value))
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(staged, path)
        sync(path.parent)
    finally:
        staged.unlink(missing_ok=True)


def temporary_path(path: Path) -> Path:
    """Return a temporary path in the folder of `path`.

    Its name is random, because processes on two machines may have the same number.
    """
    return path.with_name(f".{uuid4().hex[:12]}.tmp.{path.name}")


def is_temporary(path: Path) -> bool:
    """Return True if a path has a name from `temporary_path`."""
    return _TEMPORARY.match(path.name) is not None


def _json_text(value: Json) -> str:
    """Return JSON with one line per value of the outermost object and per entry of its lists.

    Further indentation would require Python's slow encoder, which takes a minute for 100,000 partitions.
    """
    lines = []
    for key in sorted(value):
        item = value[key]
        if isinstance(item, (list, tuple)) and item:
            item_text = "[\n  " + ",\n  ".join(_line(entry) for entry in item) + "\n ]"
        else:
            item_text = _line(item)
        lines.append(f" {json.dumps(key)}: {item_text}")
    return "{\n" + ",\n".join(lines) + "\n}"


def _line(value: Any) -> str:
    return json.dumps(value, sort_keys=True, allow_nan=False)


def sync(path: Path) -> None:
    """Sync a file, or the names in a folder, to disc, so that they survive a loss of power."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
