"""Stamps are as large as the light requires, for bright steep galaxies, faint ones, and ones larger than any stamp."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from benchmarks import _scenes as scenes
from tests.truesky import nightly
from tests.truesky.render.dispersing import fine
from tests.truesky.render.dispersing.made import FIRST, LAST, NODES, drawn, one, order, psf, trace
from truesky.numerics import matrices
from truesky.render.dispersing import draw, images, spreading
from truesky.render.dispersing.stamp_sizes import LARGE_GALAXY_SIZES, Sizes
from truesky.render.drawing import settings as drawing
from truesky.render.drawing import stamp_sizes, stamps
from truesky.request.accuracy import SURVEY

NOISE, COUNT = 28.0, LAST - FIRST + 1
SETTINGS = replace(draw.settings_for(SURVEY), nodes=3)


def galaxy(radius, index, fraction, column, row):
    """Return a galaxy with given half-light radii (arcsec), Sersic index, and fraction of light in the bulge."""
    found = one(scenes.sources(scenes.NISP, 8, galaxies=1, stars=0), 0)
    known = {
        "bulge_fraction": fraction, "bulge_radius": radius, "disk_radius": radius, "sersic_index": index,
        "inclination": 40.0, "bulge_axis_ratio": 0.8,
    }  # fmt: skip
    for name, value in known.items():
        getattr(found.shapes, name)[:] = value
    return fine.placed(found, column, row)


@cache
def steep():
    """Return (galaxy of 2 arcsec and n = 4, its spectrum of one electron, its order, the series of all wavelengths)."""
    shape, spectrum = (320, 288), np.zeros(COUNT)
    spectrum[::40] = 1.0 / len(spectrum[::40])
    source, orders = galaxy(2.0, 4.0, 1.0, 144.3, 159.7), [order(trace((-32.0, 64.0), 0.03))]
    return source, spectrum, orders, fine.series(source, spectrum, orders, fine.Seen.of(psf(), shape))


@pytest.mark.parametrize("electrons", [3e5, 1.2e5])
def test_aliased_light_of_large_galaxies_is_within_the_accuracy(electrons):
    """Errors of pixels are within the accuracy "survey" for columns as bright as for H = 17 and 18."""
    source, spectrum, orders, wanted = steep()
    light = (electrons * spectrum).astype(np.float32)[None]
    found = drawn(source, lambda _: light, orders, psf(), wanted.shape, NOISE, SETTINGS)
    # The series is also periodic, so only pixels far from the light of its periodic images are compared.
    error = np.abs(found - electrons * wanted)[60:-60, 40:-40]
    print("pixel", error.max(), "e-", error.max() / found.max(), "of the peak")
    assert error.max() < 0.02 * NOISE


def test_faint_galaxies_on_the_smallest_stamp_are_within_the_accuracy():
    """Errors of pixels are within the accuracy "survey", and only light of the PSF outside the stamp is missing."""
    spectrum, source = np.full((1, COUNT), 2e3 / COUNT, np.float32), galaxy(0.5, 1.0, 0.0, 60.0, 60.0)
    orders, through, frames = [order(trace((-32.0, 512.0)))], psf(), []
    for least in (SETTINGS.min_size, 128):
        tally, settings = draw.Tally.empty(1, 1), replace(SETTINGS, min_size=least)
        frames.append(drawn(source, lambda _: spectrum, orders, through, (256, 700), NOISE, settings, tally))
        assert tally.sizes[0] == least
    assert np.abs(frames[0] - frames[1]).max() < 0.02 * NOISE
    share = images.shares(np.arange(FIRST, LAST + 1.0), NODES).mean(axis=0)
    for found, least in zip(frames, (SETTINGS.min_size, 128), strict=True):
        middle, half = through.planes.images.shape[1] // 2, least * through.planes.samples // 2
        held = through.planes.images[:, middle - half : middle + half, middle - half : middle + half].sum(axis=(1, 2))
        assert found.sum() == pytest.approx(2e3 * matrices.matmul(share, held), rel=1e-3)


@pytest.mark.parametrize("peak", [1e5, 1e7])
def test_stamps_of_points_and_small_galaxies_are_at_most_as_large_as_the_psf(peak):
    """The size of the PSF is sufficient for any brightness; only galaxies with extended light need more."""
    point = one(scenes.sources(scenes.NISP, 8, galaxies=0, stars=1), 0)
    for source in (fine.placed(point, 60.0, 60.0), galaxy(0.3, 1.0, 0.0, 60.0, 60.0)):
        sizes = Sizes.from_sources(source, psf(), SETTINGS.edge * NOISE, SETTINGS.min_size)
        assert sizes.size(np.array([0]), np.array([peak]), np.array([512.0 * peak])) == psf().side


def test_an_invisible_large_galaxy_has_the_smallest_stamp():
    """Even its total light is below the negligible light of a pixel."""
    faint = Sizes.from_sources(galaxy(15.0, 1.0, 0.0, 60.0, 60.0), psf(), SETTINGS.edge * NOISE, SETTINGS.min_size)
    for electrons, wanted in ((1.0, SETTINGS.min_size), (1e8, LARGE_GALAXY_SIZES[1])):
        assert faint.size(np.array([0]), np.array([electrons / 512]), np.array([electrons])) == wanted


def test_a_coarse_frame_is_refined_as_its_spline():
    """The frame agrees with scipy within half a unit, although its size is not a multiple of coarse pixels."""
    rng, frame = np.random.default_rng(2), np.full((21, 35), 7, np.int64)
    coarse = rng.integers(-(10**6), 10**6, (9, 12))
    added = spreading.add_refined(coarse, 4, frame)
    places = np.meshgrid(*(1.0 + np.arange(n) / 4 for n in frame.shape), indexing="ij")
    wanted = map_coordinates(coarse / 16.0, places, order=3, prefilter=False)
    assert np.abs(frame - 7 - wanted).max() < 0.5 + 1e-6
    assert added == (frame - 7).sum()


@nightly.parametrize(("index", "fraction"), [(4.0, 1.0), (1.0, 0.0)], (1,))
def test_large_galaxies_agree_with_their_undispersed_images(index, fraction):
    """Each of two lines, 100 pixels apart, equals the image of a galaxy of 15 arcsec without a grism."""
    electrons, shape, source = 2e6, (260, 700), galaxy(15.0, index, fraction, 180.4, 130.2)
    at = np.rint(NODES[[0, 2]]).astype(int)
    spectrum = np.zeros((1, COUNT), np.float32)
    spectrum[0, at - FIRST] = electrons
    path, through = trace((-60.0, 120.0), 0.05), psf()
    wanted = np.zeros(shape)
    for wave in at:
        x, y = path.offsets(180.4, 130.2, np.array([float(wave)]))
        image = replace(
            source, column=source.column + x, row=source.row + y, electrons=np.array([electrons]),
            photons=images.shares(np.array([float(wave)]), NODES),
        )  # fmt: skip
        sizes = stamp_sizes.stamp_sizes(
            image.electrons, image.shape, image.shapes, through, NOISE, drawing.settings_for(SURVEY)
        )
        wanted += stamps.draw(image, sizes, through, shape[1], shape[0])
    found = drawn(source, lambda _: spectrum, [order(path)], through, shape, NOISE, SETTINGS)
    error = np.abs(found - wanted)
    print("pixel", error.max(), (error - 5e-3 * wanted).max(), "far", error[:, 500:].max(), wanted[:, 500:].max())
    assert np.all(error < 0.02 * NOISE + 5e-3 * wanted)
    assert found.sum() == pytest.approx(wanted.sum(), rel=1e-3)
