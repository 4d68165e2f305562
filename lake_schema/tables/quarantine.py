"""Table `quarantine`: galaxies that weak lensing cannot describe, kept apart from the table `galaxies`."""

from __future__ import annotations

from dataclasses import replace

from lake_schema.columns import Column, Table
from lake_schema.tables.galaxies import GALAXIES

QUARANTINE = Table(
    "quarantine",
    1,
    (
        *(replace(column, since=1) for column in GALAXIES.columns),
        Column(
            "determinant",
            "float32",
            ucd="arith.factor",
            doc="(1 - kappa)^2 - gamma^2: one over the magnification that it would have",
            lo=-2.0,
            hi=4.0,
        ),
    ),
    "Galaxies at or beyond a caustic, which are in no other table: no fluxes, no images.",
)
