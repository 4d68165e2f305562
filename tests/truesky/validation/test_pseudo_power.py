"""Power spectra with a mask: the coupling of multipoles, and Gaussian maps of known power."""

import math

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from lake_schema.lazy_healpy import healpy as hp
from scripts import two_point_references
from tests.truesky import nightly
from truesky.validation import pseudo_power
from truesky.validation.pseudo_power import L_MAX

NSIDE = 1 << GENERATION_ORDER
EDGES = np.append(np.arange(2, 480, 40), L_MAX + 1)


@pytest.fixture(scope="module")
def cap():
    """A circle with a radius of 12 deg and uneven weights."""
    cells = sky.cells_in_cone(20.0, 50.0, 12.0, GENERATION_ORDER)
    return pseudo_power.map_of_cells(cells, 0.5 + 0.5 * np.random.default_rng(1).random(len(cells)))


def squared_3j(a, b, c):
    """Square of the Wigner 3j symbol of a, b, c with orders 0, from factorials."""
    total = a + b + c
    if total % 2 or not abs(a - b) <= c <= a + b:
        return 0.0
    half, log = total // 2, math.lgamma
    first = log(total - 2 * a + 1) + log(total - 2 * b + 1) + log(total - 2 * c + 1) - log(total + 2)
    second = log(half + 1) - log(half - a + 1) - log(half - b + 1) - log(half - c + 1)
    return math.exp(first + 2.0 * second)


def test_coupling_is_the_sum_over_3j_symbols():
    power = np.random.default_rng(2).random(18)
    found = pseudo_power.coupling_matrix(power, 10)
    for row in range(11):
        for column in range(11):
            terms = [(2 * n + 1) * power[n] * squared_3j(row, column, n) for n in range(18)]
            wanted = (2 * column + 1) / (4.0 * np.pi) * sum(terms)
            assert found[row, column] == pytest.approx(wanted, rel=1e-9, abs=1e-13)


def test_the_whole_sky_couples_nothing():
    power = np.zeros(20)
    power[0] = 4.0 * np.pi
    np.testing.assert_allclose(pseudo_power.coupling_matrix(power, 12), np.eye(13), atol=1e-12)


def test_window_of_cells_is_that_of_averaged_maps():
    """The averaged map has values at the centres of cells of order 10, whose window is that of larger scales."""
    ell = np.arange(L_MAX + 1)
    np.random.seed(9)  # noqa: NPY002 (healpy draws from the global state)
    fine = hp.alm2map(hp.synalm(1.0 / (ell + 10.0) ** 2, L_MAX), 4 * NSIDE, L_MAX)
    coarse = hp.ud_grade(fine, NSIDE)
    ratio = pseudo_power.power_of_maps(coarse) / hp.anafast(fine, lmax=L_MAX, iter=0)
    smoothed = np.convolve(ratio, np.ones(20) / 20.0, "valid")[::40]
    window = pseudo_power.pixel_window()
    wanted = np.convolve((window / np.interp(ell / 4.0, ell, window)) ** 2, np.ones(20) / 20.0, "valid")[::40]
    np.testing.assert_allclose(smoothed, wanted, atol=0.01)
    assert wanted[-1] < 0.9


def test_constant_power_has_the_same_value_in_all_bands(cap):
    """White noise stays white, except at l = 0 and 1, which are in no band, and near l = 512, where the bands end."""
    bands = pseudo_power.bands(cap, cap, EDGES)
    np.testing.assert_allclose(bands.expect(np.ones(L_MAX + 1))[1:-2], 1.0, atol=2e-3)
    assert bands.middle[1] == 61.5


@pytest.mark.parametrize("degree", [0, 4])
def test_subtracted_means_remove_power_on_the_scales_of_the_mask(degree):
    """Slow reference: the masked spectra of all harmonics of one l, whose weighted means are subtracted."""
    nside, near = 32, [sky.cells_in_cone(20.0, 50.0, radius, 5) for radius in (18.0, 25.0)]
    masks = np.zeros((2, 12 * nside**2))
    for mask, cells in zip(masks, near, strict=True):
        mask[hp.nest2ring(nside, cells)] = 0.5 + 0.5 * np.random.default_rng(1).random(len(cells))
    mean = np.zeros((2, L_MAX + 1))
    mean[0, 2:12], mean[1, 12:40] = 1.0 / 10.0, 1.0 / 28.0
    lost = np.zeros(2)
    for m in range(degree + 1):
        for phase in (1.0, 1.0j)[: 1 + (m > 0)]:
            alm = np.zeros(hp.Alm.getsize(degree), complex)
            alm[hp.Alm.getidx(degree, degree, m)] = phase if m == 0 else phase / np.sqrt(2.0)
            mode = hp.alm2map(alm, nside, degree)
            maps = masks * mode
            centred = [own - mask * own.sum() / mask.sum() for own, mask in zip(maps, masks, strict=True)]
            both = [hp.anafast(*pair, lmax=3 * nside - 1, iter=3) for pair in (maps, centred)]
            lost += np.sum(mean[:, : 3 * nside] * (both[0] - both[1]), axis=1)
    found = pseudo_power.removed_by_means(*masks, mean)[:, degree]
    np.testing.assert_allclose(found, lost, rtol=2e-3, atol=1e-3 * np.abs(lost).max())
    assert np.abs(lost).min() > 0.0


def legendre(x):
    """Generate the Legendre polynomials of order 0 to L_MAX."""
    before, now = np.zeros_like(x), np.ones_like(x)
    for order in range(L_MAX + 1):
        yield now
        before, now = now, ((2 * order + 1) * x * now - order * before) / (order + 1)


@nightly.parametrize("maps", [200, 3000], (0,))
def test_mean_and_covariance_in_a_small_field(maps):
    """Sample: 200 or 3000 Gaussian maps in 13 deg2, 5 bands; the significance of the means is 6e-7 (5 standard errors).

    Sums over pairs of cells give the spectra of masked maps. The covariance is that of spectra that change little
    within the resolution of the mask: it may differ from the scatter by 50 %.
    """
    cells = sky.cells_in_cone(40.0, 20.0, 1.9, GENERATION_ORDER)
    place = sky.unit_vectors(*sky.cell_centres(GENERATION_ORDER, cells))
    cosine = np.clip(np.sum(place[:, None] * place, axis=-1), -1.0, 1.0)
    c_l = 1e-3 / (np.arange(L_MAX + 1) + 20.0) ** 1.5
    factors = (2.0 * np.arange(L_MAX + 1) + 1.0) * c_l / (4.0 * np.pi)
    correlation = sum(factor * one for factor, one in zip(factors, legendre(cosine), strict=True))
    values, vectors = np.linalg.eigh(correlation)
    deviates = np.random.default_rng(4).standard_normal((maps, len(cells)))
    fields = (deviates * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    fields -= fields.mean(axis=1)[:, None]
    mask = pseudo_power.map_of_cells(cells, np.ones(len(cells)))
    edges = np.array([2, 100, 150, 200, 250, 300, 350, 400, L_MAX + 1])
    bands, area = pseudo_power.bands(mask, mask, edges, is_centred=True), 4.0 * np.pi / len(mask)
    pseudo = np.stack([np.sum(fields @ one * fields, axis=1) for one in legendre(cosine)], axis=1)
    found = np.array([bands.measure(one * area**2 / (4.0 * np.pi)) for one in pseudo])[:, 1:6]
    total = bands.mix(c_l) / np.mean(mask)
    error = np.sqrt(np.diag(bands.covariance(total, total, total)))[1:6]
    expected, scatter = bands.expect(c_l)[1:6], found.std(axis=0)
    assert np.all(np.abs(found.mean(axis=0) - expected) < 5.0 * scatter / np.sqrt(maps))
    np.testing.assert_allclose(scatter, error, rtol=0.5)


@nightly.parametrize("seeds", [(11, 12, 13), range(20, 40)], (0,))
def test_masked_gaussian_maps_have_their_power(cap, seeds):
    """Sample: 3 or 20 maps, 12 bands; significance 1e-4 of chi squared with the errors of Gaussian fields."""
    from scipy.stats import chi2

    ell = np.arange(3 * NSIDE)
    c_l = 1e-5 / (ell + 20.0) ** 1.5
    bands = pseudo_power.bands(cap, cap, EDGES)
    found = []
    for seed in seeds:
        np.random.seed(seed)  # noqa: NPY002 (healpy draws from the global state)
        values = hp.synfast(c_l, NSIDE, lmax=3 * NSIDE - 1)
        found.append(bands.measure(pseudo_power.power_of_maps(values * cap)))
    expected = bands.expect(c_l[: L_MAX + 1])
    number = np.diff(EDGES.astype(float) ** 2) * np.mean(cap**2) ** 2 / np.mean(cap**4)
    pull = (np.mean(found, 0) / expected - 1.0) / np.sqrt(2.0 / number / len(seeds))
    # Neighbouring bands are not independent and the power beyond l = 512 couples to the last one.
    assert np.sum(pull[1:-1] ** 2) < chi2.isf(1e-4, len(pull) - 2) * 1.3
    assert abs(np.mean(pull[1:-1])) < 2.0


def test_power_and_windows_are_those_of_namaster():
    mask, values = two_point_references.masked_map()
    bands = pseudo_power.bands(mask, mask, two_point_references.BANDS)
    power = bands.measure(pseudo_power.power_of_maps(values))
    np.testing.assert_allclose(power, two_point_references.read_values("power"), rtol=1e-6, atol=1e-10)
    at = np.rint(bands.middle).astype(int)
    found = bands.windows[np.arange(len(at)), at]
    np.testing.assert_allclose(found, two_point_references.read_values("window"), rtol=1e-6)
