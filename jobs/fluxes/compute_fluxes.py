"""Band fluxes of every source of a lake: spark-submit jobs/fluxes/compute_fluxes.py --lake LAKE --request REQUEST."""

import sys
from pathlib import Path

if __name__ == "__main__":
    # spark-submit puts this folder first, where our modules would hide the standard library's.
    sys.path[0] = str(Path(__file__).resolve().parents[2])

from jobs.fluxes import passbands, spectra, templates
from jobs.request import Request
from jobs.shell import Job, Step, main
from lake_schema import read
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
    return [_step(read.version(lake, catalogue), kind, request) for kind, catalogue in CATALOGUES]


def _step(catalogue: read.Version, kind: str, request: Request) -> Step:
    inputs = {"catalogue": catalogue.table, "input": catalogue.key}
    facts = {**inputs, "bands": list(request.bands), "code": code_version()}
    parts = tuple(Part(name, {"part": name}) for name in catalogue.parts)
    return Step(Plan(fluxes(kind, request.bands), facts, parts), work)


def work(lake: Path, facts: Json) -> Output:
    """The fluxes of one cell, in the order of its rows."""
    rows = read.version(lake, facts["catalogue"], facts["input"]).rows(parts=[facts["part"]])
    if facts["catalogue"] == "galaxies":
        return Output(spectra.galaxy_fluxes(rows, facts["bands"], templates.galaxy_library()))
    return Output(spectra.star_fluxes(rows, facts["bands"], templates.stellar_library()))


JOB = Job("compute_fluxes", "Compute the band fluxes of galaxies and stars.", steps)

if __name__ == "__main__":
    sys.exit(main(JOB))
