"""Table `stars`: the Milky Way's stars (Serrano et al. 2024, section 4.2)."""

from __future__ import annotations

from lake_schema.columns import Column, Table
from lake_schema.tables.common import DEC, HEALPIX_29, RA, id_of_kinds

COMPONENTS = (
    (0, "thin disc"),
    (1, "thick disc"),
    (2, "halo"),
    (3, "catalogued bright star"),
    (4, "brown dwarf"),
    (5, "bulge"),
)
STAGES = ((0, "main sequence"), (1, "giant"), (2, "white dwarf"), (3, "brown dwarf"))

STARS = Table(
    "stars",
    2,
    (
        id_of_kinds(5, 5),
        RA,
        DEC,
        HEALPIX_29,
        Column("component", "int8", ucd="src.class", doc="population", codes=COMPONENTS, lo=0, hi=5),
        Column("sed", "int16", ucd="meta.code", doc="template index in the stellar library", lo=0),
        Column(
            "mag_h",
            "float32",
            "mag",
            "phot.mag;em.IR.H",
            "apparent 2MASS H, Vega, before Galactic extinction",
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
        Column("a_v", "float32", "mag", "phys.absorption.gal", "extinction A(V) on the way, R_V = 3.1", 0.0, 40.0),
        Column(
            "density_boost",
            "float32",
            ucd="stat.weight",
            doc="how many times denser than in nature this population was drawn; weight by its inverse",
            lo=1e-3,
            hi=1e6,
        ),
        Column("stage", "int8", "", "src.class", "stage of evolution", 0, 3, nullable=True, codes=STAGES, since=2),
    ),
    "Stars of the True Universe.",
    order=3,
    finest=8,
)
