"""Declaration of the table `strong_lenses`: galaxies that lens a background galaxy, with images of its arcs."""

from __future__ import annotations

from lake_schema.columns import Column, Table
from lake_schema.tables.common import (
    HEALPIX_29,
    OBSERVED_DEC,
    OBSERVED_RA,
    TRUE_DEC,
    TRUE_RA,
    density_boost_column,
    id_of_kinds,
)

_OTHER_COLUMNS = (
    Column("kind", "int8", ucd="src.class", doc="kind of source", codes=((4, "strong lens"),), lo=4, hi=4),
    Column("lens_id", "int64", ucd="meta.id.assoc", doc="the lens: a central or satellite of table galaxies", lo=0),
    Column(
        "source_id",
        "int64",
        ucd="meta.id.assoc",
        doc="the galaxy of table galaxies whose spectrum, brightness and shape the lensed one has",
        lo=0,
    ),
    density_boost_column("strong lenses were"),
    Column("z_lens", "float32", "", "src.redshift", "redshift of the lens", 0.0, 15.0),
    Column("z_source", "float32", "", "src.redshift", "redshift of the source", 0.0, 15.0),
    Column(
        "velocity_dispersion",
        "float32",
        "km/s",
        "phys.veloc.dispersion",
        "velocity dispersion of the lens",
        10.0,
        1000.0,
    ),
    Column(
        "einstein_radius", "float32", "arcsec", "phys.angSize", "Einstein radius of the isothermal ellipsoid", 0.0, 30.0
    ),
    Column("axis_ratio", "float32", ucd="phys.size.axisRatio", doc="minor / major axis of the mass", lo=0.1, hi=1.0),
    Column(
        "position_angle", "float32", "deg", "pos.posAng", "position angle of the mass, north through east", 0.0, 180.0
    ),
    Column("source_east", "float32", "arcsec", "pos", "true place of the source, east of the lens", -30.0, 30.0),
    Column("source_north", "float32", "arcsec", "pos", "true place of the source, north of the lens", -30.0, 30.0),
    Column("images", "int8", ucd="meta.number", doc="images of the source's centre", lo=1, hi=4),
    Column(
        "magnification", "float32", ucd="arith.factor", doc="flux of the arcs relative to the source", lo=0.0, hi=1e4
    ),
    Column("stamp_side", "int16", "pixel", "meta.number", "pixels of the stamp's side, of 0.05 arcsec", 1, 4096),
    Column(
        "stamp",
        "list<float32>",
        "",
        "phot.flux;arith.ratio",
        "arcs without the lens: flux in each pixel / flux of the source before magnification; row after row, "
        "from south to north, each from west to east, the lens in the middle",
        0.0,
        1e6,
    ),
)
_DESCRIPTION = "Strong lenses: singular isothermal ellipsoids, and pictures of the galaxies behind them."

STRONG_LENSES = Table(
    "strong_lenses",
    1,
    (id_of_kinds(4, 4), OBSERVED_RA, OBSERVED_DEC, HEALPIX_29, TRUE_RA, TRUE_DEC, *_OTHER_COLUMNS),
    _DESCRIPTION,
    order=5,
)
