"""Spectra on the detector agree with Fourier series of all wavelengths, and conserve light and positions."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import _scenes as scenes
from tests.truesky import nightly
from tests.truesky.render.dispersing import fine
from tests.truesky.render.dispersing.made import FIRST, LAST, drawn, one, order, psf, trace
from truesky.render.dispersing import draw, images, kernels

WAVES = np.arange(float(FIRST), LAST + 1.0)
FINE = draw.Settings(edge=1e-9, faint=0.0, along=3)


@nightly.parametrize(
    ("slope", "sag", "along"),
    [pytest.param(0.0, 0.0, 1, marks=pytest.mark.nightly), (0.07, 1.5, 1), (-0.07, -1.5, -1)],
    (2,),
)
def test_straight_traces_are_drawn_as_sample_by_sample(slope, sag, along):
    """A galaxy and a star agree if wavelengths in blocks of 110 A share a PSF.

    The traces run along and against the rows, and are as curved as traces of NISP.
    """
    through = psf()
    path = trace((300.0 if along < 0 else -10.0, along * 512.0), slope, sag=4.0 * sag)
    path.y[2, 0] = -4.0 * sag
    path.x[1, 0] = along * 512.0
    spectrum = continuum_and_line(300.0).astype(np.float32)[None]
    for i in (1, 4):
        source = placed(8, i, 60.3 if along > 0 else 260.2, 50.6)
        fast, slow = (
            drawn(
                source, lambda some: spectrum, [order(path)], through, (128, 640), 1.0,
                draw.Settings(edge=1e-6, min_size=64, block=block),
            )
            for block in (110.0, 0.0)
        )  # fmt: skip
        assert slow.sum() > 0.9 * spectrum.sum()
        assert fast.sum() == pytest.approx(slow.sum(), rel=1e-5)
        assert np.abs(fast - slow).max() < 3e-3 * slow.max()
        # A block has the PSF of its middle, which is 0.4 % narrower or wider than the PSF at its ends.
        assert np.abs(fast - slow).mean() < 3e-3 * slow.mean()


@nightly.parametrize("slope", [0.0, 0.07], (1,))
def test_orders_share_images_and_are_drawn_as_from_their_own(slope, monkeypatch):
    """An order that is curved within a few pixels shares the sheared stamps of a straight order."""
    bent, straight = trace((-70.0, 5.0, 2.0, -1.0), -0.03, 0, 1.0), trace((-10.0, 512.0), slope)
    orders, made, planes = [order(straight), order(bent, 0.2)], [], images.planes
    monkeypatch.setattr(images, "planes", lambda *which: made.append(which[1]) or planes(*which))
    spectrum = continuum_and_line(300.0).astype(np.float32)[None]
    for i in (1, 4):
        source, shape, found = placed(8, i, 150.3, 60.6), (128, 720), []
        for block in (110.0, 0.0):
            settings, layers = draw.Settings(edge=0.01, min_size=64, block=block), {}
            made.clear()
            draw.draw(
                source,
                draw.DispersedSources(lambda some: spectrum, tuple(orders), settings),
                psf(),
                shape,
                1.0,
                None,
                layers,
            )
            found.append(layers[0])
            assert {sampling.straight for sampling in made} == {block > 0.0}
        shared, own = found
        assert own.sum() > 0.15 * spectrum.sum()
        assert shared.sum() == pytest.approx(own.sum(), rel=1e-4)
        assert np.abs(shared - own).max() < 1e-3 * own.max()


def placed(seed, i, column, row, galaxies=4, stars=1):
    source = one(scenes.sources(scenes.NISP, seed, galaxies=galaxies, stars=stars), i)
    source.column[:], source.row[:] = column, row
    return source


def continuum_and_line(line=0.0, every=20):
    """Return a continuum with a mean of one electron per A, in one of `every` bins, and a line at 1.5 um."""
    spectrum = np.zeros(len(WAVES))
    spectrum[::every] = every
    spectrum[int(15000 - FIRST)] += line
    return spectrum


@pytest.mark.parametrize(
    ("i", "slope"),
    [
        (0, 0.07),
        (4, 0.0),
        *(pytest.param(i, slope, marks=pytest.mark.nightly) for i, slope in ((0, 0.0), (1, 0.0), (1, 0.07), (4, 0.07))),
    ],
)
def test_spectra_are_the_series_of_every_wavelength(i, slope):
    """The first order is 64 pixels long. The sources are galaxies and a star."""
    source, through, short = placed(8, i, 47.3, 33.6), psf(), trace((-10.0, 64.0), slope)
    spectrum = continuum_and_line(3000.0)
    shape = (72, 160)
    wanted = fine.series(source, spectrum, [order(short)], fine.Seen.of(through, shape))
    settings = draw.Settings(edge=1e-9, faint=0.0, min_size=64)
    found = drawn(source, lambda some: spectrum[None].astype(np.float32), [order(short)], through, shape, 1.0, settings)
    assert np.abs(found - wanted).max() < 5e-3 * wanted.max()
    finely = drawn(source, lambda some: spectrum[None].astype(np.float32), [order(short)], through, shape, 1.0, FINE)
    assert np.abs(finely - wanted).max() < 1.5e-3 * wanted.max()


def test_laying_keeps_the_total_and_the_mean_of_a_line():
    rng = np.random.default_rng(4)
    for _ in range(20):
        electrons, along = rng.random(50), np.array([rng.uniform(0, 3), rng.uniform(5, 40), rng.uniform(-2, 2)])
        laid = np.zeros((1, 400))
        times = (rng.uniform(-0.1, 0.1), 0.02)
        kernels.add_to_trace(electrons, along, times, 7.25, 3, np.ones((1, 50)), -20, laid)
        t = times[0] + times[1] * np.arange(50)
        places = 3 * (7.25 + np.polynomial.polynomial.polyval(t, along))
        samples = -20 + np.arange(400)
        assert laid.sum() == pytest.approx(electrons.sum(), rel=1e-13)
        assert (laid[0] * samples).sum() == pytest.approx((electrons * places).sum(), rel=1e-12)
        # A spline of degree 5 adds 6 / 12 of a squared sample to the second moment, and nothing else does.
        spread = (electrons * places**2).sum() + 0.5 * electrons.sum()
        assert (laid[0] * samples**2).sum() == pytest.approx(spread, rel=1e-12)


def test_shares_of_the_nodes_sum_to_one_and_are_one_at_each():
    nodes = images.nodes(FIRST, LAST, 4)
    share = images.shares(WAVES, nodes)
    np.testing.assert_allclose(share.sum(axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(images.shares(nodes, nodes), np.eye(4), atol=1e-12)


def test_all_light_of_an_order_is_on_a_frame_that_holds_it():
    """Only light outside the planes of the PSF is missing, and the tally contains the drawn light."""
    source, through = placed(8, 1, 140.0, 60.0), psf()
    spectrum = continuum_and_line()
    orders = [order(trace((-60.0, 120.0), 0.03)), order(trace((-70.0, 3.0, 1.0, -0.5), order=0), 0.1)]
    tally = draw.Tally.empty(1, 2)
    settings = draw.Settings(edge=1e-9, faint=0.0, min_size=96)
    frame = drawn(
        source, lambda some: spectrum[None].astype(np.float32), orders, through, (160, 300), 1.0, settings, tally
    )
    assert tally.electrons[0].sum() == pytest.approx(frame.sum(), rel=1e-9)
    for electrons, part in zip(tally.electrons[0], orders, strict=True):
        assert electrons == pytest.approx((spectrum * part.response).sum(), rel=0.02)


def test_light_below_zero_is_taken_off():
    """A response with both signs gives the drawing of its positive part minus the drawing of its negative part."""
    source, through, spectrum = placed(8, 1, 60.3, 50.6), psf(), continuum_and_line().astype(np.float32)[None]
    response, found = np.sin(np.linspace(0.0, 9.0, len(WAVES))), []
    for own in (response, np.maximum(response, 0.0), np.maximum(-response, 0.0)):
        orders = [replace(order(trace((-10.0, 512.0), 0.07)), response=own)]
        found.append(drawn(source, lambda _: spectrum, orders, through, (128, 640), 1.0, draw.Settings(min_size=64)))
    both, added, taken = found
    assert added.max() > 1.0 < taken.max()
    assert np.abs(both - (added - taken)).max() < 2e-3 * added.max()


def test_sources_add_up_in_any_order_bit_by_bit():
    all_of_them = scenes.sources(scenes.NISP, 3, galaxies=6, stars=2)
    all_of_them.column[:], all_of_them.row[:] = np.linspace(20, 220, 8), np.linspace(10, 90, 8)
    all_of_them.electrons[:] = 1.0
    spectrum, through, orders = continuum_and_line(500.0), psf(), [order(trace((-30.0, 90.0), 0.05))]

    def of(sources):
        made = lambda some: np.tile(spectrum, (len(some), 1)).astype(np.float32)  # noqa: E731
        return drawn(sources, made, orders, through, (100, 240), 1.0, draw.Settings())

    wanted = of(all_of_them)
    np.testing.assert_array_equal(of(all_of_them.take(np.arange(8)[::-1])), wanted)
    np.testing.assert_array_equal(sum(of(all_of_them.take(np.array([i]))) for i in range(8)), wanted)


def test_orders_outside_the_detector_or_below_the_noise_are_not_drawn():
    source, through = placed(8, 1, 140.0, 60.0), psf()
    spectrum = continuum_and_line().astype(np.float32)[None]
    beside = [order(trace((5000.0, 100.0)))]
    assert drawn(source, lambda some: spectrum, beside, through, (100, 240), 1.0, draw.Settings()).sum() == 0.0
    here = [order(trace((-30.0, 90.0)))]
    assert drawn(source, lambda some: spectrum, here, through, (100, 240), 1e6, draw.Settings()).sum() == 0.0


@pytest.mark.parametrize("count", [4, pytest.param(12, marks=pytest.mark.nightly)])
def test_a_line_lies_where_its_wavelength_does(count):
    """The centroid of a narrow line agrees within 0.01 pixel with an undispersed image, at several positions."""
    through, rng = psf(), np.random.default_rng(7)
    off = []
    for _ in range(count):
        source = placed(int(rng.integers(1000)), int(rng.integers(4)), rng.uniform(60, 64), rng.uniform(40, 44))
        path = trace((-30.0, 90.0), rng.uniform(-0.07, 0.07), sag=rng.uniform(-1, 1))
        spectrum = np.zeros((1, len(WAVES)), np.float32)
        spectrum[0, 3000] = 1000.0
        frame = drawn(
            source,
            lambda some, of=spectrum: of,
            [order(path)],
            through,
            (84, 160),
            1.0,
            draw.Settings(edge=1e-6, min_size=64),
        )
        x, y = path.offsets(float(source.column[0]), float(source.row[0]), WAVES[3000:3001])
        rows, columns = np.indices(frame.shape)
        own = frame.sum()
        wanted = draw_of_all(source, through, float(source.column[0] + x[0]), float(source.row[0] + y[0]))
        off.append(((frame * columns).sum() / own - wanted[0], (frame * rows).sum() / own - wanted[1]))
    assert np.abs(off).max() < 0.01


def draw_of_all(source, through, column, row):
    """Return the centroid of the same source without dispersion, in the light of its line."""
    still = placed_at(source, column, row)
    flat = [order(trace((0.0, 1e-6)))]
    spectrum = np.zeros((1, len(WAVES)), np.float32)
    spectrum[0, 3000] = 1000.0
    frame = drawn(still, lambda some: spectrum, flat, through, (84, 160), 1.0, draw.Settings(edge=1e-6, min_size=64))
    rows, columns = np.indices(frame.shape)
    return (frame * columns).sum() / frame.sum(), (frame * rows).sum() / frame.sum()


def placed_at(source, column, row):
    moved = source.take(np.array([0]))
    moved.column[:], moved.row[:] = column, row
    return moved
