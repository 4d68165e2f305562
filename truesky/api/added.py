"""Add a user's sources to the catalogue rows of an image."""

from __future__ import annotations

from typing import Any

from lake_schema.arrays import Bool, Int
from truesky.catalogue import added_sources
from truesky.cosmology import Cosmology
from truesky.render.exposure.records import Rows
from truesky.render.windows import inputs


def add_sources(rows: Rows, extra: Any, band: str, cosmology: Cosmology) -> Rows:
    """Return catalogue rows with the sources of a user at the end.

    Parameters
    ----------
    rows : Rows
        Catalogue rows.
    extra : table or mapping
        The sources, as in `added_sources.rows`.
    band : str
        Passband of their magnitudes.
    cosmology : Cosmology
        Parameters of the universe of the catalogue.

    Returns
    -------
    Rows
        The rows of all sources.

    Raises
    ------
    BadInput
        If a column is unknown or missing, a value is out of range, or the lake has a column that the sources lack.
    """
    names = rows.galaxy_fluxes.column_names
    flux_bands = [name.removeprefix("f_nu_") for name in names if name.startswith("f_nu_")]
    return inputs.add_rows(rows, *added_sources.rows(extra, band, flux_bands, cosmology))


def is_added(ids: Int) -> Bool:
    """Return the mask of the identifiers [n] that belong to sources of a user, which were added to an image."""
    return added_sources.is_added(ids)
