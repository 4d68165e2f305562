"""What the logs of runs say of the parts that they made.

of_lake         the logs of all runs, oldest first
of_products     those of runs that made the table `products`
lines           one of them: an object for its start, one a part, one for its end
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
# What a line says: of a run, of a part.
_FIELD_TYPES: dict[str, tuple[type, ...]] = {
    "job": (str,), "status": (str,), "prepare_s": (float, int), "prepare_cpu_s": (float, int),
    "part": (str,), "error": (str,), "attempt": (int,), "seconds": (float, int), "cpu_s": (float, int),
    "peak_gb": (float, int), "rows": (int,), "bytes": (int,),
}  # fmt: skip
_MAX_VALUE = 1e15


def logs_of_lake(root: Folder) -> list[Path]:
    """The files, in the order of their runs; none of a lake on object storage: they stay where the jobs ran."""
    return [] if isinstance(root, ObjectPath) else sorted(layout.runs_folder(root).glob("*.jsonl"))


def logs_of_products(root: Folder) -> list[Path]:
    """The same of table `products`."""
    return [path for path in logs_of_lake(root) if fnmatch(path.name, "*-products-*.jsonl")]


def lines(path: Path) -> list[dict[str, Any]]:
    """The lines of a log; the last one of a run that was killed may be anything, and is left out then.

    Errors : Damaged names the line that no run writes
    """
    with user_files.open_file(path, "run log") as stream:
        texts = stream.read().split(b"\n")
    entries = []
    for number, text in enumerate(texts, start=1):
        try:
            entries.append(_check_line(json.loads(text)))
        except (ValueError, RecursionError, TypeError):
            if any(texts[number:]):
                raise Damaged(f"{user_files.format_path(path)} line {number} is not what a run writes") from None
    return entries


def _check_line(line: Any) -> dict[str, Any]:
    """The line; TypeError where it is not one that a run writes."""
    if not isinstance(line, dict):
        raise TypeError
    for name, types in _FIELD_TYPES.items():
        value = line.get(name, types[0]())
        if type(value) not in types or (types != (str,) and not 0 <= value < _MAX_VALUE):
            raise TypeError
    return line
