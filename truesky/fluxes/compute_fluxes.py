"""Compute band fluxes of every source in a lake (the folder of all tables of a simulation).

    spark-submit jobs/fluxes/compute_fluxes.py --lake LAKE --request REQUEST [--bands BAND ...]

The job also writes the tables `templates`, `extinction_laws`, `emission_lines` and `passbands`, with which the fluxes
are computed. The manifest of a flux table (the list of its files) contains facts about the computation. `accuracy` is
the requested accuracy. `errors` has the resolution of each band's interpolation table, and the measured relative error.
`covered` (for stars a part of `errors`) has the ranges of redshift and extinction of the interpolation tables; sources
outside were integrated, and their column `integrated` is true. `files` has the sha256 of each file that the request
names.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pyarrow as pa

from lake_schema.columns import Table
from lake_schema.store import layout, read
from lake_schema.store.plan import Json, Output, Plan, Task
from lake_schema.store.provenance import code_version
from lake_schema.tables.fluxes import fluxes
from lake_schema.tables.galaxies import EMISSION_LINES
from lake_schema.tables.passbands import PASSBANDS
from lake_schema.tables.templates import EXTINCTION_LAWS, TEMPLATES
from truesky.command_line import simulation
from truesky.fluxes import band_fluxes, inputs
from truesky.fluxes.inputs import FluxInputs
from truesky.fluxes.tables import errors_measured
from truesky.fluxes.tables.build_tables import Setting
from truesky.fluxes.tables.settings import COVERED_RANGES, Choice, star_error_facts
from truesky.request import universe
from truesky.request.accuracy import Accuracy
from truesky.request.schema import Request
from truesky.running.submitted_job import Job, Step

CATALOGUES = (("galaxy", "galaxies"), ("star", "stars"))


def steps(lake: Path, request: Request) -> list[Step]:
    """Return the steps of the job, each of which makes one table: four input tables, and fluxes of galaxies and stars.

    The input tables are `templates`, `extinction_laws`, `emission_lines` and `passbands`. A step of fluxes has one task
    per partition (file) of the catalogue, that is, per cell of the sky. The steps are planned, not run. Tables in which
    fluxes are interpolated are computed and cached, unless the lake already has the fluxes of galaxies and of stars.
    Raises BadInput if a catalogue was made from another universe than the request describes.
    """
    catalogues = [(kind, read.input_version(lake, name, request.name)) for kind, name in CATALOGUES]
    universe.check_catalogues([version for _, version in catalogues], request)
    flux_inputs = inputs.read(request.curves)
    curves = inputs.select_passbands(request.bands, flux_inputs.passbands)
    sources = source_steps(flux_inputs)
    choices = errors_measured.choose(curves, request.accuracy, flux_inputs.library)
    flux_steps = [_step(catalogue, kind, request, flux_inputs, choices, sources) for kind, catalogue in catalogues]
    if not all(layout.version_folder(lake, step.plan.table.name, step.plan.key).exists() for step in flux_steps):
        # Compute the interpolation tables of fluxes here and cache them on disc. Otherwise every worker would compute
        # them at the same time.
        band_fluxes.prepare(
            curves, [choice.setting for choice in choices], flux_inputs.library, flux_inputs.stars, request.accuracy
        )
    return [*sources, *flux_steps]


def flux_step(kind: str, lake: Path, request: Request) -> Step:
    """Return the step of the job that makes one table, the fluxes of galaxies or of stars.

    Parameters
    ----------
    kind : str
        "galaxy" or "star".
    lake : Path
        Root folder of the lake, which must contain the catalogue.
    request : Request
        The user's request, with the passbands and the accuracy.

    Returns
    -------
    Step
        The planned step, with one task per partition (file) of the catalogue. It is not run.
    """
    flux_inputs = inputs.read(request.curves)
    choices = errors_measured.choose(
        inputs.select_passbands(request.bands, flux_inputs.passbands), request.accuracy, flux_inputs.library
    )
    return _step(
        read.input_version(lake, dict(CATALOGUES)[kind], request.name),
        kind,
        request,
        flux_inputs,
        choices,
        source_steps(flux_inputs),
    )


def source_steps(flux_inputs: FluxInputs) -> list[Step]:
    """Return four steps, which make the tables `templates`, `extinction_laws`, `emission_lines` and `passbands`.

    Each step makes one table, with a single file. The steps are planned, not run.
    """

    def step(table: Table, rows: Callable[[FluxInputs], pa.Table]) -> Step:
        plan = Plan(table, {"files": flux_inputs.sha256(), "code": code_version()}, (Task("all.parquet", {}),))
        return Step(plan, lambda lake, facts: Output(rows(flux_inputs)), on_driver=True)

    tables = (
        (TEMPLATES, inputs.template_rows),
        (EXTINCTION_LAWS, inputs.law_rows),
        (EMISSION_LINES, inputs.line_rows),
        (PASSBANDS, inputs.passband_rows),
    )
    return [step(table, rows) for table, rows in tables]


def _step(
    catalogue: read.Version,
    kind: str,
    request: Request,
    flux_inputs: FluxInputs,
    choices: Sequence[Choice],
    sources: Sequence[Step],
) -> Step:
    facts = {
        "catalogue": catalogue.table,
        "input": catalogue.key,
        "bands": list(request.bands),
        "accuracy": asdict(request.accuracy),
        **_error_facts(kind, request, choices),
        "files": flux_inputs.sha256(),
        **({"intergalactic": True} if kind == "galaxy" and flux_inputs.library.intergalactic else {}),
        "sources": {step.plan.table.name: step.plan.key for step in sources},
        "code": code_version(),
    }
    partitions = tuple(Task(name, {"part": name}) for name in catalogue.partitions)
    return Step(Plan(fluxes(kind, request.bands), facts, partitions), compute_partition)


def _error_facts(kind: str, request: Request, choices: Sequence[Choice]) -> dict[str, Any]:
    if kind == "star":
        return {"errors": {band: star_error_facts(request.accuracy) for band in request.bands}}
    errors = {band: choice.facts() for band, choice in zip(request.bands, choices, strict=True)}
    return {"errors": errors, "covered": COVERED_RANGES}


def compute_partition(lake: Path, facts: Json) -> Output:
    """Compute the fluxes of one partition (the sources in a cell of the sky), in the order of the catalogue's rows.

    `facts` has the inputs as JSON values: catalogue and its version, name of the partition, passbands, user files,
    accuracy, and resolutions of the tables in which fluxes are interpolated.
    """
    rows = read.version(lake, facts["catalogue"], facts["input"]).rows(partitions=[facts["part"]])
    curves = [inputs.passband_from_facts(lake, facts, band) for band in facts["bands"]]
    if facts["catalogue"] == "galaxies":
        chosen = [facts["errors"][band]["setting"] for band in facts["bands"]]
        settings = [Setting(*numbers) if numbers else None for numbers in chosen]
        return Output(
            band_fluxes.fluxes_with_settings(rows, curves, settings, inputs.galaxy_library_from_facts(lake, facts))
        )
    return Output(
        band_fluxes.star_fluxes(
            rows, curves, inputs.stellar_library_from_facts(lake, facts), Accuracy(**facts["accuracy"])
        )
    )


JOB = Job(
    "compute_fluxes",
    "Compute the band fluxes of galaxies and stars.",
    steps,
    list_options=simulation.FLUX_LISTS,
)
