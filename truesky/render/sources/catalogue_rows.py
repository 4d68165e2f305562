"""Read the rows of galaxies, stars and strong lenses that may shine on a detector.

A task is a detector of an exposure, with a circle on the sky that contains the detector and its surroundings. All
sources in the circle are read, and outside only bright ones. Stars are moved by their proper motion.
"""

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

# Names of the tables of sources, each followed by the name of the table with its fluxes.
CATALOGUES = (("galaxies", "galaxy_fluxes"), ("stars", "star_fluxes"))
# Name of the table of strong lenses, which a lake may lack.
LENSES = "strong_lenses"
# Largest distance from a detector, in arcsec, up to which diffraction spikes of stars and outskirts of galaxies are
# drawn on it.
FARTHEST = max(spikes.FARTHEST, selection.FARTHEST)
# Largest displacement of a star by proper motion that is allowed for, deg: 3 arcsec/yr over 12 years.
FARTHEST_MOVED = 0.01
# Epoch J2000 as a Julian year.
_JULIAN_2000 = 2000.0
# Epoch J2000 as MJD.
_MJD_2000 = 51544.5
# Days in a Julian year.
_DAYS_A_YEAR = 365.25
# Milliarcseconds in a degree.
_MAS_A_DEG = 3.6e6
# Column of all catalogues and tables of fluxes with the HEALPix index of a source.
_CELL_COLUMN = "_healpix_29"
# Key of the list of order-8 HEALPix cells in the facts of a catalogue file (recorded dictionary of its inputs).
CELLS = "generation_cells"


def drawn_cells(catalogue: read.Version) -> set[int]:
    """Return the order-8 HEALPix cells for which a catalogue was simulated, including cells without sources."""
    return {cell for part in catalogue.manifest["parts"] for cell in part["facts"][CELLS]}


def max_deflection(catalogue: read.Version) -> float:
    """Return the largest distance, in degrees, of a source outside the HEALPix cell under which it is stored.

    Stars are stored under their position at the catalogue's epoch and move; a star that has moved farther than the
    result may be missed. The result is 0 for catalogues without proper motions, such as galaxies.
    """
    return FARTHEST_MOVED if "pm_ra" in catalogue.schema.names else 0.0


def apply_proper_motion(stars: pa.Table, mjd: float) -> pa.Table:
    """Return rows of the table `stars` with their positions moved by proper motion to a date (MJD).

    Missing proper motions count as 0, and parallaxes are neglected. Rows without the columns `pm_ra` and `pm_dec` are
    returned unchanged.
    """
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
    """Read the sources that may shine on a detector, and their fluxes.

    Parameters
    ----------
    catalogue, fluxes : read.Version
        Stored versions of a table of sources and of its table of fluxes.
    task : mapping
        Row of the table `tasks`: the detector, with the `ra`, `dec` and `radius` (deg) of a circle around it.
    columns : sequence of str
        Names of the columns of the catalogue to read.
    bands : sequence of str
        Names of the bands of the fluxes to read, at least one. The flux limits apply to the first band.
    reach_arcsec : float
        Distance beyond the circle, in arcsec, up to which sources are read if they exceed `min_flux`.
    min_flux : float
        Smallest flux in microjansky of sources outside the HEALPix cells that overlap the circle. Sources inside these
        cells are read at any flux up to `reach_arcsec` beyond the circle, and with the smaller of both limits farther
        out. If it is infinite (for exposures without sources), no source of either kind is read.
    min_bright_flux : float
        Smallest flux in microjansky of sources still farther out, up to 1200 arcsec, from where diffraction spikes and
        outskirts may reach the detector. Infinite to read none of these.

    Returns
    -------
    (pyarrow.Table, pyarrow.Table, float)
        Rows of the catalogue; rows of their fluxes; and a distance in arcsec. Up to this distance beyond the circle,
        the catalogue has all HEALPix cells; it is at most `reach_arcsec`.
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
    # Fluxes are a small table. Read the large catalogue once, and only from cells with a source that is bright enough.
    light = fluxes.rows_in_cells(
        sorted({*inner_cells, *outer_cells, *farthest_cells}), GENERATION_ORDER, [*flux, _CELL_COLUMN]
    )
    cell = sky.parent(light[_CELL_COLUMN].to_numpy(), sky.MAX_ORDER, GENERATION_ORDER)
    brightness = light[flux[1]].to_numpy().astype(float)
    group = np.select([np.isin(cell, cells) for cells in (inner_cells, outer_cells)], [0, 1], 2)
    shows = (group == 0) | (brightness >= np.array([-np.inf, min_flux, min_bright_flux])[group])
    # All cells of the circle are read, so that a table of fluxes that lacks one of them is noticed.
    read_cells = np.union1d(np.array(inner_cells, np.int64), cell[shows])
    is_read = np.isin(cell, read_cells)
    rows = catalogue.rows_in_cells(read_cells.tolist(), GENERATION_ORDER, list(dict.fromkeys([*columns, "ra", "dec"])))
    light, group, shows, brightness = (
        light.filter(pa.array(is_read)),
        group[is_read],
        shows[is_read],
        brightness[is_read],
    )
    if len(rows) == len(light):
        # Remove faint sources that are in the cells of the circle only because cells are large. Tables of different
        # lengths do not belong together, which the caller reports.
        reach = task["radius"] + deflection + reach_arcsec / 3600.0
        is_near = selection.within_radius(
            rows["ra"].to_numpy(), rows["dec"].to_numpy(), (task["ra"], task["dec"]), reach
        )
        shows &= is_near | (brightness >= min(min_flux, min_bright_flux))
        indices = np.flatnonzero(shows)
        indices = pa.array(indices[np.argsort(group[indices], kind="stable")])
        rows, light = rows.take(indices), light.take(indices)
    return rows.select(list(columns)), light.select(flux), complete


@dataclass(frozen=True, slots=True)
class BrightQuery:
    """Query for the bright sources around a detector.

    Attributes
    ----------
    task : mapping
        Row of the table `tasks`: the detector, with the `ra`, `dec` and `radius` (deg) of a circle around it.
    columns : sequence of str
        Names of the columns of the catalogue to read.
    band : str
        Name of the band of the fluxes.
    min_flux : float
        Smallest flux in microjansky; infinite to read nothing.
    reach_arcsec : float
        Distance beyond the circle, in arcsec, up to which sources are included.
    """

    task: Mapping[str, Any]
    columns: Sequence[str]
    band: str
    min_flux: float
    reach_arcsec: float = 0.0


def read_bright(
    catalogue: read.Version, fluxes: read.Version, queries: Sequence[BrightQuery]
) -> list[tuple[pa.Table, pa.Table]]:
    """Read the bright sources around several detectors; rows that several queries need are read only once.

    Parameters
    ----------
    catalogue, fluxes : read.Version
        Stored versions of a table of sources and of its table of fluxes.
    queries : sequence of BrightQuery
        One query per detector.

    Returns
    -------
    list of (pyarrow.Table, pyarrow.Table)
        Rows of the catalogue, and rows of their fluxes, for each query; [] without queries.
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
    # The small tables of fluxes have been read before. Read files of the large catalogue only if at least one source is
    # bright enough.
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
    """Read the strong lenses around a detector.

    Parameters
    ----------
    table : read.Version
        Stored version of the table `strong_lenses`.
    task : mapping
        Row of the table `tasks`: the detector, with the `ra`, `dec` and `radius` (deg) of a circle around it.
    deflection : float
        Largest distance of a galaxy from the HEALPix cell under which it is stored, deg.
    reach_arcsec : float
        Distance beyond the circle, in arcsec, up to which lenses are read.
    min_flux : float
        Infinite if no source is visible, so that no lens is read; other values are ignored.

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
    # The images of arcs in the table are large. Read them only for the lenses whose positions are near the detector.
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
    """Add the galaxies behind strong lenses that were not read before because they are too faint.

    Parameters
    ----------
    galaxies : (pyarrow.Table, pyarrow.Table)
        Rows of the table `galaxies` that have been read, and rows of their fluxes.
    lenses : pyarrow.Table
        Rows of the table `strong_lenses` around the detector.
    catalogue, fluxes : read.Version
        Stored versions of the table `galaxies` and of its table of fluxes.
    task : mapping
        Row of the table `tasks`: the detector, with the `ra`, `dec` and `radius` (deg) of a circle around it.
    reach_arcsec : float
        Distance beyond the circle, in arcsec, up to which lenses were read.

    Returns
    -------
    (pyarrow.Table, pyarrow.Table)
        Rows and fluxes, followed by those of the missing galaxies; `galaxies` itself if none is missing.
    """
    rows, light = galaxies
    missing = pc.unique(lenses["source_id"]).to_numpy()
    missing = missing[~np.isin(missing, rows["id"].to_numpy())]
    if not len(missing):
        return galaxies
    # Search for the galaxies that have not been read yet in the HEALPix cells in which lenses were searched: a lens and
    # the galaxy behind it are stored under the same cell.
    cells = set(selection.cells_within_reach(task, max_deflection(catalogue), reach_arcsec))
    parts = [part["name"] for part in catalogue.manifest["parts"] if not cells.isdisjoint(part["facts"][CELLS])]
    is_missing = pc.field("id").isin(pa.array(missing))
    missing_rows = catalogue.rows(rows.column_names, parts, is_missing)
    missing_fluxes = fluxes.rows(light.column_names, parts, is_missing)
    return pa.concat_tables([rows, missing_rows]), pa.concat_tables([light, missing_fluxes])
