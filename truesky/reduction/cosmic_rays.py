"""Find cosmic rays in a calibrated image, which are sharper than point sources.

References
----------
van Dokkum 2001, PASP 113, 1420 (L.A.Cosmic), in the implementation of astroscrappy.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from astroscrappy import detect_cosmics

from lake_schema.arrays import Bool
from lake_schema.errors import OutOfRange
from truesky.reduction.calibration import COSMIC_RAY, SATURATED, ReducedImage

# Limit for the neighbours of a hit relative to the main limit; minimum contrast to fine structure; iterations.
_NEIGHBOUR_FACTOR, _CONTRAST, _ROUNDS = 0.3, 5.0, 4
# Rows that are searched at a time (to limit memory), and additional rows on both sides.
_ROWS, _MARGIN = 1024, 64


def check_limit(limit: float) -> None:
    """Check the limit of `find_hits`; raises OutOfRange if it is outside 1 to 1000."""
    if not 1.0 <= limit <= 1e3:
        raise OutOfRange("--cosmic-rays", limit, 1.0, 1e3)


def find_hits(image: ReducedImage, limit: float) -> Bool:
    """Find the pixels hit by cosmic rays.

    Parameters
    ----------
    image : ReducedImage
        Image with weights.
    limit : float
        Limit of a pixel's Laplacian in standard deviations of the noise, 1 to 1000.

    Returns
    -------
    bool array, shape (ny, nx)
        True for hit pixels.

    Notes
    -----
    Hits as faint as the noise and hits on saturated pixels are not found. If point sources are narrower than two
    pixels, their central pixels may be flagged.
    """
    check_limit(limit)
    used = image.weight > 0.0
    if not used.any():
        return np.zeros(used.shape, bool)
    typical = 1.0 / float(np.median(image.weight[used]))
    variance = np.full(used.shape, typical, np.float32)
    np.divide(np.float32(1.0), image.weight, out=variance, where=used)
    out = np.zeros(used.shape, bool)
    for first in range(0, len(out), _ROWS):
        padded = slice(max(first - _MARGIN, 0), first + _ROWS + _MARGIN)
        hit, _ = detect_cosmics(
            np.ascontiguousarray(image.image[padded], np.float32), inmask=~used[padded], invar=variance[padded],
            sigclip=limit, sigfrac=_NEIGHBOUR_FACTOR, objlim=_CONTRAST, gain=1.0, satlevel=np.inf, niter=_ROUNDS,
            fsmode="median",
        )  # fmt: skip
        out[first : first + _ROWS] = hit[first - padded.start :][:_ROWS]
    return out & used


def flag_hits(image: ReducedImage, hit: Bool) -> ReducedImage:
    """Flag hit pixels, and set their weight to 0, except in saturated pixels."""
    hit = hit & (image.flags & SATURATED == 0)
    flags = np.where(hit, image.flags | COSMIC_RAY, image.flags).astype(np.uint8)
    return replace(image, weight=np.where(hit, np.float32(0.0), image.weight), flags=flags)
