"""Put the PSF of a source on the nodes of a coarse grid, for the light of galaxies far from their middle."""

from __future__ import annotations

import numpy as np
import scipy

from lake_schema.arrays import Float, Int
from truesky.numerics.compiling import jit
from truesky.render.drawing import transfer
from truesky.render.psf.model import SAMPLES, Psf

# Half side of the square in which a PSF that is given as a profile (not as images) is evaluated, pixels. For seeing by
# the atmosphere, 1e-5 of the light lies outside.
_MOFFAT = 128


def change_by_psf(psf: Psf, weights: Float, block: int) -> Float:
    """Return the PSF of a source minus a delta function, on the nodes of a coarse grid.

    Parameters
    ----------
    psf : Psf
        PSF of the detector.
    weights : float array, shape (planes,)
        Weights of the PSF's planes (basis images) for the source, from `transfer.basis_weights`.
    block : int
        Distance between nodes, pixels.

    Returns
    -------
    float array, shape (n, n)
        Its convolution with the light of a galaxy at the nodes is the change of the light by the PSF.

    Notes
    -----
    Each sample of the PSF is averaged over a pixel and distributed to five nodes per direction, which preserves moments
    up to the fourth.
    """
    if psf.planes is None:
        side = 2 * _MOFFAT * SAMPLES + 1
        drawn = psf.profile.drawImage(nx=side, ny=side, scale=psf.pixel_scale / SAMPLES, method="no_pixel")
        image = drawn.array / drawn.array.sum(dtype=float)
    else:
        image = np.asarray(transfer.image_of(psf.planes, weights), float)
    out = _to_nodes(image, block, SAMPLES if psf.planes is None else psf.planes.samples)
    out[len(out) // 2, len(out) // 2] -= 1.0
    return out


def _to_nodes(image: Float, block: int, samples: int) -> Float:
    """Distribute the samples of an image, `samples` per pixel in each direction, to nodes `block` pixels apart."""
    out = image
    # First along columns, then along rows.
    for _ in range(2):
        nodes, shares = _shares(len(out), block, samples)
        sums = np.zeros((int(nodes[-1]) + shares.shape[1], out.shape[1]))
        _add_to_nodes(np.ascontiguousarray(out), nodes, shares, sums)
        out = sums.T
    return np.ascontiguousarray(out)


def _shares(length: int, block: int, samples: int) -> tuple[Int, Float]:
    """Return the fractions of the light of each sample of a line that are added to five nodes of a grid.

    Parameters
    ----------
    length : int
        Number of samples of the line.
    block : int
        Distance between nodes, pixels.
    samples : int
        Number of samples per pixel.

    Returns
    -------
    first_node : int array, shape (length,)
        First of the five nodes next to each sample; the first node of the grid is 0. The middle sample coincides with
        the middle node.
    shares : float array, shape (length, 5)
        Fractions, some of which are negative. Their sum is 1 for each sample.
    """
    place = (np.arange(length) - length // 2) / (samples * block)
    node = np.rint(place).astype(int)
    off, pixel = place - node, 1.0 / (12.0 * block**2)
    # Moments, about the nearest node, of a uniform pixel centred on the sample.
    first, second, third = off, off**2 + pixel, off**3 + 3.0 * off * pixel
    fourth = off**4 + 6.0 * off**2 * pixel + 1.8 * pixel**2
    shares = (
        (2.0 * first - second - 2.0 * third + fourth) / 24.0,
        (-4.0 * first + 4.0 * second + third - fourth) / 6.0,
        1.0 - (5.0 * second - fourth) / 4.0,
        (4.0 * first + 4.0 * second - third - fourth) / 6.0,
        (-2.0 * first - second + 2.0 * third + fourth) / 24.0,
    )
    return node + int(np.abs(node).max()), np.column_stack(shares)


@jit
def _add_to_nodes(image: Float, nodes: Int, shares: Float, out: Float) -> None:
    """Add the rows of an image to rows of nodes, `out` [nodes, columns], as `_shares` distributes them.

    Each row of the image [rows, columns] has few nodes, so that this is much faster than a product of matrices.
    """
    for i in range(len(image)):
        for k in range(shares.shape[1]):
            share, line, node = shares[i, k], image[i], out[nodes[i] + k]
            for j in range(len(line)):
                node[j] += share * line[j]


def convolve_inside(image: Float, kernel: Float) -> Float:
    """Return the part of the convolution of an image with a square kernel that needs no values outside the image.

    It is `scipy.signal.fftconvolve` with the mode "valid". The import of scipy.signal takes longer than most images.
    """
    shape = [scipy.fft.next_fast_len(n + len(kernel) - 1, True) for n in image.shape]
    product = scipy.fft.rfft2(image, shape) * scipy.fft.rfft2(kernel, shape)
    first, (rows, columns) = len(kernel) - 1, image.shape
    return np.ascontiguousarray(scipy.fft.irfft2(product, shape)[first:rows, first:columns])
