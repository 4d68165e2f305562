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

# Threshold for neighbours of a hit pixel as a fraction of the main threshold (`sigfrac` of astroscrappy).
_NEIGHBOUR_FACTOR = 0.3
# Smallest ratio of a hit pixel's Laplacian to the fine structure of its surroundings (`objlim` of astroscrappy).
_CONTRAST = 5.0
# Number of iterations of the search (`niter` of astroscrappy).
_ROUNDS = 4
# Number of image rows that are searched at a time, to limit memory.
_ROWS = 1024
# Number of additional rows on both sides of a searched strip, so that hits at its edges are found correctly.
_MARGIN = 64


def check_limit(limit: float) -> None:
    """Check the threshold of the cosmic ray search; raises OutOfRange if `limit` is outside 1 to 1000."""
    if not 1.0 <= limit <= 1e3:
        raise OutOfRange("--cosmic-rays", limit, 1.0, 1e3)


def find_hits(image: ReducedImage, limit: float) -> Bool:
    """Find the pixels hit by cosmic rays.

    Parameters
    ----------
    image : ReducedImage
        Calibrated image; the noise is taken from its weights. Pixels with weight 0 are not searched.
    limit : float
        A pixel is hit if the Laplacian of the image exceeds this multiple of its noise, 1 to 1000.

    Returns
    -------
    bool array, shape (ny, nx)
        True for hit pixels; False everywhere if no pixel has a weight.

    Raises
    ------
    OutOfRange
        If `limit` is out of range.

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
    """Return a copy of the image in which hit pixels have the flag COSMIC_RAY and the weight 0.

    Saturated pixels are not changed, even if they are True in `hit` (bool[ny, nx]).
    """
    hit = hit & (image.flags & SATURATED == 0)
    flags = np.where(hit, image.flags | COSMIC_RAY, image.flags).astype(np.uint8)
    return replace(image, weight=np.where(hit, np.float32(0.0), image.weight), flags=flags)
