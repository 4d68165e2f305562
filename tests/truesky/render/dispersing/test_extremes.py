"""Spectra at the extremes: hardly any dispersion, one wavelength, all light outside the frame, a crowd."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import _scenes as scenes
from tests.truesky import nightly
from tests.truesky.render.dispersing import fine
from tests.truesky.render.dispersing.made import FIRST, LAST, drawn, one, order, psf, trace
from truesky.render.dispersing import draw
from truesky.request.accuracy import DRAFT, SURVEY

COUNT = LAST - FIRST + 1
FLAT = np.full((1, COUNT), 1e4 / COUNT, np.float32)
SETTINGS = replace(draw.settings_for(SURVEY), min_size=64)


def some(i=1):
    """Return a galaxy, or the star (4), in the middle of a small frame."""
    return fine.placed(one(scenes.sources(scenes.NISP, 8, galaxies=4, stars=1), i), 64.3, 63.8)


def total(orders, spectrum=FLAT, i=1):
    tally = draw.Tally.empty(1, len(orders))
    frame = drawn(some(i), lambda _: spectrum, orders, psf(), (128, 128), 1.0, SETTINGS, tally)
    assert np.isfinite(frame).all()
    assert frame.sum() == pytest.approx(tally.electrons.sum(), rel=1e-9)
    return frame


@pytest.mark.parametrize("length", [0.0, 1e-300, 1e-12, 1e-3, -1e-9, -0.5, 0.9])
@nightly.parametrize("i", [1, 4], (1,))
def test_light_that_is_not_spread_is_an_image(length, i):
    """With hardly any dispersion, flux and position are the same as in an undispersed image."""
    frame = total([order(trace((0.0, length)))], i=i)
    assert frame.sum() == pytest.approx(1e4, rel=0.02)
    wanted = total([order(trace((0.5 * length, 1e-6)))], i=i)
    assert np.abs(frame - wanted).max() < (1e-3 + 0.3 * length**2) * wanted.max()


@pytest.mark.parametrize("at", [0, COUNT // 2, COUNT - 1])
def test_a_spectrum_of_one_bin_is_an_image_where_its_wavelength_lies(at):
    spectrum = np.zeros((1, COUNT), np.float32)
    spectrum[0, at] = 1e4
    path = trace((-20.0, 40.0), 0.05)
    frame = total([order(path)], spectrum)
    wide = total([order(trace((-20.0 + 40.0 * at / (COUNT - 1), 1e-6), 0.05))], spectrum)
    assert frame.sum() == pytest.approx(wide.sum(), rel=1e-3)
    assert np.abs(frame - wide).max() < 0.01 * wide.max()


def test_a_band_of_one_wavelength_is_an_image():
    frame = total([order(trace((-20.0, 40.0)), 1.0, FIRST, 1)], FLAT[:, :1] * COUNT)
    assert frame.sum() == pytest.approx(1e4, rel=0.02)
    assert np.average(np.arange(128), weights=frame.sum(axis=0)) == pytest.approx(44.3, abs=0.3)


def test_dark_spectra_and_orders_without_light_draw_nothing():
    assert not total([order(trace((-20.0, 40.0)))], np.zeros((1, COUNT), np.float32)).any()
    assert not total([order(trace((-20.0, 40.0)), 0.0)]).any()


@pytest.mark.parametrize("away", [1e3, 1e6, 1e12, -1e12])
def test_all_orders_beside_the_frame(away):
    orders = [order(trace((away, 512.0))), order(trace((away, 1024.0), order=2))]
    assert not total(orders).any()


def test_a_trace_that_is_long_costs_no_more_than_the_frame():
    """The trace is 100 000 pixels long, of which 128 are on the frame."""
    tracemalloc.start()
    frame = total([order(trace((-5e4, 1e5)))], FLAT * 1e3)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert frame.sum() == pytest.approx(1e7 * 128 / 1e5, rel=0.1)
    assert peak < 200e6


@pytest.mark.parametrize(
    ("count", "settings"),
    [(2500, DRAFT), pytest.param(50_000, SURVEY, marks=pytest.mark.nightly)],
)
def test_a_crowd_takes_the_memory_of_a_frame(count, settings):
    """The nightly test has 50 000 sources. The short test has the same density on a twentieth of the frame."""
    rng, shape = np.random.default_rng(1), (2040, 2040 * count // 50_000)
    crowd = scenes.sources(scenes.NISP, 5, galaxies=count * 9 // 10, stars=count // 10)
    crowd.column[:], crowd.row[:] = rng.uniform(0, shape[1], len(crowd)), rng.uniform(0, shape[0], len(crowd))
    tally, spectrum = draw.Tally.empty(len(crowd), 1), np.full(COUNT, 10.0 / COUNT, np.float32)
    orders = [order(trace((-219.0, 512.0), 0.05))]
    through = psf()
    tracemalloc.start()
    frame = drawn(
        crowd,
        lambda which: np.tile(spectrum, (len(which), 1)),
        orders,
        through,
        shape,
        28.0,
        draw.settings_for(settings),
        tally,
    )
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert np.isfinite(frame).all()
    assert frame.sum() == pytest.approx(tally.electrons.sum(), rel=1e-9)
    assert peak < 120e6 + 6 * frame.nbytes + 4000 * len(crowd)
