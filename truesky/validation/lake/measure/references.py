"""Reference data for the sources of a frame, from the tables of the lake."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.arrays import Array, Bool, Float, Int
from lake_schema.store import read
from lake_schema.tables.stars import EPOCH

POINT = 0
# Columns of `rendered_truth` that a reference requires.
TRUTH = ("id", "x", "y", "expected", "method", "psf_x", "psf_y")
# AB magnitude of 1 microjansky.
ZERO = 23.9
_JULIAN_2000, _MJD_2000, _YEAR, _MAS_A_DEG = 2000.0, 51544.5, 365.25, 3.6e6


@dataclass(frozen=True, slots=True, eq=False)
class Catalogue:
    """Stars of a lake by ascending identifier, and band fluxes.

    Attributes
    ----------
    id : int array, shape (n,)
        Identifiers of the stars.
    ra, dec : float array, shape (n,)
        Positions at EPOCH, deg.
    pm_ra, pm_dec : float array, shape (n,)
        Proper motions, mas/yr.
    flux_id : int array, shape (m,)
        Identifiers of the band fluxes.
    fluxes : dict of str to float array, shape (m,)
        Fluxes by band, uJy.
    """

    id: Int
    ra: Float
    dec: Float
    pm_ra: Float
    pm_dec: Float
    flux_id: Int
    fluxes: dict[str, Float]

    def positions_at(self, ids: Int, mjd: float) -> tuple[Float, Float]:
        """Return right ascension and declination (deg) of stars at a time (MJD), NaN if not in the catalogue."""
        if not self.id.size:
            return np.full(len(ids), np.nan), np.full(len(ids), np.nan)
        at, is_known = _find(self.id, ids)
        years = _JULIAN_2000 + (mjd - _MJD_2000) / _YEAR - EPOCH
        dec = self.dec[at] + years * self.pm_dec[at] / _MAS_A_DEG
        ra = self.ra[at] + years * self.pm_ra[at] / _MAS_A_DEG / np.cos(np.radians(self.dec[at]))
        return np.where(is_known, ra, np.nan), np.where(is_known, dec, np.nan)

    def magnitudes(self, ids: Int, band: str) -> Float:
        """Return AB magnitudes in a band, NaN if not in the catalogue."""
        if band not in self.fluxes or not self.flux_id.size:
            return np.full(len(ids), np.nan)
        at, is_known = _find(self.flux_id, ids)
        flux = np.where(is_known, self.fluxes[band][at], np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(ZERO - 2.5 * np.log10(flux))


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """Known sources of a detector.

    Attributes
    ----------
    id : int array, shape (n,)
        Identifiers.
    x, y : float array, shape (n,)
        Positions in pixels from 0, as drawn.
    expected : float array, shape (n,)
        Expected electrons.
    point : bool array, shape (n,)
        True for point sources.
    psf_x, psf_y : float array, shape (n,)
        Windowed centroid of a point source of this colour at this position, minus its position, pixels.
    ra, dec : float array, shape (n,)
        Catalogue positions of stars at the time of the exposure, deg; NaN for other sources.
    mag : float array, shape (n,)
        AB magnitudes of the catalogue.
    """

    id: Int
    x: Float
    y: Float
    expected: Float
    point: Bool
    psf_x: Float
    psf_y: Float
    ra: Float
    dec: Float
    mag: Float

    def __len__(self) -> int:
        return len(self.id)


def load_catalogue(tables: Mapping[str, read.Version], ids: Int, bands: Sequence[str]) -> Catalogue:
    """Read stars and their fluxes; tables that the lake does not have are left empty.

    Parameters
    ----------
    tables : mapping of str to Version
        Tables of the lake by name.
    ids : int array, shape (n,)
        Identifiers of the stars to read, ascending.
    bands : sequence of str
        Bands whose fluxes are read.

    Returns
    -------
    Catalogue
        Stars and fluxes.
    """
    empty = np.zeros(0)
    columns = {name: empty for name in ("id", "ra", "dec", "pm_ra", "pm_dec")}
    if (stars := tables.get("stars")) is not None:
        star_columns = [name for name in columns if name in stars.schema.names]
        rows = _sort_by_id(stars.rows(star_columns, where=pc.field("id").isin(pa.array(ids))))
        columns = {name: np.zeros(len(rows)) for name in columns} | {
            name: pc.fill_null(rows[name], 0).to_numpy() for name in star_columns
        }
    fluxes = pa.table({"id": empty})
    if (table := tables.get("star_fluxes")) is not None:
        flux_columns = [f"f_nu_{band}" for band in bands if f"f_nu_{band}" in table.schema.names]
        fluxes = _sort_by_id(table.rows(["id", *flux_columns], where=pc.field("id").isin(pa.array(ids))))
    ra, dec, pm_ra, pm_dec = (np.asarray(columns[name], float) for name in ("ra", "dec", "pm_ra", "pm_dec"))
    band_columns = {band: f"f_nu_{band}" for band in bands if f"f_nu_{band}" in fluxes.schema.names}
    return Catalogue(
        np.asarray(columns["id"], np.int64), ra, dec, pm_ra, pm_dec, np.asarray(fluxes["id"].to_numpy(), np.int64),
        {band: fluxes[name].to_numpy().astype(float) for band, name in band_columns.items()},
    )  # fmt: skip


def build_reference(truth: pa.Table, catalogue: Catalogue, band: str, mjd: float) -> Reference:
    """Return the reference data of one frame.

    Parameters
    ----------
    truth : Table
        Rows of `rendered_truth` of the frame.
    catalogue : Catalogue
        Catalogue of the lake.
    band : str
        Band of the exposure.
    mjd : float
        Time of the exposure, MJD.

    Returns
    -------
    Reference
        Sources with positions and magnitudes of the catalogue.
    """
    ids = truth["id"].to_numpy()
    psf_offsets = {name: pc.fill_null(truth[name], np.nan).to_numpy() for name in ("psf_x", "psf_y")}
    ra, dec = catalogue.positions_at(ids, mjd)
    return Reference(
        ids,
        truth["x"].to_numpy(),
        truth["y"].to_numpy(),
        truth["expected"].to_numpy(),
        truth["method"].to_numpy() == POINT,
        psf_offsets["psf_x"],
        psf_offsets["psf_y"],
        ra,
        dec,
        catalogue.magnitudes(ids, band),
    )


def _sort_by_id(rows: pa.Table) -> pa.Table:
    return rows.sort_by("id")


def _find(sorted_ids: Array, ids: Int) -> tuple[Int, Bool]:
    if not len(sorted_ids):
        return np.zeros(0, np.int64), np.zeros(len(ids), bool)
    at = np.minimum(np.searchsorted(sorted_ids, ids), len(sorted_ids) - 1)
    return at, sorted_ids[at] == ids
