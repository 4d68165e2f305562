"""Spectra of arcs of strong lenses and of trails of moving bodies are sums of spectra of points."""

from dataclasses import replace

import numpy as np
import pytest

from tests.truesky.render.dispersing.made import FIRST, LAST, drawn, order, psf, trace
from tests.truesky.render.fields import one_source, small
from truesky.render.camera.astrometry import wcs
from truesky.render.camera.pointing import boresight_for
from truesky.render.dispersing import draw
from truesky.render.sources.lensed_arcs import Picture

# A first order with a slope along rows, and a short zeroth order with 2 % of the light.
ORDERS = (order(trace(slope=0.07)), order(trace((900.0, 10.0), order=0), 0.02))
SHAPE, NOISE = (96, 640), 1000.0
SETTINGS = draw.Settings(edge=0.001, faint=0.0)
LINE = 15_000


def source(electrons=1e6, column=290.3, row=46.8):
    detector = small("nisp", "DET22", 96)
    return one_source(detector, wcs(detector, *boresight_for(detector, 53.1, -27.8, 12.0)), electrons, column, row)


def spectra(some):
    light = np.full((len(some), LAST - FIRST + 1), 2e-4, np.float32)
    light[:, LINE - FIRST] += 1.0
    return light


def frame(sources, settings=SETTINGS):
    return drawn(sources, spectra, ORDERS, psf(), SHAPE, NOISE, settings)


def points(like, columns, rows, electrons):
    """Return points with the light of one source at other positions."""
    n = len(columns)
    some = like.take(np.zeros(n, np.int64))
    return replace(
        some, ids=np.arange(n), column=columns, row=rows, electrons=electrons, picture=None, pictures=(), trail=None
    )


def check(extended, alike, beyond, settings=SETTINGS):
    """An extended source agrees with its points within 1 % of the peak, but not with a single point.

    Faint points lack wings, so the sums of light agree only within 1 %.
    """
    found, wanted = frame(extended, settings), frame(alike, settings)
    assert abs(found.sum() / wanted.sum() - 1.0) < 0.01
    assert np.abs(found - wanted).max() < 0.01 * wanted.max()
    point = frame(replace(extended, picture=None, pictures=(), trail=None), settings)
    assert np.abs(found - point).max() > beyond * wanted.max()


def test_a_trail_is_its_points():
    """The trail is 23 pixels along a diagonal, so its line is a streak instead of a spot."""
    body, trail = source(), np.array([19.0, 13.0])
    part = (np.arange(60) + 0.5) / 60 - 0.5
    alike = points(body, body.column + part * trail[0], body.row + part * trail[1], np.full(60, 1e6 / 60))
    check(replace(body, trail=trail[None]), alike, 1.0)


@pytest.mark.nightly
def test_a_trail_of_a_thousand_pixels_is_its_points():
    """The trail is longer than the largest stamp, so it is drawn in pieces."""
    body, trail = source(), np.array([998.0, 40.0])
    part = (np.arange(1000) + 0.5) / 1000 - 0.5
    alike = points(body, body.column + part * trail[0], body.row + part * trail[1], np.full(1000, 1e3))
    check(replace(body, trail=trail[None]), alike, 1.0, replace(SETTINGS, min_size=64))


def test_an_arc_is_its_pixels():
    side, scale = 16, 0.15
    y, x = np.mgrid[:side, :side] - 0.5 * (side - 1)
    light = np.exp(-0.5 * ((np.hypot(x, y) - 4.0) / 1.0) ** 2) * (1.2 + np.cos(np.arctan2(y, x) - 0.7))
    light /= light.sum()
    body = source()
    # Columns of a picture run to the east, but the first axis of the world frame points to the west.
    across, up = np.linalg.solve(body.jacobian[0], scale * np.stack([-x.ravel(), y.ravel()]))
    alike = points(body, body.column + across, body.row + up, 1e6 * light.ravel())
    arc = replace(body, picture=np.array([0]), pictures=(Picture.from_sky_image(light.astype(np.float32), scale),))
    check(arc, alike, 1.0)
