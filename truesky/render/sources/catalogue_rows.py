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


def max_deflection(catalogue: read.Version) -> float:
    """How far a source may be seen from where its cell says, deg: stars move, galaxies do not.

    Error: a star that has moved farther is missed where its cell is not read
    """
    return FARTHEST_MOVED if "pm_ra" in catalogue.schema.names else 0.0


def apply_proper_motion(stars: pa.Table, mjd: float) -> pa.Table:
    """Rows of table `stars` where their proper motions have led at a time, MJD; parallaxes are left out."""
    if not {"pm_ra", "pm_dec"} <= set(stars.column_names):
        return stars
    years = _JULIAN_2000 + (mjd - _MJD_2000) / _DAYS_A_YEAR - EPOCH
    motion = (pc.fill_null(stars[name], 0.0).to_numpy().astype(float) for name in ("pm_ra", "pm_dec"))
    east, north = (np.radians(years * each / _MAS_A_DEG) for each in motion)
    moved = sky.offset_positions(stars["ra"].to_numpy(), stars["dec"].to_numpy(), east, north)
    for name, values in zip(("ra", "dec"), moved, strict=True):
        at = stars.schema.get_field_index(name)
        stars = stars.set_column(at, stars.schema.field(name), pa.array(values))
    return stars


def read_sources(
    catalogue: read.Version,
    fluxes: read.Version,
    task: Mapping[str, Any],
    columns: Sequence[str],
    bands: Sequence[str],
    reach_arcsec: float,
    min_flux: float,
    min_bright_flux: float = float("inf"),
) -> tuple[pa.Table, pa.Table, float]:
    """(rows of a catalogue that a task may draw, their fluxes, how far beyond the task's circle they are complete).

    farther : how far beyond the circle a source may be seen and reach the detector, arcsec
    least   : microjansky, of sources beyond the cells of the circle; infinite where no source at all shows
    bright  : microjansky, of sources still farther out, as far as spikes and outskirts go; infinite where none do
    catalogue, fluxes : versions of the two tables;  task : its row
    columns : that are wanted;  bands : whose fluxes are, those of the first are limited
    """
    deflection, flux = max_deflection(catalogue), ["id", *(f"f_nu_{band}" for band in bands)]
    inner_cells: list[int] = []
    outer_cells: list[int] = []
    farthest_cells: list[int] = []
    complete = reach_arcsec
    if np.isfinite(min_flux):
        inner_cells = selection.cells_of_task(task, deflection)
        outer_cells, complete = selection.cells_beyond_task(task, deflection, reach_arcsec, drawn_cells(catalogue))
    if np.isfinite(min_bright_flux):
        reachable, _ = selection.cells_beyond_task(
            task, deflection, max(FARTHEST, reach_arcsec), drawn_cells(catalogue)
        )
        farthest_cells = sorted(set(reachable) - set(outer_cells))
    rows, light = (v.rows_in_cells(inner_cells, GENERATION_ORDER, c) for v, c in ((catalogue, columns), (fluxes, flux)))
    for cells, limit in ((outer_cells, min_flux), (farthest_cells, min_bright_flux)):
        if not cells:
            continue
        outer_rows, outer_fluxes = (
            v.rows_in_cells(cells, GENERATION_ORDER, c) for v, c in ((catalogue, columns), (fluxes, flux))
        )
        shows = pc.greater_equal(outer_fluxes[flux[1]], limit)
        rows, light = (pa.concat_tables([a, b.filter(shows)]) for a, b in ((rows, outer_rows), (light, outer_fluxes)))
    return rows, light, complete


@dataclass(frozen=True, slots=True)
class BrightQuery:
    """Of a catalogue the sources that are seen within a task's circle and shine brightly.

    task    : its row;  columns : that are wanted;  band : whose fluxes are
    least   : microjansky; infinite where no source shows;  farther : how far beyond the circle they are seen, arcsec
    """

    task: Mapping[str, Any]
    columns: Sequence[str]
    band: str
    min_flux: float
    reach_arcsec: float = 0.0


def read_bright(
    catalogue: read.Version, fluxes: read.Version, queries: Sequence[BrightQuery]
) -> list[tuple[pa.Table, pa.Table]]:
    """(rows of a catalogue, their fluxes) of each that is wanted; what several want is read once.

    catalogue, fluxes : versions of the two tables
    """
    if not queries:
        return []
    deflection = max_deflection(catalogue)
    cells = [
        selection.cells_within_reach(query.task, deflection, query.reach_arcsec) if np.isfinite(query.min_flux) else []
        for query in queries
    ]
    all_cells = sorted(set().union(*cells))
    bands = dict.fromkeys(f"f_nu_{query.band}" for query in queries)
    light = fluxes.rows_in_cells(all_cells, GENERATION_ORDER, ["id", *bands, "_healpix_29"])
    cell = sky.parent(light["_healpix_29"].to_numpy(), sky.MAX_ORDER, GENERATION_ORDER)
    shows = [
        np.isin(cell, query_cells) & (light[f"f_nu_{query.band}"].to_numpy().astype(float) >= query.min_flux)
        for query, query_cells in zip(queries, cells, strict=True)
    ]
    bright_ids = light["id"].filter(pa.array(np.logical_or.reduce(shows)))
    # Fluxes are small: only the parts of the catalogue that have some of these are read.
    parts = [
        part["name"] for part in catalogue.manifest["parts"] if not set(all_cells).isdisjoint(part["facts"][CELLS])
    ]
    columns = list(dict.fromkeys(["id", *(name for query in queries for name in query.columns)]))
    rows = catalogue.rows(columns, parts if len(bright_ids) else [], pc.field("id").isin(bright_ids))
    results = []
    for query, shown_rows in zip(queries, shows, strict=True):
        query_fluxes = light.filter(pa.array(shown_rows)).select(["id", f"f_nu_{query.band}"])
        in_query = pc.is_in(rows["id"], pc.unique(query_fluxes["id"]))
        results.append((rows.filter(in_query).select(list(query.columns)), query_fluxes))
    return results


def read_lenses(
    table: read.Version, task: Mapping[str, Any], deflection: float, reach_arcsec: float, min_flux: float
) -> pa.Table:
    """Strong lenses that are seen within a task's circle, and beyond it as far as others are read.

    deflection : largest of the galaxies, deg;  least : infinite where no source shows, as in `sources`
    farther    : arcsec, as of `sources`
    table      : version of `strong_lenses`;  task : its row
    """
    cells = selection.cells_within_reach(task, deflection, reach_arcsec) if np.isfinite(min_flux) else []
    positions = table.rows_in_cells(cells, GENERATION_ORDER, ["id", "ra", "dec"])
    ra, dec = (positions[name].to_numpy() for name in ("ra", "dec"))
    reach = task["radius"] + reach_arcsec / 3600.0
    lens_ids = positions["id"].filter(pa.array(selection.within_radius(ra, dec, (task["ra"], task["dec"]), reach)))
    # Pictures are large: only those of lenses that are seen are read.
    parts = [part["name"] for part in table.manifest["parts"] if not set(cells).isdisjoint(part["facts"][CELLS])]
    return table.rows(lensed_arcs.ARC_COLUMNS, parts if len(lens_ids) else [], pc.field("id").isin(lens_ids))


def add_lensed_galaxies(
    galaxies: tuple[pa.Table, pa.Table],
    lenses: pa.Table,
    catalogue: read.Version,
    fluxes: read.Version,
    task: Mapping[str, Any],
    reach_arcsec: float,
) -> tuple[pa.Table, pa.Table]:
    """(galaxies, their fluxes) with those behind lenses, that alone would be too faint to be seen from so far away.

    found  : rows of the two tables, whose columns are read;  lenses : of `strong_lenses`
    catalogue, fluxes : versions of the two tables;  task, farther : as of `lenses`
    """
    rows, light = galaxies
    missing = pc.unique(lenses["source_id"]).to_numpy()
    missing = missing[~np.isin(missing, rows["id"].to_numpy())]
    if not len(missing):
        return galaxies
    # A lens and what lies behind it are of one cell.
    cells = set(selection.cells_within_reach(task, max_deflection(catalogue), reach_arcsec))
    parts = [part["name"] for part in catalogue.manifest["parts"] if not cells.isdisjoint(part["facts"][CELLS])]
    is_missing = pc.field("id").isin(pa.array(missing))
    missing_rows = catalogue.rows(rows.column_names, parts, is_missing)
    missing_fluxes = fluxes.rows(light.column_names, parts, is_missing)
    return pa.concat_tables([rows, missing_rows]), pa.concat_tables([light, missing_fluxes])
