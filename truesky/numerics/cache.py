"""Arrays that are costly to make and the same for every run: kept on disc, keyed by what they were made from.

A process compares a file with its checksum before it first maps it; what differs is made again, and said so.

cache_dir        where they lie
temporary        an empty one
machine_code_dir where compiled functions lie
content_key      the key: sha256 of everything that goes into the making
cached_arrays    load, or make and load
seal, sealed     what lists a folder's files, with the checksum of each
is_whole         is a file what it was when it was sealed?
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np

from lake_schema import user_files
from lake_schema.arrays import Array
from lake_schema.errors import BadInput
from lake_schema.store import blocks, layout, manifest
from lake_schema.store.provenance import digest, machine

_CHECKSUM_FILE, _ARRAY = "sums.json", ".npy"
# Another process may remove what it found damaged at the moment when this one has made it again.
_TRIES = 3
_KEY_LENGTH = 32


def cache_dir() -> Path:
    """$TRUESKY_CACHE, else $XDG_CACHE_HOME/truesky, else ~/.cache/truesky; it need not exist yet."""
    if custom := os.environ.get("TRUESKY_CACHE"):
        return user_files.expand_path(custom)
    if home := os.environ.get("XDG_CACHE_HOME"):
        return user_files.expand_path(home) / "truesky"
    return Path.home() / ".cache" / "truesky"


@contextlib.contextmanager
def use_temporary_dir() -> Iterator[None]:
    """An empty cache meanwhile, which is removed afterwards."""
    previous = os.environ.get("TRUESKY_CACHE")
    with tempfile.TemporaryDirectory(prefix="truesky-") as folder:
        os.environ["TRUESKY_CACHE"] = folder
        try:
            yield
        finally:
            del os.environ["TRUESKY_CACHE"]
            if previous is not None:
                os.environ["TRUESKY_CACHE"] = previous


def machine_code_dir() -> Path:
    """Of numba: a folder a version of the sources, in $NUMBA_CACHE_DIR or the cache."""
    folder, key = Path(os.environ.get("NUMBA_CACHE_DIR") or cache_dir() / "numba"), sources_key()[:16]
    # A process begun by another finds the folder named already.
    return folder if folder.name == key else folder / key


def sources_key(root: Path = Path(__file__).parents[1]) -> str:
    """Return the sha256 (hex) of every file below a folder that names truesky.numerics.compiling.

    numba compiles a function again if its own file changes, but not if another file changes whose functions or
    constants it contains. A file with such constants therefore names the module in a comment.
    """
    compiled = [path for path in sorted(root.rglob("*.py")) if b"truesky.numerics.compiling" in path.read_bytes()]
    return content_key(*(part for path in compiled for part in (path.relative_to(root).as_posix(), path.read_bytes())))


def content_key(*parts: bytes | str | int | float | Array) -> str:
    """sha256 (hex) of the parts, each with its type, shape and length: ("ab", "c") and ("a", "bc") differ."""
    digest = hashlib.sha256()
    for part in parts:
        label, content = _canonical(part)
        digest.update(f"{label}:{len(content)}:".encode())
        digest.update(content)
    return digest.hexdigest()


def _canonical(part: object) -> tuple[str, bytes]:
    if isinstance(part, np.ndarray):
        if part.dtype.hasobject:
            raise BadInput("an array of Python objects has no content key")
        return f"array {part.dtype.str} {part.shape}", np.ascontiguousarray(part).tobytes()
    if isinstance(part, bytes):
        return "bytes", part
    if isinstance(part, str):
        return "str", part.encode()
    if isinstance(part, (int, float)) and not isinstance(part, bool):
        return type(part).__name__, repr(part).encode()
    raise BadInput(f"a content key is made of bytes, strings, numbers and arrays, not {type(part).__name__}")


def cached_arrays(name: str, key: str, make: Callable[[], Mapping[str, Array]]) -> dict[str, Array]:
    """The arrays that `make()` returns, made once per key and afterwards mapped from disc, read-only.

    name : legible beginning of the folder's name;  key : from content_key
    make : called only if nothing usable is stored; of processes that race, all use what the first published
    """
    # A folder that machines of several kinds share keeps each kind's: what is kept changes no result.
    machine_key = content_key(key, machine())[:_KEY_LENGTH]
    folder = cache_dir() / f"{layout.check_name(name)}-{machine_key}"
    arrays: Mapping[str, Array] | None = None
    for _ in range(_TRIES):
        stored = _load(folder)
        if stored is not None:
            return stored
        arrays = make() if arrays is None else arrays
        _publish(arrays, folder)
    raise BadInput(f"cache {folder}: what was just written cannot be read")


def _load(folder: Path) -> dict[str, Array] | None:
    checksums = stored_checksums(folder)
    if checksums is None:
        return None
    if broken := [name for name, crc in checksums.items() if not is_intact(folder / name, crc)]:
        discard(folder, f"{broken[0]} is not what was written")
        return None
    try:
        return {name.removesuffix(_ARRAY): _map(folder / name) for name in checksums}
    except (ValueError, EOFError, FileNotFoundError) as error:
        # Removed meanwhile by another process.
        discard(folder, str(error))
        return None


def store_checksums(folder: Path, names: Iterable[str]) -> None:
    """Write the checksums of a folder's files beside them, everything synced."""
    checksums = {}
    for name in names:
        manifest.sync(folder / name)
        checksums[name] = blocks.crc32(folder / name)
    manifest.write_json(folder / _CHECKSUM_FILE, {"sums": checksums, "digest": digest(checksums)})
    for path in {(folder / name).parent for name in checksums}:
        manifest.sync(path)


def stored_checksums(folder: Path) -> dict[str, int] | None:
    """Name -> CRC-32 of the files that were sealed; None where nothing usable is stored, what there was is removed."""
    if not folder.exists():
        # Looked for before its seal: another process may publish the whole of it at any time.
        return None
    try:
        stored = json.loads((folder / _CHECKSUM_FILE).read_bytes())
        checksums: dict[str, int] = stored["sums"]
        if digest(checksums) == stored["digest"]:
            return checksums
        reason = f"{_CHECKSUM_FILE} is not what was written"
    except (ValueError, LookupError, TypeError, FileNotFoundError, RecursionError) as error:
        reason = str(error)
    discard(folder, reason)
    return None


def is_intact(path: Path, crc: int) -> bool:
    """Is the file what it was when it was sealed?  Compared once a process, and again where the file has changed."""
    try:
        status = path.stat()
        return _crc32(path, status.st_ino, status.st_size, status.st_mtime_ns) == crc
    except FileNotFoundError:
        return False


@lru_cache(maxsize=65_536)
def _crc32(path: Path, *file_state: int) -> int:
    return blocks.crc32(path)


def discard(folder: Path, reason: str) -> None:
    """Remove a folder, and say so."""
    logging.getLogger(__name__).warning("cache %s: %s: made again", folder, " ".join(reason.split()))
    _remove(folder)


def _remove(folder: Path) -> None:
    if not folder.exists():
        return
    # In one rename, so that nobody meets half of it.
    trash = Path(tempfile.mkdtemp(prefix=".gone-", dir=folder.parent))
    with contextlib.suppress(OSError):
        folder.rename(trash / folder.name)
    shutil.rmtree(trash, ignore_errors=True)


def _map(file: Path) -> Array:
    mapped: Array = np.load(file, mmap_mode="r", allow_pickle=False)
    # A plain view: numpy.memmap is slower to index.
    return np.asarray(mapped)


def _publish(arrays: Mapping[str, Array], folder: Path) -> None:
    """Write the arrays beside `folder` and rename once; who comes second discards its own copy."""
    if not arrays:
        raise BadInput(f"cache {folder.name}: nothing to store")
    folder.parent.mkdir(parents=True, exist_ok=True)
    staged = Path(tempfile.mkdtemp(prefix=".making-", dir=folder.parent))
    try:
        for stem, array in arrays.items():
            np.save(staged / f"{layout.check_name(stem)}{_ARRAY}", np.ascontiguousarray(array), allow_pickle=False)
        store_checksums(staged, [f"{stem}{_ARRAY}" for stem in arrays])
        staged.chmod(0o755)
        try:
            staged.rename(folder)
            manifest.sync(folder.parent)
        except OSError:
            if not folder.is_dir():
                raise
    finally:
        shutil.rmtree(staged, ignore_errors=True)
