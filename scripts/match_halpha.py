"""Make truesky/catalogue/galaxies/halpha_matching.csv, which corrects H alpha luminosities from star formation rates.

    python scripts/match_halpha.py [--cells 120]

A sample of simulated galaxies without clustering is drawn once, in an area of --cells HEALPix cells of 0.052 deg2. In
each bin of redshift, the cumulative counts of uncorrected luminosities are matched to model 3 of Pozzetti et al. 2016.
The corrected luminosity never decreases with the uncorrected one. The table is the same for every seed of a simulation.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

import lake_schema  # noqa: F401  (restricts numpy, imported later, to common CPU instructions)

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from truesky.catalogue.galaxies import emission_lines, galaxies
from truesky.cosmology import FIDUCIAL
from truesky.request.schema import Universe
from truesky.validation.model import mean_sky

SEED = 2016
UNIVERSE = Universe(galaxy_limit=26.0, z_max=6.0, lensing=(0.0, 0.0), box_cells=192)
# Edges of the bins of redshift in which luminosities are corrected.
EDGES = np.concatenate([[0.03, 0.2], np.arange(0.3, 3.01, 0.1), [3.3, 3.7, 4.2, 5.0, 6.0]])
# Uncorrected log10 L of H alpha (erg/s) at which corrections are tabulated.
LOG_L = np.linspace(39.0, 43.6, 47)
# If fewer galaxies than this are brighter than a luminosity, its correction is that of the highest luminosity with
# enough brighter galaxies.
ENOUGH = 15
CM_PER_MPC = 3.0856775814913673e24


def sample(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the redshifts and the uncorrected log10 L of H alpha (erg/s) of simulated galaxies.

    `cells` is the number of HEALPix cells of order 8 (0.052 deg2 each) that are drawn. The galaxies are brighter than
    26 mag; galaxies without H alpha emission are left out.
    """
    lines = emission_lines.model_from_table(np.array([0.0, 9.0]), np.array([0.0, 99.0]), np.zeros((2, 2)))
    universe = replace(mean_sky.without_clustering(galaxies.model(SEED, UNIVERSE)), lines=lines)
    rows = mean_sky.rows(universe, 0, cells)
    z, flux = (rows[name].to_numpy().astype(float) for name in ("z_true", "flux_halpha"))
    shines = flux > 0.0
    distance = FIDUCIAL.luminosity_distance(z[shines]) / FIDUCIAL.h * CM_PER_MPC
    return z[shines], np.log10(flux[shines] * 4.0 * np.pi * distance**2)


def shifts(z: np.ndarray, raw: np.ndarray, area: float) -> np.ndarray:
    """Return the corrections of log10 L of H alpha, with which the counts of galaxies agree with the published model.

    Parameters
    ----------
    z : float array, shape (n,)
        Redshifts of the galaxies of a sample.
    raw : float array, shape (n,)
        Uncorrected log10 L of H alpha of these galaxies, in erg/s.
    area : float
        Area of the sample in square degrees.

    Returns
    -------
    float array, shape (redshift bins, luminosities)
        Corrections to add to log10 L, in dex, in the bins between EDGES and at the luminosities LOG_L.

    Notes
    -----
    Every bin of redshift must contain at least ENOUGH galaxies brighter than 10^39 erg/s; otherwise IndexError is
    raised.
    """
    rows = []
    for z_low, z_high in pairwise(EDGES):
        middle = 0.5 * (z_low + z_high)
        luminosities = np.sort(raw[(z > z_low) & (z < z_high)])
        distance = float(FIDUCIAL.luminosity_distance(middle)) / FIDUCIAL.h * CM_PER_MPC
        log_luminosity = np.linspace(38.0, 45.0, 281)
        counts = emission_lines.expected_counts(10.0**log_luminosity / (4 * np.pi * distance**2), z_low, z_high) * area
        above = luminosities.size - np.searchsorted(luminosities, LOG_L)
        # Counts decrease with luminosity. np.interp requires ascending values, so interpolate in their negative
        # logarithms.
        matched = np.interp(-np.log(np.maximum(above, 1)), -np.log(np.maximum(counts, 1e-9)), log_luminosity)
        shift = matched - LOG_L
        last = int(np.flatnonzero(above >= ENOUGH)[-1])
        first = int(np.flatnonzero(above < 0.98 * luminosities.size)[0])
        shift[last:] = shift[last]
        shift[:first] = shift[first]
        rows.append(np.maximum.accumulate(LOG_L + shift) - LOG_L)
    return np.array(rows)


def main() -> None:
    """Run the command, which replaces the table in the package."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=120, help="generation cells to draw (0.052 deg2 each)")
    cells = parser.parse_args().cells
    z, raw = sample(cells)
    table = shifts(z, raw, cells * sky.cell_area(GENERATION_ORDER))
    middle = 0.5 * (EDGES[1:] + EDGES[:-1])
    matching_table = np.vstack([np.concatenate([[0.0], LOG_L]), np.column_stack([middle, table])])
    note = "rows: redshift, then the shift of log10 L(H alpha) in dex; first row: raw log10 L; scripts/match_halpha.py"
    np.savetxt(emission_lines.MATCHING, matching_table, "%.4f", ",", header=note)


if __name__ == "__main__":
    main()
