"""Band fluxes of every source of a lake.

spark-submit jobs/fluxes/compute_fluxes.py --lake LAKE --request REQUEST

The tables' manifests say how: facts.accuracy what was asked for, facts.errors the setting and the measured error of
each band (fractions of the flux), facts.covered where tables were used; what lies beyond was integrated.
"""

import sys
from pathlib import Path

if __name__ == "__main__":
    # spark-submit puts this folder first, where our modules would hide the standard library's.
    sys.path[0] = str(Path(__file__).resolve().parents[2])

from dataclasses import asdict
from typing import Any

from jobs.accuracy import Accuracy
from jobs.fluxes import grid_settings, passbands, spectra, templates
from jobs.request import Request
from jobs.shell import Job, Step, main
from lake_schema import layout, read
from lake_schema.errors import BadInput
from lake_schema.provenance import code_version
from lake_schema.publish import Json, Output, Part, Plan
from lake_schema.tables.fluxes import fluxes

CATALOGUES = (("galaxy", "galaxies"), ("star", "stars"))


def steps(lake: Path, request: Request) -> list[Step]:
    """One part a cell of the catalogue, row by row beside it."""
    for band in request.bands:
        if band not in passbands.names():
            raise BadInput(f"fluxes.bands: {band!r} is not one of {', '.join(passbands.names())}")
    made = [_step(read.version(lake, catalogue), kind, request) for kind, catalogue in CATALOGUES]
    if not all(layout.version(lake, step.plan.table.name, step.plan.key).exists() for step in made):
        # Here once, and not in every worker at the same time.
        spectra.prepare(request.bands, request.accuracy)
    return made


def galaxy_step(lake: Path, request: Request) -> Step:
    """The step of the galaxies alone."""
    return _step(read.version(lake, "galaxies"), "galaxy", request)


def star_step(lake: Path, request: Request) -> Step:
    """The step of the stars alone."""
    return _step(read.version(lake, "stars"), "star", request)


def _step(catalogue: read.Version, kind: str, request: Request) -> Step:
    inputs = {"catalogue": catalogue.table, "input": catalogue.key}
    facts = {**inputs, **_how(kind, request), "code": code_version()}
    parts = tuple(Part(name, {"part": name}) for name in catalogue.parts)
    return Step(Plan(fluxes(kind, request.bands), facts, parts), work)


def _how(kind: str, request: Request) -> dict[str, Any]:
    accuracy = asdict(request.accuracy)
    if kind == "star":
        errors: dict[str, Any] = {band: grid_settings.of_stars(request.accuracy) for band in request.bands}
        return {"bands": list(request.bands), "accuracy": accuracy, "errors": errors}
    chosen = grid_settings.choose(request.bands, request.accuracy)
    errors = {band: choice.facts() for band, choice in zip(request.bands, chosen, strict=True)}
    return {"bands": list(request.bands), "accuracy": accuracy, "errors": errors, "covered": grid_settings.COVERED}


def work(lake: Path, facts: Json) -> Output:
    """The fluxes of one cell, in the order of its rows."""
    rows = read.version(lake, facts["catalogue"], facts["input"]).rows(parts=[facts["part"]])
    accuracy = Accuracy(**facts["accuracy"])
    if facts["catalogue"] == "galaxies":
        return Output(spectra.galaxy_fluxes(rows, facts["bands"], templates.galaxy_library(), accuracy))
    return Output(spectra.star_fluxes(rows, facts["bands"], templates.stellar_library(), accuracy))


JOB = Job("compute_fluxes", "Compute the band fluxes of galaxies and stars.", steps)

if __name__ == "__main__":
    sys.exit(main(JOB))
