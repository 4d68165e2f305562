"""Build table `strong_lenses` of a lake's galaxies, with pictures of the arcs.

spark-submit jobs/catalogue/build_strong_lenses.py --lake LAKE --request REQUEST
"""

from pathlib import Path

import numpy as np
import pyarrow as pa

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from lake_schema.store.plan import Json, Output, Part, Plan
from lake_schema.store.provenance import code_version
from lake_schema.tables.strong_lenses import STRONG_LENSES
from truesky.catalogue import cells
from truesky.catalogue.galaxies import strong_lenses
from truesky.request import universe
from truesky.request.schema import Request
from truesky.running.shell import Job, Step


def steps(lake: Path, request: Request) -> list[Step]:
    """One part a file of the galaxies."""
    galaxies = read.for_request(lake, "galaxies", request.name)
    universe.refuse_other([galaxies], request)
    facts = {"seed": request.seed, "galaxies": galaxies.key, "boost": request.strong_lens_boost, "code": code_version()}
    named = {part["name"]: part["facts"]["generation_cells"] for part in galaxies.manifest["parts"]}
    parts = tuple(Part(name, {"part": name, "generation_cells": own}) for name, own in named.items())
    return [Step(Plan(STRONG_LENSES, facts, parts), work)]


def work(lake: Path, facts: Json) -> Output:
    """The strong lenses of one file: sources are galaxies that are seen in the lens' own generation cell."""
    rows = read.version(lake, "galaxies", facts["galaxies"]).rows(strong_lenses.COLUMNS, [facts["part"]])
    index = rows["_healpix_29"].to_numpy()

    def draw(cell: int) -> pa.Table:
        first, last = np.searchsorted(index, sky.cell_range(GENERATION_ORDER, cell))
        return strong_lenses.draw(cell, rows.slice(first, last - first), facts["seed"], facts["boost"])

    return Output(cells.rows(facts, STRONG_LENSES, draw))


JOB = Job("build_strong_lenses", "Draw strong lenses and their arcs.", steps)
