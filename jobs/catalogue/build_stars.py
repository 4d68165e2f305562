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

# Lowest order of a file: 54 deg2, what a bright limit leaves in them is soon drawn.
_LARGEST = 3


def steps(lake: Path, request: Request) -> list[Step]:
    """Files of about as many rows, made of the generation cells that the request's area touches."""
    facts = {
        "seed": request.seed,
        "star_limit": request.universe.star_limit,
        "plane_limit": request.stars.plane_limit,
        "code": code_version(),
    }
    drawn = request.area.cells()
    numbers = stars.numbers(drawn, _model(facts))
    return [Step(Plan(STARS, facts, cells.by_number(drawn, numbers, request.stars.rows_a_file, _LARGEST)), work)]


def work(lake: Path, facts: Json) -> Output:
    """The stars of one file's cell."""
    model = _model(facts)
    dust = dust_map.load(facts["seed"])
    return Output(cells.rows(facts, STARS, lambda cell: stars.draw(cell, facts["seed"], model, dust)))


def _model(facts: Json) -> stars.StarModel:
    return stars.model(facts["star_limit"], facts["plane_limit"])


JOB = Job("build_stars", "Draw the Milky Way's stars of a sky area.", steps)

if __name__ == "__main__":
    sys.exit(main(JOB))
