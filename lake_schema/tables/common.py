"""Declarations that several tables share: columns of identifiers and positions, codes of the types of sources.

The class Origin describes the file from which a spectrum or curve was made.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from lake_schema.columns import Column

SOURCE_KINDS = (
    (0, "central galaxy"),
    (1, "satellite galaxy"),
    (2, "QSO"),
    (3, "high-redshift galaxy"),
    (4, "strong lens"),
    (5, "star"),
)

ID = Column(
    "id",
    "int64",
    ucd="meta.id;meta.main",
    lo=0,
    doc="source identifier: kind, order-8 cell, parent halo and member (lake_schema.ids)",
)
RA = Column("ra", "float64", "deg", "pos.eq.ra;meta.main", "right ascension, ICRS, true (unlensed)", 0.0, 360.0)
DEC = Column("dec", "float64", "deg", "pos.eq.dec;meta.main", "declination, ICRS, true (unlensed)", -90.0, 90.0)
OBSERVED_RA = replace(RA, doc="right ascension, ICRS, as observed (lensed)")
OBSERVED_DEC = replace(DEC, doc="declination, ICRS, as observed (lensed)")
TRUE_RA = Column("ra_true", "float64", "deg", "pos.eq.ra", "right ascension, ICRS, true (unlensed)", 0.0, 360.0)
TRUE_DEC = Column("dec_true", "float64", "deg", "pos.eq.dec", "declination, ICRS, true (unlensed)", -90.0, 90.0)
HEALPIX_29 = Column(
    "_healpix_29", "int64", ucd="pos.healpix", doc="HEALPix index of (ra, dec), order 29, nested: the sort key", lo=0
)
SKY = (ID, RA, DEC, HEALPIX_29)


@dataclass(frozen=True, slots=True)
class Origin:
    """Files from which a spectrum or a curve was made.

    Attributes
    ----------
    source : str
        Names of the files, with a reference to the literature.
    sha256 : str
        sha256 of the concatenated files, hexadecimal.
    """

    source: str
    sha256: str


def id_of_kinds(first: int, last: int) -> Column:
    """Return the column `id` of a table that contains only sources of the kinds `first` to `last`.

    A kind is a code for the type of source, such as 5 for a star, and the highest bits of an identifier. The bounds of
    the column exclude identifiers of other kinds.
    """
    return replace(ID, lo=first << 60, hi=(last + 1 << 60) - 1)


def density_boost_column(sources: str) -> Column:
    """Return the column `density_boost`.

    The column contains the factor by which the simulation multiplied the density of a type of source on the sky.
    `sources` is the subject and verb in the description of the column, such as "this kind was" or "strong lenses were".
    """
    doc = f"factor by which {sources} drawn denser than in nature; weight by its inverse"
    return Column("density_boost", "float32", ucd="stat.weight", doc=doc, lo=1e-3, hi=1e6)
