"""Declaration of the tables `halos` (dark-matter halos that host galaxies) and `halo_limits`.

`halo_limits` contains the mass, for each redshift, above which `halos` lists all halos.
"""

from __future__ import annotations

from lake_schema.columns import Column, Table
from lake_schema.tables.common import DEC, HEALPIX_29, RA, id_of_kinds

HALOS = Table(
    "halos",
    1,
    (
        id_of_kinds(0, 0),
        RA,
        DEC,
        HEALPIX_29,
        Column("z_true", "float32", "", "src.redshift", "cosmological redshift", 0.0, 15.0),
        Column("z_obs", "float32", "", "src.redshift", "observed redshift, with the peculiar velocity", -0.02, 15.0),
        Column("log_mass", "float32", "", "phys.mass", "log10 of M_200m / (Msun/h)", 5.0, 17.0),
        Column(
            "concentration", "float32", "", "src.morph.param", "R_200m / scale radius of the NFW profile", 0.5, 100.0
        ),
    ),
    "Halos of the True Universe; a galaxy's halo_id is the id of a row here, also the id of its central galaxy. "
    "Table halo_limits gives the mass above which all are listed.",
    order=5,
)

HALO_LIMITS = Table(
    "halo_limits",
    1,
    (
        Column("z_true", "float64", "", "src.redshift", "cosmological redshift", 0.0, 15.0),
        Column(
            "log_mass",
            "float64",
            "",
            "phys.mass;stat.min",
            "log10 of M_200m / (Msun/h) above which table halos lists all halos of this redshift; below, it lists "
            "halos whose central galaxy may be visible",
            5.0,
            17.0,
        ),
    ),
    "Completeness of table halos: the mass, against redshift, that the request's faintest galaxies need.",
    key=("z_true",),
)
