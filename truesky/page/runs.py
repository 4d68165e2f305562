"""What was done for a lake: tasks, seconds and GB beside forecasts, failures, the mission, where an image is from."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.errors import LakeError
from lake_schema.mission.configuration import resolve
from lake_schema.store import names as named
from lake_schema.store import read
from truesky.commands import report
from truesky.page import pictures
from truesky.page.answers import plain
from truesky.page.opened import Lake, Requested

_DEEPEST = 8
Json = dict[str, Any]


def runs(lake: Lake) -> Json:
    """Jobs with their forecasts, tasks done of all, failures, and what of the mission is not as truesky has it."""
    found: Json = {"jobs": [], "tasks": [], "failures": [], "mission": []}
    try:
        found["jobs"] = [
            {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in asdict(line).items()}
            for line in report.rows(lake.root)
        ]
    except LakeError as error:
        found["said"] = str(error)
    done = {one.place for one in pictures.pictures(lake)}
    for own in lake.observed:
        about = {"request": own.request}
        if number := own.versions["tasks"].num_rows if "tasks" in own.versions else 0:
            left, seconds = _left(own, {place[1:] for place in done if place[0] == own.request})
            found["tasks"].append(about | {"done": number - left, "all": number, "seconds_left": seconds})
        found["failures"] += [about | {k: plain(v) for k, v in row.items()} for row in pictures.failures(lake, own)]
    for own in lake.requested("mission"):
        found["mission"] += [{"request": own.request, **row} for row in _changed(own.versions["mission"])]
    return found


def _left(own: Requested, done: set[tuple[int, str]]) -> tuple[int, float]:
    """Detectors that are planned and not done: how many, and their seconds."""
    begun = pa.array([*{exposure for exposure, _ in done}], pa.int64())
    number, seconds = 0, 0.0
    for rows in own.pieces("tasks", ["exposure_id", "detector", "seconds"]):
        is_begun = pc.is_in(rows["exposure_id"], begun)
        some = rows.filter(is_begun).to_pylist()
        left = [row["seconds"] for row in some if (row["exposure_id"], row["detector"]) not in done]
        others = rows.filter(pc.invert(is_begun))
        number += len(left) + others.num_rows
        seconds += sum(left) + (pc.sum(others["seconds"]).as_py() or 0.0)
    return number, seconds


def _changed(version: read.Version) -> list[Json]:
    """Parameters that a request gave another value than they have in the mission database of this truesky."""
    rows = version.rows(["name", "value", "unit", "overridden"]).to_pylist()
    usual = resolve()
    return [
        {"name": row["name"], "value": plain(row["value"]), "unit": row["unit"],
         "usual": plain(usual.parameter(row["name"]).value) if row["name"] in usual else None}
        for row in rows
        if row["overridden"]
    ]  # fmt: skip


def provenance(lake: Lake, number: int) -> Json:
    """A tree: the image, the version of the table that it is of, what that was made of, and so on.

    number : of the image
    """
    one = pictures.picture(lake, number)
    return {
        "name": one.row["path"].rpartition("/")[2],
        "about": f"sha256 {one.version.sha256(one.row['path'])}",
        "from": [_tree(lake, one.version, 0)],
    }


def _tree(lake: Lake, version: read.Version, depth: int) -> Json:
    keys = set(named.keys_in(version.manifest.get("facts", {})))
    made_of = []
    for table in read.tables(lake.root) if depth < _DEEPEST else []:
        for key in sorted(keys):
            try:
                made_of.append(_tree(lake, read.version(lake.root, table, key), depth + 1))
            except LakeError:
                continue
    about = f"version {version.key}, {version.num_rows:,} rows, truesky {version.manifest.get('truesky', '')}"
    return {"name": version.table, "about": about, "from": made_of}
