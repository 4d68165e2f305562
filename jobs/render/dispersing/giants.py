"""The smooth light of galaxies that no stamp holds, spread along their traces.

A giant is drawn in two parts (images.Sampling): what is sharp on its own stamp, which holds it, and what is smooth on a
frame of pixels COARSE times as wide, by a stamp so much larger, from which the detector's pixels are interpolated.

sampling     of the stamps of a side
add          the smooth part of an order of a giant, onto the frame
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import RectBivariateSpline

from jobs.render.dispersing import spreading
from jobs.render.dispersing.images import Sampling
from jobs.render.dispersing.stamp_sizes import COARSE, GIANT, SIZES
from jobs.render.drawing.kernels.frame import FIXED_POINT
from lake_schema.arrays import Float, Float32, Int

# Pixels: the smooth part is nothing but what a Gaussian of this width leaves, two nodes of the coarse frame.
_SPLIT = 2.0 * COARSE
# Nodes of the coarse frame beyond the other, which the interpolation is good for up to the edge with.
_BESIDE = 6


def sampling(size: int, like: Sampling, smooth: bool = False) -> Sampling:
    """Of stamps of one of SIZES; of GIANT: the sharp part, or the smooth one, which is drawn sample by sample.

    like : samples a pixel and slope
    """
    if size < GIANT:
        return replace(like, n=size)
    whole = replace(like, n=int(SIZES[-1]), split=_SPLIT)
    return replace(whole, step=COARSE) if smooth else whole


def add(
    image: Float32, electrons: tuple[Float32, float, Float], share: Float, polynomials: tuple[Float, Float],
    times: tuple[float, float], place: tuple[float, float], like: Sampling, frame: Int,
) -> float:  # fmt: skip
    """Adds the smooth part of an order of a giant to the frame, in FIXED_POINT of an electron; returns what fell there.

    image       : float32[b, n along, n across] spline coefficients of its smooth part;  like : their sampling
    electrons   : spectrum, factor and response of spreading.spread;  share, times : as there
    polynomials : of columns and of rows along the trace, pixels;  place : column and row of the undispersed image
    """
    rows, columns = ((n - 1) // COARSE + 2 + 2 * _BESIDE for n in frame.shape)
    coarse = np.zeros((rows, columns), np.int64)
    along, across = (part / COARSE for part in polynomials)
    start = place[0] / COARSE + _BESIDE, place[1] / COARSE + _BESIDE
    spectrum, factor, response = electrons
    spreading.spread(
        image, spectrum, factor, response, share, along, across, times, start, *like.rows, like.shape, 0, FIXED_POINT,
        coarse,
    )  # fmt: skip
    y, x = (COARSE * (np.arange(float(n)) - _BESIDE) for n in coarse.shape)
    light = RectBivariateSpline(y, x, coarse / COARSE**2)(*(np.arange(float(n)) for n in frame.shape))
    units = np.rint(light).astype(np.int64)
    frame += units
    return float(units.sum() / FIXED_POINT)
