"""The light of the PSF beyond the stamps: faint, smooth, and too far out to be drawn for each source.

A stamp is as large as the noise and the source's own light ask for, and the PSF is cut to it. What is cut off (in VIS
2 % of the light, beyond 3") lies below the noise of a pixel, but it belongs to the sky: of all sources together it is
drawn here on blocks of pixels, through the mean PSF. So is what the stamps of galaxies do not hold of their own light.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy.fft

from jobs.render import kernel
from jobs.render.psf import SAMPLES, SIDE, Psf

Float = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Int = npt.NDArray[np.int64]

# Side of a block, pixels; all stamps are whole numbers of them.
BLOCK = 8
# Blocks beyond the frame: a source there sends its wings in.
MARGIN = SIDE // 2 // BLOCK + 1


def wings(column: Float, row: Float, electrons: Float, sizes: Int, psf: Psf, nx: int, ny: int) -> Float:
    """Electrons a pixel of sources [n] beyond stamps of `sizes`, on blocks, MARGIN of them before the frame's first.

    returns : float64[blocks, blocks], the same in any order of the sources
    Error   : the PSF of mean colour at the detector's centre, on blocks: a few per cent of what is beyond the stamp
    """
    shape = -(-ny // BLOCK) + 2 * MARGIN, -(-nx // BLOCK) + 2 * MARGIN
    if psf.planes is None:
        return np.zeros(shape)
    cells = _cells(psf.planes.images.mean(axis=0))
    # Wide enough that nothing comes round: the margin is as wide as the wings.
    period = [scipy.fft.next_fast_len(side, real=True) for side in shape]
    total = np.zeros((period[0], period[1] // 2 + 1), complex)
    for size in np.unique(sizes[sizes < SIDE]):
        chosen = sizes == size
        light = _on_blocks(column[chosen], row[chosen], electrons[chosen], shape)
        total += scipy.fft.rfft2(light, period) * scipy.fft.rfft2(_beyond(cells, int(size), period))
    found = scipy.fft.irfft2(total, period)[: shape[0], : shape[1]]
    return np.asarray(np.maximum(found, 0.0) / BLOCK**2)


def galaxies(column: Float, row: Float, stray: Float, reach: Float, sizes: Int, nx: int, ny: int) -> Float:
    """Electrons a pixel of galaxies [n] outside stamps of `sizes`, on the blocks of `wings`.

    stray   : float64[n, 11] profiles.on_the_sky, of a galaxy's electrons;  reach : [n] pixels, 0 = it has none there
    returns : float64[blocks, blocks], the same in any order of the galaxies
    Error   : a galaxy's own light, as if the PSF did nothing to it so far out
    """
    out = np.zeros((-(-ny // BLOCK) + 2 * MARGIN, -(-nx // BLOCK) + 2 * MARGIN), np.int64)
    some = reach > 0
    kernel.leaving(out, BLOCK, MARGIN, sizes[some], reach[some], column[some], row[some], stray[some])
    return out / kernel.FIXED_POINT


def _on_blocks(column: Float, row: Float, electrons: Float, shape: tuple[int, int]) -> Float:
    """Electrons shared among the four nearest blocks, summed in fixed point: the same in any order."""
    out = np.zeros(shape, np.int64)
    x, y = ((at - (BLOCK - 1) / 2) / BLOCK + MARGIN for at in (column, row))
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    for right in (0, 1):
        for up in (0, 1):
            share = np.abs(1 - right - (x - x0)) * np.abs(1 - up - (y - y0))
            inside = (x0 + right >= 0) & (x0 + right < shape[1]) & (y0 + up >= 0) & (y0 + up < shape[0])
            whole = np.rint(electrons * share * kernel.FIXED_POINT).astype(np.int64)
            np.add.at(out, (y0[inside] + up, x0[inside] + right), whole[inside])
    return out / kernel.FIXED_POINT


def _cells(plane: Float32) -> Float:
    """A plane summed on squares of half a block, an even number of them about its middle."""
    middle, step = len(plane) // 2, SAMPLES * BLOCK // 2
    count = (middle // step - 1) // 2 * 2 + 1
    kept = slice(middle - count * step, middle + count * step)
    whole = plane[kept, kept].reshape(2 * count, step, 2 * count, step)
    return np.asarray(whole.sum(axis=(1, 3), dtype=float))


def _beyond(cells: Float, size: int, period: Sequence[int]) -> Float:
    """What lies outside a square of `size` pixels, on blocks, the middle one first: [period]."""
    middle, half = len(cells) // 2, min(size // BLOCK, len(cells) // 2)
    hollow = cells.copy()
    hollow[middle - half : middle + half, middle - half : middle + half] = 0.0
    count = len(cells) // 4
    out = np.zeros(period)
    out[: 2 * count + 1, : 2 * count + 1] = hollow.reshape(2 * count + 1, 2, 2 * count + 1, 2).sum(axis=(1, 3))
    return np.roll(out, (-count, -count), (0, 1))
