"""Write, read and check the manifest of a version of a table.

A manifest is a JSON file in the folder of the version. It lists all files with their sizes and sha256, the facts from
which the version was made (settings, inputs, code), and a digest of the manifest itself.
"""

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

from lake_schema import sky, user_files
from lake_schema.errors import BadInput, Damaged
from lake_schema.store import blocks, layout, parquet
from lake_schema.store.object_storage.s3 import MANIFEST, Folder, ObjectPath
from lake_schema.store.plan import Json
from lake_schema.store.provenance import canonical, digest, file_sha256

# Keys that every manifest must have, and the types of their values.
_FACT_TYPES = {"table": str, "version": int, "key": str, "facts": dict, "parts": list, "rows": int, "files": list}
# Keys that the entry of each partition in a manifest must have, and the types of their values.
_PART_TYPES = {"name": str, "facts": dict}
# Keys that the entry of each file in a manifest must have, and the types of their values.
_ENTRY_TYPES = {"path": str, "bytes": int, "sha256": str}
# Largest number of values in a manifest. An image has about 35, so that this is sufficient for 900,000 images. A value
# takes up to 72 bytes of memory, an empty list for example.
_MAX_VALUES = 1 << 25
# Checksums are parts of paths of temporary copies, so other texts could lead to files outside.
_SHA256 = re.compile(r"[0-9a-f]{64}", re.ASCII)
_TEMPORARY = re.compile(r"\.[0-9a-f]{12}\.tmp\.")


def write(folder: Path, facts: Json) -> None:
    """Write the manifest of a version into its folder, and sync it to disc.

    It contains `facts` (JSON values: files, rows, inputs) and their sha256 as "digest". An existing manifest is
    replaced in one rename. ValueError is raised for NaN or an infinity in `facts`, and BadInput if the manifest is too
    large for readers.
    """
    plain, path = json.loads(canonical(facts)), folder / MANIFEST
    write_json(path, {**plain, "digest": digest(plain)})
    _refuse_many_values(path, user_files.read_bytes(path, "manifest"))


def load(folder: Folder, table: str) -> Manifest:
    """Return the manifest in the folder of a version of a table: list of files, and facts from which it was made.

    Raises
    ------
    Damaged
        If the manifest is missing, not a regular file, too large, incomplete, or changed since it was written, or
        belongs to another version or table.
    """
    path = folder / MANIFEST
    try:
        if isinstance(path, Path):
            refuse_links(path.parent, MANIFEST)
            facts = _read_once(path, *file_state(path))
        else:
            facts = _read_manifest(path)
    except BadInput as error:
        # The file is not a regular file, is too large or has too many values.
        raise Damaged(error) from None
    except (OSError, ValueError, KeyError, RecursionError) as error:
        raise Damaged(f"{path}: {type(error).__name__}: {error}") from None
    if facts["table"] != table or folder.name != f"v-{facts['key']}":
        raise Damaged(f"{path} belongs to table {facts['table']}, version {facts['key']}")
    return facts


class Manifest(dict[str, Any]):
    """Contents of the manifest of a version: its files with checksums, and the facts from which it was made.

    Callers must not change the values, because instances are cached and shared.
    """

    @cached_property
    def by_path(self) -> dict[str, dict[str, Any]]:
        """Entries of all files (size, sha256, rows), by path relative to the folder of the version."""
        return {entry["path"]: entry for entry in self["files"]}

    @cached_property
    def schemas(self) -> dict[tuple[int, ...], pa.Schema]:
        """Cache of the Arrow schema of the version's first file, empty until a reader fills it.

        The keys are results of `file_state` for this file, so a changed file is read again. On object storage, where
        files of versions never change, the key is ().
        """
        return {}


def file_state(path: Path) -> tuple[int, int, int, int]:
    """Return inode, size in bytes, and times of modification and of status change in ns of a file.

    If two calls return equal values, the file has not changed between them. OSError is raised if it does not exist.
    """
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


@lru_cache(maxsize=16)
def _read_once(path: Path, *state: int) -> Manifest:
    """Read a manifest, or return it from the cache if the file has not changed.

    `state` is the result of `file_state` for the file; with another state, the file is read again.
    """
    return _read_manifest(path)


def _read_manifest(path: Folder) -> Manifest:
    # Object storage has neither pipes nor devices, and `ObjectPath.read_bytes` limits the size.
    data = path.read_bytes() if isinstance(path, ObjectPath) else user_files.read_bytes(path, "manifest")
    _refuse_many_values(path, data)
    # Strip the text first, because the JSON reader takes 30 ns for each blank at its start or end. A character of an
    # ASCII text takes one byte of memory, of another text up to four.
    facts = json.loads(data.decode("ascii").strip())
    if not isinstance(facts, dict):
        raise Damaged(f"{path}: must contain a JSON object")
    seal = facts.pop("digest")
    if digest(facts) != seal:
        raise Damaged(f"{path} has changed since it was written: its digest differs")
    if not _is_manifest(facts):
        raise Damaged(f"{path} is not a valid manifest")
    return Manifest(facts)


def _refuse_many_values(path: Folder, data: bytes) -> None:
    # Each value in JSON follows a comma or an opening bracket, except the value of the file itself.
    if sum(data.count(mark) for mark in (b",", b"[", b"{")) > _MAX_VALUES:
        raise BadInput(f"{path}: has more than {_MAX_VALUES} values, the limit for a manifest")


def _is_manifest(facts: Any) -> bool:
    return (
        _has_types(facts, _FACT_TYPES)
        and type(facts.get("deflection_deg", 0.0)) is float
        and all(_has_types(part, _PART_TYPES) for part in facts["parts"])
        and all(_is_entry(entry) for entry in facts["files"])
    )


def _is_entry(entry: Any) -> bool:
    if not _has_types(entry, _ENTRY_TYPES) or type(entry.get("rows", 0)) is not int:
        return False
    if not _SHA256.fullmatch(entry["sha256"]):
        return False
    path = entry["path"]
    if path.endswith(".parquet") or "blocks" in entry:
        try:
            blocks.decode_blocks(entry)
        except (LookupError, TypeError, ValueError):
            return False
    return not path.startswith("/") and ".." not in path.split("/")


def _has_types(value: Any, types: Mapping[str, type]) -> bool:
    return isinstance(value, dict) and all(type(value.get(key)) is expected for key, expected in types.items())


def file_entry(path: Path, relative: str) -> dict[str, Any]:
    """Return the entry of a file for the manifest: path, size in bytes, and sha256.

    The entry of a Parquet file also has the sizes and CRC-32 of its blocks (ranges of bytes). The blocks cover the
    whole file, so that a reader can verify each part that it reads. `relative` is the path that the entry contains.
    """
    if relative.endswith(".parquet"):
        return {"path": relative, **parquet.file_checksums(path)}
    return {"path": relative, "bytes": path.stat().st_size, "sha256": file_sha256(path)}


def check_size(folder: Folder, entry: Json) -> Folder:
    """Return the path of a file of a version after comparing its size with its manifest entry.

    `folder` is the folder of the version. The contents are not read. An object on object storage is not checked here
    but when it is read.

    Raises
    ------
    Damaged
        If the file is on disc, and is missing or has another size, or the file or a folder above it is a symbolic link.
    """
    relative: str = entry["path"]
    if isinstance(folder, ObjectPath):
        return folder / relative
    refuse_links(folder, relative)
    path = folder / relative
    if fault := _size_fault(path, entry):
        raise Damaged(fault)
    return path


def refuse_links(folder: Path, relative: str) -> None:
    """Raise Damaged if a file or folder of a version, or a folder above it in the version, is a link or unreadable.

    `folder` is the folder of the version and `relative` the path in it. truesky makes no such links, and one could lead
    out of the lake.
    """
    path = folder
    for name in PurePosixPath(relative).parts:
        path /= name
        try:
            is_link = path.is_symlink()
        except OSError as error:
            # The name is too long, for example.
            raise Damaged(f"{path} cannot be read: {error.strerror}") from None
        if is_link:
            raise Damaged(f"{path} is a symbolic link, but the files of a version must not be linked")


def check_contents(folder: Folder, entry: Json) -> Path:
    """Return the path of a file of a version after comparing its size and sha256 with its manifest entry.

    `folder` is the folder of the version. An object on object storage is copied to a temporary file first; the path of
    this file is returned.

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
    """Read a whole file, and raise Damaged if it cannot be read or its sha256 differs from its manifest entry."""
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
        # `_size_difference` has found the file, but another process has removed it before reading its size.
        return f"{path} is missing"
    except OSError as error:
        return f"{path} cannot be read: {error.strerror}"


def _size_difference(path: Path, entry: Json) -> str:
    if not path.is_file():
        return f"{path} is missing"
    size = path.stat().st_size
    if size != entry["bytes"]:
        return f"{path} has {size} bytes, the manifest says {entry['bytes']}"
    return ""


def faults(folder: Folder, facts: Json, deep: bool = False) -> list[str]:
    """Compare the files of a version with its manifest, and return a description of every fault.

    Parameters
    ----------
    folder : Path or ObjectPath
        Folder of the version.
    facts : mapping
        Manifest of the version: the list of its files with sizes, checksums and numbers of rows.
    deep : bool, optional
        True to compare the sha256 of every file, and to check that the file of each HEALPix cell contains only rows in
        this cell, sorted by position. By default, only sizes, and the footers of Parquet files, are compared.

    Returns
    -------
    list of str
        One sentence per fault; an empty list for a version without faults.
    """
    entries = facts["files"]
    names = {entry["path"] for entry in entries}
    try:
        sizes = _file_sizes(folder)
    except OSError as error:
        return [f"{folder} cannot be read: {error}"]
    messages = [f"{folder / extra} is not in the manifest" for extra in sorted(sizes.keys() - names - {MANIFEST})]
    # Threads can use all cores here, because the hash functions release Python's global interpreter lock.
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
    """Return the size in bytes of each file in a folder and its subfolders, by relative path (0 for a symbolic link).

    Temporary files are left out.
    """
    if isinstance(folder, ObjectPath):
        return folder.sizes()
    # Ignore temporary files: a second process may have been writing a finished file again at the publication.
    permanent = (path for path in folder.rglob("*") if not is_temporary(path))
    files = [path for path in permanent if path.is_symlink() or not path.is_dir()]
    return {path.relative_to(folder).as_posix(): 0 if path.is_symlink() else path.stat().st_size for path in files}


def _file_faults(folder: Folder, entry: Json, size: int, deep: bool) -> list[str]:
    """Return the faults of one file of a version as sentences, [] for a file without faults.

    `size` is its size in bytes in a listing of the folder, 0 if the file is missing. If `deep`, the whole file is read.
    """
    path = folder / entry["path"]
    if isinstance(path, ObjectPath) and size != entry["bytes"]:
        return [f"{path} has {size} bytes, the manifest says {entry['bytes']}" if size else f"{path} is missing"]
    try:
        if deep:
            _check_sha256(check_size(folder, entry), entry)
            return _row_faults(folder, entry) if "rows" in entry else []
        check_size(folder, entry)
        if PurePosixPath(entry["path"]).suffix == ".parquet":
            # Read the schema only to verify the checksum of the footer; it raises Damaged.
            parquet.read_schema(folder, entry)
    except Damaged as error:
        return [str(error)]
    except (OSError, pa.ArrowInvalid) as error:
        return [f"{folder / entry['path']}: {error}"]
    return []


def _row_faults(folder: Folder, entry: Json) -> list[str]:
    path, schema = folder / entry["path"], parquet.read_schema(folder, entry)
    # `open_dataset` raises Damaged if the number of rows differs from the manifest.
    rows = parquet.open_dataset(folder, [entry], schema)
    if "_healpix_29" not in schema.names or "Npix=" not in path.name:
        return []
    index = rows.to_table(columns=["_healpix_29"])["_healpix_29"].to_numpy()
    first, last = sky.cell_range(*layout.cell_of_file("/".join(path.parts[-3:])))
    if index.size and (index.min() < first or index.max() >= last):
        return [f"{path} holds rows of another cell"]
    return [f"{path} is not sorted by _healpix_29"] if (index[1:] < index[:-1]).any() else []


# ------------------------------------- writing files so that they survive a crash or a loss of power


def write_json(path: Path, value: Json) -> None:
    """Write a JSON object to a file, which is replaced in one rename and synced to disc.

    Missing folders are created. ValueError is raised for NaN or an infinity in `value`.
    """
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
    """Return a path with a random name in the folder of `path`, for a file that is later renamed to `path`.

    The name does not contain the process number, because processes on two machines may have the same one.
    """
    return path.with_name(f".{uuid4().hex[:12]}.tmp.{path.name}")


def is_temporary(path: Path) -> bool:
    """Return True if a path has a name as `temporary_path` makes them, for files that are still being written."""
    return _TEMPORARY.match(path.name) is not None


def _json_text(value: Json) -> str:
    """Return the JSON text of an object, with sorted keys and short lines.

    Each value is on a separate line, and so is each element if the value is a list. Deeper levels are not indented,
    because `json.dumps` with `indent` is slow: it takes a minute for a manifest of 100,000 partitions.
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
    """Sync the contents of a file, or the list of names in a folder, to disc, so that it survives a loss of power."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
