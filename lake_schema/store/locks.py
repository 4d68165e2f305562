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
PATIENCE, _POLL = 10.0, 0.02
# Who asks whether a lock is held, holds it for a moment; how long to wait for that, s.
MOMENT = 1.0


@contextlib.contextmanager
def held(path: Path, refusal: str, patience: float = 0.0) -> Iterator[None]:
    """Hold a lock file, or raise Superseded.

    patience : how long to wait for another holder, s
    """
    give_up = time.monotonic() + patience
    while True:
        with path.open("a") as stream:
            if _take(path, stream.fileno()):
                yield
                return
        if time.monotonic() >= give_up:
            raise Superseded(refusal)
        time.sleep(_POLL)


def table(folder: Path) -> contextlib.AbstractContextManager[None]:
    """The lock of a table's folder, under which its versions and links are renamed."""
    return held(folder / ".lock", f"table {folder.name}: another run is publishing", PATIENCE)


def is_held(path: Path) -> bool:
    """Does somebody hold the lock now?  Writes nothing."""
    try:
        with path.open() as stream:
            return not _take(path, stream.fileno())
    except FileNotFoundError:
        return False


def _take(path: Path, descriptor: int) -> bool:
    """Lock the open file, if nobody holds it, and if it is still the one of that name: holders remove it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return path.stat().st_ino == os.fstat(descriptor).st_ino
    except (BlockingIOError, FileNotFoundError):
        return False
