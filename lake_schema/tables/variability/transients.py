"""Declaration of the table `transients`: supernovae in the galaxies of a lake, during a window of time."""

from __future__ import annotations

from lake_schema.columns import Column, Table
from lake_schema.ids import STAR_KIND
from lake_schema.tables.common import HEALPIX_29, OBSERVED_DEC, OBSERVED_RA, density_boost_column, id_of_kinds

TYPES = (
    (1, "type Ia"), (2, "type II-P"), (3, "type II-L"), (4, "type IIn"), (5, "type IIb"), (6, "type Ib"),
    (7, "type Ic"),
)  # fmt: skip

TRANSIENTS = Table(
    "transients",
    1,
    (
        id_of_kinds(STAR_KIND, STAR_KIND),
        OBSERVED_RA,
        OBSERVED_DEC,
        HEALPIX_29,
        Column("type", "int8", ucd="src.class", doc="type of supernova", codes=TYPES, lo=1, hi=7),
        Column("host_id", "int64", ucd="meta.id.assoc", doc="the galaxy of table galaxies in which it explodes", lo=0),
        Column("offset_east", "float32", "arcsec", "pos", "observed offset, east of the host's centre", -1e3, 1e3),
        Column("offset_north", "float32", "arcsec", "pos", "observed offset, north of the host's centre", -1e3, 1e3),
        Column("z_true", "float32", "", "src.redshift", "cosmological redshift", 0.0, 15.0),
        Column("z_obs", "float32", "", "src.redshift", "observed redshift, with the peculiar velocity", -0.02, 15.0),
        Column("peak_mjd", "float64", "d", "time.epoch", "MJD of the observed peak in the rest-frame B", -1e5, 3e5),
        Column(
            "abs_mag_b", "float32", "mag", "phot.mag;phys.magAbs;em.opt.B",
            "absolute AB magnitude at the peak in the rest-frame bessell_b, with the dust of the host", -25.0, 0.0,
        ),
        Column(
            "mag_b", "float32", "mag", "phot.mag;em.opt.B",
            "apparent AB magnitude of abs_mag_b, without magnification and the Milky Way", -5.0, 60.0,
        ),
        Column("stretch", "float32", "", "time.scale", "duration / duration of the template", 0.3, 2.0),
        Column(
            "ebv", "float32", "mag", "phot.color.excess",
            "E(B-V) in the host, or of the intrinsic colour (type Ia, also negative)", -1.0, 5.0,
        ),
        Column("magnification", "float32", "", "arith.factor", "factor of the flux by weak lensing", 0.0, 1e4),
        Column(
            "a_v", "float32", "mag", "phys.absorption.gal",
            "extinction A(V) of the Milky Way, by the curve of O'Donnell 1994 with R_V = 3.1", 0.0, 40.0,
        ),
        density_boost_column("transients were"),
    ),
    "Supernovae that shine at some time of the window of the request, with the properties of their light curves.",
    order=5,
)  # fmt: skip
