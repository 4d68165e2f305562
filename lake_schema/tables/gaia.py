"""Table `gaia`: the stars as Gaia's second data release would list them, a reference to calibrate by.

EXPORT   the same under Gaia's own names, for a file of its own
"""

from __future__ import annotations

from dataclasses import replace

from lake_schema.columns import Column, Table
from lake_schema.tables.common import DEC, HEALPIX_29, RA, id_of_kinds

_BANDS = (("g", "G"), ("bp", "BP"), ("rp", "RP"))


def _photometry(short: str, name: str) -> tuple[Column, ...]:
    band = {"g": "em.opt", "bp": "em.opt.B", "rp": "em.opt.R"}[short]
    missing = short != "g"
    return (
        Column(
            f"phot_{short}_mean_mag",
            "float32",
            "mag",
            f"phot.mag;{band}",
            f"{name} as measured, Vega",
            -5.0,
            40.0,
            missing,
        ),
        Column(
            f"phot_{short}_mean_flux_over_error",
            "float32",
            "",
            f"stat.snr;phot.flux;{band}",
            f"mean flux in {name} over its error",
            0.0,
            1e6,
            missing,
        ),
    )


def _error(of: str, unit: str, ucd: str, doc: str) -> Column:
    return Column(f"{of}_error", "float32", unit, f"stat.error;{ucd}", f"standard error of {doc}", 0.0, 1e3)


_ID = id_of_kinds(5, 5)
_RA = replace(RA, doc="right ascension, ICRS, as measured")
_DEC = replace(DEC, doc="declination, ICRS, as measured")
_MEASURED = (
    _error("ra", "mas", "pos.eq.ra", "right ascension times cos(dec)"),
    _error("dec", "mas", "pos.eq.dec", "declination"),
    Column("parallax", "float64", "mas", "pos.parallax", "parallax as measured", -1e3, 1e4, True),
    _error("parallax", "mas", "pos.parallax", "parallax"),
    *(column for short, name in _BANDS for column in _photometry(short, name)),
)

GAIA = Table(
    "gaia",
    1,
    (
        _ID,
        _RA,
        _DEC,
        HEALPIX_29,
        *_MEASURED,
        *(
            Column(
                f"mag_{short}_ab",
                "float32",
                "mag",
                "phot.mag;em.opt",
                f"{name} as measured, AB",
                -5.0,
                40.0,
                short != "g",
            )
            for short, name in _BANDS
        ),
    ),
    "The stars as Gaia DR2 would list them: brighter than G = 21, with its errors; the truth is in `stars`, by id.",
    order=3,
    finest=8,
)

EXPORT = Table(
    "gaia_source",
    1,
    (
        replace(_ID, name="source_id"),
        Column("ref_epoch", "float64", "yr", "meta.ref;time.epoch", "epoch of the position", 2000.0, 2100.0),
        _RA,
        _DEC,
        *_MEASURED,
        Column("bp_rp", "float32", "mag", "phot.color", "BP - RP", -20.0, 20.0, True),
    ),
    "Rows of the table `gaia` under the names of Gaia's archive.",
    key=("source_id",),
)
