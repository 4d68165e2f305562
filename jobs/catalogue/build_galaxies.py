"""Build tables `halos` and `galaxies`: spark-submit jobs/catalogue/build_galaxies.py --lake LAKE --request REQUEST."""

import sys
from pathlib import Path

if __name__ == "__main__":
    # spark-submit puts this folder first, where our modules would hide the standard library's.
    sys.path[0] = str(Path(__file__).resolve().parents[2])

from jobs.catalogue import cells, dust_map, galaxies, population
from jobs.catalogue.galaxies import GalaxyModel
from jobs.request import Request
from jobs.shell import Job, Step, main
from lake_schema import layout
from lake_schema.provenance import code_version
from lake_schema.publish import Json, Output, Plan
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.halos import HALOS

_HALO_FACTS = ("galaxy_limit", "z_max", "box_cells")


def steps(lake: Path, request: Request) -> list[Step]:
    """Two tables of one part an order-5 cell each, made of the generation cells that the request's area touches."""
    universe = request.facts("universe")["universe"]
    del universe["star_limit"]
    facts = {"seed": request.seed, **universe, "code": code_version()}
    parts = cells.parts(request.area)
    halos = Plan(HALOS, {key: facts[key] for key in ("seed", *_HALO_FACTS, "code")}, parts)
    # Up to this multipole the lensing has the power of linear theory within 10 %.
    plan = Plan(GALAXIES, {**facts, "lensing_l_max": facts["lensing_nside"]}, parts)
    if not layout.version(lake, GALAXIES.name, plan.key).exists():
        # The box and its lensing are made here, once, and only mapped by the workers.
        _universe(facts)
    return [Step(halos, halo_work), Step(plan, work)]


def halo_work(lake: Path, facts: Json) -> Output:
    """The halos of one order-5 cell."""
    people = galaxies.people(facts["seed"], *(facts[name] for name in _HALO_FACTS))
    drawn = population.Cells(people)
    return Output(cells.rows(facts, HALOS, lambda cell: galaxies.halo_table(cell, people, drawn)))


def work(lake: Path, facts: Json) -> Output:
    """The galaxies of one order-5 cell."""
    universe = _universe(facts)
    dust = dust_map.load(facts["seed"])
    drawn = population.Cells(universe.population)
    return Output(cells.rows(facts, GALAXIES, lambda cell: galaxies.draw(cell, universe, drawn, dust)))


def _universe(facts: Json) -> GalaxyModel:
    names = ("seed", "galaxy_limit", "z_max", "box_cells", "lensing_nside", "high_redshift_boost", "quasar_boost")
    return galaxies.model(*(facts[name] for name in names))


JOB = Job("build_galaxies", "Draw the halos and galaxies of a sky area.", steps)

if __name__ == "__main__":
    sys.exit(main(JOB))
