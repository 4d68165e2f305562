"""Declaration of the table `quarantine`: galaxies whose lensing is too strong to be described by shear and convergence.

They are not in the table `galaxies`, and neither fluxes nor images of them are made.
"""

from __future__ import annotations

from dataclasses import replace

from lake_schema.columns import Column, Table
from lake_schema.tables.galaxies import GALAXIES

# Bounds of columns that are wider than in the table `galaxies`: behind the centre of a massive halo, the convergence
# kappa is well above 1.
_BOUNDS = {"kappa": (-1.0, 100.0), "gamma1": (-10.0, 10.0), "gamma2": (-10.0, 10.0)}


def _with_wide_bounds(column: Column) -> Column:
    lo, hi = _BOUNDS.get(column.name, (column.lo, column.hi))
    return replace(column, lo=lo, hi=hi)


QUARANTINE = Table(
    "quarantine",
    1,
    (
        *(_with_wide_bounds(column) for column in GALAXIES.columns),
        Column(
            "determinant",
            "float32",
            ucd="arith.factor",
            doc="(1 - kappa)^2 - gamma^2: one over the magnification that it would have",
            lo=-200.0,
            hi=10_000.0,
        ),
    ),
    "Galaxies at or beyond a caustic, which are in no other table: no fluxes, no images.",
)
