"""Build table `strong_lenses` of a lake's galaxies, with pictures of the arcs.

spark-submit jobs/catalogue/build_strong_lenses.py --lake LAKE --request REQUEST
"""

from pathlib import Path

import numpy as np
import pyarrow as pa

from lake_schema import position_columns, sky
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import layout, read
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
    position_columns.refuse_earlier(galaxies)
    facts = {"seed": request.seed, "galaxies": galaxies.key, "boost": request.strong_lens_boost, "code": code_version()}
    named = {part["name"]: part["facts"].get("generation_cells") for part in galaxies.manifest["parts"]}
    parts = tuple(Part(name, {"part": name, "generation_cells": own or _all(name)}) for name, own in named.items())
    return [Step(Plan(STRONG_LENSES, facts, parts), work)]


def work(lake: Path, facts: Json) -> Output:
    """The strong lenses of one file: sources are galaxies that are seen in the lens' own generation cell."""
    rows = read.version(lake, "galaxies", facts["galaxies"]).rows(strong_lenses.COLUMNS, [facts["part"]])
    index = rows["_healpix_29"].to_numpy()

    def draw(cell: int) -> pa.Table:
        first, last = np.searchsorted(index, sky.cell_range(GENERATION_ORDER, cell))
        return strong_lenses.draw(cell, rows.slice(first, last - first), facts["seed"], facts["boost"])

    return Output(cells.rows(facts, STRONG_LENSES, draw))


def _all(part: str) -> list[int]:
    order, cell = layout.cell_of_file(part)
    shift = 2 * (GENERATION_ORDER - order)
    return list(range(cell << shift, cell + 1 << shift))


JOB = Job("build_strong_lenses", "Draw strong lenses and their arcs.", steps)
