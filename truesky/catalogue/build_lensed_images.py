"""Build the table `lensed_images`: images of transients and quasars behind the strong lenses of a lake.

Command: spark-submit jobs/catalogue/build_lensed_images.py --lake LAKE --request REQUEST.

Images of transients are computed if the request has `universe.transients`.
"""

from pathlib import Path

import numpy as np
import pyarrow as pa

from lake_schema import sky
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import layout, read
from lake_schema.store.plan import Json, Output, Plan, Task
from lake_schema.store.provenance import code_version
from lake_schema.tables.variability.lensed_images import LENSED_IMAGES
from truesky.catalogue import cells, lensed_quasars
from truesky.catalogue.transients import lensed_supernovae, supernovae
from truesky.catalogue.transients.supernovae import Window
from truesky.cosmology import from_facts
from truesky.request import universe
from truesky.request.schema import Request
from truesky.running.submitted_job import Job, Step
from truesky.variability import lensed_rows, spectral_series

LENSES, TRANSIENTS = "strong_lenses", "transients"


def steps(lake: Path, request: Request) -> list[Step]:
    """Plan the making of table `lensed_images`, with one task per partition (file) of the request's galaxies.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    request : Request
        The request; its tables `galaxies`, `strong_lenses` and, if it has transients, `transients` must be in the lake.

    Returns
    -------
    list of Step
        One step, which computes the images.

    Raises
    ------
    BadInput
        If a table is missing, or the lenses or the transients were drawn in another version of the galaxies.
    """
    galaxies = read.input_version(lake, "galaxies", request.name)
    universe.check_catalogues([galaxies], request)
    facts = {"seed": request.seed, "galaxies": galaxies.key, "boost": request.strong_lens_boost, "code": code_version()}
    names = (LENSES,) if request.transients is None else (LENSES, TRANSIENTS)
    for name in names:
        version = read.input_version(lake, name, request.name)
        if version.manifest["facts"].get("galaxies") != galaxies.key:
            command = read.OPTIONAL_TABLES[name]
            raise BadInput(f"table {name} was drawn in another version of galaxies: run truesky {command} first")
        facts[name] = version.key
    cells_by_partition = {part["name"]: part["facts"]["generation_cells"] for part in galaxies.manifest["parts"]}
    tasks = tuple(
        Task(name, {"part": name, "generation_cells": generation_cells})
        for name, generation_cells in cells_by_partition.items()
    )
    return [Step(Plan(LENSED_IMAGES, facts, tasks), draw_images)]


def draw_images(lake: Path, facts: Json) -> Output:
    """Compute the images in the HEALPix cell of one partition.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    facts : dict
        Parameters of the job and of the task; `part` is the name of the partition.

    Returns
    -------
    Output
        Rows of table `lensed_images`, also of lenses beyond the edge of the partition. Lens and source are in the same
        generation cell.
    """
    order, cell = layout.cell_of_file(facts["part"])
    generation_cells = [*facts["generation_cells"], *sky.margin_cells(order, cell, GENERATION_ORDER).tolist()]
    galaxies = read.version(lake, "galaxies", facts["galaxies"])
    window = _window(lake, facts)
    columns = lensed_quasars.COLUMNS if window is None else dict.fromkeys(lensed_quasars.COLUMNS + supernovae.COLUMNS)
    rows = cells.sort_rows(galaxies.rows_in_cells(generation_cells, GENERATION_ORDER, list(columns)))
    stored = read.version(lake, LENSES, facts[LENSES])
    lenses = cells.sort_rows(
        stored.rows_in_cells(generation_cells, GENERATION_ORDER, (*lensed_rows.LENS_COLUMNS, "_healpix_29"))
    )
    seed, cosmology = facts["seed"], from_facts(galaxies.manifest["facts"])

    def draw(generation_cell: int) -> pa.Table:
        in_cell, lenses_in_cell = (_in_cell(table, generation_cell) for table in (rows, lenses))
        quasars = lensed_quasars.draw(generation_cell, in_cell, seed, facts["boost"], cosmology)
        if window is None or not lenses_in_cell.num_rows:
            return quasars
        exploded = lensed_supernovae.draw(generation_cell, in_cell, lenses_in_cell, seed, window, cosmology)
        return pa.concat_tables([quasars, exploded])

    images = cells.draw_rows({"generation_cells": generation_cells}, LENSED_IMAGES, draw)
    inside = sky.parent(images["_healpix_29"].to_numpy(), sky.MAX_ORDER, order) == cell
    return Output(cells.sort_rows(images.filter(pa.array(inside))))


def _in_cell(rows: pa.Table, cell: int) -> pa.Table:
    """Return the rows in a generation cell, from rows that are sorted by their position."""
    first, last = np.searchsorted(rows["_healpix_29"].to_numpy(), sky.cell_range(GENERATION_ORDER, cell))
    return rows.slice(first, last - first)


def _window(lake: Path, facts: Json) -> Window | None:
    """Return the window of time of the transients, or None without transients."""
    if TRANSIENTS not in facts:
        return None
    made = read.version(lake, TRANSIENTS, facts[TRANSIENTS]).manifest["facts"]
    templates = spectral_series.templates_from_facts(made)
    return Window(made["start"], made["end"], tuple(made["kinds"]), made["boost"], templates)


JOB = Job("build_lensed_images", "Compute the images of transients and quasars behind strong lenses.", steps)
