"""A reference catalogue as SCAMP reads it: FITS_LDAC, columns under the names that its ASTREF*_KEYS have by default.

write   rows under the names of Gaia's archive -> a file

A star without a proper motion has the motion 0 with an error of 100 mas/yr: nearly no star so faint moves as far, and
whoever carries it to another epoch does not take its place for known. An error of 0 would say that it stands still.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.arrays import Float
from lake_schema.fits import ldac

_MAG_OVER_FLUX = 2.5 / np.log(10.0)
_DEG = 1.0 / 3.6e6
# Error of a proper motion that is not known, mas/yr.
_UNKNOWN_MOTION = 100.0


def write(path: Path, rows: pa.Table) -> None:
    """Replaced in one rename.

    rows : columns source_id, ref_epoch, ra, dec (deg) and their errors (mas), pmra, pmdec and theirs (mas/yr),
           phot_g_mean_mag (Vega), phot_g_mean_flux_over_error
    """
    ldac.write(path, _columns(rows))


def _columns(rows: pa.Table) -> list[ldac.ColumnData]:
    def values(name: str, unknown: float = 0.0) -> Float:
        return np.asarray(pc.fill_null(rows[name], unknown).to_numpy(), float)

    east, north = values("ra_error") * _DEG, values("dec_error") * _DEG
    return [
        ("SOURCE_ID", "K", "", rows["source_id"].to_numpy()),
        ("X_WORLD", "D", "deg", values("ra")),
        ("Y_WORLD", "D", "deg", values("dec")),
        ("ERRA_WORLD", "E", "deg", np.maximum(east, north)),
        ("ERRB_WORLD", "E", "deg", np.minimum(east, north)),
        # From the axis of right ascension.
        ("ERRTHETA_WORLD", "E", "deg", np.where(east >= north, 0.0, 90.0)),
        ("PMALPHA_J2000", "E", "mas/yr", values("pmra")),
        ("PMDELTA_J2000", "E", "mas/yr", values("pmdec")),
        ("PMALPHAERR_J2000", "E", "mas/yr", values("pmra_error", _UNKNOWN_MOTION)),
        ("PMDELTAERR_J2000", "E", "mas/yr", values("pmdec_error", _UNKNOWN_MOTION)),
        ("MAG", "E", "mag", values("phot_g_mean_mag")),
        ("MAGERR", "E", "mag", _MAG_OVER_FLUX / values("phot_g_mean_flux_over_error")),
        ("OBSDATE", "D", "yr", values("ref_epoch")),
    ]
