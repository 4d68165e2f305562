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
from lake_schema.store.object_storage.s3 import MANIFEST, Folder, Place
from lake_schema.store.plan import Json
from lake_schema.store.provenance import canonical, digest, file_sha256

# Types of what every manifest says, and of what it says of each file.
_FACTS = {"table": str, "version": int, "key": str, "facts": dict, "parts": list, "rows": int, "files": list}
_FILE = {"path": str, "bytes": int, "sha256": str}
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
        facts = _read(path) if isinstance(path, Place) else _read_once(path, *state(path))
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


def state(path: Path) -> tuple[int, int, int, int]:
    """Inode, bytes, times of modification and of change, ns: while they are the same a file need not be read again.

    Errors : OSError
    """
    about = path.stat()
    return about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns


@lru_cache(maxsize=16)
def _read_once(path: Path, *state: int) -> Manifest:
    """As long as the file stays as it is: tasks of a process read the same ones, and they may be large."""
    return _read(path)


def _read(path: Folder) -> Manifest:
    facts = json.loads(path.read_bytes())
    seal = facts.pop("digest")
    if digest(facts) != seal:
        raise Damaged(f"{path} is not what was written: its digest differs")
    if not _is_manifest(facts):
        raise Damaged(f"{path} is not a manifest of this form")
    return Manifest(facts)


def _is_manifest(facts: Any) -> bool:
    return (
        _has(facts, _FACTS)
        and type(facts.get("deflection_deg", 0.0)) is float
        and all(_has(part, {"name": str}) for part in facts["parts"])
        and all(_is_entry(entry) for entry in facts["files"])
    )


def _is_entry(entry: Any) -> bool:
    if not _has(entry, _FILE) or type(entry.get("rows", 0)) is not int:
        return False
    path = PurePosixPath(entry["path"])
    if path.suffix == ".parquet" or "blocks" in entry:
        try:
            blocks.listed(entry)
        except (LookupError, TypeError, ValueError):
            return False
    return not path.is_absolute() and ".." not in path.parts


def _has(value: Any, kinds: dict[str, type]) -> bool:
    return isinstance(value, dict) and all(type(value.get(key)) is kind for key, kind in kinds.items())


def file_facts(path: Path, relative: str) -> dict[str, Any]:
    """A file's entry in the manifest: path, bytes, sha256, and of a Parquet file the checksums of its blocks.

    The blocks cover the file from its first byte to its last, so that whatever part of it is read can be compared.
    """
    if relative.endswith(".parquet"):
        return {"path": relative, **parquet.facts(path)}
    return {"path": relative, "bytes": path.stat().st_size, "sha256": file_sha256(path)}


def checked(folder: Folder, entry: Json) -> Folder:
    """A listed file that has the size that the manifest says; what is in it is not looked at.  Errors: Damaged

    Of an object nothing is asked: whoever opens it compares its size.
    """
    path: Folder = folder / entry["path"]
    if isinstance(path, Place):
        return path
    if fault := _misfit(path, entry):
        raise Damaged(fault)
    return path


def whole(folder: Folder, entry: Json) -> Path:
    """A listed file whose every byte is what was written, by its sha256; of an object a copy.  Errors: Damaged"""
    path = checked(folder, entry)
    if isinstance(path, Place):
        return path.copy(entry["sha256"])
    _compare(path, entry)
    return path


def _compare(path: Folder, entry: Json) -> None:
    """Read all of a file.  Errors: Damaged"""
    try:
        if file_sha256(path) == entry["sha256"]:
            return
    except OSError as error:
        raise Damaged(f"{path} cannot be read: {error.strerror or error}") from None
    raise Damaged(f"{path} has other contents than the manifest says")


def _misfit(path: Path, entry: Json) -> str:
    try:
        return _difference(path, entry)
    except FileNotFoundError:
        # Removed since, with its whole version.
        return f"{path} is missing"
    except OSError as error:
        return f"{path} cannot be read: {error.strerror}"


def _difference(path: Path, entry: Json) -> str:
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
    listed = facts["files"]
    names = {entry["path"] for entry in listed}
    try:
        here = _files(folder)
    except OSError as error:
        return [f"{folder} cannot be read: {error}"]
    found = [f"{folder / extra} is not in the manifest" for extra in sorted(here.keys() - names - {MANIFEST})]
    # Hashing lets go of the interpreter: as many files at a time as there are cores.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for wrong in pool.map(lambda entry: _file_faults(folder, entry, here.get(entry["path"], 0), deep), listed):
            found += wrong
    total = sum(entry.get("rows", 0) for entry in listed)
    if total != facts["rows"]:
        found.append(f"{folder / MANIFEST}: {facts['rows']} rows in all, {total} in the files")
    return found


def _files(folder: Folder) -> Mapping[str, int]:
    """Of every file below a folder its name and its bytes; of one that is none, 0."""
    if isinstance(folder, Place):
        return folder.sizes()
    # What another copy of a task was writing when the version was renamed is in nobody's way.
    some = (path for path in folder.rglob("*") if not is_temporary(path))
    there = [path for path in some if path.is_symlink() or not path.is_dir()]
    return {path.relative_to(folder).as_posix(): 0 if path.is_symlink() else path.stat().st_size for path in there}


def _file_faults(folder: Folder, entry: Json, size: int, deep: bool) -> list[str]:
    """What is wrong with a file, of which a listing says the size."""
    path = folder / entry["path"]
    if isinstance(path, Place) and size != entry["bytes"]:
        return [f"{path} has {size} bytes, the manifest says {entry['bytes']}" if size else f"{path} is missing"]
    try:
        if deep:
            _compare(checked(folder, entry), entry)
            return _row_faults(folder, entry) if "rows" in entry else []
        checked(folder, entry)
        if PurePosixPath(entry["path"]).suffix == ".parquet":
            # The footer.
            parquet.schema(folder, entry)
    except Damaged as error:
        return [str(error)]
    except (OSError, pa.ArrowInvalid) as error:
        return [f"{folder / entry['path']}: {error}"]
    return []


def _row_faults(folder: Folder, entry: Json) -> list[str]:
    path, schema = folder / entry["path"], parquet.schema(folder, entry)
    # Refuses another number of rows.
    rows = parquet.dataset(folder, [entry], schema)
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
    own = temporary(path)
    try:
        with own.open("w") as stream:
            stream.write(_text(value))
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(own, path)
        sync(path.parent)
    finally:
        own.unlink(missing_ok=True)


def temporary(path: Path) -> Path:
    """A name beside a file that nobody else gives to their own: processes of two machines may have one number."""
    return path.with_name(f".{uuid4().hex[:12]}.tmp.{path.name}")


def is_temporary(path: Path) -> bool:
    """Is it a name that `temporary` gives?"""
    return _TEMPORARY.match(path.name) is not None


def _text(value: Json) -> str:
    """JSON, a line for each value of the outermost object, and for each of its lists' entries.

    Spread out any further it would take Python's own encoder, which takes a minute where there are 100,000 parts.
    """
    lines = []
    for key in sorted(value):
        own = value[key]
        if isinstance(own, (list, tuple)) and own:
            shown = "[\n  " + ",\n  ".join(_line(entry) for entry in own) + "\n ]"
        else:
            shown = _line(own)
        lines.append(f" {json.dumps(key)}: {shown}")
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
