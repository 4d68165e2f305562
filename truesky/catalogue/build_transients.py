"""Build the table `transients`: supernovae in the galaxies of a lake, during the window of time of a request.

Command: spark-submit jobs/catalogue/build_transients.py --lake LAKE --request REQUEST.
"""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import sky
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from lake_schema.store.plan import Json, Output, Plan, Task
from lake_schema.store.provenance import code_version
from lake_schema.tables.variability.transients import TRANSIENTS
from truesky.catalogue import cells, request_checks
from truesky.catalogue.transients import supernovae
from truesky.catalogue.transients.supernovae import Window
from truesky.cosmology import from_facts
from truesky.request import universe
from truesky.request.schema import Request
from truesky.running.submitted_job import Job, Step
from truesky.variability import spectral_series


def steps(lake: Path, request: Request) -> list[Step]:
    """Plan the making of table `transients`, with one task per partition (file) of the request's galaxies.

    BadInput is raised if the request has no transients, or only sources of the user.
    """
    settings = request.transients
    if settings is None:
        example = "universe.transients = { start = 61000, end = 62000 }"
        raise BadInput(f"request {request.name} has no transients: set {example}")
    request_checks.check_transients(request)
    galaxies = read.input_version(lake, "galaxies", request.name)
    universe.check_catalogues([galaxies], request)
    facts = {
        "seed": request.seed,
        "galaxies": galaxies.key,
        "start": settings.start,
        "end": settings.end,
        "kinds": list(settings.kinds),
        "boost": settings.boost,
        **spectral_series.facts(settings.light_curves),
        "code": code_version(),
    }
    cells_by_partition = {part["name"]: part["facts"]["generation_cells"] for part in galaxies.manifest["parts"]}
    tasks = tuple(
        Task(name, {"part": name, "generation_cells": generation_cells})
        for name, generation_cells in cells_by_partition.items()
    )
    return [Step(Plan(TRANSIENTS, facts, tasks), draw_transients)]


def draw_transients(lake: Path, facts: Json) -> Output:
    """Draw the transients in the galaxies of one partition (`facts["part"]`).

    BadInput is raised if the galaxies have no stellar masses, on which the rates depend.
    """
    galaxies = read.version(lake, "galaxies", facts["galaxies"])
    rows, cosmology = galaxies.rows(supernovae.COLUMNS, [facts["part"]]), from_facts(galaxies.manifest["facts"])
    # Quasars and galaxies beyond z = 6, of other kinds, have no stellar masses.
    galaxies_in_halos = rows.filter(pc.less(rows["kind"], 2))
    if len(galaxies_in_halos) and galaxies_in_halos["log_stellar_mass"].null_count == len(galaxies_in_halos):
        raise BadInput(f"table galaxies, {facts['part']}: no galaxy has log_stellar_mass, so that none has a supernova")
    index = sky.cell_at(rows["ra"].to_numpy(), rows["dec"].to_numpy(), GENERATION_ORDER)
    templates = spectral_series.templates_from_facts(facts)
    window = Window(facts["start"], facts["end"], tuple(facts["kinds"]), facts["boost"], templates)

    def draw(cell: int) -> pa.Table:
        in_cell = rows.take(pa.array(np.flatnonzero(index == cell)))
        return supernovae.draw(cell, in_cell, facts["seed"], window, cosmology)

    return Output(cells.draw_rows(facts, TRANSIENTS, draw))


JOB = Job("build_transients", "Draw the supernovae in the galaxies of a lake.", steps)
