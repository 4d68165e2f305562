"""Read the log files of runs: one JSON object per line for the start, for each task, and for the end of a run."""

from __future__ import annotations

import json
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from lake_schema import user_files
from lake_schema.errors import Damaged
from lake_schema.store import layout
from lake_schema.store.object_storage.s3 import Folder, ObjectPath

Json = dict[str, Any]
# Types of the fields of a line, for a run and for a task.
_FIELD_TYPES: dict[str, tuple[type, ...]] = {
    "job": (str,), "status": (str,), "prepare_s": (float, int), "prepare_cpu_s": (float, int),
    "part": (str,), "error": (str,), "attempt": (int,), "seconds": (float, int), "cpu_s": (float, int),
    "peak_gb": (float, int), "rows": (int,), "bytes": (int,),
}  # fmt: skip
_MAX_VALUE = 1e15


def logs_of_lake(root: Folder) -> list[Path]:
    """Return the log files of all runs, oldest first.

    The list is empty for a lake on object storage, whose logs stay on the machines that ran the jobs.
    """
    return [] if isinstance(root, ObjectPath) else sorted(layout.runs_folder(root).glob("*.jsonl"))


def logs_of_products(root: Folder) -> list[Path]:
    """Return the log files of the runs that made the table `products`, oldest first."""
    return [path for path in logs_of_lake(root) if fnmatch(path.name, "*-products-*.jsonl")]


def lines(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a log; an incomplete last line of a killed run is omitted.

    Raises Damaged, with the line number, if another line is invalid.
    """
    with user_files.open_file(path, "run log") as stream:
        texts = stream.read().split(b"\n")
    entries = []
    for number, text in enumerate(texts, start=1):
        try:
            entries.append(_check_line(json.loads(text)))
        except (ValueError, RecursionError, TypeError):
            if any(texts[number:]):
                raise Damaged(f"{user_files.format_path(path)} line {number} is not a valid log line") from None
    return entries


def _check_line(line: Any) -> dict[str, Any]:
    """Return the line. Raises TypeError if a run would not write it."""
    if not isinstance(line, dict):
        raise TypeError
    for name, types in _FIELD_TYPES.items():
        value = line.get(name, types[0]())
        if type(value) not in types or (types != (str,) and not 0 <= value < _MAX_VALUE):
            raise TypeError
    return line
