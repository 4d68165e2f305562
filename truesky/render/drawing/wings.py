"""Draw the light of the PSF's wings beyond the stamps, for all sources together.

A stamp is a square image around one source. Its size depends on the noise and on the source's profile, and the PSF is
cut to it. The light that is cut off (2 % in VIS, beyond 3 arcsec) lies below the noise of a pixel, but the sum over all
sources contributes to the brightness of the sky. This sum is drawn here on blocks of 8 x 8 pixels, with the mean PSF.
Light of galaxies outside their stamps is drawn in the same way.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lake_schema.arrays import Float, Float32, Int
from truesky.render.drawing.kernels import frame
from truesky.render.psf.model import SIDE, Psf
from truesky.render.sources import selection

# Side of the square blocks on which the light of the PSF's wings is drawn, pixels. The sides of all stamps are
# multiples of it.
BLOCK = 8
# Number of blocks by which the grid of blocks extends beyond each side of the detector. It is also the number of blocks
# from a point source to the end of its wings, so sources in this border contribute light to the detector. The caller
# must include them.
MARGIN = SIDE // 2 // BLOCK + 1
# Light on all blocks (of 8 x 8 pixels) that touch a square of pixels extends beyond this square by up to this number of
# pixels on each side, because blocks are whole and the light is interpolated between their centres.
_WIDER = 3.0 * BLOCK


def wings(
    column: Float, row: Float, electrons: Float, sizes: Int, psf: Psf, nx: int, ny: int, unit: float
) -> Float:  # fmt: skip
    """Return the light of the PSF's wings beyond the stamps of n sources, on blocks of 8 x 8 pixels.

    Parameters
    ----------
    column, row : float array, shape (n,)
        Positions, 0-based pixels.
    electrons : float array, shape (n,)
        Expected electrons.
    sizes : int array, shape (n,)
        Sides of the stamps, pixels.
    psf : Psf
        PSF of the detector.
    nx, ny : int
        Number of columns and of rows of the detector.
    unit : float
        Factor from electrons per pixel to the integers in which the light is summed, for example 2^20.

    Returns
    -------
    float array, shape (ceil(ny / 8) + 2 MARGIN, ceil(nx / 8) + 2 MARGIN)
        Electrons per pixel on blocks; block [MARGIN, MARGIN] begins at the first pixel of the detector. 0 for a PSF
        without planes (images), whose wings stay on the stamps. The result does not depend on the order of the sources.

    Notes
    -----
    All sources have the PSF of mean colour at the centre of the detector, averaged over blocks. The error is a few per
    cent of the light beyond the stamp.
    """
    out = _layer(nx, ny)
    if psf.planes is None:
        return out / unit
    planes = psf.planes
    cells = psf.keep(("wings",), lambda: _half_block_sums(planes.images.mean(axis=0), planes.samples))
    x, y = ((at - (BLOCK - 1) / 2) / BLOCK + MARGIN for at in (column, row))
    for size in np.unique(sizes[sizes < psf.side]):
        selected = sizes == size
        frame.add_smoothed(
            out, _light_outside_square(cells, int(size)) / BLOCK**2, x[selected], y[selected], electrons[selected], unit
        )
    return out / unit


def _layer(nx: int, ny: int) -> Int:
    return np.zeros((-(-ny // BLOCK) + 2 * MARGIN, -(-nx // BLOCK) + 2 * MARGIN), np.int64)


class OutsideLight(NamedTuple):
    """Light of n galaxies outside their stamps.

    Attributes
    ----------
    profile : float array, shape (n, 11)
        Rows of `galaxy_shapes.real_space_profile` (brightness, shape and orientation of bulge and disc), in proportion
        to which the electrons are distributed.
    electrons : float array, shape (n,)
        Electrons to be drawn outside the stamp; 0 for none.
    reach : float array, shape (n,)
        Distance from the galaxy along columns and rows up to which this light is drawn, pixels.
    """

    profile: Float
    electrons: Float
    reach: Float


def galaxies(column: Float, row: Float, outside: OutsideLight, sizes: Int, nx: int, ny: int, unit: float) -> Float:
    """Return the light of n galaxies outside their stamps, on the blocks of 8 x 8 pixels of `wings`.

    Parameters
    ----------
    column, row : float array, shape (n,)
        Positions, 0-based pixels.
    outside : OutsideLight
        Light that was removed from the stamps, because it was aliased, and is now drawn outside them.
    sizes : int array, shape (n,)
        Sides of the stamps, pixels.
    nx, ny : int
        Number of columns and of rows of the detector.
    unit : float
        Factor from electrons per pixel to the integers in which the light is summed, for example 2^20.

    Returns
    -------
    float array, shape (ceil(ny / 8) + 2 MARGIN, ceil(nx / 8) + 2 MARGIN)
        Electrons per pixel on blocks, as in `wings`. The result does not depend on the order of the galaxies.

    Notes
    -----
    The PSF has little effect at these distances and is neglected. Aliased light that was not removed from a stamp
    stays there. Light is rounded to integers, so light below half a unit per pixel is lost.
    """
    out = _layer(nx, ny)
    selected = (outside.electrons > 0) & selection.overlaps_frame(column, row, region_side(2.0 * outside.reach), nx, ny)
    profile, electrons, reach = (part[selected] for part in outside)
    frame.add_spilled(
        out, BLOCK, MARGIN, sizes[selected], reach, column[selected], row[selected], profile, electrons, unit
    )
    return out / unit


def region_side(sides: Float) -> Float:
    """Return the sides, in pixels, of the squares that may receive light if light is drawn in given squares.

    `sides` are the sides of the given squares in pixels. The result is larger by 48 pixels, because the light is drawn
    on blocks of 8 x 8 pixels and interpolated between them.
    """
    return sides + 2.0 * _WIDER


def _half_block_sums(plane: Float32, samples: int) -> Float:
    """Return the sums of a PSF image over squares of 4 x 4 pixels (half the side of a block).

    The image has `samples` samples per pixel. The number of squares per side is even, so that the middle of the image
    lies between squares.
    """
    middle, step = len(plane) // 2, samples * BLOCK // 2
    count = (middle // step - 1) // 2 * 2 + 1
    central = slice(middle - count * step, middle + count * step)
    squares = plane[central, central].reshape(2 * count, step, 2 * count, step)
    return np.asarray(squares.sum(axis=(1, 3), dtype=float))


def _light_outside_square(cells: Float, size: int) -> Float:
    """Return the light of a PSF outside its central square with a side of `size` pixels, on blocks of 8 x 8 pixels.

    `cells` are the sums of the PSF over squares of 4 x 4 pixels, from `_half_block_sums`. The middle block of the
    result is centred on the PSF, and its outermost blocks are 0.
    """
    middle, half = len(cells) // 2, min(size // BLOCK, len(cells) // 2)
    hollow = cells.copy()
    hollow[middle - half : middle + half, middle - half : middle + half] = 0.0
    count = len(cells) // 4
    return np.pad(hollow.reshape(2 * count + 1, 2, 2 * count + 1, 2).sum(axis=(1, 3)), 1)
