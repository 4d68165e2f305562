"""The manifest of a version: its files with bytes and sha256, what they were made from, sealed by its own digest.

write     put a manifest into a version's folder
load      read one; refused where a byte of it has changed
state     of a file: whether it is still the one that was read
faults    is a version what its manifest says?
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

from lake_schema import sky
from lake_schema.errors import Damaged
from lake_schema.store import blocks, layout, parquet
from lake_schema.store.object_storage.s3 import MANIFEST, Folder, ObjectPath
from lake_schema.store.plan import Json
from lake_schema.store.provenance import canonical, digest, file_sha256

# Types of what every manifest says, and of what it says of each file.
_FACT_TYPES = {"table": str, "version": int, "key": str, "facts": dict, "parts": list, "rows": int, "files": list}
_ENTRY_TYPES = {"path": str, "bytes": int, "sha256": str}
_TEMPORARY = re.compile(r"\.[0-9a-f]{12}\.tmp\.")


def write(folder: Path, facts: Json) -> None:
    """Seal the facts of a version and put them into its folder, synced."""
    plain = json.loads(canonical(facts))
    write_json(folder / MANIFEST, {**plain, "digest": digest(plain)})


def load(folder: Folder, table: str) -> Manifest:
    """The manifest of a version's folder.

    Errors : Damaged where it is missing, cut short, changed, or that of another version or table
    """
    path = folder / MANIFEST
    try:
        facts = _read_manifest(path) if isinstance(path, ObjectPath) else _read_once(path, *file_state(path))
    except (OSError, ValueError, KeyError, AttributeError, RecursionError) as error:
        raise Damaged(f"{path}: {type(error).__name__}: {error}") from None
    if facts["table"] != table or folder.name != f"v-{facts['key']}":
        raise Damaged(f"{path} is that of table {facts['table']}, version {facts['key']}")
    return facts


class Manifest(dict[str, Any]):
    """What a manifest says; nobody changes it."""

    @cached_property
    def by_path(self) -> dict[str, dict[str, Any]]:
        """The entry of each file."""
        return {entry["path"]: entry for entry in self["files"]}

    @cached_property
    def schemas(self) -> dict[tuple[int, ...], pa.Schema]:
        """That of its first part, by the `state` of the file; whoever reads it puts it there."""
        return {}


def file_state(path: Path) -> tuple[int, int, int, int]:
    """Inode, bytes, times of modification and of change, ns: while they are the same a file need not be read again.

    Errors : OSError
    """
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


@lru_cache(maxsize=16)
def _read_once(path: Path, *state: int) -> Manifest:
    """As long as the file stays as it is: tasks of a process read the same ones, and they may be large."""
    return _read_manifest(path)


def _read_manifest(path: Folder) -> Manifest:
    facts = json.loads(path.read_bytes())
    seal = facts.pop("digest")
    if digest(facts) != seal:
        raise Damaged(f"{path} is not what was written: its digest differs")
    if not _is_manifest(facts):
        raise Damaged(f"{path} is not a manifest of this form")
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
    """A file's entry in the manifest: path, bytes, sha256, and of a Parquet file the checksums of its blocks.

    The blocks cover the file from its first byte to its last, so that whatever part of it is read can be compared.
    """
    if relative.endswith(".parquet"):
        return {"path": relative, **parquet.file_checksums(path)}
    return {"path": relative, "bytes": path.stat().st_size, "sha256": file_sha256(path)}


def check_size(folder: Folder, entry: Json) -> Folder:
    """A listed file that has the size that the manifest says; what is in it is not looked at.  Errors: Damaged

    Of an object nothing is asked: whoever opens it compares its size.
    """
    path: Folder = folder / entry["path"]
    if isinstance(path, ObjectPath):
        return path
    if fault := _size_fault(path, entry):
        raise Damaged(fault)
    return path


def check_contents(folder: Folder, entry: Json) -> Path:
    """A listed file whose every byte is what was written, by its sha256; of an object a copy.  Errors: Damaged"""
    path = check_size(folder, entry)
    if isinstance(path, ObjectPath):
        return path.download(entry["sha256"])
    _check_sha256(path, entry)
    return path


def _check_sha256(path: Folder, entry: Json) -> None:
    """Read all of a file.  Errors: Damaged"""
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
        # Removed since, with its whole version.
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
    """What is wrong with a version: a list of sentences, empty where all is well.

    facts : its manifest
    deep  : also the sha256 of every file, and that each cell holds only its own rows, sorted
    """
    entries = facts["files"]
    names = {entry["path"] for entry in entries}
    try:
        sizes = _file_sizes(folder)
    except OSError as error:
        return [f"{folder} cannot be read: {error}"]
    messages = [f"{folder / extra} is not in the manifest" for extra in sorted(sizes.keys() - names - {MANIFEST})]
    # Hashing lets go of the interpreter: as many files at a time as there are cores.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for file_messages in pool.map(
            lambda entry: _file_faults(folder, entry, sizes.get(entry["path"], 0), deep), entries
        ):
            messages += file_messages
    total = sum(entry.get("rows", 0) for entry in entries)
    if total != facts["rows"]:
        messages.append(f"{folder / MANIFEST}: {facts['rows']} rows in all, {total} in the files")
    return messages


def _file_sizes(folder: Folder) -> Mapping[str, int]:
    """Of every file below a folder its name and its bytes; of one that is none, 0."""
    if isinstance(folder, ObjectPath):
        return folder.sizes()
    # What another copy of a task was writing when the version was renamed is in nobody's way.
    permanent = (path for path in folder.rglob("*") if not is_temporary(path))
    files = [path for path in permanent if path.is_symlink() or not path.is_dir()]
    return {path.relative_to(folder).as_posix(): 0 if path.is_symlink() else path.stat().st_size for path in files}


def _file_faults(folder: Folder, entry: Json, size: int, deep: bool) -> list[str]:
    """What is wrong with a file, of which a listing says the size."""
    path = folder / entry["path"]
    if isinstance(path, ObjectPath) and size != entry["bytes"]:
        return [f"{path} has {size} bytes, the manifest says {entry['bytes']}" if size else f"{path} is missing"]
    try:
        if deep:
            _check_sha256(check_size(folder, entry), entry)
            return _row_faults(folder, entry) if "rows" in entry else []
        check_size(folder, entry)
        if PurePosixPath(entry["path"]).suffix == ".parquet":
            # The footer.
            parquet.read_schema(folder, entry)
    except Damaged as error:
        return [str(error)]
    except (OSError, pa.ArrowInvalid) as error:
        return [f"{folder / entry['path']}: {error}"]
    return []


def _row_faults(folder: Folder, entry: Json) -> list[str]:
    path, schema = folder / entry["path"], parquet.read_schema(folder, entry)
    # Refuses another number of rows.
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
    """Replace a JSON file in one rename, synced."""
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
    """A name beside a file that nobody else gives to their own: processes of two machines may have one number."""
    return path.with_name(f".{uuid4().hex[:12]}.tmp.{path.name}")


def is_temporary(path: Path) -> bool:
    """Is it a name that `temporary` gives?"""
    return _TEMPORARY.match(path.name) is not None


def _json_text(value: Json) -> str:
    """JSON, a line for each value of the outermost object, and for each of its lists' entries.

    Spread out any further it would take Python's own encoder, which takes a minute where there are 100,000 parts.
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
    """Make a file, or the names in a folder, survive a loss of power."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
