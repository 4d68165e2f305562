"""Bins of wavelength conserve the light of a spectrum and its moments, and hardly change the narrowest lines."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from truesky.render.dispersing import wavelength_bins


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


@pytest.mark.parametrize("width", [2, 4, 13])
def test_error_of_the_narrowest_line(width):
    """The PSF and the pixel of NISP have an rms width of 0.7 pixels along the trace."""
    pixel = width / wavelength_bins.BIN_PIXELS
    x = np.arange(-4.0, 4.0, 0.05)
    for first in range(width):
        spectrum = np.zeros(20 * width)
        spectrum[10 * width + first] = 1.0
        electrons, place = binned(spectrum, width)
        distance = (place - (10 * width + first)) / pixel
        image = np.exp(-0.5 * ((x[:, None] - distance) / 0.7) ** 2) @ electrons
        assert np.abs(image - np.exp(-0.5 * (x / 0.7) ** 2)).max() < 5e-4


def test_width_of_bins():
    # First, second and zeroth order of a grism of NISP, and a trace that is finer than a wavelength.
    assert [wavelength_bins.bin_width(dispersion) for dispersion in (13.4, 6.7, 870.0, 0.2)] == [4, 2, 64, 1]
