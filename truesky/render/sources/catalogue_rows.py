"""Read the catalogue rows of a task: sources in its circle, bright sources beyond it, with proper motions of stars."""

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

# Tables of sources, each with its table of fluxes.
CATALOGUES = (("galaxies", "galaxy_fluxes"), ("stars", "star_fluxes"))
# Optional table of strong lenses.
LENSES = "strong_lenses"
# Largest distance from a detector of sources that may shine on it, arcsec: spikes of stars, outskirts of galaxies.
FARTHEST = max(spikes.FARTHEST, selection.FARTHEST)
# Largest displacement of a star by proper motion, deg: 3 arcsec/yr over 12 years. Julian year and MJD of J2000.
FARTHEST_MOVED = 0.01
_JULIAN_2000, _MJD_2000, _DAYS_A_YEAR, _MAS_A_DEG = 2000.0, 51544.5, 365.25, 3.6e6
# Key of the cells among the facts of a catalogue's parts.
CELLS = "generation_cells"


def drawn_cells(catalogue: read.Version) -> set[int]:
    """Order-8 cells for which a catalogue was drawn."""
    return {cell for part in catalogue.manifest["parts"] for cell in part["facts"][CELLS]}


def max_deflection(catalogue: read.Version) -> float:
    """Largest distance between a source's position and its cell, deg: stars move, galaxies do not.

    Stars that have moved farther are missed if their cell is not read.
    """
    return FARTHEST_MOVED if "pm_ra" in catalogue.schema.names else 0.0


def apply_proper_motion(stars: pa.Table, mjd: float) -> pa.Table:
    """Return rows of the table `stars` with positions at a date (MJD) from proper motions; parallaxes are neglected."""
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
    """Read the sources that a task may draw, and their fluxes.

    Parameters
    ----------
    catalogue, fluxes : read.Version
        Versions of the two tables.
    task : mapping
        Row of the task.
    columns : sequence of str
        Columns of the catalogue to read.
    bands : sequence of str
        Bands of the fluxes to read. The flux limits apply to the first band.
    reach_arcsec : float
        Distance beyond the task's circle up to which sources may reach the detector, arcsec.
    min_flux : float
        Smallest flux of sources outside the cells of the circle, microjansky; infinite if no source is visible at all.
    min_bright_flux : float
        Smallest flux of sources still farther out, up to the reach of spikes and outskirts, microjansky; infinite to
        read none of these.

    Returns
    -------
    (pyarrow.Table, pyarrow.Table, float)
        Rows of the catalogue, their fluxes, and the distance beyond the task's circle up to which they are complete,
        arcsec.
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
    """Query for the bright sources in a task's circle.

    Attributes
    ----------
    task : mapping
        Row of the task.
    columns : sequence of str
        Columns of the catalogue to read.
    band : str
        Band of the fluxes.
    min_flux : float
        Smallest flux, microjansky; infinite if no source is visible.
    reach_arcsec : float
        Distance beyond the circle up to which sources are included, arcsec.
    """

    task: Mapping[str, Any]
    columns: Sequence[str]
    band: str
    min_flux: float
    reach_arcsec: float = 0.0


def read_bright(
    catalogue: read.Version, fluxes: read.Version, queries: Sequence[BrightQuery]
) -> list[tuple[pa.Table, pa.Table]]:
    """Read the bright sources of several queries; rows that several queries need are read once.

    Parameters
    ----------
    catalogue, fluxes : read.Version
        Versions of the two tables.
    queries : sequence of BrightQuery
        The queries.

    Returns
    -------
    list of (pyarrow.Table, pyarrow.Table)
        Rows of the catalogue, and their fluxes, for each query.
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
    # Fluxes are small and read first, so that only the parts of the catalogue with bright sources are read.
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
    """Read the strong lenses in a task's circle, and beyond it up to a given distance.

    Parameters
    ----------
    table : read.Version
        Version of the table `strong_lenses`.
    task : mapping
        Row of the task.
    deflection : float
        Largest deflection of the galaxies, deg.
    reach_arcsec : float
        Distance beyond the circle up to which lenses are read, arcsec.
    min_flux : float
        Infinite if no source is visible, see `read_sources`.

    Returns
    -------
    pyarrow.Table
        Rows with the columns of `lensed_arcs.ARC_COLUMNS`.
    """
    cells = selection.cells_within_reach(task, deflection, reach_arcsec) if np.isfinite(min_flux) else []
    positions = table.rows_in_cells(cells, GENERATION_ORDER, ["id", "ra", "dec"])
    ra, dec = (positions[name].to_numpy() for name in ("ra", "dec"))
    reach = task["radius"] + reach_arcsec / 3600.0
    lens_ids = positions["id"].filter(pa.array(selection.within_radius(ra, dec, (task["ra"], task["dec"]), reach)))
    # Pictures are large, so only those of visible lenses are read.
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
    """Add galaxies behind lenses that would be too faint to be read without the lens.

    Parameters
    ----------
    galaxies : (pyarrow.Table, pyarrow.Table)
        Rows of galaxies and their fluxes.
    lenses : pyarrow.Table
        Rows of the table `strong_lenses`.
    catalogue, fluxes : read.Version
        Versions of the two tables.
    task : mapping
        Row of the task.
    reach_arcsec : float
        Distance beyond the circle up to which lenses were read, arcsec.

    Returns
    -------
    (pyarrow.Table, pyarrow.Table)
        Rows and fluxes with the additional galaxies.
    """
    rows, light = galaxies
    missing = pc.unique(lenses["source_id"]).to_numpy()
    missing = missing[~np.isin(missing, rows["id"].to_numpy())]
    if not len(missing):
        return galaxies
    # A lens and the galaxy behind it belong to the same cell.
    cells = set(selection.cells_within_reach(task, max_deflection(catalogue), reach_arcsec))
    parts = [part["name"] for part in catalogue.manifest["parts"] if not cells.isdisjoint(part["facts"][CELLS])]
    is_missing = pc.field("id").isin(pa.array(missing))
    missing_rows = catalogue.rows(rows.column_names, parts, is_missing)
    missing_fluxes = fluxes.rows(light.column_names, parts, is_missing)
    return pa.concat_tables([rows, missing_rows]), pa.concat_tables([light, missing_fluxes])
