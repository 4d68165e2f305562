"""How fast and how right the band fluxes are: python -m benchmarks.fluxes [--quick] [--json FILE] [--measure].

--measure  writes jobs/fluxes/flux_errors.csv, from which the job chooses its tables

Galaxies in two components with their lines, over the whole of the parameter space that the tables cover, in the 22 bands of
Serrano et al. 2024; the truth is direct integration in steps of 1 A, in the same run. CPU seconds of one core.
"""

from __future__ import annotations

import argparse
import csv
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from jobs.accuracy import DRAFT, SURVEY, Accuracy
from jobs.fluxes import flux_grid, grid_settings, grid_tables, integration, lines, passbands, spectra, templates
from jobs.fluxes.sources import Galaxies, galaxies_of
from jobs.fluxes.templates import Library

Float = npt.NDArray[np.float64]

BANDS = (
    "euclid_vis", "euclid_y", "euclid_j", "euclid_h", "gaia_g", "gaia_bp", "gaia_rp", "des_g", "des_r", "des_i", "des_z",
    "lsst_u", "lsst_g", "lsst_r", "lsst_i", "lsst_z", "lsst_y", "cfis_u", "cfis_r", "jedis_g", "ps1_i", "hsc_z",
)  # fmt: skip

# The settings are chosen on one sample and judged on another.
_SEED_CHOICE, _SEED_TEST, _SEED_SPEED = 1, 2, 3
_SAMPLE, _SPEED_SAMPLE = 20_000, 200_000
_QUICK = 1_000
_MAG = 2.5 / np.log(10.0)


def sample(n: int, seed: int) -> pa.Table:
    """n random rows of `galaxies`, uniform over all that the tables cover."""
    rng = np.random.default_rng(seed)
    frac = rng.uniform(0.0, 1.0, n)
    z = rng.uniform(grid_tables.Z_FIRST + 0.001, grid_tables.Z_LAST - 0.01, n)
    columns: dict[str, Any] = {
        "id": np.arange(n),
        "ra": rng.uniform(0.0, 360.0, n),
        "dec": np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, n))),
        "_healpix_29": np.arange(n),
        "kind": np.zeros(n, np.int8),
        "z_true": np.maximum(z, 0.0),
        "z_obs": z,
        "abs_mag_r01": rng.uniform(-23.0, -16.0, n),
        "mag_r01": rng.uniform(18.0, 26.0, n),
        "frac_1": frac,
        "frac_2": 1.0 - frac,
        "kappa": rng.normal(0.0, 0.02, n),
        "gamma1": rng.normal(0.0, 0.02, n),
        "gamma2": rng.normal(0.0, 0.02, n),
        "a_v": rng.uniform(0.0, grid_tables.A_V_LAST, n),
    }
    for k in (1, 2):
        columns[f"sed_{k}"] = rng.integers(0, templates.GALAXY_LIBRARY_SIZE, n).astype(np.int16)
        columns[f"ext_law_{k}"] = rng.integers(0, 5, n).astype(np.int8)
        columns[f"ebv_{k}"] = rng.uniform(0.0, grid_tables.EBV_LAST, n)
    for name in lines.columns():
        columns[name] = 10.0 ** rng.uniform(-18.0, -15.5, n)
    return pa.table(columns)


def measure(file: Path, n: int = _SAMPLE, bands: Sequence[str] = ()) -> None:
    """Write the error of every candidate setting in every passband."""
    library = templates.galaxy_library()
    rows = galaxies_of(sample(n, _SEED_CHOICE), library)
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(("band", "step", "n_ebv", "n_av", "rms", "largest"))
        for name in bands or passbands.names():
            band = passbands.load(name)
            truth = integration.galaxies(rows, [band], library)
            for setting in grid_settings.CANDIDATES:
                grid = flux_grid.open_grid([band], [setting], library)
                error = np.abs(flux_grid.galaxies(rows, grid) / truth - 1.0)
                rms, largest = float(np.sqrt(np.mean(error**2))), float(error.max())
                writer.writerow((name, setting.step, setting.n_ebv, setting.n_av, f"{rms:.2e}", f"{largest:.2e}"))
            stream.flush()
            print(name)
