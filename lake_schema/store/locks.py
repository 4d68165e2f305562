"""Lock files: one process at a time can hold a lock file; the kernel releases it when the process ends or is killed."""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator
from pathlib import Path

from lake_schema.errors import BadInput, Superseded

# Time to wait for the lock of a table, in s. Other processes hold it only while they rename a few folders or links.
TABLE_TIMEOUT = 10.0
# Time between two attempts to get a lock, in s.
_POLL_INTERVAL = 0.02
# Time to wait for the lock of a version, in s. A call of `is_held` in another process holds it for a moment.
SHORT_TIMEOUT = 1.0


@contextlib.contextmanager
def hold(path: Path, message: str, timeout: float = 0.0) -> Iterator[None]:
    """Hold a lock file in the body of a `with` statement.

    Parameters
    ----------
    path : Path
        The lock file; it is created if it does not exist.
    message : str
        Message of the exception if another process holds the lock.
    timeout : float, optional
        Time to wait until another process releases the lock, in s. By default there is one attempt.

    Yields
    ------
    None
        While the lock is held.

    Raises
    ------
    Superseded
        If another process still holds the lock after `timeout`.
    BadInput
        If the path is a symbolic link, which could lead out of the lake.
    """
    deadline = time.monotonic() + timeout
    while True:
        if path.is_symlink():
            raise BadInput(f"{path} is a symbolic link, and a lock must not be one: remove it")
        with path.open("a") as stream:
            if _try_lock(path, stream.fileno()):
                yield
                return
        if time.monotonic() >= deadline:
            raise Superseded(message)
        time.sleep(_POLL_INTERVAL)


def hold_table(folder: Path) -> contextlib.AbstractContextManager[None]:
    """Return a context manager that holds the lock of a table's folder.

    Hold it to rename versions or replace links of the table. Superseded is raised if another process still holds the
    lock after 10 s.
    """
    return hold(folder / ".lock", f"table {folder.name}: another run is publishing", TABLE_TIMEOUT)


def is_held(path: Path) -> bool:
    """Return True if a process holds the lock file now, False if none does or the file does not exist.

    Nothing is written.
    """
    try:
        with path.open() as stream:
            return not _try_lock(path, stream.fileno())
    except FileNotFoundError:
        return False


def _try_lock(path: Path, descriptor: int) -> bool:
    """Try to lock an open file, and return True on success.

    Return False if another process holds the lock, or if `path` is no longer a name of the open file: the last holder
    may have removed it, and another process may have created a new file of this name.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return path.stat().st_ino == os.fstat(descriptor).st_ino
    except (BlockingIOError, FileNotFoundError):
        return False
