"""Random numbers per pixel: their distributions up to the tails, and the independence of pixels."""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from truesky.numerics.cache import sources_key
from truesky.numerics.compiling import jit
from truesky.randomness import rng
from truesky.render.effects import pixel_random
from truesky.render.effects.readout import read_noise

# Numbers of pixels: a correlation of 4.4e-3 is found at a significance of 7e-6; by the nightly test, one of 2.2e-3.
COUNTS = [pytest.param(1 << 20, id="short"), pytest.param(1 << 22, id="long", marks=pytest.mark.nightly)]
KEY = pixel_random.draw_key(np.random.default_rng(5))
# Lowest p-value: one in a thousand good generators would be refused.
LEAST = 1e-3


@jit
def rolled(key, pixels, again):
    """Words, uniform and normal deviates of pixels; again : how many words later."""
    words, uniform, normal = np.empty(len(pixels), np.uint64), np.empty(len(pixels)), np.empty(len(pixels))
    for i in range(len(pixels)):
        bits = pixel_random.pixel_bits(key, pixels[i])
        for _ in range(again):
            bits = pixel_random.next_bits(bits)
        words[i], uniform[i], normal[i] = bits, pixel_random.uniform(bits), pixel_random.normal(bits)
    return words, uniform, normal


@jit
def far_out(key, count, least):
    """Return the normal deviates whose absolute value exceeds `least`."""
    found, n = np.empty(count // 1000), 0
    for i in range(count):
        deviate = pixel_random.normal(pixel_random.pixel_bits(key, i))
        if abs(deviate) > least:
            found[n] = deviate
            n += 1
    return found[:n]


@pytest.fixture(scope="module", params=COUNTS)
def many(request):
    """Words, uniform and normal deviates of as many pixels as a count says."""
    return rolled(KEY, np.arange(request.param), 0)


@pytest.mark.parametrize("first", [0, 77])
def test_deviates_of_many_pixels_are_those_of_each_pixel(first):
    """300,000 pixels, of which about 4,000 need more than one word and 80 lie in the tail."""
    expected = rolled(KEY, first + np.arange(300_000), 0)[2]
    found, bits = np.empty(len(expected)), np.empty(len(expected), np.uint64)
    pixel_random.fill_normals(found, bits, KEY, first)
    np.testing.assert_array_equal(found, expected)
    assert (np.abs(expected) > 3.66).sum() > 20


def test_words_are_those_of_splitmix():
    """The first of its generator begun from 1234567, as published with its code."""
    pixels = np.arange(1, 6)
    assert rolled(np.uint64(1234567), pixels, 0)[0].tolist() == [
        6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431, 16408922859458223821,
    ]  # fmt: skip


def test_code_is_compiled_again_if_the_mixer_changes(tmp_path):
    """It stands in a file that compiles nothing itself."""
    copy = tmp_path / "rng.py"
    copy.write_text(Path(rng.__file__).read_text())
    before = sources_key(tmp_path)
    copy.write_text(copy.read_text().replace("30", "29"))
    assert sources_key(tmp_path) != before


def test_uniform(many):
    """Sample of `many` pixels; significance LEAST of the law and of each 4096th part."""
    uniform = many[1]
    assert stats.kstest(uniform, "uniform").pvalue > LEAST
    assert stats.chisquare(np.bincount((uniform * 4096).astype(int), minlength=4097)[:4096]).pvalue > LEAST
    # Its logarithm is taken.
    assert pixel_random.uniform(np.uint64(0)) == 2.0**-53
    assert pixel_random.uniform(np.uint64(2**64 - 1)) == 1.0


def test_normal(many):
    """As a whole, and bin by bin, where the ziggurat's layers meet. Sample of `many` pixels, significance LEAST."""
    normal = many[2]
    assert stats.kstest(normal, "norm").pvalue > LEAST
    # Five deviates or more are expected in each bin.
    edges = np.concatenate([[-np.inf], np.arange(-3.8, 3.81, 0.02), [np.inf]])
    seen, law = np.histogram(normal, edges)[0], len(normal) * np.diff(stats.norm.cdf(edges))
    assert stats.chisquare(seen, law).pvalue > LEAST


def test_the_normal_s_tails():
    """No layer holds them: of more deviates, as many beyond each place as there should be, and as they should lie.

    Sample of 2^26 deviates; significance LEAST of each number and of the law.
    """
    count, least = 1 << 26, 3.5
    found = far_out(KEY, count, least)
    for sigma in (least, 3.654, 3.66, 4.0, 4.5, 5.0, 5.5):
        for side in (found, -found):
            expected = count * stats.norm.sf(sigma)
            low, high = stats.poisson.ppf([LEAST / 2, 1 - LEAST / 2], expected)
            assert low <= np.sum(side > sigma) <= high
    beyond = np.abs(found)[np.abs(found) > 3.66]
    assert stats.kstest(beyond, stats.truncnorm(3.66, np.inf).cdf).pvalue > LEAST


def test_each_bit_is_as_often_set(many):
    """Sample of `many` words; significance 7e-6 of each bit (4.5 standard errors)."""
    words = many[0]
    often = np.array([np.mean((words >> np.uint64(bit)) & np.uint64(1)) for bit in range(64)])
    assert np.abs(often - 0.5).max() < 4.5 * 0.5 / np.sqrt(len(words))


@pytest.mark.parametrize("step", [1, 2, 1 << 32])
def test_neighbouring_keys_have_nothing_in_common(many, step):
    """Neither in their numbers nor in how far these are from 0."""
    unlike(many, rolled(KEY + np.uint64(step), np.arange(len(many[0])), 0))


@pytest.mark.parametrize("step", [1, 4096])
def test_neighbouring_pixels_have_nothing_in_common(many, step):
    unlike([column[step:] for column in many], [column[:-step] for column in many])


def test_words_of_a_pixel_have_nothing_in_common(many):
    unlike(many, rolled(KEY, np.arange(len(many[0])), 1))


def unlike(one, other):
    """Sample of `many` pixels; significance 7e-6 of each correlation (4.5 standard errors)."""
    assert not np.any(one[0] == other[0])
    for a, b in ((one[1], other[1]), (one[2], other[2]), (one[2] ** 2, other[2] ** 2)):
        assert abs(np.corrcoef(a, b)[0, 1]) < 4.5 / np.sqrt(len(a))


def test_a_pixel_s_are_the_same_whatever_others_are_asked(many):
    some = np.random.default_rng(1).permutation(len(many[0]))[:1000]
    for found, expected in zip(rolled(KEY, some, 0), many, strict=True):
        np.testing.assert_array_equal(found, expected[some])
    # As effects ask them, of a part of a frame.
    frame = np.zeros((64, 64))
    whole = read_noise.apply(frame, 1.0, np.random.default_rng(5))
    np.testing.assert_array_equal(whole.ravel(), many[2][: whole.size])
    np.testing.assert_array_equal(read_noise.apply(frame[:7], 1.0, np.random.default_rng(5)), whole[:7])
