"""Build the table `strong_lenses`: which galaxies of a lake are strong lenses, with images of the lensed sources.

Command: spark-submit jobs/catalogue/build_strong_lenses.py --lake LAKE --request REQUEST.
"""

from pathlib import Path

import numpy as np
import pyarrow as pa

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from lake_schema.store.plan import Json, Output, Plan, Task
from lake_schema.store.provenance import code_version
from lake_schema.tables.strong_lenses import STRONG_LENSES
from truesky.catalogue import cells
from truesky.catalogue.galaxies import strong_lenses
from truesky.cosmology import from_facts
from truesky.request import universe
from truesky.request.schema import Request
from truesky.running.submitted_job import Job, Step


def steps(lake: Path, request: Request) -> list[Step]:
    """Plan the making of table `strong_lenses`, with one task per partition (file) of the request's galaxies."""
    galaxies = read.input_version(lake, "galaxies", request.name)
    universe.check_catalogues([galaxies], request)
    facts = {"seed": request.seed, "galaxies": galaxies.key, "boost": request.strong_lens_boost, "code": code_version()}
    cells_by_partition = {part["name"]: part["facts"]["generation_cells"] for part in galaxies.manifest["parts"]}
    tasks = tuple(
        Task(name, {"part": name, "generation_cells": generation_cells})
        for name, generation_cells in cells_by_partition.items()
    )
    return [Step(Plan(STRONG_LENSES, facts, tasks), draw_lenses)]


def draw_lenses(lake: Path, facts: Json) -> Output:
    """Draw the strong lenses among the galaxies of one partition (`facts["part"]`).

    Lens and source are galaxies whose observed positions are in the same generation cell (HEALPix cell of order 8).
    """
    galaxies = read.version(lake, "galaxies", facts["galaxies"])
    rows, cosmology = galaxies.rows(strong_lenses.COLUMNS, [facts["part"]]), from_facts(galaxies.manifest["facts"])
    index = rows["_healpix_29"].to_numpy()

    def draw(cell: int) -> pa.Table:
        first, last = np.searchsorted(index, sky.cell_range(GENERATION_ORDER, cell))
        return strong_lenses.draw(cell, rows.slice(first, last - first), facts["seed"], facts["boost"], cosmology)

    return Output(cells.draw_rows(facts, STRONG_LENSES, draw))


JOB = Job("build_strong_lenses", "Draw strong lenses and their arcs.", steps)
