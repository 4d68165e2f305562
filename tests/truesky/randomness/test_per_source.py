"""Numbers of sources: their own among any others, and distributed as they should be."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import special, stats

from truesky.randomness import compiled_draws
from truesky.randomness.per_source import PerSourceGenerator, keys
from truesky.randomness.rng import mix_bits

N = 100_000
KINDS = ("random", "standard_normal", "standard_gamma", "beta", "integers")

KNOWN = [
    0.7945501311667843,
    0.4920922592893747,
    0.9660583852255034,
    0.6698060766774361,
    0.039748981941167986,
    0.883613373096621,
]


def drawn(rng, kind, n=None):
    parameters = {"standard_gamma": (0.7,), "beta": (2.0, 0.6), "integers": (0, 7)}
    return getattr(rng, kind)(*parameters.get(kind, ()), n)


@given(st.sets(st.integers(0, 2**63 - 1), min_size=2, max_size=20), st.sampled_from(KINDS))
def test_a_source_has_its_own_numbers_among_any_others(found, kind):
    ids = np.array(sorted(found))
    whole, other, cut = (
        PerSourceGenerator(ids, 3, "x"),
        PerSourceGenerator(ids[::-1][:-1], 3, "x"),
        PerSourceGenerator(ids, 3, "x"),
    )
    first = drawn(whole, kind, ids.size)
    assert np.array_equal(drawn(other, kind), first[:0:-1])
    drawn(cut, kind)
    # The remaining sources continue with their next numbers, as if the others were still present.
    assert np.array_equal(drawn(cut.select(ids > ids[0]), kind), drawn(whole, kind)[1:])


def test_known_numbers():
    """The numbers themselves are part of the promise."""
    rng = PerSourceGenerator(np.array([1, 5 << 60]), 7, "galaxies")
    found = [rng.random(), rng.standard_normal(), rng.standard_gamma(0.7)]
    assert np.concatenate(found).tolist() == pytest.approx(KNOWN, rel=1e-14, abs=0.0)


def test_compiled_uniforms_are_those_of_splitmix():
    own, step = keys(np.arange(1000), 2**63 - 1, "x"), 0x9E3779B97F4A7C15
    rng = PerSourceGenerator(np.arange(1000), 2**63 - 1, "x")
    for call in range(3):
        bits = mix_bits(own + np.uint64((call + 1) * step % 2**64))
        assert np.array_equal(rng.random(), ((bits >> np.uint64(12)) + 0.5) * 2.0**-52)


@pytest.mark.parametrize(
    ("kind", "law"),
    [("random", stats.uniform()), ("standard_normal", stats.norm()), ("standard_gamma", stats.gamma(0.7)),
     ("beta", stats.beta(2.0, 0.6))],
)  # fmt: skip
def test_distributions(kind, law):
    """Sample of neighbouring identifiers; significance 1e-4 of the law, 6e-7 of correlations (5 standard errors)."""
    rng = PerSourceGenerator(np.arange(N) << 11, 0, "x")
    one, other = drawn(rng, kind), drawn(rng, kind)
    assert stats.kstest(one, law.cdf).pvalue > 1e-4
    together = np.corrcoef([one, other, one[np.r_[1:N, 0]]])
    assert np.abs(together - np.eye(3)).max() < 5 / np.sqrt(N)


def test_normals_are_the_inverse_of_the_uniforms():
    own = keys(np.arange(N), 1, "x")
    u, z = np.empty((2, N))
    compiled_draws.uniforms(own, 0, u)
    compiled_draws.normals(own, 0, z)
    assert z == pytest.approx(special.ndtri(u), rel=1e-13, abs=1e-14)


@pytest.mark.parametrize("mean", [0.0, 0.02, 3.0, 599.0, 4321.0])
def test_poisson(mean):
    """Sample of 20,000 identifiers; significance 6e-7 of the mean and of the variance (5 standard errors)."""
    found = np.array([compiled_draws.poisson(key, mean) for key in keys(np.arange(20_000), 1, "x")])
    error = np.sqrt(mean / found.size)
    assert found.mean() == pytest.approx(mean, abs=5 * error)
    assert found.var() == pytest.approx(mean, abs=5 * error * np.sqrt(1.0 + 2.0 * mean))


def test_another_number_of_sources_is_refused():
    with pytest.raises(ValueError, match="size must be the number of sources, 2, got 3"):
        PerSourceGenerator(np.arange(2), 1).random(3)
