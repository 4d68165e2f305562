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
from lake_schema.store.plan import Plan, Task
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
    forecast_bytes = {line.job: line.gb * _GB for line in catalogue_forecast.for_request(request)}
    if plan is not None:
        requested_tasks = planned.select_requested(preconditions.require_renderable_tasks(*plan), request)
        forecast_bytes["render_exposures"] = sum(row["bytes"] for row in requested_tasks)
    total = max(sum(forecast_bytes.values()) - _reusable_bytes(root, request, plan), 0.0)
    free = shutil.disk_usage(next(path for path in (root, *root.parents) if path.exists())).free
    if total > free:
        parts = ", ".join(f"{name} {size / _GB:.2f}" for name, size in forecast_bytes.items())
        raise BadInput(
            f"lake {root}: {free / _GB:.2f} GB are free, the forecast is {total / _GB:.2f} GB ({parts}): make room, or "
            "ask for a part of it (--detectors, --limit)"
        )
    return total / _GB, free / _GB


def _reusable_bytes(root: Path, request: Request, plan: tuple[pa.Table, pa.Table] | None) -> float:
    """Bytes that are forecast and will not be written: of the request's tables that stay as they are.

    Of catalogues that are in the making nothing is known, and nothing is taken off.
    """
    size = 0.0
    with contextlib.suppress(LakeError):
        for folder in _reusable_versions(root, request):
            size += _folder_bytes(folder)
        # No image is kept of catalogues that are not.
        if plan is not None:
            size += _reusable_image_bytes(root, request, *plan)
    return size


def _reusable_versions(root: Path, request: Request) -> Iterator[Path]:
    """Versions of the catalogues and their fluxes; LakeError at the first that the request would make anew."""
    for kind, table in compute_fluxes.CATALOGUES:
        version = read.input_version(root, table, request.name)
        universe.check_catalogues([version], request)
        cells = {cell for part in version.manifest["parts"] for cell in part["facts"]["generation_cells"]}
        if version.manifest["facts"].get("code") != code_version() or cells != set(request.area.cells()):
            raise BadInput(f"table {table} is not that of the request")
        yield layout.version_folder(root, table, version.key)
        plan = compute_fluxes.flux_step(kind, root, request).plan
        yield layout.version_folder(root, plan.table.name, read.version(root, plan.table.name, plan.key).key)
    with contextlib.suppress(LakeError):
        yield layout.version_folder(root, "halos", read.input_version(root, "halos", request.name).key)


def _reusable_image_bytes(root: Path, request: Request, exposures: pa.Table, tasks: pa.Table) -> float:
    """Bytes of the images that are asked for and need not be rendered."""
    # Importing the renderer takes seconds, which a lake without images need not wait for.
    from truesky.render import product_plan
    from truesky.render.planning.exposure_chunks import RenderSelection
    from truesky.render.products import exposure_files

    all_tasks = preconditions.require_renderable_tasks(exposures, tasks)
    requested_tasks, planned_counts = (
        planned.select_requested(all_tasks, request),
        Counter(all_tasks["exposure_id"].to_pylist()),
    )
    chosen = RenderSelection(exposures, all_tasks.to_pylist(), requested_tasks, planned_counts)
    products_plan = product_plan.products(product_plan.RenderInputs.from_plan(root, request, chosen))
    requested_keys = {(task["exposure_id"], task["detector"]) for task in requested_tasks}
    requested_outputs = [
        part for part in products_plan.tasks if (part.facts["exposure_id"], part.facts["detector"]) in requested_keys
    ]
    size = _reusable_output_bytes(root, request, products_plan, requested_outputs)
    if request.files == "exposure":
        exposure_plan, exposure_ids = (
            exposure_files.plan(products_plan, planned_counts),
            {number for number, _ in requested_keys},
        )
        size += _reusable_output_bytes(
            root,
            request,
            exposure_plan,
            [part for part in exposure_plan.tasks if part.facts["exposure_id"] in exposure_ids],
        )
    return size


def _reusable_output_bytes(root: Path, request: Request, plan: Plan, parts: Sequence[Task]) -> float:
    """Bytes of a plan's parts that need not be made."""
    table = plan.table.name
    reusable = reuse.reusable_tasks(root, table, request.name)
    reusable_names = {part.name for part in parts if reusable.get(part.name) == part.facts[reuse.PRODUCT]}
    # A stage has what was taken as well as what was rendered.
    return max(
        _folder_bytes(layout.stage_folder(root, table, plan.key)),
        _published_bytes(root, request, table, reusable_names) if reusable_names else 0.0,
    )


def _published_bytes(root: Path, request: Request, table: str, parts: set[str]) -> float:
    version = read.input_version(root, table, request.name)
    sizes = {entry["path"]: entry["bytes"] for entry in version.manifest["files"]}
    partitions = (part for part in version.manifest["parts"] if part["name"] in parts)
    return float(sum(sizes[path] for part in partitions for path in part["files"]))


def _folder_bytes(folder: Path) -> float:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
