"""Test the search for similar examples: the grid against the nearest neighbours."""

import numpy as np
import pytest

from tests.truesky.emulator import samples
from truesky.emulator import lookup
from truesky.emulator.features import Features
from truesky.emulator.lookup import Lookup


def uniforms(n, seed):
    return tuple(np.random.default_rng(seed).random((4, n)))


def test_lists_have_examples_near_their_node_sorted_by_outcome():
    examples = samples.examples(3000)
    found = lookup.build(examples)
    assert (found.counts >= lookup.LEAST).all()
    assert (found.counts <= lookup.MOST).all()
    size = int(np.prod([axis[2] for axis in lookup.AXES]))
    assert len(found.counts) == size + lookup.AXES[0][2] * lookup.AXES[2][2]
    for node in (100, 2000, size + 7):
        listed = found.lists[found.starts[node] :][: found.counts[node]]
        assert len(set(listed)) == len(listed)
        assert (examples.features.is_point[listed] == (node >= size)).all()
        detected, blended = (flags[listed] for flags in (examples.outcomes.detected, examples.outcomes.blended))
        assert (found.detected[node], found.blended[node]) == (detected.sum(), blended.sum())
        assert detected[: detected.sum()].all()
        assert blended[len(blended) - blended.sum() :].all()
        measured = examples.outcomes.mag_auto[listed[detected]], -examples.outcomes.radius[listed[detected]]
        assert (np.diff(sum(np.argsort(np.argsort(values)) for values in measured)) >= 0).all()


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


def test_all_similar_examples_are_used_about_as_often():
    """With lists of the 48 examples nearest to a node, an example of the most frequent kind was used 0 or many times.

    sample: 50,000 examples, which are drawn for their own features; significance: the number of uses would have a
    variance of 1 if examples were drawn at random, is 1.09, and was 1.53 with 48 examples in a list
    """
    examples = samples.examples(50_000)
    index = lookup.draw(lookup.build(examples), examples.features, uniforms(50_000, 3))
    frequent = ~examples.features.is_point & (abs(examples.features.brightness) < 1.0)
    uses = np.bincount(index, minlength=50_000)[frequent]
    assert uses.mean() == pytest.approx(1.0, abs=0.02)
    assert uses.var() < 1.25


def test_numbers_for_each_kind_of_outcome_give_the_same_fractions_as_one_number():
    """sample: 20,000 sources; significance: 4 sigma of the binomial error of the difference, and of the spread"""
    examples, found = samples.examples(50_000), samples.features(20_000, 7)
    lists, numbers = lookup.build(examples), uniforms(20_000, 3)
    node = lookup.nodes(found, numbers[:3])
    one = examples.outcomes.select(lookup.draw(lists, found, numbers))
    some = examples.outcomes.select(lookup.draw_in_steps(lists, node, *uniforms(20_000, 9)[:3]))
    for name in ("detected", "blended"):
        fractions = getattr(one, name).mean(), getattr(some, name).mean()
        assert fractions[1] == pytest.approx(fractions[0], abs=4.0 * np.sqrt(0.5 / 20_000))
    spreads = np.nanstd(one.mag_auto), np.nanstd(some.mag_auto)
    assert spreads[1] == pytest.approx(spreads[0], rel=0.1)


@pytest.mark.parametrize("number", [0.0, 0.5, np.nextafter(1.0, 0.0), 1.0])
def test_each_number_has_its_own_effect(number):
    """Numbers that are rounded to 0 or 1 are allowed: the distribution function of a normal deviate may be 1."""
    examples, found = samples.examples(5000), samples.features(500, 7)
    lists = lookup.build(examples)
    node = lookup.nodes(found, uniforms(500, 3)[:3])

    def draw(*numbers):
        drawn = examples.outcomes.select(lookup.draw_in_steps(lists, node, *(np.full(500, x) for x in numbers)))
        return drawn.detected, drawn.blended, drawn.mag_auto

    detected, blended, _ = draw(0.0, number, number)
    assert (blended == (lists.blended[node] > 0)).all()
    if number == 0.0:
        assert (detected | blended | (lists.detected[node] == 0)).all()
    detected, blended, _ = draw(1.0, 0.0, number)
    assert (detected == (lists.detected[node] > 0)).all()
    assert not draw(1.0, 1.0, number)[0][lists.detected[node] < lists.counts[node] - lists.blended[node]].any()


@pytest.mark.parametrize("number", [0.0, 0.5, 1.0])
def test_a_list_of_blended_examples_only_gives_one_of_them(number):
    """A number of 1 must not lead to the list of the node before, which has other examples."""
    lists = Lookup(*(np.array(values) for values in ([7, 8, 9, 10], [0, 2], [2, 2], [2, 0], [0, 2])))
    numbers = np.full(1, number)
    assert lookup.draw_in_steps(lists, np.array([1]), numbers, numbers, numbers)[0] in (9, 10)


def test_one_example_is_the_outcome_of_all_sources():
    examples, found = samples.examples(50).select(np.array([3])), samples.features(100, 7)
    lists, numbers = lookup.build(examples), uniforms(100, 3)
    assert (lists.counts == 1).all()
    assert not lookup.draw(lists, found, numbers).any()
    assert not lookup.draw_in_steps(lists, lookup.nodes(found, numbers[:3]), *numbers[:3]).any()


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
