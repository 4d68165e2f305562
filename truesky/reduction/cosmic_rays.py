"""Cosmic rays in one calibrated image: what is sharper than a point source can be.

found       their pixels
flagged     an image with them

Ref : van Dokkum 2001, PASP 113, 1420 (L.A.Cosmic), as astroscrappy does it
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from astroscrappy import detect_cosmics

from lake_schema.arrays import Bool
from lake_schema.errors import OutOfRange
from truesky.reduction.calibration import COSMIC_RAY, SATURATED, ReducedImage

# Of the limit, that of a hit's neighbours; contrast with the fine structure; rounds.
_NEIGHBOUR_FACTOR, _CONTRAST, _ROUNDS = 0.3, 5.0, 4
# Rows that are searched at a time (memory), and those beyond that tell what a hit is.
_ROWS, _MARGIN = 1024, 64


def check_limit(limit: float) -> None:
    """OutOfRange where a limit is none."""
    if not 1.0 <= limit <= 1e3:
        raise OutOfRange("--cosmic-rays", limit, 1.0, 1e3)


def find_hits(image: ReducedImage, limit: float) -> Bool:
    """[ny, nx] pixels that a cosmic ray has hit.

    image : with its weights
    limit : standard deviations of the noise above which a pixel's Laplacian is no source's
    Error : hits as faint as the noise are not found, nor those on saturated pixels; where a point source is narrower
            than two pixels its middle may be taken for one
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
    """The image with these pixels flagged, and without weight; what is saturated is not one."""
    hit = hit & (image.flags & SATURATED == 0)
    flags = np.where(hit, image.flags | COSMIC_RAY, image.flags).astype(np.uint8)
    return replace(image, weight=np.where(hit, np.float32(0.0), image.weight), flags=flags)
