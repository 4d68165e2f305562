"""Spectra with survey settings agree with galsim at every tenth of a pixel and a PSF of nine wavelengths."""

from functools import cache

import numpy as np
import pytest

from benchmarks import _scenes as scenes
from tests.truesky import nightly
from tests.truesky.render.dispersing import fine
from tests.truesky.render.dispersing.made import DETECTOR, FIRST, LAST, MISSION, drawn, one, order, psf
from truesky.render.camera import traces
from truesky.render.dispersing import draw
from truesky.request.accuracy import REFERENCE, SURVEY

WAVES = np.arange(float(FIRST), LAST + 1.0)
NOISE, HIGH, SEED = 28.0, 96, 20_611
SETTINGS = draw.settings_for(SURVEY)
# Grism, requested tilt, source, electrons of its first order, first wavelength with light (A from that of the band).
STAR, DISC, COMPACT, STEEP, EDGE, FAINT = range(6)
CASES = [
    ("RGS000", 0.0, STAR, 4e5, 0), ("RGS180", 4.0, DISC, 4e4, 1700), ("RGS000", -4.0, COMPACT, 6e3, 3400),
    ("RGS000", 4.0, STEEP, 6e4, 5100), ("RGS000", 0.0, EDGE, 2e4, 2500), ("RGS180", 4.0, STAR, 5e4, 5100),
    ("RGS000", -4.0, FAINT, 3e3, 800), ("RGS180", 0.0, COMPACT, 2e4, 4200), ("RGS000", -4.0, STEEP, 2e4, 1200),
]  # fmt: skip
# Lengths of the compared spectra, A: a quarter of the band, or a range that takes a second.
LONG, SHORT = 1700, 240


@cache
def sources():
    """Return a star and galaxies: a disc, a compact one, a steep bulge, one edge-on, and a small and faint one."""
    some = scenes.sources(scenes.NISP, SEED, galaxies=5, stars=1).take(np.array([5, 0, 1, 2, 3, 4]))
    known = {
        "bulge_fraction": (0.0, 0.4, 0.9, 0.1, 0.2), "bulge_radius": (0.3, 0.15, 0.35, 0.2, 0.1),
        "disk_radius": (0.9, 0.2, 0.5, 0.8, 0.25), "sersic_index": (1.0, 2.5, 4.0, 1.5, 1.2),
        "inclination": (35.0, 50.0, 40.0, 85.0, 20.0), "bulge_axis_ratio": (1.0, 0.8, 0.7, 0.9, 1.0),
    }  # fmt: skip
    for name, values in known.items():
        getattr(some.shapes, name)[:5] = values
    return some


@cache
def trace(grism, tilt, number):
    return next(one for one in traces.traces(grism, tilt, DETECTOR, MISSION) if one.order == number)


def spectrum(electrons, first, length):
    """Return electrons [w] of a continuum and two lines in a part of the band.

    They are as bright as if the whole band contained `electrons`.
    """
    here = (FIRST + first <= WAVES) & (FIRST + first + length > WAVES)
    light = np.where(here, (WAVES / 15000.0) ** -1.5, 0.0)
    light *= electrons / len(WAVES)
    for part in (0.3, 0.8):
        off = (WAVES - FIRST - first - part * length) / 8.0
        light += np.where(here & (np.abs(off) < 6.0), 0.05 * electrons / 20.0 * np.exp(-0.5 * off**2), 0.0)
    return light


def compared(case, length, number=1, settings=SETTINGS, nodes=SETTINGS.nodes):
    """Return (largest error of a pixel, brightest pixel) of an order of a case; only first orders have all light."""
    grism, tilt, which, electrons, first = case
    path, light, source = trace(grism, tilt, number), spectrum(electrons, first, length), one(sources(), which)
    reached = path.offsets(0.0, 0.0, WAVES[light > 0.0])
    # The light is in the middle of the frame.
    wide = int(np.ptp(reached[0])) + HIGH
    source = fine.placed(
        source, *(0.5 * n + 0.37 - float(o.mean()) for n, o in zip((wide, HIGH), reached, strict=True))
    )
    some = order(path, 1.0 if number == 1 else 0.02)
    wanted = fine.by_galsim(source, light, some, psf(9), (HIGH, wide), 64)
    got = drawn(source, lambda _: light[None].astype(np.float32), [some], psf(nodes), (HIGH, wide), NOISE, settings)
    print(case, number, "peak", wanted.max(), "pixel", np.abs(got - wanted).max() / wanted.max())
    return np.abs(got - wanted).max(), wanted.max()


def within(error, peak):
    assert peak > 1.0
    assert error < 5e-3 * peak
    assert error < 0.1 * NOISE or peak > 1e3


@pytest.mark.nightly
@pytest.mark.parametrize("case", CASES)
def test_first_orders_are_as_galsim_draws_them(case):
    within(*compared(case, LONG))


@nightly.parametrize("case", [CASES[1], CASES[5]], (1,))
def test_a_piece_of_a_first_order_is_as_galsim_draws_it(case):
    within(*compared(case, SHORT))


@nightly.parametrize(
    "case", [CASES[1], CASES[2], *(pytest.param(c, marks=pytest.mark.nightly) for c in CASES[3:5])], (0,)
)
def test_zeroth_orders_are_as_galsim_draws_them(case):
    """The whole band is within ten pixels, and the PSF changes by half over the band."""
    within(*compared((*case[:3], 50.0 * case[3], 0), len(WAVES), 0))


@nightly.parametrize("accuracy", [SURVEY, REFERENCE], (0,))
def test_a_star_s_zeroth_order_is_as_galsim_draws_it(accuracy):
    """The order is the brightest possible, and nearly as sharp as the PSF."""
    settings = draw.settings_for(accuracy)
    within(*compared((*CASES[0][:3], 2e7, 0), len(WAVES), 0, settings, settings.nodes))
