"""Compute the light curves of sources of a lake that change with time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import ids as identifiers
from lake_schema import units
from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from lake_schema.store.object_storage.s3 import Folder
from truesky.fluxes.inputs import passband_from_facts
from truesky.fluxes.passbands import Passband
from truesky.render.sources import nuclei, selection, transients, varying_stars
from truesky.render.windows import inputs
from truesky.request import sky_notation
from truesky.variability import active_nuclei, spectral_series, supernova_light, variable_stars

if TYPE_CHECKING:
    import pandas as pd

# Largest number of points of a light curve that one call may ask for.
_MAX_POINTS = 100_000_000


def light_curves(
    root: Folder,
    versions: Mapping[str, read.Version],
    source_ids: int | Sequence[int] | Int,
    band: str,
    mjd: float | Sequence[float] | Float,
) -> pd.DataFrame:
    """Compute the fluxes of sources at dates.

    Parameters
    ----------
    root : Folder
        The lake.
    versions : mapping of str to Version
        Versions of the tables of the lake by name.
    source_ids : int or sequence of int
        Identifiers of the n sources.
    band : str
        Name of a passband.
    mjd : float or sequence of float
        The m dates, MJD.

    Returns
    -------
    pandas.DataFrame
        n x m rows with the columns id, band, mjd, f_nu (microjansky) and mag (AB, infinite without light), one source
        after the other.

    Raises
    ------
    BadInput
        If a source is not in the lake or does not change, a date is not finite, or the passband is unknown.
    """
    import pandas as pd

    source_numbers, dates = _checked_ids(source_ids), _checked_dates(mjd)
    if len(source_numbers) * len(dates) > _MAX_POINTS:
        raise BadInput(
            f"light_curve: {len(source_numbers)} sources at {len(dates)} dates are more than {_MAX_POINTS:,} points"
        )
    for name in ("galaxies", "stars", "galaxy_fluxes", "star_fluxes"):
        if name not in versions:
            raise BadInput(f"light_curve: the lake has no table {name}: run truesky run REQUEST LAKE")
    f_nu = np.full((len(source_numbers), len(dates)), np.nan)
    for find in (_supernovae, _lensed_supernovae, _nuclei, _lensed_quasars, _stars, _galaxies):
        missing = np.flatnonzero(np.isnan(f_nu[:, 0])) if len(dates) else np.zeros(0, np.int64)
        if len(missing):
            indices, values = find(_Query(root, versions, source_numbers[missing], band, dates))
            f_nu[missing[indices]] = values
    if len(dates) and np.isnan(f_nu[:, 0]).any():
        raise BadInput(f"light_curve: there is no source {source_numbers[np.isnan(f_nu[:, 0])][0]} in this lake")
    return pd.DataFrame(
        {
            "id": np.repeat(source_numbers, len(dates)),
            "band": band,
            "mjd": np.tile(dates, len(source_numbers)),
            "f_nu": f_nu.ravel(),
            "mag": units.mag_of_f_nu(f_nu).ravel(),
        }
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Query:
    """Sources (identifiers [n]) of a lake, whose fluxes in a band at dates [m] are computed."""

    root: Folder
    versions: Mapping[str, read.Version]
    source_numbers: Int
    band: str
    dates: Float

    def passband(self) -> Passband:
        """Return the passband, that of the lake's fluxes if they have one of this name."""
        return passband_from_facts(self.root, self.versions["galaxy_fluxes"].manifest["facts"], self.band)

    def rows(self, table: str, columns: Sequence[str], key: str = "id", spread: bool = False) -> tuple[Int, pa.Table]:
        """Return the indices in `source_numbers` of the sources in a table, and their rows.

        `key` is the column with the identifiers. With `spread`, rows may be in a cell next to that of the identifier.
        """
        cells = selection.cells_of_ids(self.source_numbers, spread)
        if table not in self.versions:
            return np.zeros(0, np.int64), pa.table({name: [] for name in columns})
        rows = self.versions[table].rows_in_cells(cells, GENERATION_ORDER, list(columns))
        row = pc.index_in(pa.array(self.source_numbers), rows[key].combine_chunks())
        indices = np.flatnonzero(row.is_valid().to_numpy(zero_copy_only=False))
        return indices, rows.take(row.drop_null())

    def fluxes(self, table: str, indices: Int, spread: bool = False) -> Float:
        """Return the mean fluxes of the sources with the indices `indices`, shape (k, 1)."""
        inputs.check_band(self.versions[table], self.band)
        column = f"f_nu_{self.band}"
        selected = replace(self, source_numbers=self.source_numbers[indices])
        return np.asarray(selected.rows(table, ("id", column), spread=spread)[1][column].to_numpy(), float)[:, None]


def _supernovae(query: _Query) -> tuple[Int, Float]:
    indices, rows = query.rows(transients.TRANSIENTS, transients.COLUMNS)
    return indices, _supernova_fluxes(query, rows)


def _lensed_supernovae(query: _Query) -> tuple[Int, Float]:
    indices, rows = query.rows(transients.LENSED_IMAGES, transients.COLUMNS, spread=True)
    is_supernova = rows["type"].is_valid().to_numpy()
    return indices[is_supernova], _supernova_fluxes(query, rows.filter(pa.array(is_supernova)))


def _supernova_fluxes(query: _Query, rows: pa.Table) -> Float:
    if not len(rows):
        return np.zeros((0, len(query.dates)))
    templates = spectral_series.templates_from_facts(query.versions[transients.TRANSIENTS].manifest["facts"])
    return supernova_light.fluxes(transients.supernovae(rows), query.passband(), query.dates[None], templates)


def _nuclei(query: _Query) -> tuple[Int, Float]:
    indices, rows = query.rows(nuclei.ACTIVE_NUCLEI, nuclei.COLUMNS, "point_id", spread=True)
    # A quasar is a row of `galaxies`, which has its mean flux.
    in_galaxy = identifiers.is_transient(query.source_numbers[indices])
    points = nuclei.as_points(rows.filter(pa.array(in_galaxy)))
    return indices[in_galaxy], _point_fluxes(query, points)


def _lensed_quasars(query: _Query) -> tuple[Int, Float]:
    indices, rows = query.rows(transients.LENSED_IMAGES, nuclei.IMAGE_COLUMNS, spread=True)
    if not len(rows):
        return indices, np.zeros((0, len(query.dates)))
    sources = replace(query, source_numbers=np.unique(rows["source_id"].to_numpy()))
    _, galaxies = sources.rows("galaxies", (*nuclei.QUASAR_COLUMNS, "kind"), spread=True)
    _, varying = sources.rows(nuclei.ACTIVE_NUCLEI, nuclei.COLUMNS, spread=True)
    return indices, _point_fluxes(query, nuclei.lensed_quasars(rows, galaxies, varying))


def _point_fluxes(query: _Query, points: pa.Table) -> Float:
    dates = np.broadcast_to(query.dates, (len(points), len(query.dates)))
    f_nu = nuclei.point_fluxes(points, query.passband(), dates)
    return f_nu


def _stars(query: _Query) -> tuple[Int, Float]:
    names = varying_stars.add_columns(("id",), query.versions["stars"].schema.names)
    indices, rows = query.rows("stars", names)
    if not len(rows):
        return indices, np.zeros((0, len(query.dates)))
    factors = variable_stars.flux_factors(variable_stars.read_columns(rows), query.passband(), query.dates)
    return indices, query.fluxes("star_fluxes", indices) * factors


def _galaxies(query: _Query) -> tuple[Int, Float]:
    """Return the fluxes of galaxies, including their active nuclei, and of quasars."""
    indices, _ = query.rows("galaxies", ("id",), spread=True)
    if not len(indices):
        return indices, np.zeros((0, len(query.dates)))
    f_nu = np.repeat(query.fluxes("galaxy_fluxes", indices, spread=True), len(query.dates), axis=1)
    of_galaxies = replace(query, source_numbers=query.source_numbers[indices])
    active, rows = of_galaxies.rows(nuclei.ACTIVE_NUCLEI, nuclei.COLUMNS, spread=True)
    quasar = identifiers.kind_from_id(query.source_numbers[indices][active]) == nuclei.QUASAR_KIND
    columns = {name: rows[name].to_numpy()[quasar] for name in active_nuclei.FACTOR_COLUMNS}
    f_nu[active[quasar]] *= active_nuclei.flux_factors(columns, query.passband(), query.dates)
    f_nu[active[~quasar]] += _point_fluxes(query, nuclei.as_points(rows.filter(pa.array(~quasar))))
    return indices, f_nu


def _checked_ids(source_ids: npt.ArrayLike) -> Int:
    try:
        numbers = np.atleast_1d(np.asarray(source_ids))
        if numbers.ndim != 1 or not (numbers.size == 0 or np.issubdtype(numbers.dtype, np.integer)):
            raise ValueError
        return numbers.astype(np.int64)
    except (ValueError, OverflowError):
        raise BadInput(f"light_curve: id must be an integer or a list of integers, got {source_ids!r:.60}") from None


def _checked_dates(mjd: npt.ArrayLike) -> Float:
    try:
        dates = np.atleast_1d(np.asarray(mjd, float))
    except (TypeError, ValueError):
        raise BadInput(f"light_curve: mjd must be a number or a list of numbers, got {mjd!r:.60}") from None
    if dates.ndim != 1:
        raise BadInput(
            f"light_curve: mjd must be a number or a list of numbers, got an array of {dates.ndim} dimensions"
        )
    first, last = sky_notation.MJD_LIMITS
    bad = ~((dates >= first) & (dates <= last))
    if bad.any():
        raise BadInput(f"light_curve: mjd {dates[bad][0]:g} is not a date from MJD {first:g} to {last:g}")
    return dates
