"""Known sources of a frame with their true positions and magnitudes, from the tables of the lake."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.arrays import Array, Bool, Float, Int
from lake_schema.store import read
from lake_schema.tables.stars import EPOCH

# Value of the column `method` of the table `rendered_truth` for point sources.
POINT = 0
# Columns of the table `rendered_truth` (true positions and electrons of drawn sources) that are read.
TRUTH = ("id", "x", "y", "expected", "method", "psf_x", "psf_y")
# AB magnitude of a flux density of 1 microjansky.
ZERO = 23.9
# Epoch J2000.0 in Julian years.
_JULIAN_2000 = 2000.0
# Epoch J2000.0 as modified Julian date.
_MJD_2000 = 51544.5
# Number of days in a Julian year.
_YEAR = 365.25
# Number of milliarcseconds in a degree.
_MAS_A_DEG = 3.6e6


@dataclass(frozen=True, slots=True, eq=False)
class Catalogue:
    """Stars of a lake with positions and proper motions, and their fluxes in several bands.

    Attributes
    ----------
    id : int array, shape (n,)
        Identifiers of the stars with positions, ascending.
    ra, dec : float array, shape (n,)
        Positions at the epoch of the table `stars`, deg.
    pm_ra, pm_dec : float array, shape (n,)
        Proper motions along right ascension (times cos dec) and declination, mas/yr.
    flux_id : int array, shape (m,)
        Identifiers of the stars with fluxes, ascending.
    fluxes : dict of str to float array, shape (m,)
        Fluxes of these stars by band, uJy.
    """

    id: Int
    ra: Float
    dec: Float
    pm_ra: Float
    pm_dec: Float
    flux_id: Int
    fluxes: dict[str, Float]

    def positions_at(self, ids: Int, mjd: float) -> tuple[Float, Float]:
        """Return right ascension and declination (deg) of the stars with identifiers `ids` at the time `mjd`.

        Proper motion is included, parallax is not. Stars that are not in the catalogue have NaN.
        """
        if not self.id.size:
            return np.full(len(ids), np.nan), np.full(len(ids), np.nan)
        at, is_known = _find(self.id, ids)
        years = _JULIAN_2000 + (mjd - _MJD_2000) / _YEAR - EPOCH
        dec = self.dec[at] + years * self.pm_dec[at] / _MAS_A_DEG
        ra = self.ra[at] + years * self.pm_ra[at] / _MAS_A_DEG / np.cos(np.radians(self.dec[at]))
        return np.where(is_known, ra, np.nan), np.where(is_known, dec, np.nan)

    def magnitudes(self, ids: Int, band: str) -> Float:
        """Return the AB magnitudes of the stars with identifiers `ids` in a band.

        They are NaN for stars without flux in the catalogue and if the band was not read, and infinite for flux 0.
        """
        if band not in self.fluxes or not self.flux_id.size:
            return np.full(len(ids), np.nan)
        at, is_known = _find(self.flux_id, ids)
        flux = np.where(is_known, self.fluxes[band][at], np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(ZERO - 2.5 * np.log10(flux))


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """Known sources on a detector in one exposure: where and how bright they were simulated, and catalogue values.

    Attributes
    ----------
    id : int array, shape (n,)
        Identifiers of the sources.
    x, y : float array, shape (n,)
        Positions at which the sources were drawn in the image, pixels from 0.
    expected : float array, shape (n,)
        Expected electrons of each source in the exposure, without noise.
    point : bool array, shape (n,)
        True for point sources.
    psf_x, psf_y : float array, shape (n,)
        Windowed centroid minus true position of a point source with this colour at this place, pixels; NaN if unknown.
        It is not 0 because the PSF is asymmetric.
    ra, dec : float array, shape (n,)
        Catalogue positions of stars at the time of the exposure, deg; NaN for other sources.
    mag : float array, shape (n,)
        AB magnitudes of stars from the catalogue; NaN for other sources.
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
    """Read stars and their fluxes from the tables `stars` and `star_fluxes` of a lake.

    Parameters
    ----------
    tables : mapping of str to Version
        Tables of the lake by name. If one of the two is missing, the corresponding arrays are empty.
    ids : int array, shape (n,)
        Identifiers of the stars to read, in any order; identifiers that are not in the tables are ignored.
    bands : sequence of str
        Bands whose fluxes are read; bands without a column are ignored.

    Returns
    -------
    Catalogue
        Stars and fluxes. A missing proper motion is 0.
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
    """Combine the true positions of a frame's sources with catalogue positions and magnitudes.

    Parameters
    ----------
    truth : Table
        Rows of the table `rendered_truth` for the frame, with the columns TRUTH.
    catalogue : Catalogue
        Stars of the lake.
    band : str
        Band of the exposure, for the magnitudes.
    mjd : float
        Time of the exposure, MJD, for the proper motion.

    Returns
    -------
    Reference
        Known sources of the frame in the order of `truth`.
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
