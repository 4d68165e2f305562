"""Spiral arms and knots: the light of a disc is redistributed, by random numbers of the galaxy."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.truesky.render.fields import galaxies, one_source, small
from truesky.randomness import rng
from truesky.render.camera.astrometry import wcs
from truesky.render.camera.pointing import boresight_for
from truesky.render.sources import disc_structure, galaxy_shapes
from truesky.render.sources.disc_structure import REACH, DiscStructure
from truesky.render.sources.galaxy_shapes import EXPONENTIAL_RADIUS
from truesky.request.structure import Arms

SIDE = 192


def smooth(side=SIDE):
    """Return (exponential disc on the pixels of a picture, radius in scale lengths)."""
    at = (np.arange(side) - 0.5 * (side - 1)) * (2 * REACH / side)
    radius = np.hypot(at, at[:, None])
    return np.exp(-radius) * (2 * REACH / side) ** 2 / (2 * np.pi), radius


def half_light(image, radius):
    """Return the radius of the circle with half of the light of a disc of flux 1, partly outside the image."""
    order = np.argsort(radius, axis=None)
    grown = np.cumsum(image.ravel()[order], dtype=float)
    return np.interp(0.5, grown, radius.ravel()[order])


def arms(seed, wanted, bulge=0.1, side=SIDE):
    return disc_structure.arms_and_knots(side, bulge, wanted, rng.stream(1, "disc structure", seed)).astype(float)


@settings(max_examples=40)
@given(
    st.integers(0, 10**6), st.floats(0.0, 2.0), st.floats(0.0, 0.5), st.integers(20, 1000), st.floats(0.0, 0.49),
)  # fmt: skip
def test_flux_and_half_light_radius_stay(seed, contrast, knots, number, bulge):
    """This also holds for a few knots with half of the light, and no pixel is negative."""
    found, (disc, radius) = arms(seed, Arms(contrast, knots, number), bulge), smooth()
    assert abs(found.sum()) < 1e-6
    assert (disc + found).min() > -1e-9
    assert half_light(disc + found, radius) == pytest.approx(half_light(disc, radius), rel=0.01)
    assert not found[radius < 0.29].any()


def test_it_is_there():
    """Arms have the requested contrast: the brightest tenth of a circle over its mean. Knots are brighter."""
    disc, radius = smooth()
    ring = (radius > 1.5) & (radius < 2.0)
    for contrast in (0.4, 0.8, 1.5):
        ridges = [np.quantile(((disc + arms(n, Arms(contrast, 0.0), bulge=0.0)) / disc)[ring], 0.9) for n in range(12)]
        assert np.mean(ridges) == pytest.approx(1.0 + contrast, rel=0.15)
    knotted = [((disc + arms(n, Arms(0.0, 0.2))) / disc)[ring].max() for n in range(12)]
    assert np.mean(knotted) > 3.0


@pytest.mark.nightly
def test_arms_are_logarithmic_spirals_of_ten_to_thirty_degrees():
    """The pitch follows from the strongest spiral in the Fourier transform of a ring over angle and log radius."""
    radii, angles = np.exp(np.linspace(np.log(1.0), np.log(3.4), 64)), np.linspace(0, 2 * np.pi, 128, endpoint=False)
    disc, _ = smooth(384)
    at = (np.arange(384) - 191.5) * (2 * REACH / 384)
    x, y = radii[:, None] * np.cos(angles), radii[:, None] * np.sin(angles)
    row, column = (np.searchsorted(at, part) for part in (y, x))
    tight, open_ = [], []
    for seed in range(16):
        for bulge, found in ((0.45, tight), (0.0, open_)):
            light = (arms(seed, Arms(0.8, 0.0), bulge, 384) / disc)[row, column] * np.hanning(64)[:, None]
            power = np.abs(np.fft.fft2(light, (512, 128)))
            power[:, 0] = 0.0
            number = np.argmax(power[:, :5].max(axis=0))
            waves = np.fft.fftfreq(512, np.log(3.4) / 63 / (2 * np.pi))[np.argmax(power[:, number])]
            found.append(np.degrees(np.arctan(number / abs(waves))))
    assert 8.0 < np.min(tight) < np.max(open_) < 36.0
    assert 10.0 < np.median(tight) < 20.0 < np.median(open_) < 30.0


def test_of_a_galaxy_s_own():
    detector = small("vis", "3-4")
    form = galaxy_shapes.shapes(galaxies(np.zeros(4), np.zeros(4), disk_half_light_radius=[2.0, 2.0, 0.9, 2.0]))
    form = replace(form, bulge_fraction=np.array([0.0, 0.0, 0.0, 0.8]))
    one = one_source(detector, wcs(detector, *boresight_for(detector, 10.0, 20.0, 33.0)), disk_half_light_radius=2.0)
    four = replace(one.take(np.zeros(4, int)), ids=np.array([7, 8, 9, 10]), shape=np.arange(4), shapes=form)
    discs = DiscStructure(Arms(), 3)
    assert disc_structure.sides(form, discs).astype(bool).tolist() == [True, True, False, False]
    assert disc_structure.sides(form, discs)[0] == pytest.approx(2 * REACH * 2.0 / EXPONENTIAL_RADIUS)
    assert not disc_structure.sides(form, None).any()
    found = disc_structure.add_structure(four, form, discs)
    assert found.picture.tolist() == [0, 1, -1, -1]
    assert found.has_structure.tolist() == [True, True, False, False]
    first, second = (picture.image for picture in found.pictures)
    assert np.abs(first - second).max() > 0.1 * np.abs(first).max()
    alone = disc_structure.add_structure(four.take(np.array([1])), form, discs).pictures[0]
    np.testing.assert_array_equal(alone.image, second)
    other = disc_structure.add_structure(four, form, replace(discs, seed=4)).pictures[0].image
    assert np.abs(first - other).max() > 0.1 * np.abs(first).max()
