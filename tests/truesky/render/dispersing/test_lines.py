"""Emission lines of galaxies with survey settings agree with series of all wavelengths and a PSF of more nodes."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks import _scenes as scenes
from tests.truesky import nightly
from tests.truesky.render.dispersing import fine
from tests.truesky.render.dispersing.made import DETECTOR, FIRST, LAST, MISSION, drawn, one, order, psf
from truesky.render.camera import traces
from truesky.render.dispersing import draw
from truesky.request.accuracy import SURVEY

WAVES = np.arange(float(FIRST), LAST + 1.0)
# The seed was not used to choose settings.
SEED, NOISE, SIDE, MIDDLE = 190_611, 28.0, 96, 48.0
TURNS = (("RGS000", 0.0), ("RGS180", 4.0), ("RGS000", -4.0), ("RGS180", 0.0))
SETTINGS = draw.settings_for(SURVEY)


@cache
def first_order(grism, tilt):
    return next(trace for trace in traces.traces(grism, tilt, DETECTOR, MISSION) if trace.order == 1)


@cache
def seen():
    """Return a PSF of five wavelengths on the frame."""
    return fine.Seen.of(psf(5), (SIDE, SIDE))


@cache
def galaxies(count):
    """Return galaxies of 20 to 24 mag with half-light radii of 0.2" to 1.5"."""
    some = scenes.sources(scenes.NISP, SEED, galaxies=60 * count, stars=0)
    mag = scenes.magnitudes(some, scenes.NISP)
    return some.take(np.flatnonzero((mag > 20.0) & (mag < 24.0))[:count])


def halpha(rng):
    """Return electrons [w] of H alpha between the lines of nitrogen, at a random wavelength, and this wavelength."""
    centre, width = rng.uniform(FIRST + 200.0, LAST - 200.0), rng.uniform(1e-4, 7e-4)
    spectrum = np.zeros(len(WAVES))
    ratio = rng.uniform(0.05, 0.6)
    for rest, light in ((6549.86, ratio / 3.0), (6564.61, 1.0), (6585.27, ratio)):
        at = centre * rest / 6564.61
        off = (WAVES - at) / (width * at)
        spectrum += light * np.where(np.abs(off) < 6.0, np.exp(-0.5 * off**2), 0.0)
    return spectrum * 10.0 ** rng.uniform(2.3, 3.7) / spectrum.sum(), centre


def at_middle(source, trace, centre, rng, middle=MIDDLE):
    """Return the source at a position from which its line falls onto the middle of a small frame."""
    x, y = trace.offsets(0.0, 0.0, np.array([centre]))
    return fine.placed(source, *(middle + rng.uniform(-0.5, 0.5) - float(offset[0]) for offset in (x, y)))


def line(frame, middle):
    """Return (flux in 17 x 9 pixels, centroid along and across under a Gaussian weight) near a position."""
    rows, columns = np.indices(frame.shape)
    column, row = middle
    weight = np.exp(-0.5 * (((columns - column) / 4.0) ** 2 + ((rows - row) / 2.0) ** 2))
    box = (np.abs(columns - round(column)) <= 8) & (np.abs(rows - round(row)) <= 4)
    seen = weight * frame
    return frame[box].sum(), (seen * columns).sum() / seen.sum(), (seen * rows).sum() / seen.sum()


def frame(source, spectrum, trace, shape=(SIDE, SIDE), settings=SETTINGS):
    of = spectrum[None].astype(np.float32)
    return drawn(source, lambda _: of, [order(trace)], psf(), shape, NOISE, settings)


def held(count, turns=TURNS):
    """Return the errors [n, 3] of lines: relative flux, and position along and across (pixels)."""
    found, rng, some = [], np.random.default_rng(SEED), galaxies(count)
    for i in range(count):
        grism, tilt = turns[i % len(turns)]
        trace = first_order(grism, tilt)
        spectrum, centre = halpha(rng)
        source = at_middle(one(some, i), trace, centre, rng)
        wanted = fine.series(source, spectrum, [order(trace)], seen())
        own, other = (line(one, (MIDDLE, MIDDLE)) for one in (frame(source, spectrum, trace), wanted))
        found.append((own[0] / other[0] - 1.0, own[1] - other[1], own[2] - other[2]))
    return np.array(found)


def within(found):
    """Check fluxes, and positions along and across the dispersion."""
    flux, along, across = np.abs(found).T
    print("flux rms, largest; along, across largest:", np.sqrt((flux**2).mean()), flux.max(), along.max(), across.max())
    assert along.max() < 0.01
    assert across.max() < 0.01
    assert np.sqrt((flux**2).mean()) < 2e-4
    assert flux.max() < 1e-3


@pytest.mark.parametrize("count", [8, pytest.param(40, marks=pytest.mark.nightly)])
def test_lines_have_their_flux_and_lie_at_their_wavelength(count):
    """There are several galaxies, with the angles of the grisms in a sequence."""
    within(held(count))


@pytest.mark.nightly
def test_lines_of_many_galaxies():
    found = held(400)
    assert len(found) >= 400
    within(found)


@nightly.parametrize(("block", "error"), [(1.0, 1e-6), (SETTINGS.block, 5e-6)], (0,))
def test_a_line_and_a_continuum_apart_are_the_two_together(block, error):
    """Stamps have one size. Pixels differ by rounding in single precision, and by blocks that share a PSF."""
    rng, settings = np.random.default_rng(SEED), replace(SETTINGS, min_size=96, edge=0.1, block=block)
    for i, (grism, tilt) in enumerate(TURNS):
        trace = first_order(grism, tilt)
        spectrum, centre = halpha(rng)
        source = at_middle(one(galaxies(4), i), trace, centre, rng, 128.0)
        continuum = 0.5 * (WAVES / 15000.0) ** -2
        line, level, both = (
            frame(source, part, trace, (256, 256), settings) for part in (spectrum, continuum, spectrum + continuum)
        )
        assert np.abs(line + level - both).max() < error * both.sum()
        assert line.sum() + level.sum() == pytest.approx(both.sum(), rel=2.0 * error)
