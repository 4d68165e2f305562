"""List the entries of the cache on disc, and remove the least recently used ones.

An entry is a folder with the results of one computation. Its last use is the modification time of its list of checksums
(of the folder itself for machine code and settings of Spark), which a process sets when it first uses the entry.

A process writes the names of the entries that it uses to a file, the lease, which it keeps locked. The operating system
removes the lock when the process ends. An entry with a locked lease is not removed, unless it is damaged.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import shutil
import socket
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from lake_schema.errors import BadInput

# Name of the file with the checksums of an entry's files.
CHECKSUM_FILE = "sums.json"
# Beginnings of the names of folders: an entry that is being made, and one that is being removed.
MAKING, REMOVED = ".making-", ".gone-"
# Kinds of entries, what they contain, and the pattern that the names of their folders match. An entry belongs to the
# first kind that matches.
KINDS = (
    ("box", "simulated matter", r"box_\w+|linear_power"),
    ("lensing", "lensing maps", r"lensing_\w+"),
    ("halos", "tables of halos", r"halo_\w+|halo_catalogue"),
    ("spectra", "libraries of spectra, isochrones", r"(galaxy|stellar|published)_library|published_stars|isochrones"),
    ("fluxes", "flux tables and passbands", r"(galaxy|star|line)_table_.+|(flux_errors|band_ratios|passband)_.+"),
    ("psf", "PSF planes and profiles", r"\w+_psf|sersic"),
    ("dust", "dust maps and laws", r"dust_map|dust_file|milky_way_law"),
    ("catalogues", "your catalogues, as read", r"ingest|checked_rows|training|star_catalogue|tycho2"),
    ("page", "columns and images of the web page", r"columns|pyramid"),
    ("code", "machine code", r"numba/[0-9a-f]{16}"),
    ("spark", "settings of Spark", r"spark-[0-9a-f]{16}"),
    ("other", "measured speed and others", r".*"),
)
# Largest size of the cache, GB, if $TRUESKY_CACHE_LIMIT is not set.
DEFAULT_LIMIT_GB = 5.0
# Age at which the rest of a process that was killed is removed, s.
_LEFTOVER_AGE_S = 86_400.0
# The limit is not checked again within this time, s, unless an entry of this size is stored: listing a large cache
# takes a tenth of a second.
_CHECK_INTERVAL_S, _LARGE_BYTES = 60.0, 100e6
# Entries used within this time, s, are kept when the limit is exceeded: the next job of the same run may use them.
_RECENT_S = 600.0
# Names of the folder with the leases, and of the file whose modification time is that of the last check of the limit.
_LEASES, _CHECKED = ".in_use", ".limit_checked"
# Numbers of the errors of the operating system that mean that the disc or the quota of a user is full.
_FULL = (errno.ENOSPC, errno.EDQUOT)
# Folders of arrays and of user catalogues end with 32 hexadecimal digits of a hash.
_HASHED = re.compile(r"(?P<name>[^.].*)-[0-9a-f]{32}")


@dataclass(frozen=True, slots=True)
class Entry:
    """One entry of the cache, or the rest of a process that was killed.

    Attributes
    ----------
    folder : Path
        Its folder.
    kind : str
        Name of a kind in `KINDS`, or "leftover".
    size : int
        Size of its files, bytes.
    last_use : float
        Time of the last use in seconds since 1970. For a leftover, the time of its last change.
    """

    folder: Path
    kind: str
    size: int
    last_use: float


@dataclass(frozen=True, slots=True)
class Removal:
    """Entries that were removed, and entries that were kept because a running process uses them."""

    removed: tuple[Entry, ...]
    in_use: tuple[Entry, ...]


def limit_bytes() -> float:
    """Return the largest size of the cache in bytes: $TRUESKY_CACHE_LIMIT in GB, else 5 GB; infinity for no limit.

    Raises BadInput if the variable is neither a number >= 0 nor "none". 0 also means no limit.
    """
    text = os.environ.get("TRUESKY_CACHE_LIMIT", "").strip()
    if not text:
        return DEFAULT_LIMIT_GB * 1e9
    with contextlib.suppress(ValueError):
        value = 0.0 if text.lower() == "none" else float(text)
        if value >= 0.0:
            return 1e9 * value or float("inf")
    raise BadInput(f"$TRUESKY_CACHE_LIMIT = {text!r} must be a number of GB >= 0, or none (0 and none: no limit)")


def entries(root: Path) -> list[Entry]:
    """Return all entries and leftovers of the cache in the folder `root`, the least recently used first.

    Files and folders that truesky does not write are left out. The list is empty if the folder does not exist.
    """
    all_entries = []
    for folder in (*_folders(root), *_folders(root / "numba")):
        name = folder.relative_to(root).as_posix()
        if kind := _kind(name):
            # Another process may remove the folder at any time.
            with contextlib.suppress(FileNotFoundError):
                size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
                all_entries.append(Entry(folder, kind, size, _last_use(folder)))
    return sorted(all_entries, key=lambda entry: (entry.last_use, entry.folder))


def prune(root: Path, chosen: Sequence[Entry], max_bytes: float, min_age_s: float = 0.0) -> Removal:
    """Remove entries until the others have at most `max_bytes` together; leftovers older than a day are removed, too.

    Parameters
    ----------
    root : Path
        Folder of the cache.
    chosen : sequence of Entry
        Entries that may be removed, in this order, from `entries`.
    max_bytes : float
        Largest total size of the remaining entries; 0 to remove all.
    min_age_s : float, optional
        Entries that were used within this time (s) are kept.

    Returns
    -------
    Removal
        The removed entries, and the entries that a running process uses.
    """
    now, names_in_use = time.time(), used_names(root)
    total = sum(entry.size for entry in chosen if entry.kind != "leftover")
    removed, in_use = [], []
    for entry in chosen:
        if entry.kind == "leftover":
            if now - entry.last_use > _LEFTOVER_AGE_S:
                shutil.rmtree(entry.folder, ignore_errors=True)
                removed.append(entry)
        elif total > max_bytes and now - entry.last_use >= min_age_s:
            if entry.folder.relative_to(root).as_posix() in names_in_use:
                in_use.append(entry)
            elif _last_use(entry.folder) == entry.last_use:
                # The entry has not been used since it was listed.
                remove(entry.folder, root)
                total -= entry.size
                removed.append(entry)
    return Removal(tuple(removed), tuple(in_use))


def enforce_limit(root: Path, new_entry: Path) -> None:
    """Remove the least recently used entries if the cache is larger than its limit; called for each new entry.

    Entries that a running process uses, or that were used in the last 10 minutes, are kept. The limit is checked once
    a minute, and after each large entry. Files that cannot be removed or read are left.
    """
    max_bytes = limit_bytes()
    if max_bytes == float("inf"):
        return
    with contextlib.suppress(OSError):
        checked = root / _CHECKED
        size = sum(path.stat().st_size for path in new_entry.iterdir())
        if size < _LARGE_BYTES and checked.exists() and time.time() - checked.stat().st_mtime < _CHECK_INTERVAL_S:
            return
        checked.touch()
        prune(root, entries(root), max_bytes, _RECENT_S)


def remove(folder: Path, root: Path) -> None:
    """Remove the folder of an entry of the cache `root`, so that no process finds it with some files missing."""
    if not folder.exists():
        return
    trash = Path(tempfile.mkdtemp(prefix=REMOVED, dir=root))
    with contextlib.suppress(OSError):
        folder.rename(trash / folder.name)
    shutil.rmtree(trash, ignore_errors=True)


def record_use(root: Path, folder: Path) -> None:
    """Record that this process uses an entry: set the time of its last use, and keep other processes from removing it.

    Only the first call of a process for an entry does anything. Nothing is recorded if the folder is not in the cache
    `root`, or if files there cannot be written.
    """
    if folder.is_relative_to(root):
        with contextlib.suppress(OSError):
            used = _used_file(folder)
            _record_first_use(os.getpid(), root, folder.relative_to(root).as_posix(), _inode(used))


def used_names(root: Path) -> frozenset[str]:
    """Return the names of the entries that running processes use, and remove the leases of ended processes."""
    names: set[str] = set()
    for lease in sorted((root / _LEASES).glob("*")):
        with contextlib.suppress(OSError), lease.open() as stream:
            try:
                # The lock of the owner excludes this one.
                fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
                lease.unlink()
            except BlockingIOError:
                names.update(stream.read().splitlines())
    return frozenset(names)


@contextlib.contextmanager
def staging_folder(folder: Path) -> Iterator[Path]:
    """Make a temporary folder in which an entry is made; its name contains that of the entry.

    The folder is removed at the end, unless it was renamed. If the disc is full, the OSError names the folder of the
    cache.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    staged = Path(tempfile.mkdtemp(prefix=f"{MAKING}{folder.name}-", dir=folder.parent))
    try:
        yield staged
    except OSError as error:
        # Errors of writing to an open file do not contain its path.
        if error.errno in _FULL and error.filename is None:
            raise OSError(error.errno, os.strerror(error.errno), str(folder.parent)) from None
        raise
    finally:
        shutil.rmtree(staged, ignore_errors=True)


@lru_cache(maxsize=65_536)
def _record_first_use(process: int, root: Path, name: str, inode: int) -> None:
    """Set the time of the last use, and add the name to the lease of the process; the cache makes it happen once."""
    os.write(_lease(process, root), f"{name}\n".encode())
    if inode:
        os.utime(_used_file(root / name))


@lru_cache
def _lease(process: int, root: Path) -> int:
    """Return the descriptor of the locked file with the names of the entries that this process uses.

    The descriptor is never closed: the lock ends with the process. Raises OSError if the file cannot be written.
    """
    folder = root / _LEASES
    folder.mkdir(parents=True, exist_ok=True)
    # Remove the leases of ended processes, so that they do not accumulate.
    used_names(root)
    while True:
        descriptor, path = tempfile.mkstemp(prefix=f"{socket.gethostname()}-{process}-", dir=folder)
        try:
            # Other users of a shared cache must be able to read it.
            os.fchmod(descriptor, 0o644)
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        except OSError:
            os.close(descriptor)
            os.unlink(path)
            raise
        if os.path.exists(path):
            return descriptor
        # Another process has removed the file before it was locked.
        os.close(descriptor)


def _folders(root: Path) -> Iterator[Path]:
    with contextlib.suppress(OSError):
        yield from (Path(item.path) for item in os.scandir(root) if item.is_dir(follow_symlinks=False))


def _kind(name: str) -> str:
    """Return the kind of the folder with this name, relative to the cache; "" if truesky has not made it."""
    if name.startswith((MAKING, REMOVED)):
        return "leftover"
    match = _HASHED.fullmatch(name)
    if match is None and not name.startswith(("numba/", "spark-")):
        return ""
    title = match["name"] if match else name
    kind = next(kind for kind, _, pattern in KINDS if re.fullmatch(pattern, title))
    return kind if match or kind in ("code", "spark") else ""


def _used_file(folder: Path) -> Path:
    """Return the file or folder whose modification time is the last use of an entry."""
    return checksums if (checksums := folder / CHECKSUM_FILE).exists() else folder


def _last_use(folder: Path) -> float:
    return _used_file(folder).stat().st_mtime


def _inode(path: Path) -> int:
    return path.stat().st_ino if path.exists() else 0
