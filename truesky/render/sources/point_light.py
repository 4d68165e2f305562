"""Add point sources with their own fluxes and spectra to the stars of a detector."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Bool, Float, Int
from truesky.render.sources import selection

# Column of tables of point sources with the flux below which a source is left out, microjansky.
MIN_F_NU = "min_f_nu"


def select_nearby(points: pa.Table, task: Mapping[str, Any], reach_arcsec: float) -> pa.Table:
    """Return the sources around a detector.

    Parameters
    ----------
    points : Table
        Sources with the columns ra and dec.
    task : mapping
        Row of the table `tasks`: the detector, with the `ra`, `dec` and `radius` (deg) of a circle around it.
    reach_arcsec : float
        Distance beyond the circle, in arcsec, up to which sources are returned.

    Returns
    -------
    Table
        The sources in the enlarged circle.
    """
    return points.filter(pa.array(_is_in_circle(points, task, reach_arcsec)))


def add_flux_limits(points: pa.Table, task: Mapping[str, Any], min_f_nu: tuple[float, float]) -> pa.Table:
    """Add the column MIN_F_NU to point sources.

    Parameters
    ----------
    points : Table
        Point sources with the columns ra and dec.
    task : mapping
        Row of the table `tasks`: the detector, with the `ra`, `dec` and `radius` (deg) of a circle around it.
    min_f_nu : (float, float)
        Fluxes inside and outside the circle below which sources are left out, microjansky.

    Returns
    -------
    Table
        The sources with the additional column.
    """
    return points.append_column(MIN_F_NU, pa.array(np.where(_is_in_circle(points, task, 0.0), *min_f_nu)))


def _is_in_circle(points: pa.Table, task: Mapping[str, Any], margin_arcsec: float) -> Bool:
    place, radius = (points["ra"].to_numpy(), points["dec"].to_numpy()), task["radius"] + margin_arcsec / 3600.0
    return selection.within_radius(*place, (task["ra"], task["dec"]), radius)


@dataclass(frozen=True, slots=True, eq=False)
class OwnSpectra:
    """Spectra of n point sources, which are computed for chosen sources only.

    Attributes
    ----------
    count : int
        Number n of sources.
    compute : callable
        Function (indices of k sources, int array) -> f_lambda at the w wavelengths of the band, on any scale, float
        array of shape (k, w).
    """

    count: int
    compute: Callable[[Int], Float]

    def followed_by(self, other: OwnSpectra) -> OwnSpectra:
        """Return the spectra of these sources and of other sources after them."""

        def spectra_of(indices: Int) -> Float:
            is_own = indices < self.count
            first_spectra = self.compute(indices[is_own])
            out = np.empty((len(indices), first_spectra.shape[1]))
            out[is_own], out[~is_own] = first_spectra, other.compute(indices[~is_own] - self.count)
            return out

        return OwnSpectra(self.count + other.count, spectra_of)


@dataclass(frozen=True, slots=True, eq=False)
class PointLight:
    """Light of n point sources in an exposure.

    Attributes
    ----------
    ids : int64 array, shape (n,)
        Identifiers.
    ra, dec : float array, shape (n,)
        Positions, deg.
    f_nu : float array, shape (n,)
        Fluxes in the band of the exposure, microjansky.
    spectra : OwnSpectra
        Their spectra.
    """

    ids: Int
    ra: Float
    dec: Float
    f_nu: Float
    spectra: OwnSpectra


def append_points(stars: pa.Table, fluxes: pa.Table, points: PointLight, band: str) -> tuple[pa.Table, pa.Table]:
    """Return rows of the table `stars` and their fluxes, each with a row more for each point source.

    Parameters
    ----------
    stars, fluxes : pyarrow.Table
        Rows of the table `stars`, and their fluxes.
    points : PointLight
        The point sources.
    band : str
        Name of the band of their fluxes. The fluxes in other bands are null.

    Returns
    -------
    (pyarrow.Table, pyarrow.Table)
        The stars and their fluxes.
    """
    # A row of the table `stars` needs a template, a magnitude and dust. They do not matter, because the flux and the
    # spectrum are given separately.
    star = {"id": points.ids, "ra": points.ra, "dec": points.dec, "sed": 0, "mag_h": 0.0, "a_v": 0.0}
    return append_rows(stars, star), append_rows(fluxes, {"id": points.ids, f"f_nu_{band}": points.f_nu})


def append_rows(table: pa.Table, values: Mapping[str, Any]) -> pa.Table:
    """Return a table with additional rows.

    Parameters
    ----------
    table : pyarrow.Table
        Table with a column `id`.
    values : mapping of str to array or number
        Columns of the n additional rows, with their identifiers `id`. A value that is not an array is repeated.
        Columns that `values` lacks are null.

    Returns
    -------
    pyarrow.Table
        The rows of `table`, followed by the additional ones.
    """
    n = len(values["id"])
    columns = [
        pa.array(np.broadcast_to(values[field.name], n)).cast(field.type) if field.name in values
        else pa.nulls(n, field.type)
        for field in table.schema
    ]  # fmt: skip
    return pa.concat_tables([table, pa.table(columns, schema=table.schema)])
