"""The light of the PSF beyond the stamps: faint, smooth, and too far out to be drawn for each source.

A stamp is as large as the noise and the source's own light ask for, and the PSF is cut to it. What is cut off (in VIS
2 % of the light, beyond 3") lies below the noise of a pixel, but it belongs to the sky: of all sources together it is
drawn here on blocks of pixels, through the mean PSF.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.signal import fftconvolve

from jobs.render import kernel
from jobs.render.psf import SAMPLES, SIDE, Psf

Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]

# Side of a block, pixels; all stamps are whole numbers of them.
BLOCK = 8
# Blocks beyond the frame: a source there sends its wings in.
_MARGIN = SIDE // 2 // BLOCK + 1


def wings(column: Float, row: Float, electrons: Float, sizes: Int, psf: Psf, nx: int, ny: int) -> Float:
    """Electrons of sources [n] beyond stamps of `sizes`: float64[ny, nx]; the same in any order of the sources.

    Error : the PSF of mean colour at the detector's centre, on blocks: a few per cent of what is beyond the stamp
    """
    frame = np.zeros((ny, nx))
    if psf.planes is None:
        return frame
    shape = -(-ny // BLOCK) + 2 * _MARGIN, -(-nx // BLOCK) + 2 * _MARGIN
    mean = psf.planes.images.mean(axis=0, dtype=float)
    total = np.zeros(shape)
    for size in np.unique(sizes[sizes < SIDE]):
        chosen = sizes == size
        light = _on_blocks(column[chosen], row[chosen], electrons[chosen], shape)
        total += fftconvolve(light, _beyond(mean, int(size)), mode="same")
    kernel.add_blocks(frame, np.maximum(total, 0.0) / BLOCK**2, BLOCK, _MARGIN)
    return frame


def _on_blocks(column: Float, row: Float, electrons: Float, shape: tuple[int, int]) -> Float:
    """Electrons shared among the four nearest blocks, summed in fixed point: the same in any order."""
    out = np.zeros(shape, np.int64)
    x, y = ((at - (BLOCK - 1) / 2) / BLOCK + _MARGIN for at in (column, row))
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    for right in (0, 1):
        for up in (0, 1):
            share = np.abs(1 - right - (x - x0)) * np.abs(1 - up - (y - y0))
            inside = (x0 + right >= 0) & (x0 + right < shape[1]) & (y0 + up >= 0) & (y0 + up < shape[0])
            whole = np.rint(electrons * share * kernel.FIXED_POINT).astype(np.int64)
            np.add.at(out, (y0[inside] + up, x0[inside] + right), whole[inside])
    return out / kernel.FIXED_POINT


def _beyond(plane: Float, size: int) -> Float:
    """A plane outside a square of `size` pixels, summed on blocks about its middle."""
    middle, half, step = len(plane) // 2, SAMPLES * size // 2, SAMPLES * BLOCK
    hollow = plane.copy()
    hollow[middle - half : middle + half + 1, middle - half : middle + half + 1] = 0.0
    count = (middle - step // 2) // step
    first = middle - step // 2 - count * step
    kept = hollow[first : first + (2 * count + 1) * step, first : first + (2 * count + 1) * step]
    return np.asarray(kept.reshape(2 * count + 1, step, 2 * count + 1, step).sum(axis=(1, 3)))
