"""Add point sources with their own fluxes and spectra to the stars of a detector."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Float, Int


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
    spectra : float array, shape (n, w)
        f_lambda at the w wavelengths of the band, on any scale.
    """

    ids: Int
    ra: Float
    dec: Float
    f_nu: Float
    spectra: Float


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
