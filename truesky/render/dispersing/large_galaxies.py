"""The smooth light of galaxies that no stamp holds, spread along their traces.

A giant is drawn in two parts (images.Sampling): what is sharp on its own stamp, which holds it, and what is smooth on a
frame of pixels COARSE times as wide, by a stamp so much larger.  What is drawn there are coefficients of a cubic spline
through the coarse pixels, which the detector's are taken from.

sampling     of the stamps of a side
add          the smooth part of an order of a giant, onto the frame
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lake_schema.arrays import Float, Float32, Int
from truesky.render.dispersing import spreading
from truesky.render.dispersing.images import Sampling
from truesky.render.dispersing.stamp_sizes import COARSE, LARGE_GALAXY_SIZES, LARGEST
from truesky.render.drawing.kernels.frame import FIXED_POINT

# Pixels: the smooth part is nothing but what a Gaussian of this width leaves, two and a half nodes of the coarse frame.
# Its samples a node, along the trace and across: with one along, the middle of a bright bulge is wrong by 5 % of its
# noise; with two, or with more of both, by 1.6 %.
_SPLIT, _ALONG, _ACROSS = 2.5 * COARSE, 2, 1


def stamp_sampling(size: int, template: Sampling, smooth: bool = False) -> Sampling:
    """Of stamps of one of SIZES; of GIANTS: the sharp part, or the smooth one, which is drawn sample by sample.

    like : samples a pixel and slope
    """
    if size < LARGE_GALAXY_SIZES[0]:
        return replace(template, n=size)
    sharp = replace(template, n=LARGEST, split=_SPLIT)
    return replace(sharp, n=size // COARSE, along=_ALONG, across=_ACROSS, step=COARSE) if smooth else sharp


def add(
    image: Float32, electrons: tuple[Float32, float, Float], share: Float, polynomials: tuple[Float, Float],
    times: tuple[float, float], place: tuple[float, float], stamp_sampling: Sampling, frame: Int,
) -> float:  # fmt: skip
    """Adds the smooth part of an order of a giant to the frame, in FIXED_POINT of an electron; returns what fell there.

    image       : float32[b, n along, n across] spline coefficients of its smooth part;  like : their sampling
    electrons   : spectrum, factor and response of spreading.spread;  share, times : as there
    polynomials : of columns and of rows along the trace, pixels;  place : column and row of the undispersed image
    """
    # A node before the first of the frame's pixels and two behind the last.
    rows, columns = ((n - 1) // COARSE + 4 for n in frame.shape)
    coarse = np.zeros((rows, columns), np.int64)
    along, across = (part / COARSE for part in polynomials)
    start = place[0] / COARSE + 1.0, place[1] / COARSE + 1.0
    spectrum, factor, response = electrons
    spreading.spread(
        image,
        spectrum,
        factor,
        response,
        share,
        along,
        across,
        times,
        start,
        *stamp_sampling.rows,
        stamp_sampling.shape,
        0,
        FIXED_POINT,
        coarse,
    )
    return float(spreading.add_refined(coarse, COARSE, frame) / FIXED_POINT)
