"""Whether there is room for what a request makes: its forecast against what is free on the lake's disc.

check    refuse where there is not
"""

from __future__ import annotations

import contextlib
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import pyarrow as pa

from lake_schema.errors import BadInput, LakeError
from lake_schema.store import layout, read, reuse
from lake_schema.store.plan import Part, Plan
from lake_schema.store.provenance import code_version
from truesky.fluxes import compute_fluxes
from truesky.render.forecasting import catalogue_forecast
from truesky.render.planning import preconditions
from truesky.render.planning import tasks as planned
from truesky.request import universe
from truesky.request.schema import Request

_GB = 1e9


def check(root: Path, request: Request, plan: tuple[pa.Table, pa.Table] | None) -> tuple[float, float]:
    """Refuses a run whose forecast is larger than what is free; what it will take from the lake is taken off.

    plan    : rows of the tables `exposures` and `tasks`, None = nothing is rendered
    returns : GB that will be written, GB that are free
    """
    foreseen = {line.job: line.gb * _GB for line in catalogue_forecast.of_request(request)}
    if plan is not None:
        asked = planned.part(preconditions.rendered(*plan), request)
        foreseen["render_exposures"] = sum(row["bytes"] for row in asked)
    total = max(sum(foreseen.values()) - _there(root, request, plan), 0.0)
    free = shutil.disk_usage(next(path for path in (root, *root.parents) if path.exists())).free
    if total > free:
        parts = ", ".join(f"{name} {size / _GB:.2f}" for name, size in foreseen.items())
        raise BadInput(
            f"lake {root}: {free / _GB:.2f} GB are free, the forecast is {total / _GB:.2f} GB ({parts}): make room, or "
            "ask for a part of it (--detectors, --limit)"
        )
    return total / _GB, free / _GB


def _there(root: Path, request: Request, plan: tuple[pa.Table, pa.Table] | None) -> float:
    """Bytes that are forecast and will not be written: of the request's tables that stay as they are.

    Of catalogues that are in the making nothing is known, and nothing is taken off.
    """
    size = 0.0
    with contextlib.suppress(LakeError):
        for folder in _catalogues(root, request):
            size += _bytes(folder)
        # No image is kept of catalogues that are not.
        if plan is not None:
            size += _images(root, request, *plan)
    return size


def _catalogues(root: Path, request: Request) -> Iterator[Path]:
    """Versions of the catalogues and their fluxes; LakeError at the first that the request would make anew."""
    for kind, table in compute_fluxes.CATALOGUES:
        version = read.for_request(root, table, request.name)
        universe.refuse_other([version], request)
        cells = {cell for part in version.manifest["parts"] for cell in part["facts"]["generation_cells"]}
        if version.manifest["facts"].get("code") != code_version() or cells != set(request.area.cells()):
            raise BadInput(f"table {table} is not that of the request")
        yield layout.version(root, table, version.key)
        plan = compute_fluxes.step_of(kind, root, request).plan
        yield layout.version(root, plan.table.name, read.version(root, plan.table.name, plan.key).key)
    with contextlib.suppress(LakeError):
        yield layout.version(root, "halos", read.for_request(root, "halos", request.name).key)


def _images(root: Path, request: Request, exposures: pa.Table, tasks: pa.Table) -> float:
    """Bytes of the images that are asked for and need not be rendered."""
    # Importing the renderer takes seconds, which a lake without images need not wait for.
    from truesky.render import product_plan
    from truesky.render.planning.parts import Chosen
    from truesky.render.products import exposure_files

    every = preconditions.rendered(exposures, tasks)
    asked, planned_of = planned.part(every, request), Counter(every["exposure_id"].to_pylist())
    chosen = Chosen(exposures, every.to_pylist(), asked, planned_of)
    made = product_plan.products(product_plan.RenderInputs.of_plan(root, request, chosen))
    wanted = {(task["exposure_id"], task["detector"]) for task in asked}
    own = [part for part in made.parts if (part.facts["exposure_id"], part.facts["detector"]) in wanted]
    size = _kept(root, request, made, own)
    if request.files == "exposure":
        whole, numbers = exposure_files.plan(made, planned_of), {number for number, _ in wanted}
        size += _kept(root, request, whole, [part for part in whole.parts if part.facts["exposure_id"] in numbers])
    return size


def _kept(root: Path, request: Request, plan: Plan, parts: Sequence[Part]) -> float:
    """Bytes of a plan's parts that need not be made."""
    table = plan.table.name
    held = reuse.held(root, table, request.name)
    kept = {part.name for part in parts if held.get(part.name) == part.facts[reuse.PRODUCT]}
    # A stage has what was taken as well as what was rendered.
    return max(_bytes(layout.stage(root, table, plan.key)), _bytes_of(root, request, table, kept) if kept else 0.0)


def _bytes_of(root: Path, request: Request, table: str, parts: set[str]) -> float:
    version = read.for_request(root, table, request.name)
    sizes = {entry["path"]: entry["bytes"] for entry in version.manifest["files"]}
    kept = (part for part in version.manifest["parts"] if part["name"] in parts)
    return float(sum(sizes[path] for part in kept for path in part["files"]))


def _bytes(folder: Path) -> float:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
