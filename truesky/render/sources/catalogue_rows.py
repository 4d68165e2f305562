"""The catalogue rows that a task reads: in its circle, and the bright ones beyond it; stars where they are then."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from lake_schema.tables.stars import EPOCH
from truesky.render.psf import spikes
from truesky.render.sources import lensed_arcs, selection

# Each with its fluxes.
CATALOGUES = (("galaxies", "galaxy_fluxes"), ("stars", "star_fluxes"))
# Drawn where the lake has it.
LENSES = "strong_lenses"
# How far beyond a detector sources are looked for that shine so far, arcsec: spikes of stars, outskirts of galaxies.
FARTHEST = max(spikes.FARTHEST, selection.FARTHEST)
# How far a star has moved at most that is looked for, deg: 3"/yr over 12 years; Julian years and days, of J2000.
FARTHEST_MOVED = 0.01
_JULIAN_2000, _MJD_2000, _DAYS_A_YEAR, _MAS_A_DEG = 2000.0, 51544.5, 365.25, 3.6e6
# What the parts of catalogues say of themselves.
CELLS = "generation_cells"


def drawn_cells(catalogue: read.Version) -> set[int]:
    """Order-8 cells that a catalogue was drawn in."""
    return {cell for part in catalogue.manifest["parts"] for cell in part["facts"][CELLS]}


def deflection_of(catalogue: read.Version) -> float:
    """How far a source may be seen from where its cell says, deg: stars move, galaxies do not.

    Error: a star that has moved farther is missed where its cell is not read
    """
    return FARTHEST_MOVED if "pm_ra" in catalogue.schema.names else 0.0


def at_time(stars: pa.Table, mjd: float) -> pa.Table:
    """Rows of table `stars` where their proper motions have led at a time, MJD; parallaxes are left out."""
    if not {"pm_ra", "pm_dec"} <= set(stars.column_names):
        return stars
    years = _JULIAN_2000 + (mjd - _MJD_2000) / _DAYS_A_YEAR - EPOCH
    motion = (pc.fill_null(stars[name], 0.0).to_numpy().astype(float) for name in ("pm_ra", "pm_dec"))
    east, north = (np.radians(years * each / _MAS_A_DEG) for each in motion)
    moved = sky.displaced(stars["ra"].to_numpy(), stars["dec"].to_numpy(), east, north)
    for name, values in zip(("ra", "dec"), moved, strict=True):
        at = stars.schema.get_field_index(name)
        stars = stars.set_column(at, stars.schema.field(name), pa.array(values))
    return stars


def sources(
    catalogue: read.Version,
    fluxes: read.Version,
    task: Mapping[str, Any],
    columns: Sequence[str],
    bands: Sequence[str],
    farther: float,
    least: float,
    bright: float = float("inf"),
) -> tuple[pa.Table, pa.Table, float]:
    """(rows of a catalogue that a task may draw, their fluxes, how far beyond the task's circle they are complete).

    farther : how far beyond the circle a source may be seen and reach the detector, arcsec
    least   : microjansky, of sources beyond the cells of the circle; infinite where no source at all shows
    bright  : microjansky, of sources still farther out, as far as spikes and outskirts go; infinite where none do
    catalogue, fluxes : versions of the two tables;  task : its row
    columns : that are wanted;  bands : whose fluxes are, those of the first are limited
    """
    deflection, flux = deflection_of(catalogue), ["id", *(f"f_nu_{band}" for band in bands)]
    near: list[int] = []
    far: list[int] = []
    farthest: list[int] = []
    complete = farther
    if np.isfinite(least):
        near = selection.needed(task, deflection)
        far, complete = selection.beyond(task, deflection, farther, drawn_cells(catalogue))
    if np.isfinite(bright):
        around, _ = selection.beyond(task, deflection, max(FARTHEST, farther), drawn_cells(catalogue))
        farthest = sorted(set(around) - set(far))
    rows, light = (v.in_cells(near, GENERATION_ORDER, c) for v, c in ((catalogue, columns), (fluxes, flux)))
    for cells, limit in ((far, least), (farthest, bright)):
        if not cells:
            continue
        more, fluxes_there = (v.in_cells(cells, GENERATION_ORDER, c) for v, c in ((catalogue, columns), (fluxes, flux)))
        shows = pc.greater_equal(fluxes_there[flux[1]], limit)
        rows, light = (pa.concat_tables([a, b.filter(shows)]) for a, b in ((rows, more), (light, fluxes_there)))
    return rows, light, complete


@dataclass(frozen=True, slots=True)
class Bright:
    """Of a catalogue the sources that are seen within a task's circle and shine brightly.

    task    : its row;  columns : that are wanted;  band : whose fluxes are
    least   : microjansky; infinite where no source shows;  farther : how far beyond the circle they are seen, arcsec
    """

    task: Mapping[str, Any]
    columns: Sequence[str]
    band: str
    least: float
    farther: float = 0.0


def bright(catalogue: read.Version, fluxes: read.Version, wanted: Sequence[Bright]) -> list[tuple[pa.Table, pa.Table]]:
    """(rows of a catalogue, their fluxes) of each that is wanted; what several want is read once.

    catalogue, fluxes : versions of the two tables
    """
    if not wanted:
        return []
    deflection = deflection_of(catalogue)
    cells = [selection.within(one.task, deflection, one.farther) if np.isfinite(one.least) else [] for one in wanted]
    every = sorted(set().union(*cells))
    bands = dict.fromkeys(f"f_nu_{one.band}" for one in wanted)
    light = fluxes.in_cells(every, GENERATION_ORDER, ["id", *bands, "_healpix_29"])
    cell = sky.parent(light["_healpix_29"].to_numpy(), sky.DEEPEST, GENERATION_ORDER)
    shows = [
        np.isin(cell, own) & (light[f"f_nu_{one.band}"].to_numpy().astype(float) >= one.least)
        for one, own in zip(wanted, cells, strict=True)
    ]
    some = light["id"].filter(pa.array(np.logical_or.reduce(shows)))
    # Fluxes are small: only the parts of the catalogue that have some of these are read.
    parts = [part["name"] for part in catalogue.manifest["parts"] if not set(every).isdisjoint(part["facts"][CELLS])]
    columns = list(dict.fromkeys(["id", *(name for one in wanted for name in one.columns)]))
    rows = catalogue.rows(columns, parts if len(some) else [], pc.field("id").isin(some))
    found = []
    for one, seen in zip(wanted, shows, strict=True):
        its = light.filter(pa.array(seen)).select(["id", f"f_nu_{one.band}"])
        here = pc.is_in(rows["id"], pc.unique(its["id"]))
        found.append((rows.filter(here).select(list(one.columns)), its))
    return found


def lenses(table: read.Version, task: Mapping[str, Any], deflection: float, farther: float, least: float) -> pa.Table:
    """Strong lenses that are seen within a task's circle, and beyond it as far as others are read.

    deflection : largest of the galaxies, deg;  least : infinite where no source shows, as in `sources`
    farther    : arcsec, as of `sources`
    table      : version of `strong_lenses`;  task : its row
    """
    cells = selection.within(task, deflection, farther) if np.isfinite(least) else []
    about = table.in_cells(cells, GENERATION_ORDER, ["id", "ra", "dec"])
    ra, dec = (about[name].to_numpy() for name in ("ra", "dec"))
    reach = task["radius"] + farther / 3600.0
    seen = about["id"].filter(pa.array(selection.near(ra, dec, (task["ra"], task["dec"]), reach)))
    # Pictures are large: only those of lenses that are seen are read.
    parts = [part["name"] for part in table.manifest["parts"] if not set(cells).isdisjoint(part["facts"][CELLS])]
    return table.rows(lensed_arcs.ARC_COLUMNS, parts if len(seen) else [], pc.field("id").isin(seen))


def with_lensed(
    found: tuple[pa.Table, pa.Table],
    lenses: pa.Table,
    catalogue: read.Version,
    fluxes: read.Version,
    task: Mapping[str, Any],
    farther: float,
) -> tuple[pa.Table, pa.Table]:
    """(galaxies, their fluxes) with those behind lenses, that alone would be too faint to be seen from so far away.

    found  : rows of the two tables, whose columns are read;  lenses : of `strong_lenses`
    catalogue, fluxes : versions of the two tables;  task, farther : as of `lenses`
    """
    rows, light = found
    missing = pc.unique(lenses["source_id"]).to_numpy()
    missing = missing[~np.isin(missing, rows["id"].to_numpy())]
    if not len(missing):
        return found
    # A lens and what lies behind it are of one cell.
    cells = set(selection.within(task, deflection_of(catalogue), farther))
    parts = [part["name"] for part in catalogue.manifest["parts"] if not cells.isdisjoint(part["facts"][CELLS])]
    wanted = pc.field("id").isin(pa.array(missing))
    more = catalogue.rows(rows.column_names, parts, wanted)
    its = fluxes.rows(light.column_names, parts, wanted)
    return pa.concat_tables([rows, more]), pa.concat_tables([light, its])
