"""State of a run for its display: jobs with their forecast times, finished parts of tables, activities of processes.

The process that computes writes small JSON files to the folder in $TRUESKY_ACTIVITY, and the process that controls the
terminal reads them. Without the variable, nothing is written.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from truesky.numerics import activity
from truesky.numerics.activity import Activity

# Files that describe the jobs of the run, the present job, all its tables, and the table that it makes.
_RUN, _JOB, _TABLES, _TABLE = "run.json", "job.json", "tables.json", "table.json"
# Average progress of a part on which a worker is working, as a fraction.
_PART_IN_WORK = 0.5
# Largest number in a file that is believed.
_MOST = 1e15


@dataclass(frozen=True, slots=True)
class TableState:
    """Progress of the table that is being made. Each part is a file that a worker writes.

    Attributes
    ----------
    name : str
        Name of the table.
    unit : str
        Word for a part, such as "detector".
    parts, done : int
        Number of all parts and of finished parts.
    parts_before : int
        Number of parts of the tables of the same job that were made before.
    """

    name: str
    unit: str
    parts: int
    done: int
    parts_before: int


@dataclass(frozen=True, slots=True)
class RunState:
    """Progress of a run at one moment.

    Attributes
    ----------
    jobs : tuple of (str, float)
        Name and forecast wall time (s) of each job. Empty until the forecast is known.
    workers : int
        Number of parts that are computed at the same time.
    finished : tuple of float
        Wall times of the finished jobs, s. The next job is the present one.
    job_started : float
        Start of the present job, s since 1970.
    tables_started : float
        Time at which the present job had prepared the making of its tables, s since 1970; 0 before.
    parts_of_job : int
        Number of parts of all tables of the present job that workers make.
    table : TableState or None
        Table that the present job makes; None before its first table.
    activities : tuple of Activity
        What processes are doing, the oldest first.
    """

    jobs: tuple[tuple[str, float], ...] = ()
    workers: int = 1
    finished: tuple[float, ...] = ()
    job_started: float = 0.0
    tables_started: float = 0.0
    parts_of_job: int = 0
    table: TableState | None = None
    activities: tuple[Activity, ...] = ()

    @property
    def job(self) -> str | None:
        """Return the name of the present job; None before the first job and after the last one."""
        return self.jobs[len(self.finished)][0] if len(self.finished) < len(self.jobs) else None


def announce_run(jobs: Sequence[tuple[str, float]], workers: int) -> None:
    """Tell the display the names and forecast wall times (s) of all jobs, and how many parts run at the same time."""
    _write(_RUN, {"jobs": list(jobs), "workers": workers})


def announce_job(finished: Sequence[float]) -> None:
    """Tell the display that the next job starts, or that the last has ended.

    `finished` are the wall times (s) of the jobs that have ended.
    """
    _write(_TABLE, {})
    _write(_TABLES, {})
    _write(_JOB, {"finished": list(finished), "job_started": time.time()})


def announce_tables(parts: int) -> None:
    """Tell the display that the making of the present job's tables starts, which have a number of parts together."""
    _write(_TABLES, {"tables_started": time.time(), "parts_of_job": parts})


@contextlib.contextmanager
def table_in_work(name: str, unit: str, receipts: Path, parts: int, parts_before: int) -> Iterator[None]:
    """Show in the display of the run that the parts of a table are made inside the `with` block.

    Parameters
    ----------
    name : str
        Name of the table.
    unit : str
        Word for a part, such as "detector".
    receipts : Path
        Folder in which each finished part leaves one JSON file.
    parts : int
        Number of parts of the table.
    parts_before : int
        Number of parts of earlier tables of the job.

    Yields
    ------
    None
    """
    table = {"name": name, "unit": unit, "parts": parts, "parts_before": parts_before}
    _write(_TABLE, {**table, "receipts": str(receipts)})
    try:
        yield
    finally:
        _write(_TABLE, {**table, "done": parts})


def count_receipts(folder: Path) -> int:
    """Return the number of finished parts, each of which has left a JSON file in the folder; 0 if it is unreadable."""
    try:
        return sum(1 for path in folder.glob("*.json") if not path.name.startswith("."))
    except (OSError, ValueError):
        return 0


def read_state(folder: Path) -> RunState:
    """Return the state of a run from the files in its folder.

    Files that are not there yet, or are damaged, are left out: the state is only shown.
    """
    run, job, tables, table = (_read(folder / name) for name in (_RUN, _JOB, _TABLES, _TABLE))
    jobs, finished = run.get("jobs"), job.get("finished")
    pairs = jobs if isinstance(jobs, list) else []
    return RunState(
        tuple((str(pair[0]), _seconds(pair[1])) for pair in pairs if isinstance(pair, list) and len(pair) == 2),
        max(_count(run.get("workers")), 1),
        tuple(_seconds(value) for value in finished) if isinstance(finished, list) else (),
        _seconds(job.get("job_started")),
        _seconds(tables.get("tables_started")),
        _count(tables.get("parts_of_job")),
        _table_state(table) if table else None,
        tuple(activity.read_activities(folder)),
    )


def _table_state(table: dict[str, Any]) -> TableState:
    receipts = table.get("receipts")
    done = _count(table["done"]) if "done" in table else count_receipts(Path(str(receipts))) if receipts else 0
    name, unit = (str(table.get(key, "")) for key in ("name", "unit"))
    return TableState(name, unit, _count(table.get("parts")), done, _count(table.get("parts_before")))


def _seconds(value: object) -> float:
    """Return a time that was read; 0 if it is no finite number of 0 or more."""
    return float(value) if isinstance(value, int | float) and 0 <= value <= _MOST else 0.0


def _count(value: object) -> int:
    """Return a number of things that was read; 0 if it is no whole number of 0 or more."""
    return value if isinstance(value, int) and 0 <= value <= _MOST else 0


def time_left(state: RunState, now: float) -> float | None:
    """Estimate the remaining wall time of a run.

    Parameters
    ----------
    state : RunState
        State of the run.
    now : float
        Time, s since 1970.

    Returns
    -------
    float or None
        Seconds; None if there is no forecast. Before the first part of the present job is finished, the remaining time
        of the job follows from the forecast. Later it follows from the time per part. The forecast times of jobs that
        have not started are multiplied by the measured over the forecast time of all finished work.
    """
    if state.job is None:
        return None
    number, elapsed = len(state.finished), max(now - state.job_started, 0.0)
    forecast = [seconds for _, seconds in state.jobs]
    share = _finished_share(state)
    measured = sum(state.finished) + (elapsed if share > 0.0 else 0.0)
    expected = sum(forecast[:number]) + forecast[number] * share
    pace = measured / expected if expected > 0.0 else 1.0
    making = max(now - state.tables_started, 0.0)
    present = making * (1.0 - share) / share if share > 0.0 else max(forecast[number] * pace - elapsed, 0.0)
    return present + pace * sum(forecast[number + 1 :])


def _finished_share(state: RunState) -> float:
    """Return the finished fraction of the present job; 0 before its first part is finished."""
    table = state.table
    if table is None or not (done := table.parts_before + table.done):
        return 0.0
    remaining = max(state.parts_of_job - done, 0)
    return (done + _PART_IN_WORK * min(state.workers, remaining)) / max(state.parts_of_job, done)


def _write(name: str, content: dict[str, object]) -> None:
    if folder := os.environ.get(activity.SETTING):
        activity.write_json(Path(folder) / name, content)


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}
