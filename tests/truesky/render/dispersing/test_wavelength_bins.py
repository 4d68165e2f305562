"""Bins of wavelength conserve the light of a spectrum and its moments, and hardly change the narrowest lines."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import _scenes as scenes
from tests.truesky.render.dispersing.made import DETECTOR, FIRST, LAST, MISSION, order, psf
from truesky.render.camera import traces
from truesky.render.dispersing import draw, wavelength_bins

# Settings of the accuracy `reference`, except for the size of stamps, and settings with which all light is a product.
FINE = draw.Settings(edge=0.001, along=3, block=50.0)
PRODUCT = draw.Settings(separable=10.0)
# Largest difference that bins make, as a fraction of the peak of the line.
ERROR = 1e-3


def binned(spectrum, width, factor=1.0, response=None):
    """Return the electrons in bins, and the wavelength index at which each bin lies."""
    out = np.zeros(wavelength_bins.bin_count(len(spectrum), width))
    response = np.ones(len(spectrum)) if response is None else response
    wavelength_bins.bin_electrons(
        spectrum.astype(np.float32), factor, response, wavelength_bins.bin_weights(width), out
    )
    return out, width * (np.arange(len(out)) - wavelength_bins.BINS_BEFORE)


@given(st.integers(1, 64), st.integers(1, 200), st.integers(0, 2**32 - 1))
def test_bins_conserve_light_and_moments(width, count, seed):
    rng = np.random.default_rng(seed)
    spectrum, response = rng.random(count).astype(np.float32), rng.uniform(-1.0, 2.0, count)
    electrons, place = binned(spectrum, width, 3.0, response)
    light = 3.0 * spectrum.astype(float) * response
    scale = max(count, width)
    for power in range(6):
        moment = (light * ((np.arange(count) - 0.5 * count) / scale) ** power).sum()
        found = (electrons * ((place - 0.5 * count) / scale) ** power).sum()
        assert found == pytest.approx(moment, rel=1e-9, abs=1e-9 * np.abs(light).sum())


def test_a_bin_of_one_wavelength_changes_nothing():
    spectrum = np.random.default_rng(3).random(50).astype(np.float32)
    electrons, place = binned(spectrum, 1)
    np.testing.assert_array_equal(electrons[(place >= 0) & (place < 50)], spectrum)
    assert electrons.sum() == pytest.approx(spectrum.sum(dtype=float), rel=1e-14, abs=0)


@pytest.mark.parametrize(("settings", "tilt"), [(draw.Settings(), 0.0), (FINE, 4.0), (PRODUCT, 0.0)])
def test_a_line_of_a_star_against_every_wavelength(settings, tilt):
    """A line of one wavelength in the spectrum of a star is the narrowest; the error is a fraction of its peak."""
    (trace,) = (part for part in traces.traces("RGS000", tilt, DETECTOR, MISSION) if part.order == 1)
    orders, count = (order(trace, 1.0),), LAST - FIRST + 1
    stars = scenes.sources(scenes.NISP, 5, galaxies=0, stars=1)
    shape, cache = (64, 600), {}
    for at in (1001, 1003, 3404):
        x, y = trace.offsets(0.0, 0.0, np.array([FIRST + at]))
        stars.column[:], stars.row[:] = 300.3 - x, 32.4 - y
        spectrum = np.zeros((1, count), np.float32)
        spectrum[0, at] = 1.0
        with_bins, without = (
            draw.draw(
                replace(stars, electrons=np.full(1, 1e4)),
                draw.DispersedSources(lambda some, light=spectrum: light, orders, replace(settings, bin=pixels)),
                psf(4), shape, 1e5 if settings is PRODUCT else 1.0, None, None, cache,
            )
            for pixels in (settings.bin, 0.0)
        )  # fmt: skip
        assert without.sum() > 8e3
        assert 0.0 < np.abs(with_bins - without).max() < ERROR * without.max()
        assert with_bins.sum() == pytest.approx(without.sum(), rel=1e-5, abs=0)


@pytest.mark.parametrize("along", [(-10.0, 80.0, 20.0), (900.0, -400.0), (3.0, 5.0, 0.0, 90.0)])
@pytest.mark.parametrize("t", [(-0.9, 4e-4), (0.0, 1.5e-4)])
def test_bins_are_narrow_where_the_dispersion_is_largest(along, t):
    """The spectrum may extend beyond the trace, whose ends are at t = 0 and 1."""
    response, pixels = np.ones(6861), 0.25
    found = wavelength_bins.Bins.from_trace(np.array(along), t, response, np.ones((6861, 1)), pixels)
    place = np.polynomial.polynomial.polyval(t[0] + t[1] * np.arange(-2, 6861 + 3, found.width), along)
    wavelength = np.polynomial.polynomial.polyval(t[0] + t[1] * np.arange(-2, 6861 + 3), along)
    largest = np.abs(np.diff(place)).max()
    assert found.width == 1 or largest <= 1.02 * pixels
    assert found.width == 64 or largest + np.abs(np.diff(wavelength)).max() > 0.98 * pixels
    assert found.share.shape == (1, wavelength_bins.bin_count(6861, found.width))
