"""Print the mean weights of galaxies as hosts of supernovae, per volume and by redshift.

    python -m scripts.supernova_hosts > truesky/catalogue/transients/supernova_hosts.csv

Galaxies of cells all over the sky are drawn down to a deep limit. The densities are smoothed by a polynomial, because
they are a smooth function of redshift in the model, and vary between cells.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Float
from lake_schema.ids import GENERATION_ORDER
from truesky.catalogue import dust_map
from truesky.catalogue.galaxies import galaxies
from truesky.catalogue.halos.population import CellCache
from truesky.catalogue.transients import rates
from truesky.cosmology import FIDUCIAL
from truesky.request.schema import Universe

# Seed of the universe, and redshifts of the table.
SEED, NODES = 11, np.concatenate([np.arange(0.0, 1.0, 0.05), np.arange(1.0, 6.3, 0.25)])
# Edges of the bins in redshift, AB magnitude limit in H, and number of order-8 cells: nearby and distant galaxies.
NEAR = np.array([0.02, 0.1, 0.15, 0.2, 0.25, 0.3]), 23.0, 600
FAR = np.concatenate([np.arange(0.3, 2.0, 0.1), np.arange(2.0, 6.1, 0.25)]), 27.0, 24
# Degree of the polynomial of log density in ln(1 + z).
DEGREE = 5


def densities(edges: Float, limit: float, cells: int) -> tuple[Float, Float]:
    """Return both weights per Mpc^3 in the bins of redshift between the edges, shape (2, bins), and the volumes, Mpc^3.

    Galaxies brighter than `limit` (H, AB mag) in `cells` order-8 cells are drawn.
    """
    universe = Universe(galaxy_limit=limit, galaxy_band="euclid_h", z_max=float(edges[-1]) + 0.01, lensing=(0.0, 0.0),
                        quasar_boost=0.0, high_redshift_boost=0.0)  # fmt: skip
    model = galaxies.model(SEED, replace(universe, z_max=min(universe.z_max, 6.0)))
    dust, law = dust_map.map_for_request(SEED, None), rates.rates()
    sums = np.zeros((2, len(edges) - 1))
    chosen = (np.arange(cells) + 0.5) / cells * 12 * 4**GENERATION_ORDER
    for cell in chosen.astype(int).tolist():
        rows = galaxies.draw(cell, model, CellCache(model.population), dust)
        z, mass, sfr = (rows[name].to_numpy().astype(float) for name in ("z_true", "log_stellar_mass", "log_sfr"))
        weights = rates.type_ia_weight(law, mass, sfr), 10.0**sfr
        sums += [np.histogram(z, edges, weights=weight)[0] for weight in weights]
    solid_angle = np.radians(1.0) ** 2 * sky.cell_area(GENERATION_ORDER) * cells
    volume = FIDUCIAL.comoving_volume(edges[:-1], edges[1:]) / FIDUCIAL.h**3 * solid_angle
    return sums / volume, volume


def main() -> None:
    """Print the table; to standard error, the ratios of the densities to their fits."""
    nearby_densities, distant_densities = densities(*NEAR), densities(*FAR)
    values, volume = (np.concatenate(pair, axis=-1) for pair in zip(nearby_densities, distant_densities, strict=True))
    x = np.log1p(np.concatenate([0.5 * (edges[1:] + edges[:-1]) for edges in (NEAR[0], FAR[0])]))
    weight = np.minimum(volume, np.median(volume)) ** 0.5
    fits = [np.polynomial.Polynomial.fit(x, np.log10(value), DEGREE, w=weight) for value in values]
    for value, fit in zip(values, fits, strict=True):
        print(np.round(10.0 ** (np.log10(value) - fit(x)), 2), file=sys.stderr)
    print("z,type_ia,star_formation")
    for z in NODES:
        print(f"{z:.2f},{10 ** fits[0](np.log1p(z)):.4e},{10 ** fits[1](np.log1p(z)):.4e}")


if __name__ == "__main__":
    main()
