"""Declaration of the table `stars`: simulated and catalogued Milky Way stars (Serrano et al. 2024, section 4.2)."""

from __future__ import annotations

from dataclasses import replace

from lake_schema.columns import Column, Table
from lake_schema.tables.common import DEC, HEALPIX_29, RA, density_boost_column, id_of_kinds

COMPONENTS = (
    (0, "thin disc"),
    (1, "thick disc"),
    (2, "halo"),
    (3, "catalogued bright star"),
    (4, "brown dwarf"),
    (5, "bulge"),
)
STAGES = ((0, "main sequence"), (1, "giant"), (2, "white dwarf"), (3, "brown dwarf"), (4, "subgiant"))

# Epoch of the positions of stars, as a Julian year.
EPOCH = 2015.5


def _template_columns(k: int) -> tuple[Column, ...]:
    return (
        Column(f"sed_{k}", "int16", "", "meta.code", f"template {k} that the spectrum is mixed of", 0, nullable=True),
        Column(f"frac_{k}", "float32", "", "phot.flux.density;arith.ratio",
               f"share of template {k} in f_lambda at 5500 A; sed has what is left by all", 0.0, 1.0, True,
               mantissa_bits=12),
    )  # fmt: skip


# Types of variable stars in the column `variability`, which is null for constant stars.
VARIABILITY = (
    (1, "RR Lyrae, fundamental mode (RRab)"),
    (2, "RR Lyrae, first overtone (RRc)"),
    (3, "classical Cepheid"),
    (4, "Mira"),
    (5, "semi-regular giant"),
    (6, "binary with eclipses"),
    (7, "close binary without eclipses, with tides"),
)
_OPTIONAL = "; the column exists only with universe.variables"
# Columns of variable stars; all are null for constant stars.
VARIABILITY_COLUMNS = (
    Column(
        "variability",
        "int8",
        "",
        "meta.code.class;src.var",
        f"type of a variable star, null for a constant one{_OPTIONAL}",
        1,
        7,
        True,
        VARIABILITY,
    ),
    Column("period", "float64", "d", "time.period", f"period of the pulsation or orbit{_OPTIONAL}", 0.01, 1e9, True),
    Column(
        "epoch",
        "float64",
        "d",
        "time.epoch",
        f"MJD of a maximum of light of a pulsating star, or of the middle of an eclipse of this star{_OPTIONAL}",
        5e4,
        1.1e9,
        True,
    ),
    Column(
        "amplitude",
        "float32",
        "mag",
        "src.var.amplitude;em.opt.V",
        f"difference between minimum and maximum of the star's own light in Johnson V{_OPTIONAL}",
        0.0,
        15.0,
        True,
    ),
    Column(
        "eclipse_radius_ratio",
        "float32",
        "",
        "phys.size.radius;arith.ratio",
        f"radius of the star that eclipses this star, in radii of this star; 0 without eclipses{_OPTIONAL}",
        0.0,
        1e5,
        True,
    ),
    Column(
        "eclipse_impact",
        "float32",
        "",
        "pos.angDistance;arith.ratio",
        f"distance of the centres on the sky in the middle of the eclipse, in radii of this star{_OPTIONAL}",
        0.0,
        1e5,
        True,
    ),
    Column(
        "eclipse_duration",
        "float32",
        "d",
        "time.duration",
        f"time from the first to the last contact of the eclipse; 0 without eclipses{_OPTIONAL}",
        0.0,
        1e6,
        True,
    ),
    Column(
        "tidal_amplitude",
        "float32",
        "",
        "src.var.amplitude;arith.ratio",
        f"relative semi-amplitude of the flux by tides; its minima are at the epoch and half a period later{_OPTIONAL}",
        0.0,
        0.2,
        True,
    ),
)

STARS = Table(
    "stars",
    1,
    (
        id_of_kinds(5, 5),
        RA,
        DEC,
        HEALPIX_29,
        Column("component", "int8", ucd="src.class", doc="population", codes=COMPONENTS, lo=0, hi=5),
        Column(
            "sed", "int16", ucd="meta.code", doc="template index in the stellar library, of the largest share", lo=0
        ),
        Column(
            "mag_h",
            "float32",
            "mag",
            "phot.mag;em.IR.H",
            "apparent 2MASS H, Vega, before Galactic extinction; AB by ab_minus_vega of twomass_h in table passbands",
            -10.0,
            40.0,
        ),
        Column(
            "abs_mag_h", "float32", "mag", "phot.mag;phys.magAbs;em.IR.H", "absolute 2MASS H, Vega", -15.0, 30.0, True
        ),
        Column("distance", "float64", "pc", "pos.distance", "heliocentric distance", 0.0, 1e6, True),
        Column("teff", "float32", "K", "phys.temperature.effective", "effective temperature", 300.0, 1e5, True),
        Column("log_g", "float32", "", "phys.gravity", "log10 of the surface gravity / (cm s-2)", -1.0, 10.0, True),
        Column("metallicity", "float32", "", "phys.abund.Z", "[M/H], dex", -5.0, 1.5, True),
        Column(
            "a_v",
            "float32",
            "mag",
            "phys.absorption.gal",
            "extinction A(V) on the way, by the curve of O'Donnell 1994 with R_V = 3.1",
            0.0,
            40.0,
        ),
        density_boost_column("this population was"),
        Column("stage", "int8", "", "src.class", "stage of evolution", 0, 4, nullable=True, codes=STAGES),
        *(column for k in (2, 3, 4) for column in _template_columns(k)),
        Column("mass", "float32", "solMass", "phys.mass", "mass at birth", 0.0, 200.0, True),
        Column("age", "float32", "Gyr", "time.age", "age of its population", 0.0, 14.5, True),
        Column(
            "pm_ra",
            "float32",
            "mas yr-1",
            "pos.pm;pos.eq.ra",
            "proper motion in right ascension times cos(dec)",
            -1e5,
            1e5,
            True,
        ),
        Column(
            "pm_dec",
            "float32",
            "mas yr-1",
            "pos.pm;pos.eq.dec",
            "proper motion in declination",
            -1e5,
            1e5,
            True,
        ),
        Column(
            "radial_velocity",
            "float32",
            "km s-1",
            "spect.dopplerVeloc;pos.heliocentric",
            "radial velocity, positive away from the Sun",
            -2e3,
            2e3,
            True,
        ),
        Column(
            "companion_of",
            "int64",
            "",
            "meta.id.assoc",
            "identifier of the star it orbits, whether or not that is in the table; orbits do not move it",
            5 << 60,
            (6 << 60) - 1,
            True,
        ),
    ),
    "Stars of the True Universe, where they are at J2015.5; proper motions carry them to other times.",
    order=3,
    max_order=8,
)


def stars(variables: bool) -> Table:
    """Return the declaration of table `stars`, with the columns of variable stars if `variables` is True."""
    return replace(STARS, columns=STARS.columns + VARIABILITY_COLUMNS) if variables else STARS
