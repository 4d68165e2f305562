"""Whether there is room for what a request makes: its forecast against what is free on the lake's disc.

check    refuse where there is not
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pyarrow as pa

from jobs.render.planning import tasks as planned
from jobs.request.schema import Request
from lake_schema.errors import BadInput

_GB = 1e9


def check(root: Path, request: Request, tasks: pa.Table | None) -> None:
    """Refuses a run whose forecast is larger than what is free; what an earlier run left of it is taken off.

    tasks : rows of the table `tasks`, None = nothing is rendered
    """
    foreseen = {} if tasks is None else {"images": float(sum(row["bytes"] for row in planned.part(tasks, request)))}
    total = sum(foreseen.values())
    free = shutil.disk_usage(next(path for path in (root, *root.parents) if path.exists())).free
    if total > free:
        parts = ", ".join(f"{name} {size / _GB:.2f}" for name, size in foreseen.items())
        raise BadInput(
            f"lake {root}: {free / _GB:.2f} GB are free, the forecast is {total / _GB:.2f} GB ({parts}): make room, or "
            "ask for a part of it (--detectors, --limit)"
        )
