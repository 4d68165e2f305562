"""Declaration of the table `active_nuclei`: quasars, and active nuclei in galaxies."""

from __future__ import annotations

from dataclasses import replace

from lake_schema.columns import Column, Table
from lake_schema.tables.common import (
    HEALPIX_29,
    OBSERVED_DEC,
    OBSERVED_RA,
    SOURCE_KINDS,
    TRUE_DEC,
    TRUE_RA,
    density_boost_column,
    id_of_kinds,
)

NUCLEUS_TYPES = ((1, "continuum and broad lines are visible"), (2, "continuum and broad lines are hidden by dust"))

_OTHER_COLUMNS = (
    Column(
        "kind",
        "int8",
        ucd="src.class",
        doc="kind of the row of table galaxies: a quasar is drawn as QSO, other nuclei are in central and satellite "
        "galaxies",
        codes=SOURCE_KINDS[:3],
        lo=0,
        hi=2,
    ),
    Column(
        "host_id",
        "int64",
        ucd="meta.id.parent",
        doc="galaxy that contains the nucleus; the host of a quasar may be too faint for table galaxies; missing for "
        "quasars at random positions",
        lo=0,
        nullable=True,
    ),
    density_boost_column("this kind was"),
    Column("type", "int8", ucd="src.class", doc="type of the nucleus", codes=NUCLEUS_TYPES, lo=1, hi=2),
    Column("z_true", "float32", "", "src.redshift", "cosmological redshift", 0.0, 15.0),
    Column("z_obs", "float32", "", "src.redshift", "observed redshift, with the peculiar velocity", -0.02, 15.0),
    Column(
        "log_luminosity", "float32", "", "phys.luminosity", "log10 of the bolometric luminosity / (erg/s)", 30.0, 50.0
    ),
    Column("log_black_hole_mass", "float32", "", "phys.mass", "log10 of the black hole's mass / Msun", 0.0, 12.0),
    Column(
        "log_eddington_ratio",
        "float32",
        "",
        "phys.luminosity;arith.ratio",
        "log10 of the bolometric luminosity / Eddington luminosity",
        -8.0,
        4.0,
    ),
    Column(
        "m_1450",
        "float32",
        "mag",
        "phot.mag;phys.magAbs;em.UV.100-200nm",
        "absolute AB magnitude at 1450 Angstrom for h = 0.67, without the dust that hides type 2",
        -35.0,
        0.0,
    ),
    Column(
        "mag_1450",
        "float32",
        "mag",
        "phot.mag;em.UV.100-200nm",
        "mean apparent AB magnitude at 1450 Angstrom in the rest frame, before dust, magnification and Milky Way",
        -5.0,
        60.0,
    ),
    Column(
        "template", "int16", ucd="meta.code", doc="index of the template spectrum among those of quasars", lo=0, hi=8
    ),
    Column(
        "log_stellar_mass",
        "float32",
        "",
        "phys.mass",
        "log10 of the stellar mass of the host / Msun; missing if the host is not in table galaxies",
        0.0,
        14.0,
        True,
    ),
    Column("log_halo_mass", "float32", "", "phys.mass", "log10 of M_200m / (Msun/h) of the halo", 5.0, 17.0, True),
    Column("kappa", "float32", ucd="arith.factor", doc="convergence", lo=-1.0, hi=2.0),
    Column("gamma1", "float32", ucd="arith.factor", doc="shear along east-west, as in table galaxies", lo=-1.0, hi=1.0),
    Column(
        "gamma2", "float32", ucd="arith.factor", doc="shear along north-east, as in table galaxies", lo=-1.0, hi=1.0
    ),
    Column("a_v", "float32", "mag", "phys.absorption.gal", "extinction A(V) of the Milky Way", 0.0, 40.0),
    Column(
        "point_id", "int64", ucd="meta.id", doc="identifier of the point source in images (table rendered_truth)", lo=0
    ),
    Column("light_curve_key", "int64", ucd="meta.code", doc="random key from which the light curve is computed"),
)
_ID = replace(
    id_of_kinds(0, 2), doc="identifier of the row of table galaxies: the quasar, or the galaxy with the nucleus"
)

ACTIVE_NUCLEI = Table(
    "active_nuclei",
    1,
    (_ID, OBSERVED_RA, OBSERVED_DEC, HEALPIX_29, TRUE_RA, TRUE_DEC, *_OTHER_COLUMNS),
    "Active nuclei: quasars, and nuclei in galaxies.",
    order=5,
)
