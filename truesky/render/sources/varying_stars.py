"""Scale the fluxes of variable stars to the date of an exposure."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import pyarrow as pa

from lake_schema.tables.stars import VARIABILITY_COLUMNS
from truesky.fluxes.passbands import Passband
from truesky.variability import variable_stars


def add_columns(columns: Sequence[str], present: Collection[str]) -> tuple[str, ...]:
    """Return columns of the table `stars` to read: `columns`, and the columns of variable stars that are `present`."""
    return *columns, *(column.name for column in VARIABILITY_COLUMNS if column.name in present)


def fluxes_at(stars: pa.Table, fluxes: pa.Table, bands: Mapping[str, Passband], mjd: float) -> pa.Table:
    """Return the fluxes of stars at a date.

    Parameters
    ----------
    stars, fluxes : pyarrow.Table
        Rows of the table `stars`, and their fluxes.
    bands : mapping of str to Passband
        Passbands of the columns f_nu_<band> that are scaled, by name.
    mjd : float
        The date, MJD.

    Returns
    -------
    pyarrow.Table
        The fluxes; variable stars have the flux of the date. The table itself if no star varies.
    """
    columns = variable_stars.read_columns(stars)
    (rows,) = np.nonzero(columns["variability"])
    if not len(rows):
        return fluxes
    varying = {name: values[rows] for name, values in columns.items()}
    for name, band in bands.items():
        at = fluxes.schema.get_field_index(f"f_nu_{name}")
        field = fluxes.schema.field(at)
        values = fluxes[at].to_numpy().copy()
        values[rows] = values[rows] * variable_stars.flux_factors(varying, band, mjd)
        fluxes = fluxes.set_column(at, field, pa.array(values, field.type))
    return fluxes
