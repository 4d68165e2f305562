"""Build the table `galaxies` of a request: spark-submit jobs/catalogue/build_galaxies.py --lake LAKE --request REQUEST."""

import sys
from pathlib import Path

if __name__ == "__main__":
    # spark-submit puts this folder first, where our modules would hide the standard library's.
    sys.path[0] = str(Path(__file__).resolve().parents[2])

from jobs.catalogue import cells, dust_map, galaxies
from jobs.request import Request
from jobs.shell import Job, Step, main
from lake_schema.provenance import code_version
from lake_schema.publish import Json, Output, Plan
from lake_schema.tables.galaxies import GALAXIES


def steps(lake: Path, request: Request) -> list[Step]:
    """One part an order-5 cell, made of the generation cells that the request's area touches."""
    limits = {"galaxy_limit": request.universe.galaxy_limit, "z_max": request.universe.z_max}
    facts = {"seed": request.seed, **limits, "code": code_version()}
    return [Step(Plan(GALAXIES, facts, cells.parts(request.area)), work)]


def work(lake: Path, facts: Json) -> Output:
    """The galaxies of one order-5 cell."""
    model = galaxies.model(facts["galaxy_limit"], facts["z_max"])
    dust = dust_map.load(facts["seed"])
    return Output(cells.rows(facts, GALAXIES, lambda cell: galaxies.draw(cell, facts["seed"], model, dust)))


JOB = Job("build_galaxies", "Draw the galaxies of a sky area.", steps)

if __name__ == "__main__":
    sys.exit(main(JOB))
