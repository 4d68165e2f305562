"""Store arrays that are expensive to compute in a cache on disc, under a hash of the inputs of the computation.

Arrays are memory-mapped. Before a process maps a file for the first time, it checks the checksum. If a file is damaged,
its arrays are computed again, with a warning. If several processes need the same missing arrays, one of them computes
them and the others wait. The cache has a largest size (truesky/numerics/cache_entries.py).
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import logging
import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from tokenize import TokenError
from types import SimpleNamespace
from typing import Any

import numpy as np

from lake_schema import user_files
from lake_schema.arrays import Array
from lake_schema.errors import BadInput
from lake_schema.store import blocks, layout, manifest
from lake_schema.store.provenance import digest, machine
from truesky.numerics import activity, cache_entries
from truesky.numerics.cache_entries import CHECKSUM_FILE

# Suffix of a file with an array.
_ARRAY = ".npy"
# Largest number of attempts to write and read an entry (a folder of arrays): another process may remove it as damaged
# just after this process has replaced it.
_TRIES = 3
# Number of hexadecimal digits of the hash in the name of an entry's folder.
_KEY_LENGTH = 32
# Longest time for which a process waits for another one that makes the same entry, and time between two looks, s.
_MAX_WAIT_S, _LOOK_S = 3600.0, 0.05
# Name of the module that compiles functions. It is composed here so that this file does not contain it and therefore
# does not belong to the files of `sources_key`.
_COMPILING = b".".join((b"truesky", b"numerics", b"compiling"))


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


def _labels_dir() -> Path:
    """Return the folder with one small file per label: the name of the entry that has the label."""
    return cache_dir() / "labels"


def machine_code_dir() -> Path:
    """Return the folder for machine code of numba, named by a hash of the sources (16 digits of `sources_key`).

    It is in $NUMBA_CACHE_DIR, by default in the folder `numba` of the cache. It may not exist yet.
    """
    folder, key = Path(os.environ.get("NUMBA_CACHE_DIR") or cache_dir() / "numba"), sources_key()[:16]
    # Do not append the key twice: in a child process $NUMBA_CACHE_DIR may be the folder of the parent process.
    return folder if folder.name == key else folder / key


def sources_key(root: Path = Path(__file__).parents[1]) -> str:
    """Return one sha256 (hexadecimal) of the paths and contents of all Python files that affect compiled machine code.

    They are the files below the folder `root` that contain the full name of the module `compiling` of this package.
    Numba compiles a function again if its own file changes, but not if its constants or the functions that it calls
    change in another file. The other file must therefore contain this name, for example in a comment.
    """
    compiled = [path for path in sorted(root.rglob("*.py")) if _COMPILING in path.read_bytes()]
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


def cached_arrays(name: str, key: str, make: Callable[[], Mapping[str, Array]], label: str = "") -> dict[str, Array]:
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
    label : str, optional
        Hash from `truesky.numerics.cache_labels`, by which `has_label` finds the arrays without their key.

    Returns
    -------
    dict of str to array
        Read-only arrays, memory-mapped from disc.

    Raises
    ------
    BadInput
        If `make` returns no arrays, a name is not allowed as a file name, or the stored arrays cannot be read after
        three attempts.
    OSError
        If the arrays cannot be written. If the disc is full, the message names the folder of the cache.
    """
    # Include the kind of this machine (instruction set and C library) in the key. Machines of different kinds may share
    # the cache, and the last bits of their results may differ.
    machine_key = content_key(key, machine())[:_KEY_LENGTH]
    folder = cache_dir() / f"{layout.check_name(name)}-{machine_key}"
    arrays: Mapping[str, Array] | None = None
    for _ in range(_TRIES):
        if (stored := _load(folder)) is not None:
            break
        # Find a mistake in the limit before the computation.
        cache_entries.limit_bytes()
        with lock(folder):
            # Another process may have stored the arrays while this one waited.
            if (stored := _load(folder)) is not None:
                break
            with cache_entries.staging_folder(folder) as staged:
                if arrays is None:
                    with activity.report(f"{name.replace('_', ' ')} (computed once, then in the cache)"):
                        arrays = make()
                _store(arrays, staged)
                publish(staged, folder)
    else:
        stored = _load(folder)
    if stored is None:
        raise BadInput(f"cache {folder}: files that were just written cannot be read")
    if label:
        _store_label(label, folder.name)
    return stored


def has_label(label: str) -> bool:
    """Return True if the cache contains arrays that `cached_arrays` has computed or used with this label."""
    try:
        return (cache_dir() / (_labels_dir() / label).read_text()).is_dir()
    except FileNotFoundError:
        return False


def _store_label(label: str, entry: str) -> None:
    """Write the name of an entry (a folder of arrays) to the file of a label, unless it contains this name."""
    file = _labels_dir() / label
    # The cache of another user may be read-only. The label is then missing, which only affects forecasts.
    with contextlib.suppress(OSError):
        if not file.exists() or file.read_text() != entry:
            file.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile("w", dir=file.parent, prefix=".making-", delete=False) as stream:
                stream.write(entry)
            Path(stream.name).replace(file)


@contextlib.contextmanager
def lock(folder: Path) -> Iterator[None]:
    """Let only one process or thread at a time make the entry `folder` of the cache; the others wait.

    If a process is killed, the next one continues at once. After an hour, and on file systems without locks, the `with`
    block is entered without the lock; the first process that publishes the entry then wins.
    """
    path = folder.with_name(f".lock-{folder.name}")
    folder.parent.mkdir(parents=True, exist_ok=True)
    descriptor = _acquire(path)
    try:
        yield
    finally:
        if descriptor is not None:
            # Remove the file before the lock is released. A process that waits for this lock then notices that its file
            # is no longer there, and makes a new one.
            with contextlib.suppress(OSError):
                path.unlink()
            fcntl.flock(descriptor, fcntl.LOCK_UN)
            os.close(descriptor)


def _acquire(path: Path) -> int | None:
    """Return the descriptor of the locked file, or None if it cannot be locked."""
    deadline = time.monotonic() + _MAX_WAIT_S
    while True:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError:
            return None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(descriptor), os.stat(path)):
                return descriptor
        except FileNotFoundError:
            # The process that had the lock has just removed the file.
            pass
        except BlockingIOError:
            if time.monotonic() > deadline:
                os.close(descriptor)
                return None
            time.sleep(_LOOK_S)
        except OSError:
            os.close(descriptor)
            return None
        os.close(descriptor)


def _load(folder: Path) -> dict[str, Array] | None:
    checksums = stored_checksums(folder)
    if checksums is None:
        return None
    if broken := [name for name, crc in checksums.items() if not is_intact(folder / name, crc)]:
        discard(folder, f"{broken[0]} is damaged")
        return None
    try:
        return {name.removesuffix(_ARRAY): _map(folder / name) for name in checksums}
    except (ValueError, EOFError, FileNotFoundError, TokenError, OverflowError) as error:
        # Another process may have removed the folder in the meantime.
        discard(folder, str(error))
        return None


def store_checksums(folder: Path, names: Iterable[str]) -> None:
    """Write the CRC-32 of the named files of a folder to a file in it, and flush all of them to disc (fsync)."""
    checksums = {}
    for name in names:
        manifest.sync(folder / name)
        checksums[name] = blocks.crc32(folder / name)
    manifest.write_json(folder / CHECKSUM_FILE, {"sums": checksums, "digest": digest(checksums)})
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
    # Record the use before the files are opened, so that no other process removes them in between.
    cache_entries.record_use(folder.parent, folder)
    try:
        stored = json.loads((folder / CHECKSUM_FILE).read_bytes())
        checksums: dict[str, int] = stored["sums"]
        if digest(checksums) == stored["digest"]:
            return checksums
        reason = f"{CHECKSUM_FILE} is damaged"
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
    """Remove a damaged folder of the cache, and log a warning with the reason, unless it does not exist any more."""
    if not folder.exists():
        # Another process has removed it, because it was damaged or the cache was too large.
        return
    logging.getLogger(__name__).warning("cache %s: %s: computed again", folder, " ".join(reason.split()))
    cache_entries.remove(folder, folder.parent)


def _map(file: Path) -> Array:
    mapped: Array = np.load(file, mmap_mode="r", allow_pickle=False)
    # Return a plain array that shares the memory, because numpy.memmap is slower to index.
    return np.asarray(mapped)


def _store(arrays: Mapping[str, Array], staged: Path) -> None:
    if not arrays:
        raise BadInput(f"cache {staged.name}: the computation returned no arrays")
    for stem, array in arrays.items():
        with (staged / f"{layout.check_name(stem)}{_ARRAY}").open("wb") as stream:
            # Hide from numpy that the stream is a file. For a file it calls a function of C, whose error lacks the
            # reason, such as a full disc.
            writer: Any = SimpleNamespace(write=stream.write)
            np.lib.format.write_array(writer, np.ascontiguousarray(array), allow_pickle=False)
    store_checksums(staged, [f"{stem}{_ARRAY}" for stem in arrays])


def publish(staged: Path, folder: Path) -> None:
    """Rename the temporary folder of a complete entry to `folder`, and remove old entries if the cache is too large.

    If another process has created `folder` in the meantime, the temporary folder is left.
    """
    staged.chmod(0o755)
    try:
        staged.rename(folder)
        manifest.sync(folder.parent)
    except OSError:
        if not folder.is_dir():
            raise
    cache_entries.record_use(folder.parent, folder)
    cache_entries.enforce_limit(folder.parent, folder)
