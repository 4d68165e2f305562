"""Whether there is room for what a request makes: its forecast against what is free on the lake's disc.

check    refuse where there is not
"""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

import pyarrow as pa

from jobs.render import catalogue_forecast
from jobs.render.planning import tasks as planned
from jobs.render.products import run_log
from jobs.request.schema import Request
from lake_schema.errors import BadInput, LakeError
from lake_schema.store import layout

_GB = 1e9


def check(root: Path, request: Request, tasks: pa.Table | None) -> None:
    """Refuses a run whose forecast is larger than what is free; what an earlier run left of it is taken off.

    tasks : rows of the table `tasks` that have a simulator, None = nothing is rendered
    """
    foreseen = {line.job: line.gb * _GB for line in catalogue_forecast.of_request(request)}
    if tasks is not None:
        foreseen["render_exposures"] = sum(row["bytes"] for row in planned.part(tasks, request))
    total = max(sum(foreseen.values()) - _left(root, request), 0.0)
    free = shutil.disk_usage(next(path for path in (root, *root.parents) if path.exists())).free
    if total > free:
        parts = ", ".join(f"{name} {size / _GB:.2f}" for name, size in foreseen.items())
        raise BadInput(
            f"lake {root}: {free / _GB:.2f} GB are free, the forecast is {total / _GB:.2f} GB ({parts}): make room, or "
            "ask for a part of it (--detectors, --limit)"
        )


def _left(root: Path, request: Request) -> float:
    """Bytes of the versions, whole or in the making, that the last runs of a request of this name made."""
    keys: dict[str, str] = {}
    for path in run_log.of_lake(root):
        with contextlib.suppress(LakeError):
            first = next(iter(run_log.lines(path)), {})
            if first.get("request") == request.name:
                keys[layout.name(first.get("table", ""))] = layout.name(first.get("key", ""))
    folders = [place(root, *item) for item in keys.items() for place in (layout.version, layout.stage)]
    return sum(file.stat().st_size for folder in folders for file in folder.rglob("*") if file.is_file())
