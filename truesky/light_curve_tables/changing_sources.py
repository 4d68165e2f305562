"""Read the sources around an exposure that change, and compute their fluxes on its detectors as images have them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import sky
from lake_schema.arrays import Float, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from lake_schema.store.plan import Json
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.variability.light_curves import (
    LENSED_QUASAR,
    LENSED_SUPERNOVA,
    LIGHT_CURVES,
    NUCLEUS,
    QUASAR,
    SUPERNOVA,
    VARIABLE_STAR,
)
from truesky.render.camera import astrometry
from truesky.render.channels.aim import Aim
from truesky.render.sources import catalogue_rows, nuclei, selection, transients, varying_stars
from truesky.render.sources.nuclei import Nuclei
from truesky.render.sources.transients import LENSED_IMAGES, Transients

# Columns of the table `stars` with the position at a date, read together with the columns of variable stars.
_STAR_COLUMNS = ("id", "ra", "dec", "pm_ra", "pm_dec")


@dataclass(frozen=True, slots=True, eq=False)
class ChangingSources:
    """Sources around an exposure that change.

    Attributes
    ----------
    stars, star_fluxes : Table
        Rows of variable stars at their positions at the date of the exposure, and their mean fluxes in its band.
    quasars : Table
        Positions and mean fluxes of quasars of the table `galaxies` that vary.
    transients : Transients, optional
        Supernovae and their lensed images.
    nuclei : Nuclei, optional
        Nuclei in galaxies, lensed images of quasars, and the light curves of `quasars`.
    lensed : int64 array
        Identifiers of lensed images.
    """

    stars: pa.Table
    star_fluxes: pa.Table
    quasars: pa.Table
    transients: Transients | None
    nuclei: Nuclei | None
    lensed: Int


def circle_around(tasks: Sequence[Json]) -> dict[str, float]:
    """Return a circle on the sky (`ra`, `dec` and `radius` in deg) that contains the circles of tasks.

    `tasks` are at least one row of the table `tasks`, with the circles of detectors of an exposure.
    """
    ra, dec, radius = (np.array([task[name] for task in tasks]) for name in ("ra", "dec", "radius"))
    x, y, z = sky.unit_vectors(ra, dec).mean(axis=0)
    centre = float(np.degrees(np.arctan2(y, x)) % 360.0), float(np.degrees(np.arctan2(z, np.hypot(x, y))))
    reach = float((sky.separation(ra, dec, *centre) + radius).max())
    return {"ra": centre[0], "dec": centre[1], "radius": reach}


def read_sources(
    versions: Mapping[str, read.Version], circle: Mapping[str, Any], exposed: ExposureRow
) -> ChangingSources:
    """Read the sources in a circle that change.

    Parameters
    ----------
    versions : mapping of str to Version
        Stored versions of the tables of the lake by name. Tables of sources that change may be missing.
    circle : mapping
        `ra`, `dec` and `radius` (deg) of a circle that contains the detectors.
    exposed : ExposureRow
        The exposure.

    Returns
    -------
    ChangingSources
        The sources; also some outside the circle.

    Raises
    ------
    BadInput
        If there are no fluxes in the band of the exposure, or the user's spectra of supernovae have changed.
    """
    nearby_nuclei = nuclei.read_nuclei(versions, circle, 0.0, (0.0, 0.0))
    stars, star_fluxes = _variable_stars(versions, circle, exposed)
    quasar_ids = pa.array([], pa.int64()) if nearby_nuclei is None else nearby_nuclei.quasars["id"]
    cells = _cells(versions["galaxies"], circle)
    lensed = (
        versions[LENSED_IMAGES].rows_in_cells(cells, GENERATION_ORDER, ["id"]) if LENSED_IMAGES in versions else None
    )
    return ChangingSources(
        stars,
        star_fluxes,
        _rows(versions["galaxy_fluxes"], cells, ["id", "ra", "dec", f"f_nu_{exposed.band}"], quasar_ids),
        transients.read_transients(versions, circle, 0.0, (0.0, 0.0)),
        nearby_nuclei,
        np.zeros(0, np.int64) if lensed is None else lensed["id"].to_numpy(),
    )


def _variable_stars(
    versions: Mapping[str, read.Version], circle: Mapping[str, Any], exposed: ExposureRow
) -> tuple[pa.Table, pa.Table]:
    """Return the variable stars in a circle at the date of an exposure, and their mean fluxes in its band."""
    table = versions["stars"]
    names = varying_stars.add_columns(_STAR_COLUMNS, table.schema.names)
    # Most stars are constant. They are left out while the files are read, so that dense fields need little memory.
    varies = pc.is_valid(pc.field("variability")) if "variability" in names else pc.scalar(False)
    cells = _cells(table, circle)
    stars = table.rows_in_cells(cells, GENERATION_ORDER, names, varies)
    fluxes = _rows(versions["star_fluxes"], cells, ["id", f"f_nu_{exposed.band}"], stars["id"])
    return catalogue_rows.apply_proper_motion(stars, exposed.middle_mjd), fluxes


def _cells(catalogue: read.Version, circle: Mapping[str, Any]) -> list[int]:
    return selection.cells_of_task(circle, catalogue_rows.max_deflection(catalogue))


def _rows(version: read.Version, cells: Sequence[int], columns: Sequence[str], ids: pa.Array) -> pa.Table:
    """Return the rows of a table with the identifiers `ids`, from order-8 cells."""
    return version.rows_in_cells(cells, GENERATION_ORDER, columns, pc.field("id").isin(pc.unique(ids)))


def light_on_detector(sources: ChangingSources, aim: Aim) -> pa.Table:
    """Compute the fluxes of the sources on a detector, with the functions that images use.

    Parameters
    ----------
    sources : ChangingSources
        Sources around the exposure.
    aim : Aim
        Exposure and detector.

    Returns
    -------
    Table
        Rows of the table `light_curves` by ascending identifier, without sources that do not shine. The positions of
        all are on the detector.
    """
    pieces = [_star_light(sources, aim), _quasar_light(sources, aim)]
    pieces += [_supernova_light(sources, sources.transients, aim)] if sources.transients else []
    pieces += [_nuclear_light(sources, sources.nuclei, aim)] if sources.nuclei else []
    rows = pa.concat_tables(pieces)
    return rows.filter(pc.greater(rows["f_nu"], 0.0)).sort_by("id")


def _star_light(sources: ChangingSources, aim: Aim) -> pa.Table:
    stars = _on_detector(sources.stars, aim)
    mean = sources.star_fluxes.take(_places(stars, sources.star_fluxes))
    bands = {aim.exposure.band: aim.band}
    fluxes = varying_stars.fluxes_at(stars, mean, bands, aim.exposure.middle_mjd)
    column = f"f_nu_{aim.exposure.band}"
    return _light(stars, aim, np.full(len(stars), VARIABLE_STAR), fluxes[column].to_numpy(), mean[column].to_numpy())


def _quasar_light(sources: ChangingSources, aim: Aim) -> pa.Table:
    quasars, column = _on_detector(sources.quasars, aim), f"f_nu_{aim.exposure.band}"
    fluxes = quasars
    if sources.nuclei is not None:
        bands = {aim.exposure.band: aim.band}
        fluxes = nuclei.quasar_fluxes(quasars, sources.nuclei.quasars, bands, aim.exposure.middle_mjd)
    mean = quasars[column].to_numpy()
    return _light(quasars, aim, np.full(len(quasars), QUASAR), fluxes[column].to_numpy(), mean)


def _supernova_light(sources: ChangingSources, supernovae: Transients, aim: Aim) -> pa.Table:
    rows = _on_detector(supernovae.rows, aim)
    light = transients.light_at(Transients(rows, supernovae.templates), aim.band, aim.exposure.middle_mjd)
    shining = rows.filter(pa.array(np.isin(rows["id"].to_numpy(), light.ids)))
    is_lensed = np.isin(light.ids, sources.lensed)
    return _light(shining, aim, np.where(is_lensed, LENSED_SUPERNOVA, SUPERNOVA), light.f_nu)


def _nuclear_light(sources: ChangingSources, nearby_nuclei: Nuclei, aim: Aim) -> pa.Table:
    points = _on_detector(nearby_nuclei.points, aim)
    light = nuclei.light_at(Nuclei(points, nearby_nuclei.quasars), aim.band, aim.exposure.middle_mjd)
    shining = points.filter(pa.array(np.isin(points["id"].to_numpy(), light.ids)))
    mean = nuclei.mean_fluxes(shining, aim.band)
    is_lensed = np.isin(light.ids, sources.lensed)
    return _light(shining, aim, np.where(is_lensed, LENSED_QUASAR, NUCLEUS), light.f_nu, mean)


def _on_detector(rows: pa.Table, aim: Aim) -> pa.Table:
    """Return the rows whose positions are on the detector, with their pixel coordinates `x` and `y`."""
    ra, dec = rows["ra"].to_numpy(), rows["dec"].to_numpy()
    # The radius is twice the distance of the corners, because distortion stretches detectors.
    is_near = selection.within_radius(ra, dec, aim.centre, 2.0 * aim.half_diagonal / 3600.0)
    rows = rows.filter(pa.array(is_near))
    x, y = astrometry.pixel_of_sky(aim.wcs, ra[is_near], dec[is_near])
    nx, ny = aim.detector.nx, aim.detector.ny
    inside = (x >= -0.5) & (x < nx - 0.5) & (y >= -0.5) & (y < ny - 0.5)
    rows = rows.filter(pa.array(inside))
    return rows.append_column("x", pa.array(x[inside])).append_column("y", pa.array(y[inside]))


def _places(rows: pa.Table, other: pa.Table) -> pa.Array:
    """Return the index in `other` of the row with the same identifier as each row of `rows`."""
    return pc.index_in(rows["id"].combine_chunks(), other["id"].combine_chunks())


def _light(rows: pa.Table, aim: Aim, source_types: Int, f_nu: Float, mean: Float | None = None) -> pa.Table:
    """Return rows of the table `light_curves` for the rows of sources on a detector."""
    n = len(rows)
    columns = {name: rows[name] for name in ("id", "x", "y")}
    columns |= {"exposure_id": np.full(n, aim.exposure.exposure_id), "mjd": np.full(n, aim.exposure.middle_mjd)}
    columns |= {"detector": [aim.detector.name] * n, "band": [aim.exposure.band] * n}
    columns |= {"source_type": source_types, "f_nu": f_nu}
    if mean is not None:
        columns["f_nu_mean"] = mean
    return LIGHT_CURVES.build(columns)
