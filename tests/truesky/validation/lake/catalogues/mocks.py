"""Mock galaxies and shear from many plane waves on a field around right ascension 0, with known correlations."""

import numpy as np

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from truesky.cosmology import FIDUCIAL
from truesky.validation import field as fields
from truesky.validation import theory

CELLS = sky.cells_in_cone(0.0, 0.0, 0.9, GENERATION_ORDER)
FIELD = fields.from_cells(GENERATION_ORDER, CELLS)
WAVES, LOWEST, HIGHEST = 500, 100.0, 2e4


def scattered(rng, n):
    """About n positions in the field: order-29 indices, ra, dec."""
    parts = [sky.random_in_cell(GENERATION_ORDER, int(cell), n // len(CELLS), rng) for cell in CELLS]
    return tuple(np.concatenate(one) for one in zip(*parts, strict=True))


def waves(rng, c_l):
    """Multipoles, variances, wave vectors (2, w) and phases of a field with given C_l."""
    ell = np.geomspace(LOWEST, HIGHEST, WAVES)
    power = np.exp(np.interp(np.log(ell), np.log(theory.ELL), np.log(c_l)))
    variance = power * ell**2 * np.log(ell[1] / ell[0]) / (2 * np.pi)
    turn, phase = 2 * np.pi * rng.random((2, WAVES))
    return ell, variance, ell * np.stack([np.cos(turn), np.sin(turn)]), phase


def plane(ra, dec):
    """Offsets to the east and north in rad of positions near (0, 0)."""
    return np.radians((ra + 180.0) % 360.0 - 180.0), np.radians(dec)


def sheared(seed=1, n=8000):
    """Columns of galaxies at z = 1 whose shear and convergence are derivatives of one potential."""
    rng = np.random.default_rng(seed)
    index, ra, dec = scattered(rng, n)
    c_l = theory.convergence_power(FIDUCIAL, theory.ELL, FIDUCIAL.comoving_distance(np.ones(1)), np.ones(1))
    ell, variance, (kx, ky), phase = waves(rng, c_l)
    east, north = plane(ra, dec)
    # psi = sum of -2 kappa / l^2 cos(k x + phase): kappa = (psi_xx + psi_yy) / 2.
    kappa = np.sqrt(2 * variance) * np.cos(np.outer(east, kx) + np.outer(north, ky) + phase)
    return {
        "id": np.arange(len(ra)), "ra": ra, "dec": dec, "_healpix_29": index, "kind": np.zeros(len(ra), np.int8),
        "z_true": np.float32(1.0) + rng.normal(0.0, 0.01, len(ra)).astype(np.float32), "kappa": kappa.sum(1),
        "gamma1": np.sum(kappa * (kx**2 - ky**2) / ell**2, 1), "gamma2": np.sum(kappa * 2 * kx * ky / ell**2, 1),
    }  # fmt: skip


def clustered(seed=1, n=6000, log_mass=12.5):
    """Columns of galaxies at 0.6 < z < 0.8 that cluster as halos of a mass, and the variances of their waves."""
    rng = np.random.default_rng(seed)
    index, ra, dec = scattered(rng, 4 * n)
    columns = {
        "kind": np.zeros(len(ra), np.int8), "z_true": rng.uniform(0.6, 0.8, len(ra)).astype(np.float32),
        "log_halo_mass": np.full(len(ra), log_mass, np.float32), "abs_mag_r01": rng.uniform(-22.0, -17.0, len(ra)),
        "sed_1": np.full(len(ra), 10), "sed_2": np.full(len(ra), 10), "frac_1": np.full(len(ra), 0.5),
        "frac_2": np.full(len(ra), 0.5), "ext_law_1": np.zeros(len(ra), np.int8), "ebv_1": np.zeros(len(ra)),
        "id": np.arange(len(ra)), "ra": ra, "dec": dec, "_healpix_29": index,
    }  # fmt: skip
    edges = np.asarray(FIDUCIAL.comoving_distance(np.array([0.6, 0.65, 0.7, 0.75, 0.8])))
    wide = np.diff(edges)
    shells = theory.Shells(0.5 * (edges[1:] + edges[:-1]), wide, 0.25 / wide * bias(log_mass))
    c_l = theory.galaxy_power(FIDUCIAL, theory.ELL, shells)
    ell, variance, (kx, ky), phase = waves(rng, c_l)
    east, north = plane(ra, dec)
    g = np.cos(np.outer(east, kx) + np.outer(north, ky) + phase) * np.sqrt(2 * variance)
    dense = np.exp(g.sum(1))
    kept = rng.random(len(ra)) * np.percentile(dense, 99.9) < dense
    return {name: values[kept] for name, values in columns.items()}, (ell, variance)


def bias(log_mass):
    """Bias of halos at z = 0.7 from the formula of Tinker et al. 2010 for an overdensity of 200 times the mean."""
    from colossus.lss import bias as halo_bias

    theory.matter_power(FIDUCIAL, np.ones(1), 0.0, is_linear=True)
    return float(halo_bias.haloBias(10.0**log_mass, 0.7, mdef="200m", model="tinker10"))
