"""Test the combination of frames and the weights on arrays."""

import numpy as np
import pytest

from lake_schema.errors import BadInput
from truesky.reduction import calibration
from truesky.reduction.combining import clipped_mean


def poisson_frames(count, level, shape=(200, 100), seed=1):
    rng = np.random.default_rng(seed)
    return (rng.poisson(level, (count, *shape)) + rng.normal(0.0, 4.0, (count, *shape))).astype(np.float32)


def variance(expected, rows):
    return np.maximum(expected, 0.0) + 16.0


def test_a_clipped_mean_is_the_mean_without_what_is_in_few_frames():
    frames = poisson_frames(6, 100.0)
    clean = clipped_mean(frames, variance)
    np.testing.assert_allclose(clean.mean[clean.count == 6], frames.mean(axis=0)[clean.count == 6], rtol=1e-5)
    assert (clean.count < 6).mean() < 1e-3
    hit = frames.copy()
    hit[2, 50:60] += 5000.0
    hit[4, 55:57] += 300.0
    found = clipped_mean(hit, variance)
    assert np.all(found.count[50:55] <= 5)
    assert np.abs(found.mean[50:60].mean() - 100.0) < 1.0
    # The scatter of the mean agrees with its uncertainty.
    assert np.std((clean.mean - 100.0) / clean.uncertainty) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("count", [1, 2])
def test_few_frames_believe_the_lower(count):
    frames = poisson_frames(count, 0.0)
    frames[0, 10] += 1e4
    found = clipped_mean(frames, variance)
    assert np.all(found.count[10] == 1)
    if count == 2:
        assert np.abs(found.mean[10]).max() < 30.0
    with pytest.raises(BadInput, match="no frames"):
        clipped_mean(frames[:0], variance)


def test_the_level_of_the_sky_does_not_see_sources():
    y, x = np.mgrid[:260, :300]
    sky = 100.0 + 0.05 * x + 0.02 * y
    image = sky + np.random.default_rng(2).normal(0.0, 10.0, sky.shape)
    image[40:60, 70:100] += 1e5
    found = calibration.sky_level(image, np.ones(image.shape, bool))
    inside = (slice(40, 220), slice(40, 260))
    assert np.abs(found - sky)[inside].max() < 2.0
    assert calibration.sky_level(image, np.zeros(image.shape, bool)).max() == 0.0


def test_the_weight_of_a_pixel_does_not_depend_on_its_noise():
    """Otherwise weighted means would be too low, by 0.6 % for 150 electrons."""
    rng = np.random.default_rng(3)
    image = rng.poisson(150.0, (512, 512)) + rng.normal(0.0, 4.4, (512, 512))
    light = calibration.expected_light(image, np.ones(image.shape, bool), 4.4**2)
    assert np.mean(1.0 / (light + 4.4**2)) * image.var() == pytest.approx(1.0, abs=0.01)
    assert np.average(image, weights=1.0 / (light + 4.4**2)) == pytest.approx(150.0, abs=0.1)


def test_a_source_has_its_own_shot_noise():
    image = np.full((128, 128), 100.0)
    image[60:70, 60:70] += 5000.0
    light = calibration.expected_light(image, np.ones(image.shape, bool), 20.0)
    assert light[65, 65] == pytest.approx(5100.0, rel=0.01)
    assert light[10, 10] == pytest.approx(100.0, rel=0.01)
