"""Declaration of the table `randoms`: uniform random points in the areas that bands cover, with depth and masks.

Random points have the geometry of the survey but no clustering. Two-point statistics compare galaxies with them.
"""

from __future__ import annotations

from dataclasses import replace

from lake_schema.columns import Column, Table
from lake_schema.tables.common import DEC, HEALPIX_29, RA, id_of_kinds
from lake_schema.tables.survey.depth import DEPTH

# Code of random points in identifiers. No source has it.
KIND = 6

RANDOMS = Table(
    "randoms",
    1,
    (
        replace(
            id_of_kinds(KIND, KIND),
            doc="identifier of the point: 6, order-8 cell and number in the cell; equal for all bands and densities",
        ),
        replace(RA, doc="right ascension, ICRS"),
        replace(DEC, doc="declination, ICRS"),
        HEALPIX_29,
        Column("band", "string", ucd="instr.bandpass", doc="passband whose area the points cover"),
        replace(DEPTH.column("depth_point"), doc="5-sigma AB magnitude of a point source at this place"),
        DEPTH.column("mask"),
        replace(
            DEPTH.column("covered"),
            doc="fraction of the depth pixel that exposures cover; points are kept with this probability",
        ),
        Column(
            "detection",
            "float32",
            "",
            "stat.probability",
            "probability that a galaxy is detected here; null without a model of the detection",
            0.0,
            1.0,
            nullable=True,
        ),
    ),
    "Uniform random points in the areas that bands cover, with the depth and masks at each point in each band.",
    key=("id", "band"),
    order=5,
    max_order=8,
)
