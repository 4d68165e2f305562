"""Build the table `stars` of a request: spark-submit jobs/catalogue/build_stars.py --lake LAKE --request REQUEST."""

import sys
from pathlib import Path

if __name__ == "__main__":
    # spark-submit puts this folder first, where our modules would hide the standard library's.
    sys.path[0] = str(Path(__file__).resolve().parents[2])

from jobs.catalogue import cells, dust_map, stars
from jobs.request import Request
from jobs.shell import Job, Step, main
from lake_schema.provenance import code_version
from lake_schema.publish import Json, Output, Plan
from lake_schema.tables.stars import STARS


def steps(lake: Path, request: Request) -> list[Step]:
    """One part an order-5 cell, made of the generation cells that the request's area touches."""
    facts = {"seed": request.seed, "star_limit": request.universe.star_limit, "code": code_version()}
    return [Step(Plan(STARS, facts, cells.parts(request.area)), work)]


def work(lake: Path, facts: Json) -> Output:
    """The stars of one order-5 cell."""
    model = stars.model(facts["star_limit"])
    dust = dust_map.load(facts["seed"])
    return Output(cells.rows(facts, STARS, lambda cell: stars.draw(cell, facts["seed"], model, dust)))


JOB = Job("build_stars", "Draw the Milky Way's stars of a sky area.", steps)

if __name__ == "__main__":
    sys.exit(main(JOB))
