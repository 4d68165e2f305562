"""Band fluxes of every source of a lake, and the tables of what they were made with.

spark-submit jobs/fluxes/compute_fluxes.py --lake LAKE --request REQUEST [--bands BAND ...]

The tables' manifests say how: facts.accuracy what was asked for, facts.errors the setting and the measured error of
each band (fractions of the flux), facts.covered where tables were used; what lies beyond was integrated, which the
column `integrated` says of every source. facts.files holds the sha256 of each file that the request named.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pyarrow as pa

from lake_schema.columns import Table
from lake_schema.store import layout, read
from lake_schema.store.plan import Json, Output, Part, Plan
from lake_schema.store.provenance import code_version
from lake_schema.tables.fluxes import fluxes
from lake_schema.tables.galaxies import EMISSION_LINES
from lake_schema.tables.passbands import PASSBANDS
from lake_schema.tables.templates import EXTINCTION_LAWS, TEMPLATES
from truesky.fluxes import band_fluxes, inputs
from truesky.fluxes.inputs import Own
from truesky.fluxes.tables import errors_measured
from truesky.fluxes.tables.build_tables import Setting
from truesky.fluxes.tables.settings import COVERED, Choice, of_stars
from truesky.request import universe
from truesky.request.accuracy import Accuracy
from truesky.request.schema import Request
from truesky.running.shell import Job, Step

CATALOGUES = (("galaxy", "galaxies"), ("star", "stars"))


def steps(lake: Path, request: Request) -> list[Step]:
    """What fluxes are made with; then one part a cell of each catalogue, row by row beside it."""
    catalogues = [(kind, read.for_request(lake, name, request.name)) for kind, name in CATALOGUES]
    universe.refuse_other([version for _, version in catalogues], request)
    own = inputs.read(request.curves)
    curves = inputs.curves(request.bands, own.passbands)
    sources = source_steps(own)
    chosen = errors_measured.choose(curves, request.accuracy, own.library)
    made = [_step(catalogue, kind, request, own, chosen, sources) for kind, catalogue in catalogues]
    if not all(layout.version(lake, step.plan.table.name, step.plan.key).exists() for step in made):
        # Here once, and not in every worker at the same time.
        band_fluxes.prepare(curves, [choice.setting for choice in chosen], own.library, own.stars, request.accuracy)
    return [*sources, *made]


def step_of(kind: str, lake: Path, request: Request) -> Step:
    """The step of the galaxies or of the stars alone."""
    own = inputs.read(request.curves)
    chosen = errors_measured.choose(inputs.curves(request.bands, own.passbands), request.accuracy, own.library)
    return _step(
        read.for_request(lake, dict(CATALOGUES)[kind], request.name), kind, request, own, chosen, source_steps(own)
    )


def source_steps(own: Own) -> list[Step]:
    """The tables `templates`, `extinction_laws`, `emission_lines` and `passbands`."""

    def step(table: Table, rows: Callable[[Own], pa.Table]) -> Step:
        plan = Plan(table, {"files": own.sha256(), "code": code_version()}, (Part("all.parquet", {}),))
        return Step(plan, lambda lake, facts: Output(rows(own)), on_driver=True)

    tables = (
        (TEMPLATES, inputs.template_rows),
        (EXTINCTION_LAWS, inputs.law_rows),
        (EMISSION_LINES, inputs.line_rows),
        (PASSBANDS, inputs.passband_rows),
    )
    return [step(table, rows) for table, rows in tables]


def _step(
    catalogue: read.Version, kind: str, request: Request, own: Own, chosen: Sequence[Choice], sources: Sequence[Step]
) -> Step:
    facts = {
        "catalogue": catalogue.table,
        "input": catalogue.key,
        "bands": list(request.bands),
        "accuracy": asdict(request.accuracy),
        **_errors(kind, request, chosen),
        "files": own.sha256(),
        **({"intergalactic": True} if kind == "galaxy" and own.library.intergalactic else {}),
        "sources": {step.plan.table.name: step.plan.key for step in sources},
        "code": code_version(),
    }
    parts = tuple(Part(name, {"part": name}) for name in catalogue.parts)
    return Step(Plan(fluxes(kind, request.bands), facts, parts), work)


def _errors(kind: str, request: Request, chosen: Sequence[Choice]) -> dict[str, Any]:
    if kind == "star":
        return {"errors": {band: of_stars(request.accuracy) for band in request.bands}}
    errors = {band: choice.facts() for band, choice in zip(request.bands, chosen, strict=True)}
    return {"errors": errors, "covered": COVERED}


def work(lake: Path, facts: Json) -> Output:
    """The fluxes of one cell, in the order of its rows."""
    rows = read.version(lake, facts["catalogue"], facts["input"]).rows(parts=[facts["part"]])
    curves = [inputs.passband_of(lake, facts, band) for band in facts["bands"]]
    if facts["catalogue"] == "galaxies":
        chosen = [facts["errors"][band]["setting"] for band in facts["bands"]]
        settings = [Setting(*numbers) if numbers else None for numbers in chosen]
        return Output(band_fluxes.galaxy_fluxes_by(rows, curves, settings, inputs.library_of(lake, facts)))
    return Output(band_fluxes.star_fluxes(rows, curves, inputs.stars_of(lake, facts), Accuracy(**facts["accuracy"])))


JOB = Job(
    "compute_fluxes",
    "Compute the band fluxes of galaxies and stars.",
    steps,
    options=(("bands", "passbands, instead of those of the request"),),
)
