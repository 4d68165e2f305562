"""Build tables `halos` and `galaxies`: spark-submit jobs/catalogue/build_galaxies.py --lake LAKE --request REQUEST."""

import sys
from functools import partial
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    # spark-submit puts this folder first, where our modules would hide the standard library's.
    sys.path[0] = str(Path(__file__).resolve().parents[2])

import pyarrow as pa

from jobs.catalogue import cells, dust_map, galaxies, halo_catalogue, ingest, ingested_galaxies, mapping, population
from jobs.catalogue.galaxies import GalaxyModel
from jobs.own_files import Catalogue, DustMap, Ingest
from jobs.request import Request
from jobs.shell import Job, Step, main
from lake_schema import layout
from lake_schema.provenance import code_version
from lake_schema.publish import Json, Output, Plan
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.halos import HALOS

_HALO_FACTS = ("galaxy_limit", "z_max", "box_cells")


def steps(lake: Path, request: Request) -> list[Step]:
    """Two tables of one part an order-5 cell each, made of the generation cells that the request's area touches.

    Galaxies of a finished catalogue are one table: its halos are not known.
    """
    if request.ingest.galaxies is not None:
        return [_ingested(lake, request, request.ingest.galaxies)]
    universe = request.facts("universe")["universe"]
    del universe["star_limit"]
    own = request.ingest
    light_cone = {"halos": _halo_facts(own.halos)} if own.halos else {}
    facts = {"seed": request.seed, **universe, **light_cone, **dust_map.facts(own.dust), "code": code_version()}
    parts = cells.parts(request.area)
    halos = Plan(HALOS, {key: facts[key] for key in ("seed", *_HALO_FACTS, *light_cone, "code")}, parts)
    # Up to this multipole the lensing has the power of linear theory within 10 %.
    plan = Plan(GALAXIES, {**facts, "lensing_l_max": facts["lensing_nside"]}, parts)
    if not layout.version(lake, GALAXIES.name, plan.key).exists():
        # The box and its lensing are made here, once, and only mapped by the workers.
        _universe(facts, own)
    return [Step(halos, partial(halo_work, own=own)), Step(plan, partial(work, own=own))]


def halo_work(lake: Path, facts: Json, own: Ingest | None = None) -> Output:
    """The halos of one order-5 cell."""
    given: list[Any] = [facts["seed"], *(facts[name] for name in _HALO_FACTS), _light_cone(facts, own)]
    people = galaxies.people(*given)
    drawn = population.Cells(people)
    return Output(cells.rows(facts, HALOS, lambda cell: galaxies.halo_table(cell, people, drawn)))


def work(lake: Path, facts: Json, own: Ingest | None = None) -> Output:
    """The galaxies of one order-5 cell."""
    universe = _universe(facts, own)
    dust = dust_map.chosen(facts["seed"], own.dust if own else None)
    drawn = population.Cells(universe.population)
    return Output(cells.rows(facts, GALAXIES, lambda cell: galaxies.draw(cell, universe, drawn, dust)))


def _universe(facts: Json, own: Ingest | None) -> GalaxyModel:
    names = ("seed", "galaxy_limit", "z_max", "box_cells", "lensing_nside", "high_redshift_boost", "quasar_boost")
    given: list[Any] = [*(facts[name] for name in names), _light_cone(facts, own)]
    return galaxies.model(*given)


def _halo_facts(given: Catalogue) -> Json:
    columns = mapping.halos(dict(given.columns))
    return {"sha256": ingest.files(given.files, columns)[1], "columns": dict(given.columns)}


def _light_cone(facts: Json, own: Ingest | None) -> halo_catalogue.LightCone | None:
    if own is None or own.halos is None:
        return None
    columns = mapping.halos(dict(own.halos.columns))
    found, _ = ingest.listed(own.halos.files, columns)
    return halo_catalogue.load(found, facts["halos"]["sha256"], columns)


def _ingested(lake: Path, request: Request, given: Catalogue) -> Step:
    columns = mapping.galaxies(given.format, dict(given.columns))
    found, sha256 = ingest.files(given.files, columns)
    about = {"sha256": sha256, "format": given.format, "columns": dict(given.columns)}
    dust = request.ingest.dust
    facts = {"seed": request.seed, "ingest": about, **dust_map.facts(dust), "code": code_version()}
    plan = Plan(GALAXIES, facts, cells.parts(request.area))
    if not layout.version(lake, GALAXIES.name, plan.key).exists():
        ingest.split(found, sha256, columns)
    return Step(plan, partial(ingested_work, given=given, dust=dust))


def ingested_work(lake: Path, facts: Json, given: Catalogue, dust: DustMap | None) -> Output:
    """A catalogue's galaxies of one order-5 cell."""
    columns = mapping.galaxies(given.format, dict(given.columns))
    found, _ = ingest.listed(given.files, columns)
    laid_out = ingest.split(found, facts["ingest"]["sha256"], columns)
    model = ingested_galaxies.model(facts["seed"], columns, laid_out)
    sky_map = dust_map.chosen(facts["seed"], dust)

    def draw(cell: int) -> pa.Table:
        return ingested_galaxies.draw(cell, ingest.rows(laid_out, cell), model, sky_map)

    return Output(cells.rows(facts, GALAXIES, draw))


JOB = Job("build_galaxies", "Draw the halos and galaxies of a sky area.", steps)

if __name__ == "__main__":
    sys.exit(main(JOB))
