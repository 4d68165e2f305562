"""Multipoles in redshift space: pairs of positions, unclustered points, and a field with known anisotropy."""

from itertools import pairwise

import numpy as np
import pytest

from scripts import two_point_references
from tests.truesky import nightly
from truesky.cosmology import FIDUCIAL
from truesky.validation import pairs, redshift_space, theory

EDGES = np.array([20.0, 30.0, 40.0])


def test_counts_are_those_of_all_pairs():
    rng = np.random.default_rng(3)
    place = rng.uniform(-1.0, 1.0, (300, 3)) * 30.0 + np.array([900.0, 200.0, -100.0])
    kind, patch = rng.integers(0, 2, 300), rng.integers(0, 4, 300)
    edges, angles = np.array([2.0, 10.0, 25.0]), 5
    found = pairs.count_pairs_in_space(place, kind, patch, edges, angles)
    wanted, without = np.zeros((3, 2, angles)), np.zeros((4, 3, 2, angles))
    for i in range(300):
        for j in range(i):
            step, middle = place[i] - place[j], place[i] + place[j]
            length = np.sqrt(np.sum(step**2))
            if edges[0] <= length < edges[-1]:
                mu = abs(np.sum(step * middle)) / length / np.sqrt(np.sum(middle**2))
                at = kind[i] + kind[j], int(length >= edges[1]), int(mu * angles)
                wanted[at] += 1
                for one in range(4):
                    without[one][at] += one not in (patch[i], patch[j])
    np.testing.assert_array_equal(found.total.reshape(3, 2, angles), wanted)
    np.testing.assert_array_equal(found.jackknife.reshape(4, 3, 2, angles), without)
    assert wanted.sum() > 1000


def test_multipoles_are_those_of_treecorr():
    """TreeCorr counts pairs by both distances, in bins of 1 Mpc/h; ours are bins of separation and angle."""
    place, kind = two_point_references.clusters_in_space()
    edges = two_point_references.SEPARATION
    (mono, quad), _ = redshift_space.measure_multipoles(place, kind, np.zeros(len(kind), int), edges)
    assert mono == pytest.approx(two_point_references.read_values("xi_0"), rel=0.025, abs=0)
    assert quad == pytest.approx(two_point_references.read_values("xi_2"), rel=0.0, abs=0.012)
    assert mono[0] > 0.3
    assert quad[0] > 0.3


def test_correlation_of_matter_agrees_with_its_power_on_large_scales():
    """The rms in spheres of 8 Mpc/h follows from xi, too."""
    r, xi = redshift_space.matter_correlation(FIDUCIAL, 0.0)
    x = np.minimum(r / 16.0, 1.0)
    overlap = 3.0 * r**2 / 8.0**3 * (1.0 - 1.5 * x + 0.5 * x**3) * (r < 16.0)
    assert np.sqrt(np.trapezoid(overlap * xi, r)) == pytest.approx(FIDUCIAL.sigma_8, rel=0.01)


def test_factors_of_kaiser():
    """Hamilton 1992 for b = 1: (1 + 2/3 f + 1/5 f^2) and (4/3 f + 4/7 f^2)."""
    assert redshift_space.kaiser_factors(1.0, 0.5) == pytest.approx((1.0 + 1.0 / 3.0 + 0.05, 2.0 / 3.0 + 1.0 / 7.0))
    assert redshift_space.kaiser_factors(2.0, 0.0) == (4.0, 0.0)


def test_unclustered_points_have_no_multipoles():
    """Sample: 10,000 points and 20,000 random points in 16 patches; significance 1e-4 for each (5 jackknife errors)."""
    rng = np.random.default_rng(4)
    place = rng.uniform(0.0, 300.0, (30_000, 3)) + np.array([1000.0, 0.0, 0.0])
    kind = np.repeat([0, 1], [10_000, 20_000])
    patch = (place[:, 1] // 75.0).astype(int) * 4 + (place[:, 2] // 75.0).astype(int)
    value, jackknife = redshift_space.measure_multipoles(place, kind, patch, EDGES)
    error = np.sqrt(15.0 / 16.0 * np.sum((jackknife - jackknife.mean(0)) ** 2, 0))
    assert np.all(np.abs(value) < 5.0 * error)
    assert error.max() < 0.02


BIAS, GROWTH, Z = 1.5, float(FIDUCIAL.growth_rate(0.5)), 0.5


def grid_power(shape, step, smoothing, bias=BIAS):
    """Power (bias + GROWTH mu^2)^2 P(k) of a smoothed periodic field, with the line of sight along the first axis."""
    kx, ky = (2.0 * np.pi * np.fft.fftfreq(n, step) for n in shape[:2])
    kz = 2.0 * np.pi * np.fft.rfftfreq(shape[2], step)
    k2 = kx[:, None, None] ** 2 + ky[None, :, None] ** 2 + kz**2
    k = np.sqrt(np.where(k2 > 0.0, k2, 1.0))
    nodes = np.geomspace(1e-3, 10.0, 300)
    power = np.exp(np.interp(np.log(k), np.log(nodes), np.log(theory.matter_power(FIDUCIAL, nodes, Z, True))))
    anisotropy = (bias + GROWTH * kx[:, None, None] ** 2 / k**2) ** 2
    return power * np.exp(-((k * smoothing) ** 2)) * anisotropy * (k2 > 0.0)


def transformed(modes, shape):
    return np.fft.irfftn(modes, shape, axes=(0, 1, 2))


def multipoles_of_grid(xi, step, edges):
    """xi_0 and xi_2 of a correlation function on a periodic grid, averaged over the cells in each shell."""
    axis = np.fft.fftfreq(len(xi), 1.0 / len(xi)) * step
    x, y, z = axis[:, None, None], axis[None, :, None], axis[None, None, :]
    r = np.sqrt(x**2 + y**2 + z**2)
    quadrupole = 1.5 * x**2 / np.maximum(r, step) ** 2 - 0.5
    shells = [(r >= low) & (r < high) for low, high in pairwise(edges)]
    return np.array([[np.mean((xi * weight)[shell]) for shell in shells] for weight in (1.0, 5.0 * quadrupole)])


def test_linear_theory_is_that_of_a_field_of_waves():
    """The largest wave of the box is 900 Mpc/h long, and the field is smoothed, which changes xi by a few per cent."""
    shape, step = (180,) * 3, 5.0
    found = multipoles_of_grid(transformed(grid_power(shape, step, 3.0), shape) / step**3, step, EDGES)
    np.testing.assert_allclose(found, redshift_space.expected_multipoles(FIDUCIAL, Z, BIAS, EDGES), rtol=0.08)


def lognormal_points(seed, shape, step, number, bias=BIAS):
    """Points in a box whose density is the exponential of a Gaussian field, and their xi on the grid."""
    rng = np.random.default_rng(seed)
    power = grid_power(shape, step, 4.0, bias)
    density = np.exp(transformed(np.fft.rfftn(rng.standard_normal(shape)) * np.sqrt(power / step**3), shape))
    count = rng.poisson(density * number / density.sum())
    at = np.repeat(np.stack(np.unravel_index(np.arange(count.size), shape), 1), count.ravel(), 0)
    return (at + rng.random(at.shape)) * step, np.expm1(transformed(power, shape) / step**3)


@nightly.parametrize("seeds", [range(3), range(24)], (0,))
def test_anisotropy_is_that_of_the_field(seeds):
    """Sample: 3 or 24 boxes of 320 Mpc/h at 20 to 40 Mpc/h; significance 6e-5 for each (4 standard deviations).

    The standard deviations of a box, 0.22 and 0.15, are measured with 6 boxes.
    """
    side, values, wanted, far = 320.0, [], np.zeros(1), np.array([1e5, 0.0, 0.0])
    for seed in seeds:
        place, xi = lognormal_points(seed, (64,) * 3, side / 64, 15_000)
        wanted = multipoles_of_grid(xi, side / 64, EDGES)
        random = np.random.default_rng(100 + seed).uniform(0.0, side, (30_000, 3))
        both = np.concatenate([place, random]) + far
        kind = np.repeat([0, 1], [len(place), len(random)])
        values.append(redshift_space.measure_multipoles(both, kind, np.zeros(len(both), int), EDGES)[0])
    mono, quad = np.mean(values, 0).mean(1) / wanted.mean(1)
    assert abs(mono - 1.0) < 4.0 * 0.22 / np.sqrt(len(seeds))
    assert abs(quad - 1.0) < 4.0 * 0.15 / np.sqrt(len(seeds))
