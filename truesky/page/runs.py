"""Answers to the web page about the computations that filled a lake.

They contain the time and disc space of the jobs with their forecasts, the progress and failures of rendering, the
mission parameters (of telescope, cameras and survey) that users changed, and the provenance of an image.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.errors import LakeError
from lake_schema.mission.configuration import resolve
from lake_schema.store import read
from lake_schema.store import request_links as named
from truesky.commands import report
from truesky.page import pictures
from truesky.page.answers import to_json_value
from truesky.page.lake_session import LakeSession, RequestTables

_MAX_DEPTH = 8
Json = dict[str, Any]


def runs(lake: LakeSession) -> Json:
    """Return the state of all computations of the lake.

    The keys of the result are `jobs` (time, memory and disc space of each job, measured and forecast), `tasks` (per
    request the numbers of planned and of finished detectors, and the forecast CPU time of the others in s), `failures`
    (detectors whose last attempt failed) and `mission` (mission parameters that a request has changed). If the logs
    cannot be read, `jobs` is empty, and `said` is the reason.
    """
    result: Json = {"jobs": [], "tasks": [], "failures": [], "mission": []}
    try:
        result["jobs"] = [
            {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in asdict(line).items()}
            for line in report.job_totals(lake.root)
        ]
    except LakeError as error:
        result["said"] = str(error)
    done = {image.detector_key for image in pictures.pictures(lake)}
    for request_tables in lake.observed_requests:
        label = {"request": request_tables.request}
        if number := request_tables.versions["tasks"].num_rows if "tasks" in request_tables.versions else 0:
            remaining, seconds = _remaining_work(
                request_tables, {place[1:] for place in done if place[0] == request_tables.request}
            )
            result["tasks"].append(label | {"done": number - remaining, "all": number, "seconds_left": seconds})
        result["failures"] += [
            label | {k: to_json_value(v) for k, v in row.items()}
            for row in pictures.failed_detectors(lake, request_tables)
        ]
    for request_tables in lake.request_tables("mission"):
        result["mission"] += [
            {"request": request_tables.request, **row}
            for row in _overridden_parameters(request_tables.versions["mission"])
        ]
    return result


def _remaining_work(request_tables: RequestTables, done: set[tuple[int, str]]) -> tuple[int, float]:
    """Return the number of planned detector images that do not exist yet, and the forecast of their CPU time in s.

    `done` contains the number of the exposure and the name of the detector for each existing image.
    """
    begun = pa.array([*{exposure for exposure, _ in done}], pa.int64())
    number, seconds = 0, 0.0
    for rows in request_tables.iterate_rows("tasks", ["exposure_id", "detector", "seconds"]):
        is_begun = pc.is_in(rows["exposure_id"], begun)
        begun_rows = rows.filter(is_begun).to_pylist()
        remaining_seconds = [row["seconds"] for row in begun_rows if (row["exposure_id"], row["detector"]) not in done]
        other_rows = rows.filter(pc.invert(is_begun))
        number += len(remaining_seconds) + other_rows.num_rows
        seconds += sum(remaining_seconds) + (pc.sum(other_rows["seconds"]).as_py() or 0.0)
    return number, seconds


def _overridden_parameters(version: read.Version) -> list[Json]:
    """Return the mission parameters (of telescope, cameras or survey) that a request has changed.

    `version` is the request's version of the table `mission`. Each dictionary has `name`, `value`, `unit`, and `usual`,
    the default value in the mission database of the running truesky (None if this database has no such parameter).
    """
    rows = version.rows(["name", "value", "unit", "overridden"]).to_pylist()
    defaults = resolve()
    return [
        {"name": row["name"], "value": to_json_value(row["value"]), "unit": row["unit"],
         "usual": to_json_value(defaults.parameter(row["name"]).value) if row["name"] in defaults else None}
        for row in rows
        if row["overridden"]
    ]  # fmt: skip


def provenance(lake: LakeSession, number: int) -> Json:
    """Return the provenance of an image as a tree.

    The root is the image file. Its child is the version of the table `products` that lists the file. The children of a
    version are the versions of other tables from which it was computed, and so on.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    number : int
        Number of the image: its index in the list of `pictures.pictures`.

    Returns
    -------
    dict
        A node of the tree with `name`, `about` (a text) and `from` (list of child nodes).

    Notes
    -----
    BadInput is raised if there is no image with this number.
    """
    image = pictures.picture(lake, number)
    return {
        "name": image.row["path"].rpartition("/")[2],
        "about": f"sha256 {image.version.file_sha256(image.row['path'])}",
        "from": [_provenance_tree(lake, image.version, 0)],
    }


def _provenance_tree(lake: LakeSession, version: read.Version, depth: int) -> Json:
    keys = set(named.version_keys_in(version.manifest.get("facts", {})))
    inputs = []
    for table in read.table_names(lake.root) if depth < _MAX_DEPTH else []:
        for key in sorted(keys):
            try:
                inputs.append(_provenance_tree(lake, read.version(lake.root, table, key), depth + 1))
            except LakeError:
                continue
    summary = f"version {version.key}, {version.num_rows:,} rows, truesky {version.manifest.get('truesky', '')}"
    return {"name": version.table, "about": summary, "from": inputs}
