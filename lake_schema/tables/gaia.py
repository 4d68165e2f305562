"""Declaration of the table `gaia`: simulated stars with the errors and columns that Gaia DR2 would give them.

The table serves as a reference catalogue for calibrations. `EXPORT` and `EXPORT_DR3` declare the same rows with the
column names of Gaia's archive, for export to files. `EXPORT_DR3` also has the column order of DR3.
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


def _error(column_name: str, unit: str, ucd: str, doc: str, nullable: bool = False) -> Column:
    return Column(
        f"{column_name}_error",
        "float32",
        unit,
        f"stat.error;{ucd}",
        f"standard error of {doc}",
        0.0,
        1e3,
        nullable,
    )


def _motion(short: str, axis: str, doc: str) -> tuple[Column, ...]:
    ucd = f"pos.pm;pos.eq.{axis}"
    value = Column(short, "float64", "mas yr-1", ucd, f"proper motion in {doc}, as measured", -1e5, 1e5, True)
    return value, _error(short, "mas yr-1", ucd, f"the proper motion in {doc}", nullable=True)


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

_RUWE = Column(
    "ruwe", "float32", "", "stat.error", "renormalised unit weight error of the astrometry", 0.0, 100.0, True
)
_MOTIONS = (
    *_motion("pmra", "ra", "right ascension times cos(dec)"),
    *_motion("pmdec", "dec", "declination"),
    _RUWE,
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
        *_MOTIONS,
    ),
    "The stars as Gaia DR2 would list them: brighter than G = 21, with its errors; the truth is in `stars`, by id.",
    order=3,
    max_order=8,
)

VARIABLE, NOT_AVAILABLE = "VARIABLE", "NOT_AVAILABLE"
VARIABLE_FLAG = Column(
    "phot_variable_flag",
    "string",
    "",
    "meta.code;src.var",
    f"{VARIABLE} for variable stars, {NOT_AVAILABLE} for others; the column exists only with universe.variables",
)


def with_variable_flag(table: Table) -> Table:
    """Return the declaration of `GAIA`, `EXPORT` or `EXPORT_DR3` with the column of variable stars at its end."""
    return replace(table, columns=(*table.columns, VARIABLE_FLAG))


PARAMETERS = ("ra", "dec", "parallax", "pmra", "pmdec")


def _flux(short: str, name: str) -> tuple[Column, ...]:
    ucd = f"phot.flux;{ {'g': 'em.opt', 'bp': 'em.opt.B', 'rp': 'em.opt.R'}[short] }"
    return (
        Column(f"phot_{short}_mean_flux", "float64", "electron s-1", ucd, f"mean flux in {name}", 0.0, 1e15, True),
        Column(
            f"phot_{short}_mean_flux_error",
            "float64",
            "electron s-1",
            f"stat.error;{ucd}",
            f"standard error of the mean flux in {name}",
            0.0,
            1e15,
            True,
        ),
    )


_CORRELATIONS = tuple(
    Column(
        f"{first}_{second}_corr",
        "float32",
        "",
        "stat.correlation",
        f"correlation of {first} and {second}",
        -1.0,
        1.0,
        True,
    )
    for i, first in enumerate(PARAMETERS)
    for second in PARAMETERS[i + 1 :]
)
_FLUXES = tuple(column for short, name in _BANDS for column in _flux(short, name))

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
        *_MOTIONS,
        *_CORRELATIONS,
        *_FLUXES,
    ),
    "Rows of the table `gaia` under the names of Gaia's archive.",
    key=("source_id",),
)


def _make_dr3_table() -> Table:
    """Return the declaration of a table with the columns of Gaia DR3's gaia_source that truesky has, in DR3's order."""
    columns_by_name = {column.name: column for column in EXPORT.columns}
    parameter_names = [name for parameter in PARAMETERS for name in (parameter, f"{parameter}_error")]
    # Begin with the columns up to the parallax error, after which DR3 has parallax_over_error and pm.
    order: list[str | Column] = ["source_id", "ref_epoch", *parameter_names[:6]]
    order += [
        Column(
            "parallax_over_error", "float32", "", "stat.snr;pos.parallax", "parallax over its error", None, None, True
        ),
        Column("pm", "float32", "mas yr-1", "pos.pm", "total proper motion", 0.0, 2e5, True),
        *parameter_names[6:],
        *(column.name for column in _CORRELATIONS),
        Column(
            "astrometric_params_solved",
            "int16",
            "",
            "meta.number",
            "which parameters are known: 31 all five, 3 the position alone",
            3,
            31,
        ),
        "ruwe",
    ]
    for short, _ in _BANDS:
        prefix = f"phot_{short}_mean"
        order += [f"{prefix}_flux", f"{prefix}_flux_error", f"{prefix}_flux_over_error", f"{prefix}_mag"]
    columns = tuple(columns_by_name[item] if isinstance(item, str) else item for item in [*order, "bp_rp"])
    doc = (
        "Rows of the table `gaia` under the names, and in the order, of DR3's gaia_source; the values are those of DR2."
    )
    return Table("gaia_source", 1, columns, doc, key=("source_id",))


EXPORT_DR3 = _make_dr3_table()
