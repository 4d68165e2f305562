"""Galaxies of one cell in which supernovae explode."""

import numpy as np
import pyarrow as pa

from lake_schema import ids, sky
from truesky.catalogue.transients import supernovae

CELL = 500_000


def galaxies(number=2000, seed=1, **changes):
    """Return rows of table `galaxies` with the columns that supernovae need, at random places in the cell `CELL`."""
    rng = np.random.default_rng(seed)
    first, last = sky.cell_range(8, CELL)
    index = np.sort(rng.integers(first, last, number))
    ra, dec = sky.positions_of_indices(index)
    z = rng.uniform(0.02, 2.0, number)
    columns = {
        "id": ids.source_id(0, CELL, np.arange(number)), "kind": np.zeros(number, np.int8), "ra": ra, "dec": dec,
        "z_true": z, "z_obs": z + 1e-3, "log_stellar_mass": rng.uniform(8.0, 11.5, number),
        "log_sfr": rng.uniform(-2.0, 2.0, number), "a_v": np.full(number, 0.1),
        "bulge_fraction": rng.choice([0.0, 0.3, 1.0], number), "bulge_half_light_radius": rng.uniform(0.1, 1.0, number),
        "bulge_sersic_index": rng.uniform(0.5, 6.0, number), "bulge_axis_ratio": rng.uniform(0.5, 1.0, number),
        "disk_half_light_radius": rng.uniform(0.1, 1.0, number), "disk_axis_ratio": rng.uniform(0.2, 1.0, number),
        "position_angle": rng.uniform(0.0, 180.0, number), "kappa": np.full(number, 0.05),
        "gamma1": np.full(number, 0.02), "gamma2": np.full(number, -0.01),
    }  # fmt: skip
    return pa.table({name: {**columns, **changes}[name] for name in supernovae.COLUMNS})
