"""A lake as an older truesky wrote it, whose files go by true positions, made here: no file of that time is kept."""

import numpy as np

from lake_schema import sky
from lake_schema.store import layout, publish, read
from lake_schema.store.plan import Output, Part, Plan
from lake_schema.tables.fluxes import fluxes
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.strong_lenses import STRONG_LENSES
from tests.universe import rows_of

CELL, ROWS, AWAY = 1607, 300, 60.0 / 3600.0
FLUXES = fluxes("galaxy", ["euclid_vis"])


def galaxies(table, seed=3):
    """Rows of the table of this or of an earlier time, in one file, seen up to a minute of arc from where they are."""
    rows = rows_of(table, ROWS, seed)
    other = ("ra_true", "dec_true") if "ra_true" in table.names else ("ra_lensed", "dec_lensed")
    offset = np.radians(np.random.default_rng(seed).uniform(-0.7, 0.7, (2, ROWS)) * AWAY)
    places = dict(zip(other, sky.displaced(rows["ra"].to_numpy(), rows["dec"].to_numpy(), *offset), strict=True))
    return table.build({name: places.get(name, rows[name]) for name in table.names})


def published(root, table, rows, **facts):
    """The key of the version."""
    part = Part(layout.cell_file(5, CELL), {"generation_cells": list(range(CELL << 6, CELL + 1 << 6))})
    publish.make(root, Plan(table, {"seed": 3, **facts}, (part,)), lambda lake, about: Output(rows))
    return read.published_last(root, table.name).key


def write(root, *, is_earlier=True, and_fluxes=True):
    """Galaxies, their fluxes and strong lenses, of before or of now."""
    root.mkdir(parents=True, exist_ok=True)
    of_galaxies, of_lenses, of_fluxes = (
        table.earlier if is_earlier else table for table in (GALAXIES, STRONG_LENSES, FLUXES)
    )
    rows = galaxies(of_galaxies)
    key = published(root, of_galaxies, rows)
    shared = {name: rows[name] for name in ("id", "ra", "dec", "_healpix_29")}
    light = {"f_nu_euclid_vis": rows["bulge_fraction"], "integrated": [False] * ROWS}
    if and_fluxes:
        published(root, of_fluxes, of_fluxes.build({**shared, **light}), input=key)
        published(root, of_lenses, galaxies(of_lenses), galaxies=key)
    return rows
