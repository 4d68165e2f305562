"""Render the planned exposures: spark-submit jobs/render/render_exposures.py --lake LAKE --request REQUEST."""

from collections.abc import Callable
from pathlib import Path

import pyarrow as pa

from lake_schema.store import parquet, read, reuse
from lake_schema.store.plan import Json, Output, Part, Plan
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.rendered_truth import RENDERED_SPECTRA, RENDERED_TRUTH
from truesky.render import detector_inputs, product_plan
from truesky.render.channels import registry
from truesky.render.exposure import render
from truesky.render.planning import preconditions
from truesky.render.product_plan import RenderInputs
from truesky.render.products import exposure_files, fits_files, truth_table
from truesky.render.products.beside import psf_file, spectra_file, truth_file
from truesky.render.psf import to_psfex
from truesky.render.sources import catalogue_rows, selection
from truesky.request.schema import Request
from truesky.running import heap
from truesky.running.shell import Job, Step


def steps(lake: Path, request: Request) -> list[Step]:
    """One part a detector of an exposure, the longest first; then what was drawn on each, and files of whole exposures.

    Detectors that are not asked for, and that the request's present version has as they would be rendered now, stay:
    a part is added to what there is.
    """
    inputs = RenderInputs.of(lake, request)
    _refuse_uncovered(inputs)
    plan = product_plan.products(inputs)
    drawn = tuple(Part(part.name, {"part": part.name, reuse.PRODUCT: part.facts[reuse.PRODUCT]}) for part in plan.parts)
    steps = [Step(plan, work, unit="detector"), Step(Plan(RENDERED_TRUTH, {"products": plan.key}, drawn), truth_work)]
    spread = _dispersed(inputs.chosen.exposures)
    spectra = tuple(own for own, part in zip(drawn, plan.parts, strict=True) if part.facts["exposure_id"] in spread)
    if spectra:
        steps.append(Step(Plan(RENDERED_SPECTRA, {"products": plan.key}, spectra), spectra_work))
    if request.files == "exposure":
        steps.append(Step(exposure_files.plan(plan, inputs.chosen.planned), exposure_files.work, unit="exposure"))
    return steps


def _refuse_uncovered(inputs: RenderInputs) -> None:
    """The detectors that are asked for must lie where the catalogues were drawn."""
    needed = inputs.with_earlier(inputs.chosen.asked)
    places = {tuple(task[k] for k in ("ra", "dec", "radius")): task for task in needed if task["cells"]}
    for name in ("galaxies", "stars"):
        version = inputs.versions[name]
        of_task = [selection.needed(task, catalogue_rows.deflection_of(version)) for task in places.values()]
        preconditions.refuse_uncovered(version, {cell for cells in of_task for cell in cells})


def _dispersed(exposures: pa.Table) -> set[int]:
    """Exposures whose sources are spread out by a grism."""
    found = set()
    for row in map(ExposureRow.of, exposures.to_pylist()):
        channel = registry.CHANNELS.get(row.channel)
        if channel is not None and channel.disperses is not None and channel.sees_sky(row.image_type):
            found.add(row.exposure_id)
    return found


def work(lake: Path, facts: Json) -> Output:
    """One detector: its sources from its own cells, its image, its files."""
    request = facts["request"]
    with heap.kept():
        aim, rows_, own = detector_inputs.prepared(lake, facts)
        noise = request["noise_seed"]
        rendered = render.render(aim, rows_, own, request["seed"], request["truth"], noise_seed=noise)
    rice, form = request["compression"] == "rice", request["wcs"]
    rows, files = fits_files.products(rendered, request["truth"], rice, form)
    drawn = truth_table.truth(rendered)
    place = facts["exposure_id"], facts["detector"]
    files = {**files, truth_file(*place): lambda path: parquet.write(path, drawn, RENDERED_TRUTH)}
    spectra = truth_table.spectra(rendered)
    if spectra is not None:
        files[spectra_file(*place)] = lambda path: parquet.write(path, spectra, RENDERED_SPECTRA)
    if aim.channel.on_ground and rendered.psf is not None:
        model, exposure = rendered.psf, aim.exposure
        beside = psf_file(exposure.exposure_id, exposure.channel, exposure.band, aim.detector.name)
        files[beside] = lambda path: to_psfex.written(model, aim.detector, path)
    return Output(rows, files)


def truth_work(lake: Path, facts: Json) -> Output:
    """What was drawn on one detector, from beside its images."""
    return _beside(lake, facts, truth_file)


def spectra_work(lake: Path, facts: Json) -> Output:
    """Where spectra lie on one detector, likewise."""
    return _beside(lake, facts, spectra_file)


def _beside(lake: Path, facts: Json, file_of: Callable[[int, str], str]) -> Output:
    products = read.version(lake, "products", facts["products"])
    (row, *_) = products.rows(["exposure_id", "detector"], [facts["part"]]).to_pylist()
    return Output(products.beside(file_of(row["exposure_id"], row["detector"])))


JOB = Job(
    "render_exposures",
    "Render every planned detector to FITS.",
    steps,
    options=(("detectors", "only these of every exposure"),),
    numbers=(("limit", "only the first so many of them, by exposure and detector"),),
)
