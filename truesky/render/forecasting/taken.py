"""What a request's detectors took, beside their forecast: CPU, memory, bytes, core-hours a square degree.

rows     a line a channel, camera and image type, one a channel, one of all
text     the table that a person reads
"""

from __future__ import annotations

import contextlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from lake_schema import sky
from lake_schema.errors import LakeError
from lake_schema.store import read
from truesky.render.camera import footprints
from truesky.render.planning import parts
from truesky.render.products import run_log

# Cells of the sky that are counted where their centre is seen, 0.2 arcmin2: of a detector's area right to 2 %.
_ORDER = 13
_ALL = "all"
# Image types that survey the sky: others are taken where it is bright or dense.
_SURVEYED = ("science", "deep")
_TASK = ("exposure_id", "detector", "channel", "seconds", "bytes", "ra", "dec", "radius", "s_region")
# Channel, camera, image type.
_Kind = tuple[str, str, str]


@dataclass(frozen=True, slots=True)
class Line:
    """One kind of exposure.

    planned, made, measured : detectors; of which the lake has images; of which a log says what they took
    cpu_s, forecast_s       : of those that were measured
    peak_gb                 : largest memory of a process that made one
    gb, forecast_gb         : of those that are made
    deg2                    : of the sky that those see that are measured, each place once; 0 = none is of a survey
    core_hours_deg2         : of these, as often as each place is seen; of sums the sum; 0 = none is of a survey
    """

    channel: str
    camera: str
    image_type: str
    planned: int
    made: int
    measured: int
    cpu_s: float
    forecast_s: float
    peak_gb: float
    gb: float
    forecast_gb: float
    deg2: float
    core_hours_deg2: float


def rows(root: Path, request: str | None = None, factor: float = 1.0) -> list[Line]:
    """Of a request's images, or of the lake's only ones.

    factor : CPU s of this machine over those of the forecast
    """
    products = read.version(root, "products", request=request)
    made_of = products.manifest["facts"]["inputs"]
    tasks, exposures = (read.version(root, name, made_of[name]) for name in ("tasks", "exposures"))
    sizes = {entry["path"]: entry["bytes"] for entry in products.manifest["files"]}
    named = {part["name"]: part for part in products.manifest["parts"]}
    took = _took(root, products.key)
    made = {
        (part["facts"]["exposure_id"], part["facts"]["detector"]): (
            sum(sizes[path] for path in part.get("files", ())),
            took.get(name, {}),
        )
        for name, part in named.items()
    }
    about = exposures.rows(("exposure_id", "camera", "image_type"))
    kinds: dict[_Kind, list[dict[str, Any]]] = defaultdict(list)
    # Of a large plan a small part may be made: of the others it counts how many there are.
    numbers = {number for number, _ in made}
    exposed = {
        row["exposure_id"]: row for row in parts.of_exposures(exposures, numbers, about.column_names).to_pylist()
    }
    for task in parts.of_exposures(tasks, numbers, _TASK).to_pylist():
        kinds[_kind({**task, **exposed[task["exposure_id"]]})].append(task)
    own = [_line(kind, number, kinds[kind], made, factor) for kind, number in sorted(_planned(tasks, about).items())]
    channels = sorted({line.channel for line in own})
    sums = [_sum(channel, [line for line in own if line.channel == channel]) for channel in channels]
    return [*own, *sums, _sum(_ALL, own)]


Made = Mapping[tuple[int, str], tuple[int, Mapping[str, Any]]]


def _kind(row: Mapping[str, Any]) -> _Kind:
    return row["channel"], row["camera"], row["image_type"]


def _planned(tasks: read.Version, exposures: pa.Table) -> dict[_Kind, int]:
    """How many detectors of each kind are planned."""
    found: Counter[_Kind] = Counter()
    for some in parts.each(tasks, ("exposure_id", "channel")):
        sums = some.join(exposures, "exposure_id").group_by(["channel", "camera", "image_type"])
        for row in sums.aggregate([("exposure_id", "count")]).to_pylist():
            found[_kind(row)] += row["exposure_id_count"]
    return found


def _line(kind: _Kind, planned: int, tasks: Sequence[dict[str, Any]], made: Made, factor: float) -> Line:
    own = [(task, *made[place]) for task in tasks if (place := (task["exposure_id"], task["detector"])) in made]
    known = [(task, took) for task, _, took in own if took]
    cpu = sum(took["cpu_s"] for _, took in known)
    deg2 = _seen([task for task, _ in known]) if kind[2] in _SURVEYED else 0.0
    return Line(
        *kind,
        planned=planned,
        made=len(own),
        measured=len(known),
        cpu_s=cpu,
        forecast_s=factor * sum(task["seconds"] for task, _ in known),
        peak_gb=max((took.get("peak_gb", 0.0) for _, took in known), default=0.0),
        gb=sum(size for _, size, _ in own) / 1e9,
        forecast_gb=sum(task["bytes"] for task, *_ in own) / 1e9,
        deg2=deg2,
        core_hours_deg2=cpu / 3600.0 / deg2 if deg2 else 0.0,
    )


def _sum(name: str, lines: Sequence[Line]) -> Line:
    names = ("planned", "made", "measured", "cpu_s", "forecast_s", "gb", "forecast_gb", "core_hours_deg2")
    total = {field: sum(getattr(line, field) for line in lines) for field in names}
    peak = max((line.peak_gb for line in lines), default=0.0)
    return Line(name, _ALL, "", **total, peak_gb=peak, deg2=0.0)


def _seen(tasks: Sequence[dict[str, Any]]) -> float:
    """Area, deg2, that footprints cover together."""
    some = [{name: task[name] for name in ("ra", "dec", "radius", "s_region")} for task in tasks]
    if not some:
        return 0.0
    cells = np.unique(np.concatenate([sky.cells_in_cone(t["ra"], t["dec"], t["radius"], _ORDER) for t in some]))
    seen = footprints.counts(pa.Table.from_pylist(some), *sky.cell_centres(_ORDER, cells))
    return float((seen > 0).sum() * sky.cell_area(_ORDER))


def _took(root: Path, key: str) -> dict[str, Mapping[str, Any]]:
    """Of each part of a version of `products` that a run made, what its log says; the last run of several."""
    found: dict[str, Mapping[str, Any]] = {}
    for path in run_log.of_products(root):
        with contextlib.suppress(LakeError, OSError):
            first, *lines = run_log.lines(path) or [{}]
            if first.get("key") == key:
                found |= {
                    line["part"]: line for line in lines if "part" in line and "error" not in line and "cpu_s" in line
                }
    return found


def text(lines: Sequence[Line]) -> Iterator[str]:
    """The lines as a table; a dash where there is nothing to say."""
    yield (
        f"{'channel':8} {'camera':9} {'image type':17} {'detectors':>9} {'of':>6} {'measured':>8} {'CPU s':>9} "
        f"{'forecast':>9} {'peak GB':>8} {'GB':>8} {'forecast':>8} {'deg2':>7} {'core-h/deg2':>11}"
    )
    for one in lines:
        area = f"{one.deg2:7.3f}" if one.deg2 else f"{'-':>7}"
        hours = f"{one.core_hours_deg2:11.3f}" if one.core_hours_deg2 else f"{'-':>11}"
        yield (
            f"{one.channel:8} {one.camera:9} {one.image_type:17} {one.made:9,} {one.planned:6,} {one.measured:8,} "
            f"{one.cpu_s:9,.1f} {one.forecast_s:9,.1f} {one.peak_gb:8.2f} {one.gb:8.3f} {one.forecast_gb:8.3f} "
            f"{area} {hours}"
        )
