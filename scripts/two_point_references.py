"""Print two-point statistics of TreeCorr, NaMaster and CCL, with which the tests compare truesky.

    python -m scripts.two_point_references > tests/truesky/validation/two_point_references.csv

The packages treecorr, pymaster and pyccl must be installed. Their versions are in the first line of the file.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Array, Float, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.lazy_healpy import healpy as hp
from lake_schema.tables.survey.depth import ORDER
from truesky.catalogue.halos import matching
from truesky.cosmology import FIDUCIAL
from truesky.survey_maps import random_points
from truesky.survey_maps.depth_lookup import DepthMap
from truesky.validation import pseudo_power, theory
from truesky.validation.pseudo_power import L_MAX

STORED = Path(__file__).parents[1] / "tests" / "truesky" / "validation" / "two_point_references.csv"
PACKAGES = ("treecorr", "pymaster", "pyccl")
# Edges of the separations of points on the sky (arcmin) and in space (Mpc/h), and width of the fine bins along and
# across the line of sight from which multipoles are computed.
THETA, SEPARATION, FINE = np.geomspace(0.3, 20.0, 9), np.array([8.0, 16.0, 24.0, 32.0]), 1.0
# First multipole of each band of a power spectrum, and the one after the last; multipoles of theory.
BANDS, ELL = np.append(np.arange(2, 480, 40), L_MAX + 1), np.array([50.0, 100.0, 200.0, 400.0])
# Redshifts of the lenses of the expected spectra, and of their sources.
LENSES, SOURCE = (0.4, 0.6), 1.3


def points_with_holes() -> tuple[dict[str, Array], dict[str, Array]]:
    """Return "galaxies" and random points, both uniform, in an area with holes and half-covered pixels."""
    cells, pixels_a_cell = np.array([400_000, 400_001, 400_003]), 1 << 2 * (ORDER - GENERATION_ORDER)
    pixels = (cells[:, None] * pixels_a_cell + np.arange(pixels_a_cell)).ravel()
    pixels = pixels[(pixels // 64 % 5 > 0) & (pixels % 7 > 0)]
    covered = np.where(pixels // 256 % 2, 1.0, 0.5).astype(np.float32)
    depth = DepthMap("euclid_vis", pixels, {
        "depth_point": np.full(len(pixels), 26.0, np.float32), "mask": np.zeros(len(pixels), np.int16),
        "covered": covered,
    })  # fmt: skip
    galaxies, scattered = (
        random_points.draw_points(cells.tolist(), density, seed, depth) for density, seed in ((8.0, 2), (50.0, 1))
    )
    return galaxies, scattered


def clusters_in_space() -> tuple[Float, Int]:
    """Return positions (Mpc/h) in a distant box, and kinds: galaxies (0) in elongated clusters, random points (1)."""
    rng, side = np.random.default_rng(8), 140.0
    centre = rng.uniform(0.0, side, (80, 3))
    members = np.repeat(centre, 25, axis=0) + rng.standard_normal((2000, 3)) * np.array([12.0, 6.0, 6.0])
    scattered = rng.uniform(0.0, side, (6000, 3))
    place = np.concatenate([members % side, scattered]) + np.array([2000.0, -0.5 * side, -0.5 * side])
    return place, np.repeat([0, 1], [2000, 6000])


def masked_map() -> tuple[Float, Float]:
    """Return a mask, a circle with uneven weights, and a map of plane waves that is multiplied by it."""
    rng = np.random.default_rng(1)
    cells = sky.cells_in_cone(20.0, 50.0, 12.0, GENERATION_ORDER)
    weight = 0.5 + 0.5 * rng.random(len(cells))
    place, values = sky.unit_vectors(*sky.cell_centres(GENERATION_ORDER, cells)), np.zeros(len(cells))
    for number in np.geomspace(10.0, 400.0, 200):
        wave = rng.standard_normal(3)
        wave *= number / np.sqrt(np.sum(wave**2))
        values += np.cos(np.sum(wave * place, 1) + rng.uniform(0.0, 2.0 * np.pi)) * number / 400.0
    return pseudo_power.map_of_cells(cells, weight), pseudo_power.map_of_cells(cells, weight * values)


def lens_sample() -> tuple[Float, Float]:
    """Return redshifts and biases of galaxies in halos of one mass."""
    z, halos = np.linspace(*LENSES, 401), matching.masses(FIDUCIAL)
    return z, halos.interpolate_pairs(halos.bias, z, np.full(len(z), 12.5))


def read_values(quantity: str) -> Float:
    """Return the values of a quantity in the file, in its order."""
    lines = [line for line in STORED.read_text(encoding="ascii").splitlines() if not line.startswith("#")]
    return np.array([float(row["value"]) for row in csv.DictReader(lines) if row["quantity"] == quantity])


def rows() -> Iterator[str]:
    """Yield the lines of the file: versions of the packages, then name of the quantity, its argument, and its value."""
    yield f"# {', '.join(f'{name} {version(name)}' for name in PACKAGES)}; scripts/two_point_references.py"
    yield "quantity,at,value"
    for values in (_angular_correlation(), _multipoles(), _powers(), _expected_powers()):
        for quantity, at, value in values:
            yield f"{quantity},{at:.6g},{value:.8g}"


def _angular_correlation() -> Iterator[tuple[str, float, float]]:
    import treecorr

    places = [
        treecorr.Catalog(ra=points["ra"], dec=points["dec"], ra_units="deg", dec_units="deg")
        for points in points_with_holes()
    ]
    settings = {"min_sep": THETA[0], "max_sep": THETA[-1], "nbins": len(THETA) - 1, "sep_units": "arcmin"}
    counts = [treecorr.NNCorrelation(**settings, bin_slop=0.0, metric="Euclidean") for _ in range(3)]
    for count, pair in zip(counts, ((0,), (1,), (0, 1)), strict=True):
        count.process(*(places[i] for i in pair))
    w, variance = counts[0].calculateXi(rr=counts[1], dr=counts[2])
    for i, at in enumerate(np.sqrt(THETA[1:] * THETA[:-1])):
        yield "w", at, w[i]
        yield "w_error", at, float(np.sqrt(variance[i]))


def _multipoles() -> Iterator[tuple[str, float, float]]:
    """Yield xi_0 and xi_2: means over fine bins along and across the line of sight, weighted by their volume."""
    import treecorr

    place, kind = clusters_in_space()
    points = [treecorr.Catalog(**dict(zip("xyz", place[kind == code].T, strict=True))) for code in (0, 1)]
    size = round(SEPARATION[-1] / FINE)

    def pair_fractions(*pair: int) -> Float:
        """Return the fractions of pairs by distance along and across the line of sight."""
        below = [np.zeros(size)]
        for number in range(1, size + 1):
            counts = treecorr.NNCorrelation(
                bin_type="Linear", min_sep=0.0, max_sep=SEPARATION[-1], nbins=size, metric="FisherRperp", bin_slop=0.0,
                min_rpar=-number * FINE, max_rpar=number * FINE,
            )  # fmt: skip
            counts.process(*(points[i] for i in pair))
            below.append(counts.npairs / _all_pairs(*(points[i].ntot for i in pair)))
        return np.diff(below, axis=0)

    by_chance = pair_fractions(1, 1)
    xi = (pair_fractions(0, 0) - 2.0 * pair_fractions(0, 1)) / by_chance + 1.0
    middle = (np.arange(size) + 0.5) * FINE
    along, across = middle[:, None], middle[None, :]
    s = np.sqrt(along**2 + across**2)
    quadrupole = 1.5 * (along / s) ** 2 - 0.5
    for first, last in pairwise(SEPARATION):
        weight = across * ((s >= first) & (s < last))
        for name, legendre in (("xi_0", np.ones_like(s)), ("xi_2", 5.0 * quadrupole)):
            yield name, 0.5 * (first + last), float(np.sum(weight * legendre * xi) / weight.sum())


def _all_pairs(first: int, second: int) -> float:
    """Return the number of all pairs as TreeCorr counts them: twice in one catalogue."""
    return float(first * (first - 1)) if first == second else float(first * second)


def _powers() -> Iterator[tuple[str, float, float]]:
    import pymaster

    mask, values = masked_map()
    settings = {
        "lmax": L_MAX, "lmax_mask": 3 * hp.get_nside(mask) - 1, "n_iter": 3, "n_iter_mask": 3, "masked_on_input": True,
    }  # fmt: skip
    field, workspace = pymaster.NmtField(mask, [values], **settings), pymaster.NmtWorkspace()
    workspace.compute_coupling_matrix(field, field, pymaster.NmtBin.from_edges(BANDS[:-1], BANDS[1:]))
    power = workspace.decouple_cell(pymaster.compute_coupled_cell(field, field))[0]
    windows = workspace.get_bandpower_windows()[0, :, 0]
    middle = 0.5 * (BANDS[1:] + BANDS[:-1] - 1)
    for i, at in enumerate(middle):
        yield "power", at, power[i]
    for i, at in enumerate(middle):
        yield "window", at, windows[i, round(at)]


def _expected_powers() -> Iterator[tuple[str, float, float]]:
    """Yield spectra of galaxies and convergence; CCL has truesky's matter power, so that only projections differ."""
    import pyccl

    h, k, a = FIDUCIAL.h, np.geomspace(1e-4, 30.0, 500), 1.0 / (1.0 + np.linspace(0.0, 2.0, 41)[::-1])
    power = np.array([theory.matter_power(FIDUCIAL, k, 1.0 / scale_factor - 1.0) for scale_factor in a])
    surface = pyccl.Pk2D(a_arr=a, lk_arr=np.log(k * h), pk_arr=np.log(power / h**3), is_logp=True)
    universe = pyccl.Cosmology(
        Omega_c=FIDUCIAL.omega_m - FIDUCIAL.omega_b, Omega_b=FIDUCIAL.omega_b, h=h, sigma8=FIDUCIAL.sigma_8,
        n_s=FIDUCIAL.n_s, transfer_function="eisenstein_hu", Omega_g=0.0, Neff=0.0,
    )  # fmt: skip
    grid = np.linspace(LENSES[0] - 0.1, LENSES[1] + 0.1, 800)
    inside = ((grid > LENSES[0]) & (grid < LENSES[1])).astype(float)
    galaxies = pyccl.NumberCountsTracer(
        universe, has_rsd=False, dndz=(grid, inside), bias=(grid, np.interp(grid, *lens_sample()))
    )
    source_z = np.linspace(SOURCE - 0.01, SOURCE + 0.01, 200)
    lensed = pyccl.WeakLensingTracer(universe, dndz=(source_z, np.ones(200)))
    # CCL has the prefactor of shear, where convergence has 1.
    shear = np.sqrt((ELL + 2.0) * (ELL + 1.0) * ELL * (ELL - 1.0)) / (ELL + 0.5) ** 2
    for name, other, factor in (("galaxy_power", galaxies, 1.0), ("galaxy_convergence_power", lensed, shear)):
        values = pyccl.angular_cl(universe, galaxies, other, ELL, p_of_k_a=surface) / factor
        yield from ((name, at, value) for at, value in zip(ELL, values, strict=True))


if __name__ == "__main__":
    print("\n".join(rows()))
