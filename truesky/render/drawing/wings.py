"""Light of the PSF beyond the stamps, drawn for all sources together.

The size of a stamp depends on the noise and on the source's profile, and the PSF is cut to it. The light that is cut
off (2 % in VIS, beyond 3 arcsec) lies below the noise of a pixel, but it is a part of the sky. For all sources together
it is drawn here on blocks of pixels, with the mean PSF. Light of galaxies outside their stamps is drawn in the same
way.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lake_schema.arrays import Float, Float32, Int
from truesky.render.drawing.kernels import frame
from truesky.render.psf.model import SIDE, Psf
from truesky.render.sources import selection

# Side of a block, pixels. All stamps consist of whole blocks.
BLOCK = 8
# Number of blocks from a point to the end of its wings, and number of blocks on each side of the frame. The caller must
# include the sources in these blocks.
MARGIN = SIDE // 2 // BLOCK + 1
# Pixels by which light on blocks extends beyond its nominal square, to each side, because of whole blocks and
# interpolation.
_WIDER = 3.0 * BLOCK


def wings(
    column: Float, row: Float, electrons: Float, sizes: Int, psf: Psf, nx: int, ny: int, unit: float
) -> Float:  # fmt: skip
    """Light of sources beyond their stamps, on blocks.

    Parameters
    ----------
    column, row : float array, shape (n,)
        Positions, pixels.
    electrons : float array, shape (n,)
        Expected electrons.
    sizes : int array, shape (n,)
        Sides of the stamps, pixels.
    psf : Psf
        PSF of the detector.
    nx, ny : int
        Columns and rows of the detector.
    unit : float
        Units of the blocks' integers per electron.

    Returns
    -------
    float array
        Electrons per pixel on blocks, MARGIN of which lie before the first pixel of the frame. The result does not
        depend on the order of the sources.

    Notes
    -----
    The PSF of mean colour at the detector's centre is used, on blocks. The error is a few per cent of the light beyond
    the stamp.
    """
    out = _layer(nx, ny)
    if psf.planes is None:
        return out / unit
    cells = _half_block_sums(psf.planes.images.mean(axis=0), psf.planes.samples)
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
    """Light of galaxies [n] outside their stamps.

    Attributes
    ----------
    profile : float array, shape (n, 11)
        Rows of `galaxy_shapes.real_space_profile`.
    electrons : float array, shape (n,)
        Electrons outside the stamp.
    reach : float array, shape (n,)
        Distance up to which the light is drawn, pixels.
    """

    profile: Float
    electrons: Float
    reach: Float


def galaxies(column: Float, row: Float, outside: OutsideLight, sizes: Int, nx: int, ny: int, unit: float) -> Float:
    """Light of galaxies outside their stamps, on the blocks of `wings`.

    Parameters
    ----------
    column, row : float array, shape (n,)
        Positions, pixels.
    outside : OutsideLight
        Light that was removed from their stamps.
    sizes : int array, shape (n,)
        Sides of the stamps, pixels.
    nx, ny : int
        Columns and rows of the detector.
    unit : float
        Units of the blocks' integers per electron.

    Returns
    -------
    float array
        Electrons per pixel on blocks. The result does not depend on the order of the galaxies.

    Notes
    -----
    The effect of the PSF at these distances is neglected. Light that remains on the stamp is not moved. Blocks have
    integer units per pixel, so that very faint light is lost.
    """
    out = _layer(nx, ny)
    selected = (outside.electrons > 0) & selection.overlaps_frame(column, row, region_side(2.0 * outside.reach), nx, ny)
    profile, electrons, reach = (part[selected] for part in outside)
    frame.add_spilled(
        out, BLOCK, MARGIN, sizes[selected], reach, column[selected], row[selected], profile, electrons, unit
    )
    return out / unit


def region_side(sides: Float) -> Float:
    """Sides of the squares, in pixels, that receive light from blocks drawn in squares of given sides."""
    return sides + 2.0 * _WIDER


def _half_block_sums(plane: Float32, samples: int) -> Float:
    """Sums of a plane with `samples` per pixel over squares of half a block, in an even number about its middle."""
    middle, step = len(plane) // 2, samples * BLOCK // 2
    count = (middle // step - 1) // 2 * 2 + 1
    central = slice(middle - count * step, middle + count * step)
    squares = plane[central, central].reshape(2 * count, step, 2 * count, step)
    return np.asarray(squares.sum(axis=(1, 3), dtype=float))


def _light_outside_square(cells: Float, size: int) -> Float:
    """Light outside a square of `size` pixels, on blocks about the middle one, with a border of zeros."""
    middle, half = len(cells) // 2, min(size // BLOCK, len(cells) // 2)
    hollow = cells.copy()
    hollow[middle - half : middle + half, middle - half : middle + half] = 0.0
    count = len(cells) // 4
    return np.pad(hollow.reshape(2 * count + 1, 2, 2 * count + 1, 2).sum(axis=(1, 3)), 1)
