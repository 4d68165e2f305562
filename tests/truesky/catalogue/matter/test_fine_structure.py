"""Structure below the voxels: a slow reference, statistics of the noise, and weights and positions of halos."""

from dataclasses import replace
from functools import partial

import healpy as hp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from truesky.catalogue.matter import fine_structure, lightcone
from truesky.cosmology import FIDUCIAL
from truesky.randomness import rng as random_bits

SEED = 7
few = settings(max_examples=20, deadline=None)
fractions = st.tuples(*[st.floats(0.0, 0.999)] * 3)


def structure_with_octaves(count, seed=SEED):
    """Return a structure with only the first octaves, without the check of the variance."""
    whole = fine_structure.model(seed)
    return replace(
        whole,
        keys=whole.keys[:count],
        scatter=np.ones(count) / np.sqrt(count),
        parameters=replace(whole.parameters, steps=whole.parameters.steps[:count]),
    )


def at(structure, place):
    """Return G at positions of shape (3, n), Mpc/h."""
    chi = np.sqrt(np.sum(place**2, 0))
    return fine_structure.values(structure, place / chi, chi)


def reference_hash(bits):
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        bits = (bits ^ bits >> shift) * factor % 2**32
    return bits ^ bits >> 16


def reference_value(structure, vector, chi):
    """Compute G at one position with integers of Python."""
    total = 0.0
    for (key_1, key_2), step, scatter in zip(
        structure.keys.tolist(), structure.parameters.steps, structure.scatter, strict=True
    ):
        place = vector * (chi * (1.0 / step)) + 65536.0
        corner = np.floor(place).astype(int)
        part, mean, variance = place - corner, 0.0, 0.0
        for i, j, k in np.ndindex(2, 2, 2):
            x, y, z = (corner + np.array([i, j, k])).tolist()
            bits = reference_hash(reference_hash(reference_hash((x + key_1) % 2**32) ^ (y + key_2) % 2**32) ^ z)
            share = np.prod(np.where([i, j, k], part, 1.0 - part))
            mean += share * sum(bits.to_bytes(4, "little"))
            variance += share**2
        total += scatter * (mean - 510.0) / np.sqrt(4 * (256**2 - 1) / 12 * variance)
    return total


@few
@given(st.integers(0, 2**63 - 1), st.integers(0, 2**32 - 1))
def test_the_compiled_field_agrees_with_the_reference(seed, number):
    rng = np.random.default_rng(number)
    vector, chi = np.stack(hp.ang2vec(np.pi * rng.random(20), 2 * np.pi * rng.random(20)), -1), 6500.0 * rng.random(20)
    structure = fine_structure.model(seed)
    expected = [reference_value(structure, vector[:, i], chi[i]) for i in range(20)]
    assert fine_structure.values(structure, vector, chi) == pytest.approx(expected, abs=1e-9)


@few
@given(fractions, st.integers(0, 2**63 - 1))
def test_mean_0_and_variance_1_at_each_place_in_a_lattice_cell(fraction, seed):
    """Positions that differ by whole lattice steps.

    Significance 6e-7 (5 standard errors) for the 4,096 independent values of one fraction and seed.
    """
    structure = structure_with_octaves(1, seed)
    corner = 2.0 * np.stack(np.meshgrid(*[np.arange(50.0, 66.0)] * 3)).reshape(3, -1)
    value = at(structure, structure.parameters.steps[0] * (corner + np.array(fraction)[:, None]))
    assert value.mean() == pytest.approx(0.0, abs=5.0 / 64.0)
    # The kurtosis of a value is at most 3.
    assert value.var() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0) / 64.0)


@few
@given(fractions, st.integers(0, 2), st.integers(-1000, 1000))
def test_the_field_is_continuous_across_lattice_borders(fraction, axis, border):
    structure = fine_structure.model(SEED)
    for step in structure.parameters.steps:
        place = step * (np.array(fraction) + np.array([300.0, -500.0, 700.0]))[:, None] * np.ones(3)
        place[axis] = step * (border + np.array([-1e-6, 0.0, 1e-6]))
        assert np.ptp(at(structure, place)) < 1e-4


@few
@given(fractions, st.integers(0, 2), st.floats(2.0, 6.0))
def test_no_correlation_beyond_two_lattice_steps(fraction, axis, apart):
    """And a correlation above 0.5 at a third of a step. Significance 6e-7 for 4,096 independent pairs of values."""
    structure = structure_with_octaves(1)
    corner = 4.0 * np.stack(np.meshgrid(*[np.arange(50.0, 66.0)] * 3)).reshape(3, -1)
    place, step = corner + np.array(fraction)[:, None], structure.parameters.steps[0]
    far, near = place.copy(), place.copy()
    far[axis] += apart
    near[axis] += 1.0 / 3.0
    value = at(structure, step * place)
    assert np.mean(value * at(structure, step * far)) == pytest.approx(0.0, abs=5.0 / 64.0)
    assert np.mean(value * at(structure, step * near)) > 0.5


def test_seeds_and_octaves_are_independent(rng):
    """Significance 6e-7 (5 standard errors) for 30,000 positions that are mostly in different lattice cells."""
    place = rng.uniform(-4000.0, 4000.0, (3, 30_000))
    first, second = (fine_structure.model(seed) for seed in (SEED, SEED + 1))
    octave = replace(first, keys=first.keys[1:], scatter=np.ones(1), parameters=replace(first.parameters, steps=(3.3,)))
    base = at(structure_with_octaves(1), place)
    assert np.mean(base * at(structure_with_octaves(1, SEED + 1), place)) == pytest.approx(0.0, abs=5.0 / 30_000**0.5)
    assert np.mean(base * at(octave, place)) == pytest.approx(0.0, abs=5.0 / 30_000**0.5)
    assert not np.array_equal(at(first, place), at(second, place))


def test_the_norm_is_the_mean_of_the_exponential(rng):
    """At 200,000 positions (5 standard errors), and from the 256 bytes at 3,000 places in a lattice cell."""
    structure = fine_structure.model(SEED)
    value = at(structure, rng.uniform(-4000.0, 4000.0, (3, 200_000)))
    part = rng.random((3, 3000))
    near = [np.where(np.array(corner)[:, None], part, 1.0 - part) for corner in np.ndindex(2, 2, 2)]
    corners = np.stack([np.prod(share, 0) for share in near])
    corners /= np.sqrt(np.sum(corners**2, 0))
    byte = (np.arange(256) - 127.5) / np.sqrt(4 * (256**2 - 1) / 12)
    for amplitude, norm in zip(structure.amplitude, structure.norm, strict=True):
        weight = np.exp(amplitude * value)
        assert weight.mean() == pytest.approx(norm, rel=5.0 * weight.std() / norm / 200_000**0.5)
        expected = 1.0
        for scatter in structure.scatter:
            factor = amplitude * scatter * corners
            expected *= np.mean(np.prod(np.mean(np.exp(factor[..., None] * byte), -1) ** 4, 0))
        assert norm == pytest.approx(expected, rel=3e-4)
        # The exponential of a Gaussian has a larger mean.
        assert 0.99 < norm / np.exp(0.5 * amplitude**2) < 0.999


@pytest.fixture(scope="module")
def divided(box):
    """Voxels of an order-8 cell and their subvoxels."""
    table = lightcone.distance_table(FIDUCIAL, 3.0)
    steps = lightcone.radial_steps(box.model.cell, 6.0, float(table.chi[-1]), table)
    used = np.arange(steps.z.size) % 7 == 0
    voxels = lightcone.voxels(box, lightcone.draw_replicas(box, float(table.chi[-1])), steps, 8, 5000, used)
    structure = fine_structure.model(SEED)
    return structure, steps, voxels, fine_structure.divide(structure, steps, voxels)


def test_weights_are_means_over_the_subvoxels(divided):
    """Each voxel separately, with positions from HEALPix cells of the voxel and of its children."""
    structure, steps, voxels, subvoxels = divided
    counts = np.diff(subvoxels.first)
    assert set(counts.tolist()) == {2, 8}
    for v in np.linspace(0, voxels.step.size - 1, 200).astype(int).tolist():
        step, order, cell = (int(column[v]) for column in (voxels.step, voxels.order, voxels.cell))
        is_wide = 1.023 * steps.middle[step] / 2**order > structure.parameters.widest_undivided
        inner, outer = steps.edge[step] ** 3, steps.edge[step + 1] ** 3
        chi = np.cbrt([inner + share * (outer - inner) for share in (0.25, 0.75)])
        children = 4 * cell + np.arange(4) if is_wide else np.array([cell])
        vector = np.stack(hp.pix2vec(1 << (order + is_wide), children, nest=True))
        value = np.concatenate([fine_structure.values(structure, vector, np.full(children.size, c)) for c in chi])
        assert subvoxels.value[slice(*subvoxels.first[v : v + 2])].tobytes() == value.tobytes()
        weight = np.mean(np.exp(structure.amplitude[:, None] * value), 1) / structure.norm
        assert subvoxels.weight[v] == pytest.approx(weight, rel=1e-12, abs=0.0)


def test_the_mean_weight_is_1(divided):
    """Sample of steps that are 28 Mpc/h apart, whose means scatter; significance 6e-7 (5 standard errors)."""
    _, _, voxels, subvoxels = divided
    number = np.bincount(voxels.step)
    for weight in subvoxels.weight.T:
        volume = np.bincount(voxels.step, weight)[number > 0] / number[number > 0]
        assert volume.mean() == pytest.approx(1.0, abs=5.0 * volume.std() / volume.size**0.5)


def test_no_voxels_have_no_subvoxels(divided, box):
    structure, steps, _, _ = divided
    empty = lightcone.Voxels(*[np.zeros(0, np.int64)] * 4, np.zeros(0))
    subvoxels = fine_structure.divide(structure, steps, empty)
    assert subvoxels.first.tolist() == [0]
    assert subvoxels.weight.shape == (0, len(box.smoothed))
    drawn = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.uint64)
    index, chi = fine_structure.place_halos(structure, steps, empty, subvoxels, drawn)
    assert index.size == chi.size == 0


def uniform(key):
    return ((int(key) >> 12) + 0.5) * 2.0**-52


def child(key, number):
    shifted = (int(key) + (number + 1) * int(random_bits.GOLDEN)) % 2**64
    return int(random_bits.mix_bits(np.array([shifted], np.uint64))[0])


def choose(weights, share):
    return min(int(np.searchsorted(np.cumsum(weights), share * np.sum(weights), side="right")), len(weights) - 1)


def reference_place(divided, voxel, field, key):
    structure, steps, voxels, subvoxels = divided
    amplitude, order, cell = structure.amplitude[field], int(voxels.order[voxel]), int(voxels.cell[voxel])
    value = subvoxels.value[slice(*subvoxels.first[voxel : voxel + 2])]
    half, quarter = divmod(choose(np.exp(amplitude * value), uniform(child(key, 0))), value.size // 2)
    if value.size == 8:
        order, cell = order + 1, 4 * cell + quarter
    inner, outer = (float(steps.edge[voxels.step[voxel] + i]) ** 3 for i in (0, 1))
    index, chi, weights = [], [], []
    for j in range(structure.parameters.candidates):
        bits = 2 * (29 - order)
        index.append(cell << bits | child(key, 2 + 2 * j) % (1 << bits))
        chi.append(np.cbrt(inner + (half + uniform(child(key, 3 + 2 * j))) / 2.0 * (outer - inner)))
        vector = np.array(hp.pix2vec(1 << 29, index[-1], nest=True))
        weights.append(np.exp(amplitude * reference_value(structure, vector, chi[-1])))
    chosen = choose(weights, uniform(child(key, 1)))
    return index[chosen], chi[chosen]


def test_positions_agree_with_the_reference(divided, rng):
    structure, steps, voxels, subvoxels = divided
    voxel, field = rng.integers(voxels.step.size, size=200), rng.integers(5, size=200)
    key = rng.integers(2**63, size=200).astype(np.uint64)
    index, chi = fine_structure.place_halos(structure, steps, voxels, subvoxels, (voxel, field, key))
    expected = [reference_place(divided, *halo) for halo in zip(voxel, field, key, strict=True)]
    assert index.tolist() == [place for place, _ in expected]
    assert chi == pytest.approx([distance for _, distance in expected], rel=1e-12, abs=0.0)
    # A position does not depend on the other halos.
    alone = partial(fine_structure.place_halos, structure, steps, voxels, subvoxels)
    assert alone((voxel[:7], field[:7], key[:7]))[1].tobytes() == chi[:7].tobytes()


def test_halos_in_a_voxel_are_denser_where_the_field_is_higher(divided):
    """Many halos in one voxel: each is inside, and the mean of G grows by about B times its variance in the voxel."""
    structure, steps, voxels, subvoxels = divided
    voxel = int(np.argmax(np.diff(subvoxels.first) == 8))
    key = np.arange(20_000).astype(np.uint64)
    column = np.full(key.size, voxel)
    index, chi = fine_structure.place_halos(structure, steps, voxels, subvoxels, (column, np.full(key.size, 1), key))
    assert np.all(index >> 2 * (29 - voxels.order[voxel]) == voxels.cell[voxel])
    step = int(voxels.step[voxel])
    assert np.all((chi > steps.edge[step]) & (chi < steps.edge[step + 1]))
    value = fine_structure.values(structure, np.stack(hp.pix2vec(1 << 29, index, nest=True)), chi)
    uniform_index = (voxels.cell[voxel] << 2 * (29 - voxels.order[voxel])) + np.random.default_rng(1).integers(
        1 << 2 * (29 - voxels.order[voxel]), size=key.size
    )
    inner, outer = steps.edge[step] ** 3, steps.edge[step + 1] ** 3
    flat_chi = np.cbrt(np.random.default_rng(2).uniform(inner, outer, key.size))
    flat = fine_structure.values(structure, np.stack(hp.pix2vec(1 << 29, uniform_index, nest=True)), flat_chi)
    weight = np.exp(structure.amplitude[1] * flat)
    expected = np.sum(weight * flat) / weight.sum()
    assert value.mean() - flat.mean() == pytest.approx(expected - flat.mean(), rel=0.2)
    assert expected - flat.mean() > 0.1
