"""Add the columns of variable stars to the drawn stars of a cell and to their companions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lake_schema import ids
from lake_schema.arrays import Array, Float, Int
from lake_schema.tables.stars import VARIABILITY_COLUMNS
from truesky.catalogue.stars import stellar_populations
from truesky.variability import variable_stars
from truesky.variability.eclipses import Pairs
from truesky.variability.pulsation import StarProperties

_STAR = 5
# Stages of evolution of the stars in a contact binary.
_UNEVOLVED = (stellar_populations.DWARF, stellar_populations.SUBGIANT)


def columns(
    primaries: Mapping[str, Any], companions: Mapping[str, Any], orbits: tuple[Int, Float], cell: int, seed: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the columns of variable stars of the stars drawn in a cell.

    Parameters
    ----------
    primaries : mapping of str to array, shape (n,)
        Columns of table `stars` of single stars and primaries, which have the numbers 0 to n - 1 in the cell.
    companions : mapping of str to array, shape (k,)
        Columns of their companions.
    orbits : tuple of array, shape (k,)
        Index of the primary of each companion, and semi-major axis of the orbit, AU.
    cell : int
        Nested index of the order-8 cell.
    seed : int
        Seed of the request.

    Returns
    -------
    of_primaries, of_companions : dict of str to masked array, shape (n,) and (k,)
        Columns of variable stars, masked for constant stars.
    """
    primary, axis = orbits
    numbers = np.arange(len(primaries["teff"]))
    first, second = (_constant_columns(count) for count in (numbers.size, primary.size))
    pairs = Pairs(
        np.stack([np.ma.filled(primaries["mass"], np.nan)[primary], companions["mass"]]),
        np.stack([primaries["log_g"][primary], companions["log_g"]]),
        np.isin(primaries["stage"][primary], _UNEVOLVED),
        axis,
    )
    index, is_variable, values = variable_stars.binary_columns(ids.source_id(_STAR, cell, primary), pairs, seed)
    for side, target, rows in ((0, first, primary[index]), (1, second, index)):
        chosen = is_variable[side]
        _fill(target, rows[chosen], {name: column[side, chosen] for name, column in values.items()})
    stars = StarProperties(
        np.asarray(primaries["teff"]),
        np.asarray(primaries["log_g"]),
        np.ma.filled(primaries["mass"], np.nan),
        np.asarray(primaries["metallicity"]),
        np.asarray(primaries["abs_mag_h"]),
        np.asarray(primaries["stage"]) == stellar_populations.GIANT,
    )
    pulsating, pulsations = variable_stars.pulsation_columns(ids.source_id(_STAR, cell, numbers), stars, seed)
    for column in first.values():
        column[pulsating] = np.ma.masked
    _fill(first, pulsating, pulsations)
    return first, second


def _constant_columns(count: int) -> dict[str, Any]:
    """Return the columns of constant stars: arrays of the types of the table in which all values are masked."""
    return {
        column.name: np.ma.MaskedArray(np.zeros(count, column.arrow_type.to_pandas_dtype()), mask=True)
        for column in VARIABILITY_COLUMNS
    }


def _fill(target: Mapping[str, Any], rows: Int, values: Mapping[str, Array]) -> None:
    for name, column in values.items():
        target[name][rows] = column
