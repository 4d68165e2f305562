"""The light of the PSF beyond the stamps: faint, smooth, and too far out to be drawn for each source.

A stamp is as large as the noise and the source's own light ask for, and the PSF is cut to it. What is cut off (in VIS
2 % of the light, beyond 3") lies below the noise of a pixel, but it belongs to the sky: of all sources together it is
drawn here on blocks of pixels, through the mean PSF. So is what the stamps of galaxies do not hold of their own light.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lake_schema.arrays import Float, Float32, Int
from truesky.render.drawing.kernels import frame
from truesky.render.psf.model import SIDE, Psf
from truesky.render.sources import selection

# Side of a block, pixels; all stamps are whole numbers of them.
BLOCK = 8
# Blocks from a point to where its wings end, and as many are there beyond the frame: who draws has to name the sources
# that lie so far out.
MARGIN = SIDE // 2 // BLOCK + 1
# Pixels by which light on blocks is wider, to each side, than it is said to be: cut and interpolated between them.
_WIDER = 3.0 * BLOCK


def wings(
    column: Float, row: Float, electrons: Float, sizes: Int, psf: Psf, nx: int, ny: int, unit: float
) -> Float:  # fmt: skip
    """Electrons a pixel of sources [n] beyond stamps of `sizes`, on blocks, MARGIN of them before the frame's first.

    unit    : of the blocks' integers to an electron
    column, row, electrons : float64[n] pixels, and expected;  psf : of the detector;  nx, ny : its pixels
    returns : float64[blocks, blocks], the same in any order of the sources
    Error   : the PSF of mean colour at the detector's centre, on blocks: a few per cent of what is beyond the stamp
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

    profile : float64[n, 11] galaxy_shapes.on_the_sky;  electrons : [n] that leave the stamp;  reach : [n] pixels
    """

    profile: Float
    electrons: Float
    reach: Float


def galaxies(column: Float, row: Float, outside: OutsideLight, sizes: Int, nx: int, ny: int, unit: float) -> Float:
    """Electrons a pixel of galaxies [n] outside stamps of `sizes`, on the blocks of `wings`.

    column, row : float64[n] pixels;  outside : what is taken off their stamps
    nx, ny      : pixels of the detector;  unit : of the blocks' integers to an electron
    returns : float64[blocks, blocks], the same in any order of the galaxies
    Error   : a galaxy's own light, as if the PSF did nothing to it so far out; what is left on the stamp stays there;
              a block has whole units a pixel: of the faintest little is seen
    """
    out = _layer(nx, ny)
    selected = (outside.electrons > 0) & selection.overlaps_frame(column, row, region_side(2.0 * outside.reach), nx, ny)
    profile, electrons, reach = (part[selected] for part in outside)
    frame.add_spilled(
        out, BLOCK, MARGIN, sizes[selected], reach, column[selected], row[selected], profile, electrons, unit
    )
    return out / unit


def region_side(sides: Float) -> Float:
    """Sides of the squares, pixels, that light shows in that is drawn on blocks in squares of such sides."""
    return sides + 2.0 * _WIDER


def _half_block_sums(plane: Float32, samples: int) -> Float:
    """A plane, `samples` a pixel, summed on squares of half a block, an even number of them about its middle."""
    middle, step = len(plane) // 2, samples * BLOCK // 2
    count = (middle // step - 1) // 2 * 2 + 1
    central = slice(middle - count * step, middle + count * step)
    squares = plane[central, central].reshape(2 * count, step, 2 * count, step)
    return np.asarray(squares.sum(axis=(1, 3), dtype=float))


def _light_outside_square(cells: Float, size: int) -> Float:
    """What lies outside a square of `size` pixels, on blocks about the middle one, and a border of nothing."""
    middle, half = len(cells) // 2, min(size // BLOCK, len(cells) // 2)
    hollow = cells.copy()
    hollow[middle - half : middle + half, middle - half : middle + half] = 0.0
    count = len(cells) // 4
    return np.pad(hollow.reshape(2 * count + 1, 2, 2 * count + 1, 2).sum(axis=(1, 3)), 1)
