"""Read from a lake (folder of stored tables) what is needed to draw windows, small parts of detectors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import sky
from lake_schema.arrays import Int
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.store import read
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.tables.stars import VARIABILITY_COLUMNS
from truesky.fluxes.inputs import galaxy_library_from_facts, stellar_library_from_facts
from truesky.render.channels.aim import Aim
from truesky.render.drawing import stamp_sizes
from truesky.render.exposure import visible_sources
from truesky.render.exposure.records import Rows, Variant
from truesky.render.sources import catalogue_rows, transients, varying_stars
from truesky.render.sources.catalogue_rows import LENSES
from truesky.render.sources.nuclei import read_nuclei
from truesky.render.sources.transients import read_transients
from truesky.render.windows.source_blocks import READ_ORDER, Pair, SourceBlocks

# Smallest distance from a window, in arcsec, within which sources of any flux are read. Light beyond the stamps of
# faint sources is drawn up to 26 arcsec from them.
_MIN_MARGIN = 30.0


class SkyTables:
    """Tables of a lake from which windows are drawn.

    Parameters
    ----------
    lake : Folder
        Lake (folder of stored tables).
    versions : mapping of str to Version
        Versions of the tables galaxies, galaxy_fluxes, stars and star_fluxes, and of strong_lenses if there are any.

    Attributes
    ----------
    galaxies, stars : SourceBlocks
        Catalogues with their fluxes. The rows around recent windows are kept in memory.
    galaxy_library, stellar_library : Library
        Templates with which the fluxes were computed.
    """

    def __init__(self, lake: Folder, versions: Mapping[str, read.Version]) -> None:
        self.versions = versions
        self.galaxies = SourceBlocks(versions["galaxies"], versions["galaxy_fluxes"], visible_sources.GALAXY_COLUMNS)
        star_columns = varying_stars.add_columns(visible_sources.STAR_COLUMNS, versions["stars"].schema.names)
        self.stars = SourceBlocks(versions["stars"], versions["star_fluxes"], star_columns)
        # Flux tables are found by the object of a library, so that all windows must use the same object.
        self.galaxy_library = galaxy_library_from_facts(lake, versions["galaxy_fluxes"].manifest["facts"])
        self.stellar_library = stellar_library_from_facts(lake, versions["star_fluxes"].manifest["facts"])


def read_rows(tables: SkyTables, aim: Aim, variant: Variant) -> Rows:
    """Read the catalogue rows of all sources whose light may reach a window.

    Parameters
    ----------
    tables : SkyTables
        Tables of the lake.
    aim : Aim
        Exposure and detector, with the window.
    variant : Variant
        Mission parameters and accuracy.

    Returns
    -------
    Rows
        All sources in the window and its surroundings, except very faint supernovae and nuclei, and bright sources
        farther away.

    Raises
    ------
    BadInput
        If the catalogues do not contain the whole window and its surroundings, or have no fluxes in the band.
    """
    exposure, detector, band = aim.exposure, aim.detector, aim.band
    limits = visible_sources.flux_limits(exposure, detector, band, variant)
    margin = max(variant.mission.value("survey.selection_margin", "arcsec"), _MIN_MARGIN)
    ra, dec = aim.centre
    task = {"ra": ra, "dec": dec, "radius": (aim.half_diagonal + margin) / 3600.0}
    ring = max(stamp_sizes.reach(detector.pixel_scale) - margin, 0.0)
    versions = tables.versions
    refuse_uncovered(versions["galaxies"], task)
    for fluxes in ("galaxy_fluxes", "star_fluxes"):
        check_band(versions[fluxes], exposure.band)
    galaxies, stars = (
        blocks.read(task, exposure.band, [(ring, limits.min_flux), (catalogue_rows.FARTHEST, far_limit)])
        for blocks, far_limit in ((tables.galaxies, limits.far_galaxy), (tables.stars, limits.spikes))
    )
    lenses = None
    if LENSES in versions:
        deflection = catalogue_rows.max_deflection(versions["galaxies"])
        lenses = catalogue_rows.read_lenses(versions[LENSES], task, deflection, ring, limits.min_flux)
        pair = versions["galaxies"], versions["galaxy_fluxes"]
        galaxies = catalogue_rows.add_lensed_galaxies(galaxies, lenses, *pair, task, ring)
    return Rows(
        *galaxies,
        *stars,
        galaxy_library=tables.galaxy_library,
        stellar_library=tables.stellar_library,
        complete_margin_arcsec=margin,
        lenses=lenses,
        transients=read_transients(versions, task, ring, (limits.min_point_flux, limits.min_flux)),
        nuclei=read_nuclei(versions, task, ring, (limits.min_point_flux, limits.min_flux)),
    )


def check_band(fluxes: read.Version, band: str) -> None:
    """Raise BadInput if a table of fluxes has no column for a band. The message lists the bands that it has."""
    if f"f_nu_{band}" not in fluxes.schema.names:
        present = [name.removeprefix("f_nu_") for name in fluxes.schema.names if name.startswith("f_nu_")]
        raise BadInput(f"band {band}: the lake has fluxes in {', '.join(present)}; add the band to fluxes.bands")


def refuse_uncovered(catalogue: read.Version, task: Mapping[str, Any]) -> None:
    """Raise BadInput if a catalogue does not contain the circle of a task (`ra`, `dec`, `radius` in deg).

    The message names the part of the circle that the catalogue contains.
    """
    cells = np.array(sorted(catalogue_rows.drawn_cells(catalogue)), np.int64)
    nearby_cells = sky.cells_in_cone(task["ra"], task["dec"], task["radius"], READ_ORDER)
    inside = np.isin(sky.parent(nearby_cells, READ_ORDER, GENERATION_ORDER), cells)
    if not inside.all():
        if not inside.any():
            raise outside_area(cells, task["ra"], task["dec"])
        place, percent = _format_place(task["ra"], task["dec"]), 100.0 * inside.mean()
        raise BadInput(f"{place}: cut by the edge of the catalogue, which has {percent:.0f} % of the surroundings")


def outside_area(cells: Int, ra: float, dec: float) -> BadInput:
    """Return the error for a place outside the cells of a catalogue.

    Parameters
    ----------
    cells : int array
        Cells of the catalogue, of order 8.
    ra, dec : float
        The place, deg.

    Returns
    -------
    BadInput
        The error, which tells where the cells are, or asks whether ra and dec are exchanged.
    """
    return BadInput(f"{_format_place(ra, dec)}: outside the area of the catalogue{_where(cells, ra, dec)}")


def _format_place(ra: float, dec: float) -> str:
    return f"ra {ra:.5f}, dec {dec:.5f}"


def refuse_unknown(rows: Rows, without: Sequence[int]) -> None:
    """Raise BadInput if a source or arc that is to be left out is not in the catalogue rows around a window."""
    tables = [rows.galaxies, rows.stars, *(() if rows.lenses is None else (rows.lenses,))]
    tables += [] if rows.transients is None else [rows.transients.rows]
    tables += [] if rows.nuclei is None else [rows.nuclei.points]
    ids = np.concatenate([table["id"].to_numpy() for table in tables])
    for number in without:
        if number not in ids:
            raise BadInput(f"without: there is no source or arc {number} in this image or around it")


def _where(cells: Int, ra: float, dec: float) -> str:
    """Return the end of a message about a position outside all cells of a catalogue: where the cells are."""
    # A declination that was given as right ascension may have been read as an angle from 0 to 360 deg.
    exchanged_ra, exchanged_dec = dec % 360.0, (ra + 180.0) % 360.0 - 180.0
    if abs(exchanged_dec) <= 90.0:
        exchanged_cell = sky.cell_at([exchanged_ra], [exchanged_dec], GENERATION_ORDER)
        if np.isin(exchanged_cell, cells).all():
            return ": are ra and dec exchanged?"
    near_ra, near_dec = _middle(cells)
    return f", which is near ra {near_ra:.1f}, dec {near_dec:.1f}"


def _middle(cells: Int) -> tuple[float, float]:
    """Return ra, dec (deg) of the middle of cells, or of the cell that is closest to it if no cell contains it."""
    centre_ra, centre_dec = sky.cell_centres(GENERATION_ORDER, cells)
    x, y, z = sky.unit_vectors(centre_ra, centre_dec).mean(axis=0)
    ra, dec = float(np.degrees(np.arctan2(y, x)) % 360.0), float(np.degrees(np.arctan2(z, np.hypot(x, y))))
    if np.isin(sky.cell_at([ra], [dec], GENERATION_ORDER), cells).all():
        return ra, dec
    closest = int(np.argmin(sky.separation(centre_ra, centre_dec, ra, dec)))
    return float(centre_ra[closest]), float(centre_dec[closest])


def select_rows(rows: Rows, without: Sequence[int] = ()) -> Rows:
    """Return catalogue rows without the sources and arcs with given identifiers."""
    if not len(without):
        return rows
    left_out = pa.array([int(number) for number in without], pa.int64())

    def rest(table: pa.Table) -> pa.Table:
        return table.filter(pc.invert(pc.is_in(table["id"], left_out)))

    def rest_of_lenses(table: pa.Table) -> pa.Table:
        # Without its galaxy, an arc has no light.
        return rest(table.filter(pc.invert(pc.is_in(table["source_id"], left_out))))

    return replace(
        rows,
        galaxies=rest(rows.galaxies),
        galaxy_fluxes=rest(rows.galaxy_fluxes),
        stars=rest(rows.stars),
        star_fluxes=rest(rows.star_fluxes),
        lenses=None if rows.lenses is None else rest_of_lenses(rows.lenses),
        transients=None if rows.transients is None else transients.without(rows.transients, left_out),
        nuclei=None if rows.nuclei is None else rows.nuclei.without(left_out),
    )


def add_rows(rows: Rows, galaxies: Pair, stars: Pair) -> Rows:
    """Add sources to catalogue rows.

    Parameters
    ----------
    rows : Rows
        Catalogue rows.
    galaxies, stars : (pyarrow.Table, pyarrow.Table)
        Rows of the tables `galaxies` and `stars`, and their fluxes.

    Returns
    -------
    Rows
        Catalogue rows with the additional sources at the end.

    Raises
    ------
    BadInput
        If the catalogue has a column that the additional sources lack.
    """

    def concatenate(table: pa.Table, new: pa.Table) -> pa.Table:
        # Catalogues without optional columns, such as proper motions, stay without them. Added stars do not vary.
        for column in VARIABILITY_COLUMNS:
            if column.name in table.column_names and column.name not in new.column_names:
                new = new.append_column(column.name, pa.nulls(len(new), column.arrow_type))
        columns = {name: new[name] for name in table.column_names if name in new.column_names}
        if missing := [name for name in table.column_names if name not in columns]:
            raise BadInput(f"sources cannot be added: the lake has a column {missing[0]} that they lack")
        return pa.concat_tables([table, pa.table(columns).cast(table.schema)])

    return replace(
        rows,
        galaxies=concatenate(rows.galaxies, galaxies[0]),
        galaxy_fluxes=concatenate(rows.galaxy_fluxes, galaxies[1]),
        stars=concatenate(rows.stars, stars[0]),
        star_fluxes=concatenate(rows.star_fluxes, stars[1]),
    )


def mission_of_lake(mission: read.Version | None) -> MissionConfiguration:
    """Return the mission parameters that a lake contains, or the built-in ones for a lake without them."""
    from lake_schema.mission import configuration
    from lake_schema.mission.published import read_back

    return configuration.resolve() if mission is None else read_back(mission)
