"""Render the planned exposures: spark-submit jobs/render/render_exposures.py --lake LAKE --request REQUEST."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pyarrow as pa

from lake_schema.store import parquet, read, reuse
from lake_schema.store.plan import Json, Output, Plan, Task
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.rendered_truth import RENDERED_SPECTRA, RENDERED_TRUTH
from truesky.command_line import simulation
from truesky.numerics import activity
from truesky.render import detector_inputs, product_plan
from truesky.render.channels import registry
from truesky.render.exposure import render
from truesky.render.planning import preconditions
from truesky.render.previous_exposures import ChargeMaps
from truesky.render.product_plan import RenderInputs
from truesky.render.products import exposure_files, fits_files, truth_table
from truesky.render.products.sidecar_files import psf_file, spectra_file, truth_file
from truesky.render.psf import to_psfex
from truesky.render.sources import catalogue_rows, selection
from truesky.request.schema import Request
from truesky.running import memory_reuse
from truesky.running.submitted_job import Job, Step


def steps(lake: Path, request: Request) -> list[Step]:
    """Return the steps of this job: render the detectors, collect the tables of true positions, write exposure files.

    Exposures of a detector that leave persistence in one another are rendered one after the other, if possible by the
    same worker, which keeps their charge maps. Otherwise, detectors with the longest estimated time are rendered first.
    Files with all detectors of an exposure are written
    only if the request asks for them. Images of detectors that are not requested now are kept if their inputs have not
    changed. Raises BadInput if the plan or the catalogues do not fit the request.
    """
    inputs = RenderInputs.from_request(lake, request)
    _refuse_uncovered(inputs)
    plan = product_plan.products(inputs)
    truth_parts = tuple(
        Task(part.name, {"part": part.name, reuse.PRODUCT: part.facts[reuse.PRODUCT]}) for part in plan.tasks
    )
    steps = [
        Step(
            plan,
            partial(render_task, charge_maps=ChargeMaps.from_environment()),
            unit="detector",
            link_of=inputs.chain_links(),
        ),
        Step(Plan(RENDERED_TRUTH, {"products": plan.key}, truth_parts), read_truth),
    ]
    dispersed = _dispersed_exposures(inputs.selection.exposures)
    spectra_parts = tuple(
        truth_part
        for truth_part, part in zip(truth_parts, plan.tasks, strict=True)
        if part.facts["exposure_id"] in dispersed
    )
    if spectra_parts:
        steps.append(Step(Plan(RENDERED_SPECTRA, {"products": plan.key}, spectra_parts), read_spectra))
    if request.files == "exposure":
        steps.append(
            Step(
                exposure_files.plan(plan, inputs.selection.detector_counts, request.file_names),
                exposure_files.make_exposure_file,
                unit="exposure",
            )
        )
    return steps


def _refuse_uncovered(inputs: RenderInputs) -> None:
    """Raise BadInput if the catalogues do not cover the sky of all requested detectors.

    The same is checked for earlier exposures whose sources must be drawn, because they leave persistence in a requested
    image.
    """
    tasks = inputs.with_previous_tasks(inputs.selection.requested)
    task_by_place = {tuple(task[k] for k in ("ra", "dec", "radius")): task for task in tasks if task["cells"]}
    for name in ("galaxies", "stars"):
        version = inputs.versions[name]
        of_task = [
            selection.cells_of_task(task, catalogue_rows.max_deflection(version)) for task in task_by_place.values()
        ]
        preconditions.refuse_uncovered(version, {cell for cells in of_task for cell in cells})


def _dispersed_exposures(exposures: pa.Table) -> set[int]:
    """Return the numbers of those rows of the table `exposures` that are exposures of the sky through a grism."""
    numbers = set()
    for row in map(ExposureRow.from_row, exposures.to_pylist()):
        channel = registry.CHANNELS.get(row.channel)
        if channel is not None and channel.dispersion is not None and channel.sees_sky(row.image_type):
            numbers.add(row.exposure_id)
    return numbers


def render_task(lake: Path, facts: Json, charge_maps: ChargeMaps | None = None) -> Output:
    """Render one detector of an exposure.

    Parameters
    ----------
    lake : Path
        Lake (folder of stored tables).
    facts : dict
        Recorded inputs of the image (see `detector_inputs.load_inputs`).
    charge_maps : ChargeMaps, optional
        Memory in which the charge maps of earlier exposures are kept for other tasks of the same plan. By default none
        are kept.

    Returns
    -------
    Output
        Rows of the table `products`, and the functions that write the files: image, truth maps, tables of drawn sources
        and PSF.
    """
    request = facts["request"]
    with memory_reuse.retain_freed_memory():
        aim, source_rows, variant = detector_inputs.load_inputs(lake, facts, charge_maps)
        noise, truth = request["noise_seed"], request["truth"]
        with activity.report(f"detector {aim.detector.name}, exposure {aim.exposure.exposure_id}"):
            rendered = render.render(aim, source_rows, variant, request["seed"], truth, noise_seed=noise)
    rice, wcs_convention = request["compression"] == "rice", request["wcs"]
    rows, files = fits_files.products(rendered, request["truth"], rice, wcs_convention)
    drawn = truth_table.truth(rendered)
    place = facts["exposure_id"], facts["detector"]
    files = {**files, truth_file(*place): lambda path: parquet.write(path, drawn, RENDERED_TRUTH)}
    spectra = truth_table.spectra(rendered)
    if spectra is not None:
        files[spectra_file(*place)] = lambda path: parquet.write(path, spectra, RENDERED_SPECTRA)
    if rendered.psf is not None and aim.channel.dispersion is None:
        model, exposure = rendered.psf, aim.exposure
        psf_path = psf_file(exposure.exposure_id, exposure.channel, exposure.band, aim.detector.name)
        files[psf_path] = lambda path: to_psfex.write(model, aim.detector, path)
    return Output(rows, files)


def read_truth(lake: Path, facts: Json) -> Output:
    """Return the rows of the table `rendered_truth` for one detector, from the file that is stored with its images."""
    return _read_sidecar(lake, facts, truth_file)


def read_spectra(lake: Path, facts: Json) -> Output:
    """Return the rows of the table `rendered_spectra` for one detector, from the file stored with its images."""
    return _read_sidecar(lake, facts, spectra_file)


def _read_sidecar(lake: Path, facts: Json, file_of: Callable[[int, str], str]) -> Output:
    products = read.version(lake, "products", facts["products"])
    (row, *_) = products.rows(["exposure_id", "detector"], [facts["part"]]).to_pylist()
    return Output(products.read_sidecar(file_of(row["exposure_id"], row["detector"])))


JOB = Job(
    "render_exposures",
    "Render every planned detector to FITS.",
    steps,
    list_options=simulation.RENDER_LISTS,
    integer_options=simulation.RENDER_INTEGERS,
)
