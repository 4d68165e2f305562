"""Test the examples of a frame on made-up images of round sources."""

import numpy as np
import pytest
from astropy.wcs import WCS

from lake_schema.errors import OutOfRange
from lake_schema.ids import source_id
from truesky.emulator import features, frame_examples
from truesky.emulator.frame_examples import Geometry, Settings, TrueSources
from truesky.reduction import catalogue
from truesky.reduction.calibration import NO_DATA, ReducedImage
from truesky.reduction.catalogue import Limits

SIDE, SCALE, SIGMA, NOISE, ZERO = 500, 0.1, 1.2, 10.0, 32.0
PSF_AREA = 4.0 * np.pi * (SIGMA * SCALE) ** 2
DEPTH = ZERO - 2.5 * np.log10(5.0 * NOISE * np.sqrt(PSF_AREA) / SCALE)


def made_up(n=120, seed=2, brightest=-5.0):
    """Return true sources on a grid of places, their light, and the image of it with noise."""
    rng = np.random.default_rng(seed)
    columns = np.arange(n) % 11
    x, y = 25.0 + 45.0 * columns + rng.random(n), 25.0 + 45.0 * (np.arange(n) // 11) + rng.random(n)
    is_point = np.arange(n) % 3 == 0
    radius = np.where(is_point, 0.0, 0.2)
    magnitude = DEPTH + rng.uniform(brightest, 1.5, n)
    ids = source_id(np.where(is_point, 5, 0), 3, np.arange(n))
    light = np.zeros((SIDE, SIDE))
    grid = np.arange(SIDE)
    for i in range(n):
        width = np.hypot(SIGMA, radius[i] / SCALE / 1.1774)
        profile = np.exp(-0.5 * (grid - x[i]) ** 2 / width**2), np.exp(-0.5 * (grid - y[i]) ** 2 / width**2)
        flux = 10.0 ** (0.4 * (ZERO - magnitude[i]))
        light += flux / (2.0 * np.pi * width**2) * profile[1][:, None] * profile[0]
    pixels = light + 100.0 + NOISE * rng.standard_normal(light.shape)
    image = ReducedImage(
        pixels.astype(np.float32), np.full(light.shape, NOISE**-2, np.float32), np.zeros(light.shape, np.uint8)
    )
    return TrueSources(ids, x, y, magnitude, radius), light, image


def compared(sources, image, **changes):
    """Return the examples of an image; `changes` are functions that replace columns of the measurements."""
    system = WCS(naxis=2)
    system.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    system.wcs.crval, system.wcs.crpix, system.wcs.cdelt = (
        [150.0, 2.0],
        [250.0, 250.0],
        [-SCALE / 3600.0, SCALE / 3600.0],
    )
    measured, segments = catalogue.detect_segments(image, 1e6, 5.0, Limits())
    measured |= {name: change(measured) for name, change in changes.items()}
    return frame_examples.compare(
        sources, (measured, segments), image, {"depth": DEPTH, "psf_area": PSF_AREA}, Geometry(system, SCALE, ZERO)
    )


def test_bright_sources_are_detected_with_their_magnitude_size_and_position():
    sources, _, image = made_up()
    found = compared(sources, image)
    outcomes, brightness = found.examples.outcomes, found.examples.features.brightness
    bright, faint = brightness < -2.5, brightness > 1.0
    assert outcomes.detected[bright].all()
    assert outcomes.detected[faint].mean() < 0.5
    assert np.median(outcomes.mag_auto[bright]) == pytest.approx(0.05, abs=0.05)
    assert np.median(outcomes.mag_aper[bright]) == pytest.approx(0.0, abs=0.15)
    assert outcomes.radius[bright] == pytest.approx(1.0, abs=0.3)
    assert np.abs(outcomes.dx[bright]).max() < 1.0
    offset = outcomes.mag_auto[bright] / outcomes.magerr_auto[bright]
    assert 0.3 < np.std(offset) < 5.0
    assert np.isnan(outcomes.mag_auto[~outcomes.detected]).all()
    assert (found.examples.features.is_point == (sources.radius[found.rows] == 0.0)).all()


@pytest.mark.parametrize(
    "changes",
    [
        {"flux_auto": lambda measured: 0.9 * measured["fluxerr_auto"]},
        {"flux_aper": lambda measured: 0.9 * measured["fluxerr_aper"]},
        {"flux_radius": lambda measured: np.full(len(measured["x"]), np.nan)},
    ],
)
def test_detections_with_hardly_any_flux_or_without_a_size_count_as_none(changes):
    sources, _, image = made_up()
    assert compared(sources, image).examples.outcomes.detected.sum() > 50
    found = compared(sources, image, **changes).examples.outcomes
    assert not found.detected.any()
    assert np.isnan(found.mag_auto).all()
    assert (found.flags == 0).all()


def test_sources_at_the_edge_without_data_or_too_faint_are_no_examples():
    sources, _, image = made_up()
    everything = compared(sources, image)
    flags = image.flags.copy()
    flags[int(np.rint(sources.y[5])), int(np.rint(sources.x[5]))] = NO_DATA
    moved = TrueSources(
        sources.ids, np.where(np.arange(120) == 7, 3.0, sources.x), sources.y, sources.magnitude, sources.radius
    )
    rows = compared(moved, ReducedImage(image.image, image.weight, flags)).rows
    assert set(everything.rows) - set(rows) == {5, 7}
    deeper = TrueSources(sources.ids, sources.x, sources.y, sources.magnitude + 1.0, sources.radius)
    assert compared(deeper, image).examples.features.brightness.max() <= frame_examples.FAINTEST


def test_cosmic_rays_are_replaced_and_sources_are_not():
    sources, light, image = made_up(brightest=-7.0)
    pixels = image.image.copy()
    pixels[200:203, 60:90] += 300.0
    replaced = frame_examples.replace_hits(
        ReducedImage(pixels, image.weight, image.flags), light, 5.0, np.random.default_rng(1)
    )
    assert np.abs(replaced.image[200:203, 60:90] - light[200:203, 60:90] - 100.0).max() < 6.0 * NOISE
    changed = replaced.image != pixels
    assert changed[199:204, 59:91].all()
    changed[199:204, 59:91] = False
    assert changed.mean() < 1e-3
    assert len(sources.ids) == 120


@pytest.mark.parametrize("part", [0.1, 0.4, 0.7])
def test_replaced_pixels_have_the_mean_sky_of_whole_numbers_of_adu(part):
    """The median of such pixels is a whole number of ADU, and wrong by up to 1.7 electrons.

    sample: 40,000 replaced pixels with a noise of 10 electrons; significance: 0.25 electrons are 5 sigma
    """
    rng, adu = np.random.default_rng(5), 3.48
    sky = (30.0 + part) * adu
    pixels = (adu * np.rint((sky + NOISE * rng.standard_normal((SIDE, SIDE))) / adu)).astype(np.float32)
    pixels[100:300, 100:300] += 1000.0
    image = ReducedImage(
        pixels, np.full((SIDE, SIDE), NOISE**-2, np.float32), np.zeros((SIDE, SIDE), np.uint8)
    )  # fmt: skip
    replaced = frame_examples.replace_hits(image, np.zeros((SIDE, SIDE)), 5.0, np.random.default_rng(1))
    assert replaced.image[100:300, 100:300].mean() == pytest.approx(sky, abs=0.25)


def test_settings_have_limits():
    for bad in ({"aperture": 0.0}, {"cosmic_rays": 1.0}):
        with pytest.raises(OutOfRange):
            Settings(**bad)
    assert Settings().facts() == {"threshold": 1.5, "pixels": 5, "aperture_fwhm": 3.0}
    assert features.psf_radius(PSF_AREA) == pytest.approx(1.1774 * SIGMA * SCALE, rel=1e-4)
