"""Spectra of bright sources with the PSF at few wavelengths, compared with the PSF at ten."""

from dataclasses import replace

import pytest

from benchmarks import _dispersion as dispersion
from truesky.render.dispersing import draw
from truesky.request.accuracy import PRESETS

# Number of sources of H = 17 to 23, and of the brightest of them, which are drawn.
SOURCES, BRIGHT = 36, 7


def largest_error(settings, sources, fine):
    """Return the largest difference of a pixel from images with finer settings, as a fraction of its noise."""
    psf, fine_psf = (dispersion.settings_psf(each) for each in (settings, fine))
    images = ((dispersion.draw_images(s, settings, psf), dispersion.draw_images(s, fine, fine_psf), s) for s in sources)
    return max(dispersion.errors(drawn, truth, source)[0] for drawn, truth, source in images)


@pytest.mark.parametrize("preset", ["quicklook", pytest.param("draft", marks=pytest.mark.nightly)])
def test_errors_of_bright_spectra_are_those_that_headers_name(preset):
    sources = sorted(dispersion.sample_sources(78, SOURCES), key=lambda each: -each.source.electrons[0])[:BRIGHT]
    settings, named = draw.settings_for(PRESETS[preset]), draw.expected_errors(PRESETS[preset])["background"]
    # Errors of wavelengths and of positions partly cancel. The second ones are small at quicklook, and cost time.
    fine = replace(settings, nodes=10) if preset == "quicklook" else dispersion.TRUTH
    assert largest_error(settings, sources, fine) < named
    # The test would notice one wavelength less.
    assert largest_error(replace(settings, nodes=2), sources, fine) > 1.5 * named
