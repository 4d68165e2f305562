"""Read the log files of job runs.

A log has one JSON object per line: one for the start of the run, one for each finished or failed partition of the table
that is made, and one for the end of the run.
"""

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
# Allowed types of the fields in a line of a run's log. Fields up to "prepare_cpu_s" belong to lines about the whole
# run, fields from "part" on to lines about one partition of the table that is made.
_FIELD_TYPES: dict[str, tuple[type, ...]] = {
    "job": (str,), "status": (str,), "prepare_s": (float, int), "prepare_cpu_s": (float, int),
    "part": (str,), "error": (str,), "attempt": (int,), "seconds": (float, int), "cpu_s": (float, int),
    "peak_gb": (float, int), "rows": (int,), "bytes": (int,),
}  # fmt: skip
# Numbers in a line of a run's log (seconds, GB, rows, bytes) must be at least 0 and below this value; otherwise the
# line counts as damaged.
_MAX_VALUE = 1e15


def logs_of_lake(root: Folder) -> list[Path]:
    """Return the log files of all runs in a lake (folder of stored tables), oldest first.

    The list is empty for a lake on object storage, whose logs stay on the machines that ran the jobs.
    """
    return [] if isinstance(root, ObjectPath) else sorted(layout.runs_folder(root).glob("*.jsonl"))


def logs_of_products(root: Folder) -> list[Path]:
    """Return the log files of the runs that rendered images (made the table `products`), oldest first."""
    return [path for path in logs_of_lake(root) if fnmatch(path.name, "*-products-*.jsonl")]


def lines(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a log file as dicts.

    An incomplete last line, which a killed run may leave, is omitted. Raises Damaged, with the line number, if another
    line is not a valid JSON object of a log.
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
    """Return a parsed log line unchanged.

    Raises TypeError if it is not a dict, or if a known field has a wrong type or a number outside 0 to 1e15.
    """
    if not isinstance(line, dict):
        raise TypeError
    for name, types in _FIELD_TYPES.items():
        value = line.get(name, types[0]())
        if type(value) not in types or (types != (str,) and not 0 <= value < _MAX_VALUE):
            raise TypeError
    return line
