"""Build the table `active_nuclei`: the quasars and the active galaxies of a lake.

Command: spark-submit jobs/catalogue/build_active_nuclei.py --lake LAKE --request REQUEST.
"""

from pathlib import Path

from lake_schema.errors import BadInput
from lake_schema.store import read
from lake_schema.store.plan import Json, Output, Plan, Task
from lake_schema.store.provenance import code_version
from lake_schema.tables.variability.active_nuclei import ACTIVE_NUCLEI
from truesky.catalogue.nuclei import accretion, rows
from truesky.cosmology import from_facts
from truesky.request import universe
from truesky.request.schema import Request
from truesky.running.submitted_job import Job, Step


def steps(lake: Path, request: Request) -> list[Step]:
    """Plan the making of table `active_nuclei`, with one task per partition (file) of the request's galaxies.

    Raises BadInput if the request has no variable sources, because its galaxies then have no lines of active nuclei.
    """
    if not request.universe.variables:
        raise BadInput("universe.variables is false: set it to true for active nuclei")
    galaxies = read.input_version(lake, "galaxies", request.name)
    universe.check_catalogues([galaxies], request)
    facts = {"seed": request.seed, "galaxies": galaxies.key, "code": code_version()}
    cells_by_partition = {part["name"]: part["facts"]["generation_cells"] for part in galaxies.manifest["parts"]}
    tasks = tuple(
        Task(name, {"part": name, "generation_cells": generation_cells})
        for name, generation_cells in cells_by_partition.items()
    )
    return [Step(Plan(ACTIVE_NUCLEI, facts, tasks), draw_nuclei)]


def draw_nuclei(lake: Path, facts: Json) -> Output:
    """Make the rows of the quasars and active galaxies of one partition of table `galaxies` (`facts["part"]`)."""
    galaxies = read.version(lake, "galaxies", facts["galaxies"])
    cosmology = from_facts(galaxies.manifest["facts"])
    table = galaxies.rows(rows.COLUMNS, [facts["part"]])
    return Output(rows.draw(table, facts["seed"], accretion.laws(), cosmology))


JOB = Job("build_active_nuclei", "Draw active nuclei and quasars.", steps)
