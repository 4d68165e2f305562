"""Build the table `stars` of a request.

Command: spark-submit jobs/catalogue/build_stars.py --lake LAKE --request REQUEST.
"""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from lake_schema.store.plan import Json, Output, Plan
from lake_schema.store.provenance import code_version
from lake_schema.tables import stars as declarations
from lake_schema.tables.stars import STARS
from truesky.catalogue import cells, dust_map, given_sources, request_checks
from truesky.catalogue.stars import stars
from truesky.cosmology import Cosmology
from truesky.request.area import Area
from truesky.request.checks import check_rendered
from truesky.request.files import DustMap, UserSources
from truesky.request.schema import Request, Stars
from truesky.running.submitted_job import Job, Step

# HEALPix order of the largest cell (54 deg2) that a file may cover. With a bright magnitude limit, even such a cell has
# few stars and is drawn quickly.
_MIN_FILE_ORDER = 3


def steps(lake: Path, request: Request) -> list[Step]:
    """Plan the making of table `stars`, in files with similar numbers of rows.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    request : Request
        The request; all generation cells (HEALPix cells of order 8) that its area touches are drawn completely.

    Returns
    -------
    list of Step
        One step, which draws the stars.
    """
    check_rendered(request)
    choice = request.stars
    if request.sources is not None:
        return [_given_step(request, request.sources)]
    facts = {
        "seed": request.seed,
        "star_limit": request.universe.star_limit,
        "plane_limit": choice.plane_limit,
        "bright_limit": choice.bright_limit,
        "density": choice.density,
        "brown_dwarf_boost": choice.brown_dwarf_boost,
        **request_checks.star_files(choice),
        **dust_map.facts(request.ingest.dust),
        "code": code_version(),
    }
    if request.universe.variables:
        facts["variables"] = True
    generation_cells = request.area.cells()
    numbers = stars.expected_counts(generation_cells, request_checks.star_model(facts["star_limit"], choice, facts))
    tasks = cells.tasks_by_row_count(generation_cells, numbers, choice.rows_a_file, _MIN_FILE_ORDER)
    plan = Plan(declarations.stars(request.universe.variables), facts, tasks)
    return [Step(plan, partial(draw_stars, choice=choice, user_dust_map=request.ingest.dust))]


def _given_step(request: Request, source_tables: UserSources) -> Step:
    facts = {
        "seed": request.seed,
        "sources": source_tables.facts(request.area.bounding_circle()),
        "code": code_version(),
    }
    cosmology = request.universe.cosmology
    model = _given_model(source_tables, request.area, cosmology)
    generation_cells = request.area.cells()
    tasks = cells.tasks_by_row_count(
        generation_cells, stars.expected_counts(generation_cells, model), request.stars.rows_a_file, _MIN_FILE_ORDER
    )
    return Step(
        Plan(STARS, facts, tasks),
        partial(draw_given_stars, source_tables=source_tables, area=request.area, cosmology=cosmology),
    )


def draw_given_stars(lake: Path, facts: Json, source_tables: UserSources, area: Area, cosmology: Cosmology) -> Output:
    """Make the stars of one file for a request whose stars and galaxies are all listed in tables of the user.

    Parameters
    ----------
    lake : Path
        Not used.
    facts : dict
        Parameters of the job and of the task; `generation_cells` are the order-8 cells to draw.
    source_tables : UserSources
        The user's tables of stars and galaxies.
    area : Area
        Area of the request.
    cosmology : Cosmology
        Parameters of the universe.

    Returns
    -------
    Output
        Rows of table `stars`.
    """
    model, dust = _given_model(source_tables, area, cosmology, facts["sources"]), np.zeros(12, np.float32)
    return Output(cells.draw_rows(facts, STARS, lambda cell: stars.draw(cell, facts["seed"], model, dust)))


def _given_model(
    source_tables: UserSources, area: Area, cosmology: Cosmology, planned: Json | None = None
) -> stars.StarModel:
    """Return a model that contains exactly the stars in the user's table, without any magnitude limit.

    `planned` are the checksums of the tables when the job began; None to skip this check.
    """
    catalogue = given_sources.stars(given_sources.load(source_tables, area, cosmology, planned), source_tables.band)
    return stars.model(math.inf, math.inf, brown_dwarf_boost=0.0, catalogue=catalogue)


def draw_stars(lake: Path, facts: Json, choice: Stars, user_dust_map: DustMap | None = None) -> Output:
    """Draw the stars of one file, which contains the stars in one order-8 cell or more.

    Parameters
    ----------
    lake : Path
        Not used.
    facts : dict
        Parameters of the job and of the task; `generation_cells` are the order-8 cells to draw.
    choice : Stars
        Section `stars` of the request.
    user_dust_map : DustMap, optional
        The user's dust map; None for the simulated map.

    Returns
    -------
    Output
        Rows of table `stars`.
    """
    has_variables = facts.get("variables", False)
    model = replace(request_checks.star_model(facts["star_limit"], choice, facts), variables=has_variables)
    dust = dust_map.map_for_request(facts["seed"], user_dust_map)
    table = declarations.stars(has_variables)
    return Output(cells.draw_rows(facts, table, lambda cell: stars.draw(cell, facts["seed"], model, dust)))


JOB = Job("build_stars", "Draw the Milky Way's stars of a sky area.", steps)
