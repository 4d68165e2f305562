"""Smooth light of galaxies that exceed the largest stamp, spread along their traces.

Such a galaxy is drawn in two parts (`images.Sampling`). The sharp part is drawn on a stamp that contains it. The smooth
part is drawn with a larger stamp on a frame of pixels that are COARSE times as wide. These coarse pixels contain the
coefficients of a cubic spline, which is evaluated at the detector's pixels.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lake_schema.arrays import Float, Float32, Int
from truesky.render.dispersing import spreading
from truesky.render.dispersing.images import Sampling
from truesky.render.dispersing.stamp_sizes import COARSE, LARGE_GALAXY_SIZES, LARGEST
from truesky.render.drawing.kernels.frame import FIXED_POINT

# Width of the Gaussian that separates the smooth part, pixels: two and a half coarse pixels. Samples per coarse pixel
# along and across the trace. With one sample along, the middle of a bright bulge has an error of 5 % of its noise; with
# two, or more in both directions, 1.6 %.
_SPLIT, _ALONG, _ACROSS = 2.5 * COARSE, 2, 1


def stamp_sampling(size: int, template: Sampling, smooth: bool = False) -> Sampling:
    """Sampling of stamps of a given side.

    Parameters
    ----------
    size : int
        Side, one of SIZES or LARGE_GALAXY_SIZES.
    template : Sampling
        Samples per pixel and slope.
    smooth : bool
        For LARGE_GALAXY_SIZES: True for the smooth part, which is drawn sample by sample, and False for the sharp part.

    Returns
    -------
    Sampling
        The sampling.
    """
    if size < LARGE_GALAXY_SIZES[0]:
        return replace(template, n=size)
    sharp = replace(template, n=LARGEST, split=_SPLIT)
    return replace(sharp, n=size // COARSE, along=_ALONG, across=_ACROSS, step=COARSE) if smooth else sharp


def add(
    image: Float32, electrons: tuple[Float32, float, Float], share: Float, polynomials: tuple[Float, Float],
    times: tuple[float, float], place: tuple[float, float], stamp_sampling: Sampling, frame: Int,
) -> float:  # fmt: skip
    """Add the smooth part of an order of a large galaxy to the frame.

    Parameters
    ----------
    image : float32 array, shape (b, n along, n across)
        Spline coefficients of the smooth part.
    electrons : (float32 array, float, float array)
        Spectrum, factor and response of `spreading.spread`.
    share : float array, shape (w, b)
        Share of each PSF by wavelength.
    polynomials : (float array, float array)
        Coefficients of t^i for columns and rows along the trace, pixels.
    times : (float, float)
        Trace parameter t of the first wavelength, and its step.
    place : (float, float)
        Column and row of the undispersed image.
    stamp_sampling : Sampling
        Sampling of the image.
    frame : int array, shape (ny, nx)
        Frame in FIXED_POINT units per electron, changed in place.

    Returns
    -------
    float
        Electrons that were added to the frame.
    """
    # The spline needs one node before the frame's first pixel and two after the last.
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
