"""Random streams: keyed by identity, independent, the same everywhere."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import BadInput
from truesky.randomness.rng import stream, uniforms

IDENTITY = st.lists(st.one_of(st.integers(-(2**63), 2**63 - 1), st.text(max_size=8)), min_size=1, max_size=4).map(tuple)


def first_words(*identity):
    return tuple(stream(*identity).integers(0, 2**63, 4).tolist())


def test_known_stream():
    """The numbers themselves are part of the promise: a lake made yesterday can be made again."""
    assert first_words(7, "galaxies", 12) == (
        415543004655744998,
        9066114087085225434,
        652314837451289750,
        352554425273647078,
    )


@given(IDENTITY, IDENTITY)
def test_streams_are_equal_only_where_identities_are(a, b):
    assert (first_words(*a) == first_words(*b)) == (a == b)


def test_numpy_integers_are_integers():
    assert first_words(np.int64(5), "x") == first_words(5, "x")
    assert first_words(1) != first_words("1")
    assert first_words("a", "b") != first_words("ab")


def test_no_collision_in_many_identities():
    words = {first_words(3, "cell", i)[0] for i in range(20_000)}
    assert len(words) == 20_000


@pytest.mark.parametrize("part", [1.5, None, True, b"x", ("a",)])
def test_other_types_are_refused(part):
    with pytest.raises(BadInput, match="random stream"):
        stream(1, part)


def test_uniform_and_uncorrelated():
    """Sample of 100,000 numbers of each stream; significance 6e-5 (4 standard errors)."""
    a, b = stream(1, "a").random(100_000), stream(1, "b").random(100_000)
    assert abs(a.mean() - 0.5) < 4 / np.sqrt(12 * 100_000)
    assert abs(np.corrcoef(a, b)[0, 1]) < 4 / np.sqrt(100_000)


def test_known_uniforms():
    found = uniforms(np.array([1, 2, 5 << 60]), 2, 7, "gaia")
    assert found.tolist() == [
        [0.5111712202830357, 0.7535975679108528, 0.7677442672325997],
        [0.9305092908390095, 0.6476532320138498, 0.6501092774921381],
    ]


@given(st.sets(st.integers(0, 2**63 - 1), min_size=1, max_size=20), st.integers(1, 5))
def test_a_source_has_its_own_uniforms_among_any_others(found, count):
    ids = np.array(sorted(found))
    whole = uniforms(ids, count, 3, "x")
    assert np.all((whole > 0.0) & (whole < 1.0))
    assert np.array_equal(uniforms(ids[::-1], count, 3, "x"), whole[:, ::-1])
    assert np.array_equal(uniforms(ids[:1], count + 2, 3, "x")[:count], whole[:, :1])


def test_uniforms_are_uniform_and_independent():
    """Of neighbouring identifiers, of the numbers of one source, and of two seeds.

    Sample of 100,000 identifiers; significance 6e-7 of means, counts and correlations (5 standard errors).
    """
    n = 100_000
    found = np.concatenate([uniforms(np.arange(n) << 18, 3, seed, "x") for seed in (1, 2)])
    assert abs(found.mean(1) - 0.5).max() < 5 / np.sqrt(12 * n)
    counts = np.stack([np.histogram(row, 100, (0.0, 1.0))[0] for row in found])
    assert ((counts - n / 100) ** 2 / (n / 100)).sum(1) == pytest.approx(99.0, abs=5 * np.sqrt(2 * 99))
    together = np.concatenate([found, found[:, np.r_[1:n, 0]]])
    assert np.abs(np.corrcoef(together) - np.eye(12)).max() < 5 / np.sqrt(n)
