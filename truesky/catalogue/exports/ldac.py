"""Write an astrometric reference catalogue for SCAMP in FITS_LDAC format.

The column names are the defaults of SCAMP's parameters ASTREF*_KEYS. A star without a measured proper motion gets a
proper motion of 0 with an error of 100 mas/yr. Hardly any star without a measurement moves faster. With an error of 0,
programs would assume that the star does not move.
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
# Error that is written for an unknown proper motion, mas/yr.
_UNKNOWN_MOTION = 100.0


def write(path: Path, rows: pa.Table) -> None:
    """Write an astrometric reference catalogue to a file; an existing file is replaced atomically.

    Parameters
    ----------
    path : Path
        File to write.
    rows : Table
        Columns source_id, ref_epoch (yr), ra and dec (deg), ra_error and dec_error (mas), pmra, pmdec, pmra_error and
        pmdec_error (mas/yr, null if unknown), phot_g_mean_mag (Vega) and phot_g_mean_flux_over_error.
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
        # ERRTHETA is the angle of the larger error (ERRA) from the axis of right ascension.
        ("ERRTHETA_WORLD", "E", "deg", np.where(east >= north, 0.0, 90.0)),
        ("PMALPHA_J2000", "E", "mas/yr", values("pmra")),
        ("PMDELTA_J2000", "E", "mas/yr", values("pmdec")),
        ("PMALPHAERR_J2000", "E", "mas/yr", values("pmra_error", _UNKNOWN_MOTION)),
        ("PMDELTAERR_J2000", "E", "mas/yr", values("pmdec_error", _UNKNOWN_MOTION)),
        ("MAG", "E", "mag", values("phot_g_mean_mag")),
        ("MAGERR", "E", "mag", _MAG_OVER_FLUX / values("phot_g_mean_flux_over_error")),
        ("OBSDATE", "D", "yr", values("ref_epoch")),
    ]
