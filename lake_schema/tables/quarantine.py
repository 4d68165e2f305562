"""Declaration of the table `quarantine`: galaxies that weak lensing cannot describe, separate from `galaxies`."""

from __future__ import annotations

from dataclasses import replace

from lake_schema.columns import Column, Table
from lake_schema.tables.galaxies import GALAXIES

# A galaxy behind the centre of a massive halo has a convergence of several.
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
