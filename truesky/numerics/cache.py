"""Store arrays that are expensive to compute in a cache on disc, under a hash of the inputs of the computation.

Arrays are memory-mapped. Before a process maps a file for the first time, it checks the checksum. If a file is damaged,
its arrays are computed again, with a warning.
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

# Name of the file with the checksums of a folder's files, and suffix of a file with an array.
_CHECKSUM_FILE, _ARRAY = "sums.json", ".npy"
# Largest number of attempts to write and read an entry (a folder of arrays): another process may remove it as damaged
# just after this process has replaced it.
_TRIES = 3
# Number of hexadecimal digits of the hash in the name of an entry's folder.
_KEY_LENGTH = 32


def cache_dir() -> Path:
    """Return the folder of the cache: $TRUESKY_CACHE, else $XDG_CACHE_HOME/truesky, else ~/.cache/truesky.

    The folder may not exist yet.
    """
    if custom := os.environ.get("TRUESKY_CACHE"):
        return user_files.expand_path(custom)
    if home := os.environ.get("XDG_CACHE_HOME"):
        return user_files.expand_path(home) / "truesky"
    return Path.home() / ".cache" / "truesky"


@contextlib.contextmanager
def use_temporary_dir() -> Iterator[None]:
    """Use an empty temporary folder as the cache inside the `with` block, and remove it at the end.

    $TRUESKY_CACHE is set to the folder, so that child processes use it, too, and restored at the end.
    """
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
    """Return the folder for machine code of numba, named by a hash of the sources (16 digits of `sources_key`).

    It is in $NUMBA_CACHE_DIR, by default in the folder `numba` of the cache. It may not exist yet.
    """
    folder, key = Path(os.environ.get("NUMBA_CACHE_DIR") or cache_dir() / "numba"), sources_key()[:16]
    # Do not append the key twice: in a child process $NUMBA_CACHE_DIR may be the folder of the parent process.
    return folder if folder.name == key else folder / key


def sources_key(root: Path = Path(__file__).parents[1]) -> str:
    """Return one sha256 (hexadecimal) of the paths and contents of all Python files that affect compiled machine code.

    They are the files below the folder `root` that contain the text "truesky.numerics.compiling". Numba compiles a
    function again if its own file changes, but not if its constants or the functions that it calls change in another
    file. The other file must therefore contain this text, for example in a comment.
    """
    compiled = [path for path in sorted(root.rglob("*.py")) if b"truesky.numerics.compiling" in path.read_bytes()]
    return content_key(*(part for path in compiled for part in (path.relative_to(root).as_posix(), path.read_bytes())))


def content_key(*parts: bytes | str | int | float | Array) -> str:
    """Return one sha256 (hexadecimal) of all arguments, which identifies the inputs of a computation.

    Types, shapes and lengths are included: ("ab", "c") and ("a", "bc") differ. Raises BadInput for an argument that is
    not bytes, str, int, float or a NumPy array without Python objects; bool is refused, too.
    """
    digest = hashlib.sha256()
    for part in parts:
        label, content = _canonical(part)
        digest.update(f"{label}:{len(content)}:".encode())
        digest.update(content)
    return digest.hexdigest()


def _canonical(part: object) -> tuple[str, bytes]:
    if isinstance(part, np.ndarray):
        if part.dtype.hasobject:
            raise BadInput("content keys do not support arrays of Python objects")
        return f"array {part.dtype.str} {part.shape}", np.ascontiguousarray(part).tobytes()
    if isinstance(part, bytes):
        return "bytes", part
    if isinstance(part, str):
        return "str", part.encode()
    if isinstance(part, (int, float)) and not isinstance(part, bool):
        return type(part).__name__, repr(part).encode()
    raise BadInput(f"content keys support bytes, strings, numbers and arrays, got {type(part).__name__}")


def cached_arrays(name: str, key: str, make: Callable[[], Mapping[str, Array]]) -> dict[str, Array]:
    """Return arrays from the cache, or compute and store them.

    Parameters
    ----------
    name : str
        First part of the name of the folder with the arrays, to be read by humans.
    key : str
        Hash of everything on which the arrays depend, from `content_key`.
    make : callable
        Function without arguments that returns the arrays by name. It is called only if the cache has no intact files
        for the key. If several processes compute the arrays at the same time, all use those that were stored first.

    Returns
    -------
    dict of str to array
        Read-only arrays, memory-mapped from disc.

    Raises
    ------
    BadInput
        If `make` returns no arrays, a name is not allowed as a file name, or the stored arrays cannot be read after
        three attempts.
    """
    # Include the kind of this machine (instruction set and C library) in the key. Machines of different kinds may share
    # the cache, and the last bits of their results may differ.
    machine_key = content_key(key, machine())[:_KEY_LENGTH]
    folder = cache_dir() / f"{layout.check_name(name)}-{machine_key}"
    arrays: Mapping[str, Array] | None = None
    for _ in range(_TRIES):
        stored = _load(folder)
        if stored is not None:
            return stored
        arrays = make() if arrays is None else arrays
        _publish(arrays, folder)
    raise BadInput(f"cache {folder}: files that were just written cannot be read")


def _load(folder: Path) -> dict[str, Array] | None:
    checksums = stored_checksums(folder)
    if checksums is None:
        return None
    if broken := [name for name, crc in checksums.items() if not is_intact(folder / name, crc)]:
        discard(folder, f"{broken[0]} is damaged")
        return None
    try:
        return {name.removesuffix(_ARRAY): _map(folder / name) for name in checksums}
    except (ValueError, EOFError, FileNotFoundError) as error:
        # Treat a file that vanished like a damaged one: another process may have removed the folder in the meantime.
        discard(folder, str(error))
        return None


def store_checksums(folder: Path, names: Iterable[str]) -> None:
    """Write the CRC-32 of the named files of a folder to a file in it, and flush all of them to disc (fsync)."""
    checksums = {}
    for name in names:
        manifest.sync(folder / name)
        checksums[name] = blocks.crc32(folder / name)
    manifest.write_json(folder / _CHECKSUM_FILE, {"sums": checksums, "digest": digest(checksums)})
    for path in {(folder / name).parent for name in checksums}:
        manifest.sync(path)


def stored_checksums(folder: Path) -> dict[str, int] | None:
    """Return the CRC-32 of each file of a folder by name, from the list that `store_checksums` has written.

    Return None if the folder does not exist. Also return None if its list is missing or damaged; the folder is then
    removed.
    """
    if not folder.exists():
        # Test for the folder before reading the list. Another process may publish the folder in between, and the code
        # below would remove a folder whose list was missing.
        return None
    try:
        stored = json.loads((folder / _CHECKSUM_FILE).read_bytes())
        checksums: dict[str, int] = stored["sums"]
        if digest(checksums) == stored["digest"]:
            return checksums
        reason = f"{_CHECKSUM_FILE} is damaged"
    except (ValueError, LookupError, TypeError, FileNotFoundError, RecursionError) as error:
        reason = str(error)
    discard(folder, reason)
    return None


def is_intact(path: Path, crc: int) -> bool:
    """Return True if a file exists and has the given CRC-32.

    A process computes the checksum only once per file, and again if the size or modification time of the file changes.
    """
    try:
        status = path.stat()
        return _crc32(path, status.st_ino, status.st_size, status.st_mtime_ns) == crc
    except FileNotFoundError:
        return False


@lru_cache(maxsize=65_536)
def _crc32(path: Path, *file_state: int) -> int:
    return blocks.crc32(path)


def discard(folder: Path, reason: str) -> None:
    """Remove a damaged folder of the cache, and log a warning with the reason."""
    logging.getLogger(__name__).warning("cache %s: %s: computed again", folder, " ".join(reason.split()))
    _remove(folder)


def _remove(folder: Path) -> None:
    if not folder.exists():
        return
    # Rename the folder before its files are removed, so that no other process finds a folder with some files missing.
    trash = Path(tempfile.mkdtemp(prefix=".gone-", dir=folder.parent))
    with contextlib.suppress(OSError):
        folder.rename(trash / folder.name)
    shutil.rmtree(trash, ignore_errors=True)


def _map(file: Path) -> Array:
    mapped: Array = np.load(file, mmap_mode="r", allow_pickle=False)
    # Return a plain array that shares the memory, because numpy.memmap is slower to index.
    return np.asarray(mapped)


def _publish(arrays: Mapping[str, Array], folder: Path) -> None:
    """Write the arrays to a temporary folder, and rename it to `folder` when it is complete.

    If another process has created `folder` in the meantime, discard the temporary one.
    """
    if not arrays:
        raise BadInput(f"cache {folder.name}: the computation returned no arrays")
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
