"""Power spectra with a mask: the coupling of multipoles, and Gaussian maps of known power."""

import math

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from lake_schema.lazy_healpy import healpy as hp
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


def test_windows_are_those_of_pymaster(cap):
    nmt = pytest.importorskip("pymaster")
    settings = {"lmax": L_MAX, "lmax_mask": 3 * NSIDE - 1, "n_iter": 3, "n_iter_mask": 3}
    masked, workspace = nmt.NmtField(cap, [np.zeros_like(cap)], **settings), nmt.NmtWorkspace()
    workspace.compute_coupling_matrix(masked, masked, nmt.NmtBin.from_edges(EDGES[:-1], EDGES[1:]))
    wanted = workspace.get_bandpower_windows()[0, :, 0]
    np.testing.assert_allclose(pseudo_power.bands(cap, cap, EDGES).windows, wanted, atol=1e-12)
