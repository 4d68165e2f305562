"""Tell the process that shows the progress of a run what each other process of the run is doing.

The environment variable TRUESKY_ACTIVITY names a folder. Each activity, such as the making of a lensing map, has a
small file in it, which is removed when the activity ends. Without the variable, nothing is written.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

SETTING = "TRUESKY_ACTIVITY"
# Prefix of the files of activities. Other files of the folder describe the whole run.
_PREFIX = "activity-"
# Smallest time between two updates of the file of an activity, s.
_UPDATE_INTERVAL = 0.2
# Largest number in a file that is believed.
_MOST = 1e15

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Activity:
    """Something that a process is doing.

    Attributes
    ----------
    text : str
        What it does, such as "lensing map".
    started : float
        Time of the start, s since 1970.
    done : int
        Number of finished steps.
    total : int
        Number of all steps; 0 if the activity is not divided into steps.
    process : int
        Number of the process.
    """

    text: str
    started: float
    done: int
    total: int
    process: int


@contextlib.contextmanager
def report(text: str, total: int = 0) -> Iterator[Callable[[int], None]]:
    """Show an activity in the display of the run inside the `with` block.

    Parameters
    ----------
    text : str
        What is done, such as "lensing map".
    total : int, optional
        Number of steps; 0 if the activity is not divided into steps.

    Yields
    ------
    callable
        Function that takes the number of finished steps, for the display.
    """
    if not (folder := os.environ.get(SETTING)):
        yield _ignore
        return
    path = Path(folder) / f"{_PREFIX}{os.getpid()}-{time.monotonic_ns()}.json"
    started = time.time()
    last_update = 0.0

    def update(done: int) -> None:
        nonlocal last_update
        if (now := time.monotonic()) - last_update >= _UPDATE_INTERVAL:
            last_update = now
            write_json(path, {"text": text, "started": started, "done": done, "total": total, "process": os.getpid()})

    update(0)
    try:
        yield update
    finally:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


def track(items: Sequence[Item], text: str) -> Iterator[Item]:
    """Yield the items of a sequence, and show in the display of the run how many have been processed."""
    with report(text, len(items)) as update:
        for i, item in enumerate(items):
            update(i)
            yield item


def read_activities(folder: Path) -> list[Activity]:
    """Return the activities of all processes that are still running, the oldest first."""
    activities = []
    for path in folder.glob(f"{_PREFIX}*.json"):
        # A file that is damaged is left out, because activities are only shown.
        with contextlib.suppress(OSError, ValueError, TypeError, OverflowError, RecursionError):
            activity = Activity(**json.loads(path.read_bytes()))
            os.kill(activity.process, 0)
            if isinstance(activity.text, str) and all(
                isinstance(number, int | float) and 0 <= number <= _MOST
                for number in (activity.started, activity.done, activity.total)
            ):
                activities.append(activity)
    return sorted(activities, key=lambda activity: activity.started)


def write_json(path: Path, content: dict[str, object]) -> None:
    """Replace a file by the JSON form of a dictionary; do nothing if it cannot be written, since it is only shown."""
    temporary = path.with_name(f".{path.name}-{os.getpid()}")
    with contextlib.suppress(OSError):
        temporary.write_text(json.dumps(content))
        temporary.replace(path)


def _ignore(done: int) -> None:
    """Do nothing, since no process shows the progress."""
