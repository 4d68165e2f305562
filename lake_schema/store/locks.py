"""Files that are locked: held by one process at a time, let go of by the kernel when it dies, however it dies."""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator
from pathlib import Path

from lake_schema.errors import Superseded

# A table's own lock is held for a few renames; how long to wait for another holder, and how often to look, s.
TABLE_TIMEOUT, _POLL_INTERVAL = 10.0, 0.02
# Who asks whether a lock is held, holds it for a moment; how long to wait for that, s.
SHORT_TIMEOUT = 1.0


@contextlib.contextmanager
def hold(path: Path, message: str, timeout: float = 0.0) -> Iterator[None]:
    """Hold a lock file, or raise Superseded.

    patience : how long to wait for another holder, s
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
    """The lock of a table's folder, under which its versions and links are renamed."""
    return hold(folder / ".lock", f"table {folder.name}: another run is publishing", TABLE_TIMEOUT)


def is_held(path: Path) -> bool:
    """Does somebody hold the lock now?  Writes nothing."""
    try:
        with path.open() as stream:
            return not _try_lock(path, stream.fileno())
    except FileNotFoundError:
        return False


def _try_lock(path: Path, descriptor: int) -> bool:
    """Lock the open file, if nobody holds it, and if it is still the one of that name: holders remove it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return path.stat().st_ino == os.fstat(descriptor).st_ino
    except (BlockingIOError, FileNotFoundError):
        return False
