"""Test the search for similar examples: the grid against the nearest neighbours."""

import numpy as np
import pytest

from tests.truesky.emulator import samples
from truesky.emulator import lookup
from truesky.emulator.features import Features


def uniforms(n, seed):
    return tuple(np.random.default_rng(seed).random((4, n)))


def test_lists_have_examples_near_their_node_sorted_by_outcome():
    examples = samples.examples(3000)
    found = lookup.build(examples)
    assert (found.counts >= lookup.LEAST).all()
    assert (found.counts <= lookup.MOST).all()
    size = int(np.prod([axis[2] for axis in lookup.AXES]))
    assert len(found.lists) == size + lookup.AXES[0][2] * lookup.AXES[2][2]
    for node in (100, 2000, size + 7):
        listed = found.lists[node, : found.counts[node]]
        assert len(set(listed)) == len(listed)
        assert (examples.features.is_point[listed] == (node >= size)).all()
        offsets = np.nan_to_num(examples.outcomes.mag_auto[listed], nan=1e3)
        assert (np.diff(offsets) >= 0.0).all()


def test_grid_gives_what_a_search_for_the_nearest_examples_gives():
    """The completeness of the fast path is that of the slow one, and that of the made-up survey, in bins of brightness.

    sample: 20,000 sources, 5 bins; significance: 4 sigma of the binomial error, and 0.03 for the neighbourhoods
    """
    examples, found = samples.examples(50_000), samples.features(20_000, 7)
    fast = lookup.draw(lookup.build(examples), found, uniforms(20_000, 3))
    slow = lookup.draw_nearest(examples, found, uniforms(20_000, 4)[3])
    bins = np.digitize(found.brightness, [-3.0, -1.5, -0.5, 0.5])
    truth = samples.probability(found)
    for i in range(5):
        chosen = bins == i
        error = 4.0 * np.sqrt(0.25 / chosen.sum())
        rates = [examples.outcomes.detected[index][chosen].mean() for index in (fast, slow)]
        assert rates[0] == pytest.approx(rates[1], abs=error + 0.01)
        assert rates[0] == pytest.approx(truth[chosen].mean(), abs=error + 0.03)
        scatter = [np.nanstd(examples.outcomes.mag_auto[index][chosen]) for index in (fast, slow)]
        assert scatter[0] == pytest.approx(scatter[1], rel=0.15)


def test_examples_are_of_the_type_of_the_source_and_near_it():
    examples, found = samples.examples(20_000), samples.features(2000, 8)
    index = lookup.draw(lookup.build(examples), found, uniforms(2000, 5))
    assert (examples.features.is_point[index] == found.is_point).all()
    common = abs(found.brightness) < 1.0
    assert np.median(abs(examples.features.brightness[index] - found.brightness)[common]) < 0.3


def test_without_points_those_of_the_other_type_are_used():
    examples = samples.examples(500)
    examples = examples.select(~examples.features.is_point)
    found = lookup.build(examples)
    assert (found.counts >= lookup.LEAST).all()
    assert found.lists.max() < len(examples)


def test_few_examples_are_enough():
    found = lookup.build(samples.examples(5))
    assert (found.counts >= 1).all()
    assert (found.counts <= 5).all()


def test_sources_beyond_the_grid_have_the_lists_of_its_last_nodes():
    """The largest number below 1 is rounded up when it is added to the number of the last node."""
    found = samples.features(4, 1)
    beyond = Features(np.full(4, 9.0), np.full(4, 9.0), np.full(4, 9.0), found.is_point)
    largest = np.full(4, np.nextafter(1.0, 0.0))
    index = lookup.draw(lookup.build(samples.examples(500)), beyond, (largest, largest, largest, largest))
    assert ((index >= 0) & (index < 500)).all()
