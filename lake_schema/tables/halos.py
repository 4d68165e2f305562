"""Table `halos`: the dark-matter halos that the galaxies of the True Universe live in."""

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
        Column(
            "complete",
            "bool",
            "",
            "meta.code",
            "above the mass limit of its redshift: all are listed there, below it only what may be seen",
        ),
    ),
    "Halos of the True Universe; a galaxy's halo_id is the id of a row here, also the id of its central galaxy.",
    order=5,
)
