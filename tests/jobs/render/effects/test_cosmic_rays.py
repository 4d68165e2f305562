"""Cosmic rays: how many, how long, how much; even over the frame; in the readout where they belong."""

import numpy as np
import pytest

from jobs.render import focal_plane
from jobs.render.effects import cosmic_rays
from jobs.render.effects.effect import Scene
from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import resolve

MISSION = resolve()
TRACKS = np.array(MISSION.numbers("env.cosmic_rays.vis_tracks"))
SCENE = Scene(MISSION, "vis", 560.53, 0.25, 1e4, focal_plane.detector("vis", "3-4", MISSION))


def test_a_nominal_exposure_is_covered_to_two_or_three_per_cent():
    expected, quantiles = cosmic_rays.EFFECT.parameters(SCENE)
    assert expected == pytest.approx(1.0 * 4096 * 4132 * (12e-4) ** 2 * 560.53)
    # A sixteenth of a detector, and of its tracks.
    image = cosmic_rays.tracks((1033, 1024), expected / 16, quantiles, np.random.default_rng(5))
    assert 0.02 < (image > 0).mean() < 0.03


def test_charge_and_number():
    """Whole electrons; the total is that of the tracks drawn, wherever they end."""
    image = cosmic_rays.tracks((300, 200), 400.0, TRACKS, np.random.default_rng(5))
    np.testing.assert_array_equal(image, np.rint(image))
    assert image.min() == 0
    rng = np.random.default_rng(5)
    count = rng.poisson(400.0)
    *_, electrons = cosmic_rays._events(count, 300, 200, TRACKS, rng)
    assert image.sum() == electrons.sum()


def test_quantiles():
    """Median length 10.6 pixels, median charge 12.2 ke-, the longest the most."""
    x, y, cosine, sine, length, electrons = cosmic_rays._events(40_000, 100, 100, TRACKS, np.random.default_rng(1))
    assert np.median(length) == pytest.approx(10.56, rel=0.02)
    assert np.median(electrons) == pytest.approx(12_216, rel=0.03)
    assert np.percentile(length, 90) == pytest.approx(29.4, rel=0.05)
    assert (np.diff(electrons[np.argsort(length)]) >= 0).all()
    np.testing.assert_allclose(cosine**2 + sine**2, 1.0)
    assert 0 <= min(x.min(), y.min()) <= max(x.max(), y.max()) < 100


def test_a_track_is_one_pixel_thin_and_straight():
    image = np.zeros((40, 40))
    one = tuple(np.array([value]) for value in (5.5, 8.5, np.cos(0.3), np.sin(0.3), 20.0, 10_001.0))
    cosmic_rays._draw(image, one, np.zeros(1, np.int64), 40)
    assert image.sum() == 10_001
    rows, columns = np.nonzero(image)
    assert columns.min() == 5
    assert columns.max() == 24
    # Every pixel that is hit lies on the line, and charge follows the path's length: 500 an entire pixel step.
    distance = np.abs((columns - 5) * np.sin(0.3) - (rows - 8) * np.cos(0.3))
    assert distance.max() < 0.75
    by_column = image.sum(axis=0)[6:24]
    np.testing.assert_allclose(by_column, 10_001 / 20 / np.cos(0.3), atol=2)


def test_even_over_the_frame():
    image = cosmic_rays.tracks((200, 200), 40_000.0, TRACKS, np.random.default_rng(2)) > 0
    border = np.concatenate([image[:5].ravel(), image[-5:].ravel(), image[:, :5].ravel(), image[:, -5:].ravel()])
    assert border.mean() == pytest.approx(image.mean(), rel=0.02)


def test_readout_hits_lie_in_readout_coordinates():
    """Rows that are read later have been on the detector for longer; prescan and overscan columns have no silicon."""
    expected, _, rows, prescan, columns = cosmic_rays.READOUT.parameters(SCENE)
    assert (rows, prescan, columns) == (2066, 51, 2048)
    assert expected == pytest.approx(72 * 2066 * 2048 * (12e-4) ** 2)
    empty = np.zeros((40, 126, 90))
    out = cosmic_rays.apply_readout(empty, 60.0, TRACKS, 120, 10, 64, np.random.default_rng(1))
    assert (out[:, :, :10] == 0).all()
    assert (out[:, :, 74:] == 0).all()
    hits = (out[:, :, 10:74] > 0).mean(axis=(0, 2))
    early, late = hits[:30].mean(), hits[90:120].mean()
    assert late > 3 * early
    # Overscan rows are hit, too.
    assert hits[120:].mean() > 0.8 * late


def test_too_many_are_refused():
    for wrong in (-1.0, np.nan, 1e12):
        with pytest.raises(OutOfRange, match="cosmic"):
            cosmic_rays.tracks((3, 3), wrong, TRACKS, np.random.default_rng(1))
