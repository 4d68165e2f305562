"""Counts of pairs against a loop over all pairs, at right ascension 0 and at the poles."""

from types import SimpleNamespace

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from truesky.validation import field as fields
from truesky.validation import pairs, two_points
from truesky.validation.two_points import ARCMIN, TwoPointFunction

EDGES = np.radians([0.01, 0.1, 0.3, 0.8])


def around(rng, ra, dec, n=150):
    """Random positions within 1 deg."""
    east, north = np.radians(rng.uniform(-0.7, 0.7, (2, n)))
    ra, dec = sky.offset_positions(np.full(n, ra), np.full(n, dec), east, north)
    return sky.wrap_angle(ra), dec


@pytest.mark.parametrize("centre", [(0.0, 12.0), (0.0, 90.0), (77.0, -90.0), (180.0, 0.0)])
def test_every_pair_is_counted_once(centre):
    rng = np.random.default_rng(2)
    ra, dec = around(rng, *centre)
    kind, patch = rng.integers(0, 2, 150), rng.integers(0, 3, 150)
    found = pairs.count_pairs(sky.unit_vectors(ra, dec), kind, patch, EDGES)
    one, other = np.triu_indices(150, 1)
    apart = np.radians(sky.separation(ra[one], dec[one], ra[other], dec[other]))
    for left_out in (None, 0, 1, 2):
        here = np.ones(len(one), bool) if left_out is None else (patch[one] != left_out) & (patch[other] != left_out)
        sums = found.total if left_out is None else found.jackknife[left_out]
        for k in range(3):
            assert sums[k].tolist() == np.histogram(apart[here & (kind[one] + kind[other] == k)], EDGES)[0].tolist()


@pytest.mark.parametrize("centre", [(0.0, 0.0), (0.0, 89.9), (120.0, -90.0)])
def test_shear_about_a_mass_is_tangential_everywhere(centre):
    """The convergence is at one position only; gamma_t is that of all others, and gamma_x is 0 in any frame."""
    rng = np.random.default_rng(3)
    ra, dec = around(rng, *centre)
    ra[0], dec[0] = centre
    frame = pairs.frames(ra, dec)
    towards = np.einsum("nij,j->ni", frame[:, :2], frame[0, 2])
    twice = 2.0 * np.arctan2(towards[:, 1], towards[:, 0])
    shear = np.stack([-0.03 * np.cos(twice), -0.03 * np.sin(twice), np.zeros(150)], 1)
    shear[0] = 0.0, 0.0, 1.0
    found = pairs.sum_shear_products(ra, dec, shear, np.zeros(150, int), EDGES)
    apart = np.radians(sky.separation(ra[0], dec[0], ra[1:], dec[1:]))
    number = np.histogram(apart, EDGES)[0]
    assert found.total[5] == pytest.approx(0.5 * 0.03 * number, abs=1e-9)
    assert found.total[6] == pytest.approx(np.zeros(3), abs=1e-9)
    assert found.total[0].sum() > number.sum() > 50


def test_uniform_shear_is_plus_alone():
    ra, dec = around(np.random.default_rng(4), 0.0, 0.0)
    shear = np.tile([0.02, -0.01, 0.0], (150, 1))
    found = pairs.sum_shear_products(ra, dec, shear, np.zeros(150, int), EDGES)
    assert found.total[1] / found.total[0] == pytest.approx(np.full(3, 5e-4), rel=1e-3, abs=0.0)


def test_thinning_is_by_identifiers_and_as_much_as_is_wanted():
    ra, dec = around(np.random.default_rng(5), 30.0, 40.0, 2000)
    place, ids = sky.unit_vectors(ra, dec), np.arange(2000) + (1 << 58)
    kept = pairs.thin_sample(ids, place, EDGES[-1], 5e5)
    assert pairs.thin_sample(ids, place, EDGES[-1], 1e9).all()
    assert 400 < kept.sum() < 1400
    order = np.random.default_rng(6).permutation(2000)
    assert (pairs.thin_sample(ids[order], place[order], EDGES[-1], 5e5) == kept[order]).all()


def test_errors_of_patches_are_those_of_a_mean():
    values = np.random.default_rng(7).normal(size=(16, 400))
    without = (values.sum(0) - values) / 15
    assert np.mean(fields.jackknife_error(without)) == pytest.approx(0.25, rel=0.05)
    assert np.isnan(fields.jackknife_error(without[:4])).all()


def test_a_catalogue_that_does_not_say_where_it_was_drawn_is_where_its_sources_are():
    cells = np.arange(4096, 4096 + 32)
    index = np.concatenate(
        [sky.random_in_cell(GENERATION_ORDER + 2, int(c), 600, np.random.default_rng(1))[0] for c in cells]
    )

    silent = SimpleNamespace(manifest={"parts": [{"facts": {}}]})
    found = fields.from_version(silent, index)
    assert found.order > GENERATION_ORDER + 1
    assert found.n_patches <= 2
    assert found.area == pytest.approx(32 * sky.cell_area(GENERATION_ORDER + 2), rel=0.02)
    assert fields.from_version(silent, index[:0]).patch_of(index[:3]).tolist() == [-1, -1, -1]


def test_wide_bins_are_of_their_narrow_ones():
    edges, number = np.array([0.0, 1.0, 2.0, 4.0, 8.0]) * ARCMIN, np.array([0.0, 2.0, 6.0, 5.0])
    fine = TwoPointFunction(
        edges, number, np.array([[np.nan, 1.0, 3.0, 7.0]]), np.array([[[np.nan, 1.0, 3.0, 7.0]]] * 8)
    )
    wide = two_points.rebin(fine, edges[[1, 3, 4]])
    assert wide.value.tolist() == [[2.5, 7.0]]
    assert wide.number.tolist() == [8.0, 5.0]


def test_products_of_values_are_summed_by_separation():
    ra, dec = around(np.random.default_rng(8), 0.0, 89.8)
    values = np.random.default_rng(9).normal(size=(150, 2))
    number, separation, product = pairs.sum_products(sky.unit_vectors(ra, dec), values, EDGES)
    one, other = np.triu_indices(150, 1)
    apart = np.radians(sky.separation(ra[one], dec[one], ra[other], dec[other]))
    assert number.tolist() == np.histogram(apart, EDGES)[0].tolist()
    assert separation == pytest.approx(np.histogram(apart, EDGES, weights=apart)[0], rel=1e-9)
    for kind in range(2):
        both = values[one, kind] * values[other, kind]
        assert product[kind] == pytest.approx(np.histogram(apart, EDGES, weights=both)[0], abs=1e-9)
