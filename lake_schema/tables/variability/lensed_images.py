"""Declaration of the table `lensed_images`: images of transients and quasars behind strong lenses."""

from __future__ import annotations

from dataclasses import replace

from lake_schema.columns import Column, Table
from lake_schema.ids import STAR_KIND
from lake_schema.tables.common import DEC, HEALPIX_29, RA, density_boost_column, id_of_kinds
from lake_schema.tables.variability.transients import TRANSIENTS

# Properties of a supernova on which its light depends, null for quasars. The date is that of the image.
SUPERNOVA = (
    *(
        replace(TRANSIENTS.column(name), nullable=True)
        for name in ("type", "z_obs", "mag_b", "stretch", "ebv", "a_v")
    ),
    replace(
        TRANSIENTS.column("peak_mjd"), nullable=True, doc="MJD of the observed peak of this image in the rest-frame B"
    ),
)  # fmt: skip

LENSED_IMAGES = Table(
    "lensed_images",
    1,
    (
        id_of_kinds(STAR_KIND, STAR_KIND),
        replace(RA, doc="right ascension of the image, ICRS"),
        replace(DEC, doc="declination of the image, ICRS"),
        HEALPIX_29,
        Column(
            "source_id",
            "int64",
            ucd="meta.id.assoc",
            doc="the source: a transient in the galaxy behind the lens, or a quasar of table galaxies",
            lo=0,
        ),
        Column("lens_id", "int64", ucd="meta.id.assoc", doc="the lens: a galaxy of table galaxies", lo=0),
        replace(
            id_of_kinds(4, 4),
            name="system_id",
            ucd="meta.id.assoc",
            doc="lens and source: for a transient, the row of table strong_lenses with its host",
        ),
        density_boost_column("lenses and sources were"),
        Column("z_lens", "float32", "", "src.redshift", "redshift of the lens", 0.0, 15.0),
        Column("z_source", "float32", "", "src.redshift", "redshift of the source", 0.0, 15.0),
        Column("images", "int8", ucd="meta.number", doc="images of the source behind this lens", lo=1, hi=4),
        Column("image", "int8", ucd="meta.number", doc="number of the image, in the order of arrival", lo=1, hi=4),
        Column("magnification", "float32", "", "arith.factor", "flux relative to the source without lens", 0.0, 1e4),
        Column(
            "parity",
            "int8",
            ucd="meta.code",
            doc="orientation of the image",
            codes=((-1, "mirrored (saddle point of the arrival time)"), (1, "not mirrored")),
            lo=-1,
            hi=1,
        ),
        Column(
            "delay", "float64", "d", "time.interval", "arrival after the first image of the source, observed", 0.0, 1e5
        ),
        *SUPERNOVA,
    ),
    "Images of transients and quasars behind strong lenses: where, how bright, and how late.",
    order=5,
)
