"""Compare the costs of images that have been rendered (CPU time, memory, size) with their forecast."""

from __future__ import annotations

import contextlib
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from lake_schema import sky
from lake_schema.errors import LakeError
from lake_schema.store import read
from lake_schema.texts import text_tables
from truesky.render.camera import footprints
from truesky.render.forecasting.image_costs import size_ratio
from truesky.render.planning import exposure_chunks
from truesky.render.products import run_log

# HEALPix order of the cells (0.2 arcmin2) with which the area of footprints is measured: cells with their centre in a
# footprint are counted. The error of a detector's area is 2 %.
_ORDER = 13
# Name in place of the channel or camera in a line of the result that adds up several channels or cameras.
_ALL = "all"
# Image types for which CPU time per area of the sky is computed. Other exposures see special fields, or no sky.
_SURVEY_TYPES = ("science", "deep")
# Columns of the table `tasks` (one row per planned detector of an exposure) that are read.
_TASK_COLUMNS = ("exposure_id", "detector", "channel", "seconds", "bytes", "ra", "dec", "radius", "s_region")
# Channel, camera and image type; the costs of all exposures with the same three are added up in one line.
_Kind = tuple[str, str, str]


@dataclass(frozen=True, slots=True)
class Line:
    """CPU time, memory and file size of all images of a channel, camera and image type, or of several such groups.

    Attributes
    ----------
    channel, camera, image_type : str
        Channel, camera and image type. A line that adds up several groups has camera "all" and image type "", and
        the sum over everything also has channel "all".
    planned, rendered, measured : int
        Number of detector images that are planned, that the lake contains, and whose cost is recorded in a log.
    cpu_s, forecast_s : float
        Actual and forecast CPU seconds of the measured images.
    peak_gb : float
        Largest peak memory of a process in GB; 0 if unknown.
    gb, forecast_gb : float
        Actual and forecast file size of the rendered images in GB.
    deg2 : float
        Area of the sky in the measured images of image type "science" or "deep", each place counted once. 0 for other
        types and for sums.
    core_hours_deg2 : float
        Core-hours per square degree of this area, all its exposures included. It is 0 for other types. A line that adds
        up several groups has the sum of their values.
    """

    channel: str
    camera: str
    image_type: str
    planned: int
    rendered: int
    measured: int
    cpu_s: float
    forecast_s: float
    peak_gb: float
    gb: float
    forecast_gb: float
    deg2: float
    core_hours_deg2: float


def summarise(root: Path, request: str | None = None, factor: float = 1.0) -> list[Line]:
    """Compare CPU time, memory and size of a request's rendered images with their forecast.

    Parameters
    ----------
    root : Path
        Lake (folder of stored tables and images).
    request : str, optional
        Name of the request; None if the lake has only one.
    factor : float, optional
        CPU time of this machine relative to the reference machine, whose CPU seconds the stored forecast has.

    Returns
    -------
    list of Line
        One line per channel, camera and image type, then one per channel, and one for everything.

    Notes
    -----
    An error is raised if the lake has no images of the request.
    """
    products = read.version(root, "products", request=request)
    input_versions = products.manifest["facts"]["inputs"]
    tasks, exposures = (read.version(root, name, input_versions[name]) for name in ("tasks", "exposures"))
    sizes = {entry["path"]: entry["bytes"] for entry in products.manifest["files"]}
    task_facts = {part["name"]: part for part in products.manifest["parts"]}
    metrics = _task_metrics(root, products.key)
    rendered = {
        (part["facts"]["exposure_id"], part["facts"]["detector"]): (
            sum(sizes[path] for path in part.get("files", ())),
            metrics.get(name, {}),
        )
        for name, part in task_facts.items()
    }
    exposure_columns = exposures.rows(("exposure_id", "camera", "image_type"))
    tasks_of_kind: dict[_Kind, list[dict[str, Any]]] = defaultdict(list)
    # Read the rows of rendered exposures only: the tables of all planned exposures may be larger than the memory.
    # Exposures that are not rendered are only counted.
    exposure_ids = {number for number, _ in rendered}
    exposure_rows = {
        row["exposure_id"]: row
        for row in exposure_chunks.rows_of_exposures(exposures, exposure_ids, exposure_columns.column_names).to_pylist()
    }
    for task in exposure_chunks.rows_of_exposures(tasks, exposure_ids, _TASK_COLUMNS).to_pylist():
        tasks_of_kind[_kind({**task, **exposure_rows[task["exposure_id"]]})].append(task)
    files = products.manifest["facts"]["request"]
    form = files["compression"], files["readout"], files["truth"]
    lines = [
        _line(kind, number, tasks_of_kind[kind], rendered, (factor, size_ratio(kind[0], kind[2], *form)))
        for kind, number in sorted(_planned_counts(tasks, exposure_columns).items())
    ]
    channels = sorted({line.channel for line in lines})
    sums = [_sum(channel, [line for line in lines if line.channel == channel]) for channel in channels]
    return [*lines, *sums, _sum(_ALL, lines)]


# For each rendered image, by exposure number and detector name: size of its files in bytes, and the CPU time and memory
# that its log records (empty if unknown).
RenderedTasks = Mapping[tuple[int, str], tuple[int, Mapping[str, Any]]]


def _kind(row: Mapping[str, Any]) -> _Kind:
    return row["channel"], row["camera"], row["image_type"]


def _planned_counts(tasks: read.Version, exposures: pa.Table) -> dict[_Kind, int]:
    """Return the number of planned detector images for each (channel, camera, image type)."""
    counts: Counter[_Kind] = Counter()
    for table in exposure_chunks.rows_by_partition(tasks, ("exposure_id", "channel")):
        sums = table.join(exposures, "exposure_id").group_by(["channel", "camera", "image_type"])
        for row in sums.aggregate([("exposure_id", "count")]).to_pylist():
            counts[_kind(row)] += row["exposure_id_count"]
    return counts


def _line(
    kind: _Kind, planned: int, tasks: Sequence[dict[str, Any]], rendered: RenderedTasks, factors: tuple[float, float]
) -> Line:
    """Return the costs of one kind of images.

    `factors` are the CPU time relative to the reference machine, and the size of files relative to uncompressed ones.
    """
    rendered_tasks = [
        (task, *rendered[place]) for task in tasks if (place := (task["exposure_id"], task["detector"])) in rendered
    ]
    measured_tasks = [(task, metrics) for task, _, metrics in rendered_tasks if metrics]
    cpu = sum(metrics["cpu_s"] for _, metrics in measured_tasks)
    deg2 = _covered_area([task for task, _ in measured_tasks]) if kind[2] in _SURVEY_TYPES else 0.0
    return Line(
        *kind,
        planned=planned,
        rendered=len(rendered_tasks),
        measured=len(measured_tasks),
        cpu_s=cpu,
        forecast_s=factors[0] * sum(task["seconds"] for task, _ in measured_tasks),
        peak_gb=max((metrics.get("peak_gb", 0.0) for _, metrics in measured_tasks), default=0.0),
        gb=sum(size for _, size, _ in rendered_tasks) / 1e9,
        forecast_gb=factors[1] * sum(task["bytes"] for task, *_ in rendered_tasks) / 1e9,
        deg2=deg2,
        core_hours_deg2=cpu / 3600.0 / deg2 if deg2 else 0.0,
    )


def _sum(name: str, lines: Sequence[Line]) -> Line:
    names = ("planned", "rendered", "measured", "cpu_s", "forecast_s", "gb", "forecast_gb", "core_hours_deg2")
    total = {field: sum(getattr(line, field) for line in lines) for field in names}
    peak = max((line.peak_gb for line in lines), default=0.0)
    return Line(name, _ALL, "", **total, peak_gb=peak, deg2=0.0)


def _covered_area(tasks: Sequence[dict[str, Any]]) -> float:
    """Return the area of the sky in deg2 that the footprints of some detectors cover together, overlaps counted once.

    `tasks` are rows of the table `tasks` with the footprints; without rows the area is 0.
    """
    footprint_rows = [{name: task[name] for name in ("ra", "dec", "radius", "s_region")} for task in tasks]
    if not footprint_rows:
        return 0.0
    cells = np.unique(
        np.concatenate([sky.cells_in_cone(t["ra"], t["dec"], t["radius"], _ORDER) for t in footprint_rows])
    )
    counts = footprints.counts(pa.Table.from_pylist(footprint_rows), *sky.cell_centres(_ORDER, cells))
    return float((counts > 0).sum() * sky.cell_area(_ORDER))


def _task_metrics(root: Path, key: str) -> dict[str, Mapping[str, Any]]:
    """Return the CPU time and memory in the logs of each detector image, by name of its partition in `products`.

    `key` selects the version of the table `products` (one row per image). A later run replaces an earlier one. Logs
    that cannot be read and failed images are skipped.
    """
    metrics: dict[str, Mapping[str, Any]] = {}
    for path in run_log.logs_of_products(root):
        with contextlib.suppress(LakeError, OSError):
            first, *lines = run_log.lines(path) or [{}]
            if first.get("key") == key:
                metrics |= {
                    line["part"]: line for line in lines if "part" in line and "error" not in line and "cpu_s" in line
                }
    return metrics


_HEADINGS = (
    "channel", "camera", "image type", "images", "planned", "CPU time, s", "forecast, s", "peak memory, GB", "size, GB",
    "forecast, GB", "area, deg2", "CPU h/deg2",
)  # fmt: skip


def format_table(lines: Sequence[Line]) -> list[str]:
    """Return the comparison as lines of a text table, beginning with the headings.

    Lines without a rendered image are left out, and so are sums of a single line, columns without any value, and the
    column of planned images if all are rendered. "-" means that a value is unknown or does not apply.
    """
    kinds = [line for line in lines if line.camera != _ALL and line.rendered]
    channels = Counter(line.channel for line in kinds)
    sums = [
        line
        for line in lines
        if line.camera == _ALL and (channels[line.channel] > 1 or (line.channel == _ALL and len(kinds) > 1))
    ]
    rows = [_cells(line) for line in (*kinds, *sums)]
    columns = [
        i
        for i, heading in enumerate(_HEADINGS)
        if any(row[i] not in ("", "-") for row in rows)
        and (heading != "planned" or any(line.planned != line.rendered for line in kinds))
    ]
    headings = [_HEADINGS[i] for i in columns]
    return text_tables.format_table(headings, [[row[i] for i in columns] for row in rows], _HEADINGS[3:])


def _cells(line: Line) -> tuple[str, ...]:
    def number(value: float, digits: int) -> str:
        # Print small values with two significant digits, so that none appears as 0.
        if not value:
            return "-"
        return f"{value:,.{digits}f}" if value >= 10.0**-digits else f"{value:.2g}"

    return (
        line.channel, line.camera, line.image_type, f"{line.rendered:,}", f"{line.planned:,}", number(line.cpu_s, 1),
        number(line.forecast_s, 1), number(line.peak_gb, 2), number(line.gb, 3), number(line.forecast_gb, 3),
        number(line.deg2, 3), number(line.core_hours_deg2, 2),
    )  # fmt: skip
