"""Sources, a PSF and orders to disperse."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from lake_schema.mission.configuration import resolve
from truesky.render.camera.detectors import detector
from truesky.render.camera.traces import Trace
from truesky.render.dispersing import draw, images
from truesky.render.dispersing.draw import Order
from truesky.render.psf import euclid

MISSION = resolve()
DETECTOR = detector("nisp", "DET23", MISSION)
FIRST, LAST = 12060, 18920
NODES = images.nodes(FIRST, LAST, 3)


@cache
def psf(count=3):
    """NISP's, of a few wavelengths of the red grism."""
    return euclid.nisp_psf_at(DETECTOR, images.nodes(FIRST, LAST, count), MISSION, 4)


def trace(along=(-219.4, 512.0), slope=0.0, order=1, sag=0.0):
    """A trace of coefficients along the dispersion, turned."""
    x, y = np.zeros((4, 3)), np.zeros((4, 3))
    x[: len(along), 0] = along
    y[: len(along), 0] = slope * np.array(along)
    y[1:3, 0] += (sag, -sag)
    return Trace(order, float(FIRST), float(LAST), x, y)


def order(of_trace, response=1.0, first=FIRST, count=LAST - FIRST + 1):
    return Order(of_trace, first, np.full(count, float(response)))


def one(sources, i):
    """Source i alone, of one unit of its spectrum."""
    return replace(sources.take(np.array([i])), electrons=np.ones(1))


def drawn(sources, spectra, orders, through, shape, noise, settings, tally=None):
    """The frame of sources with their spectra."""
    return draw.draw(sources, draw.DispersedSources(spectra, tuple(orders), settings), through, shape, noise, tally)
