"""Lock files: held by one process at a time, and released by the kernel when the process ends in any way."""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator
from pathlib import Path

from lake_schema.errors import Superseded

# Time to wait for a table's lock, which is held during a few renames, and interval between attempts, in s.
TABLE_TIMEOUT, _POLL_INTERVAL = 10.0, 0.02
# `is_held` holds the lock for a moment. Time to wait for that, in s.
SHORT_TIMEOUT = 1.0


@contextlib.contextmanager
def hold(path: Path, message: str, timeout: float = 0.0) -> Iterator[None]:
    """Hold a lock file while the context is active.

    Parameters
    ----------
    path : Path
        The lock file; it is created if it does not exist.
    message : str
        Message of the exception.
    timeout : float, optional
        Time to wait for another holder, in s.

    Yields
    ------
    None
        While the lock is held.

    Raises
    ------
    Superseded
        If another process still holds the lock after `timeout`.
    """
    deadline = time.monotonic() + timeout
    while True:
        with path.open("a") as stream:
            if _try_lock(path, stream.fileno()):
                yield
                return
        if time.monotonic() >= deadline:
            raise Superseded(message)
        time.sleep(_POLL_INTERVAL)


def hold_table(folder: Path) -> contextlib.AbstractContextManager[None]:
    """Hold the lock of a table's folder, which protects renames of its versions and links."""
    return hold(folder / ".lock", f"table {folder.name}: another run is publishing", TABLE_TIMEOUT)


def is_held(path: Path) -> bool:
    """Return True if a process holds the lock now; nothing is written."""
    try:
        with path.open() as stream:
            return not _try_lock(path, stream.fileno())
    except FileNotFoundError:
        return False


def _try_lock(path: Path, descriptor: int) -> bool:
    """Lock the open file; return True if that succeeds and the file still has this name (holders remove lock files)."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return path.stat().st_ino == os.fstat(descriptor).st_ino
    except (BlockingIOError, FileNotFoundError):
        return False
