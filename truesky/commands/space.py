"""Compare the forecast size of a request's tables and images with the free space on the disc.

Tables and images are written to a lake, a folder with one subfolder per table. Files that the lake already contains are
not written again.
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
from lake_schema.texts.amounts import format_size
from truesky.fluxes import compute_fluxes
from truesky.render.forecasting.image_costs import ImageCosts
from truesky.render.forecasting.request_cost import job_costs
from truesky.render.planning import preconditions
from truesky.render.planning import tasks as planned
from truesky.request import universe
from truesky.request.schema import Request

_GB = 1e9


def check(root: Path, request: Request, plan: tuple[pa.Table, pa.Table] | None) -> tuple[float, float]:
    """Check that the free space on the disc is sufficient for all jobs of a request.

    The forecast size does not include tables and images that the lake already contains and that can be reused.

    Parameters
    ----------
    root : Path
        Folder of the lake. It need not exist.
    request : Request
        The request, with the detectors to render from the command line.
    plan : tuple of pyarrow.Table or None
        Rows of the tables `exposures` (planned exposures) and `tasks` (their detectors); None if nothing is rendered.

    Returns
    -------
    required_gb : float
        Size of the files that will be written, in GB.
    free_gb : float
        Free space on the disc, in GB.

    Raises
    ------
    BadInput
        If the free space is too small. The message gives the forecast of each job.
    """
    images = ImageCosts(request)
    if plan is not None:
        images.add(*plan)
    forecast_bytes = {job.job: job.bytes for job in job_costs(request, images) if job.bytes}
    total = max(sum(forecast_bytes.values()) - _reusable_bytes(root, request, plan), 0.0)
    free = shutil.disk_usage(next(path for path in (root, *root.parents) if path.exists())).free
    if total > free:
        parts = ", ".join(f"{name} {format_size(size)}" for name, size in forecast_bytes.items())
        raise BadInput(
            f"lake {root}: {format_size(free)} are free, the forecast is {format_size(total)} ({parts}): free some "
            "space, or render fewer detectors (--detectors, --limit)"
        )
    return total / _GB, free / _GB


def _reusable_bytes(root: Path, request: Request, plan: tuple[pa.Table, pa.Table] | None) -> float:
    """Return the size in bytes of the forecast tables and images that the lake already contains and a run reuses.

    It is 0 for a new lake. Catalogues that another run is still writing count as 0.
    """
    size = 0.0
    with contextlib.suppress(LakeError):
        for folder in _reusable_versions(root, request):
            size += _folder_bytes(folder)
        # Images can be reused only if all catalogues are reused, too. If a catalogue cannot be reused,
        # `_reusable_versions` has raised LakeError.
        if plan is not None:
            size += _reusable_image_bytes(root, request, *plan)
    return size


def _reusable_versions(root: Path, request: Request) -> Iterator[Path]:
    """Yield the folders of the catalogues and fluxes that a run of the request can reuse.

    Raises LakeError at the first table that does not exist, or was made by other code or for another universe or area.
    """
    for kind, table in compute_fluxes.CATALOGUES:
        version = read.input_version(root, table, request.name)
        universe.check_catalogues([version], request)
        cells = {cell for part in version.manifest["parts"] for cell in part["facts"]["generation_cells"]}
        if version.manifest["facts"].get("code") != code_version() or cells != set(request.area.cells()):
            raise BadInput(f"table {table} was not made by this code for the area of the request")
        yield layout.version_folder(root, table, version.key)
        plan = compute_fluxes.flux_step(kind, root, request).plan
        yield layout.version_folder(root, plan.table.name, read.version(root, plan.table.name, plan.key).key)
    with contextlib.suppress(LakeError):
        yield layout.version_folder(root, "halos", read.input_version(root, "halos", request.name).key)


def _reusable_image_bytes(root: Path, request: Request, exposures: pa.Table, tasks: pa.Table) -> float:
    """Return the size in bytes of the requested images in the lake that need not be rendered again.

    `exposures` and `tasks` are the rows of the plan. Files of whole exposures are included if the request has them.
    """
    # Import here, because importing the renderer takes seconds and requests without images do not need it.
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
            exposure_files.plan(products_plan, planned_counts, request.file_names),
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
    """Return the size in bytes of the files of those tasks in `parts` that need not run again.

    `plan` is the plan of the table to which the tasks belong. A task need not run again if the request's present
    version of the table has its file, made from the same inputs, or if an interrupted run of this plan has written its
    file. If the files of the interrupted run are larger, the result is their size, with the files of other tasks.
    """
    table = plan.table.name
    reusable = reuse.reusable_tasks(root, table, request.name)
    reusable_names = {part.name for part in parts if reusable.get(part.name) == part.facts[reuse.PRODUCT]}
    # Take the larger size instead of the sum: the folder of an interrupted run also contains the files that it has
    # reused from the published version.
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
