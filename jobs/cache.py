"""Arrays that are costly to make and the same for everybody: kept on disc, keyed by what they were made from.

cache_dir        where they lie
machine_code_dir where compiled functions lie
content_key      the key: sha256 of everything that goes into the making
cached_arrays    load, or make and load
"""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lake_schema import layout, user_files
from lake_schema.errors import BadInput
from lake_schema.provenance import machine

Array = npt.NDArray[Any]

# Lists a folder's arrays, so that one that went missing is noticed.
_NAMES = "arrays.txt"
_KEY_LENGTH = 32


def cache_dir() -> Path:
    """$TRUESKY_CACHE, else $XDG_CACHE_HOME/truesky, else ~/.cache/truesky; it need not exist yet."""
    if own := os.environ.get("TRUESKY_CACHE"):
        return user_files.expanded(own)
    if home := os.environ.get("XDG_CACHE_HOME"):
        return user_files.expanded(home) / "truesky"
    return Path.home() / ".cache" / "truesky"


def machine_code_dir() -> Path:
    """Of numba: a folder a version of the sources, in $NUMBA_CACHE_DIR or the cache."""
    folder, key = Path(os.environ.get("NUMBA_CACHE_DIR") or cache_dir() / "numba"), sources_key()[:16]
    # A process begun by another finds the folder named already.
    return folder if folder.name == key else folder / key


def sources_key(root: Path = Path(__file__).parent) -> str:
    """sha256 (hex) of every file below a folder that has compiled functions.

    numba compiles a function anew when its own file changes, not when one does whose functions are in it.
    """
    compiled = [path for path in sorted(root.rglob("*.py")) if b"jobs.compiling" in path.read_bytes()]
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
    own = content_key(key, machine())[:_KEY_LENGTH]
    folder = cache_dir() / f"{layout.name(name)}-{own}"
    stored = _load(folder)
    if stored is not None:
        return stored
    _publish(make(), folder)
    stored = _load(folder)
    if stored is None:
        raise BadInput(f"cache {folder}: what was just written cannot be read")
    return stored


def _load(folder: Path) -> dict[str, Array] | None:
    try:
        names = (folder / _NAMES).read_text(encoding="utf-8").split()
        return {name: _map(folder / f"{name}.npy") for name in names}
    except (ValueError, EOFError, OSError):
        # Cut short by a crash of the machine: make it again.
        shutil.rmtree(folder, ignore_errors=True)
        return None


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
        (staged / _NAMES).write_text("\n".join(arrays), encoding="utf-8")
        for stem, array in arrays.items():
            np.save(staged / f"{layout.name(stem)}.npy", np.ascontiguousarray(array), allow_pickle=False)
        staged.chmod(0o755)
        try:
            staged.rename(folder)
        except OSError:
            if not folder.is_dir():
                raise
    finally:
        shutil.rmtree(staged, ignore_errors=True)
