"""Make image pyramids for display: copies of an image, each with half the resolution of the previous one."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lake_schema.arrays import Array
from truesky.numerics import cache
from truesky.numerics.code_fingerprints import code_key
from truesky.render.products import preview, read_back

# Side in pixels of the square tiles into which an image is cut for display. The image is halved until it fits into one.
TILE = 512


def levels(path: Path, has_unit: bool, hits: Path | None, contents: tuple[str, str]) -> list[Array]:
    """Return all levels of the pyramid of an image, from the disc cache if it has them.

    Parameters
    ----------
    path : Path
        The image file.
    has_unit : bool
        True to convert the image to electrons, False to use the pixels as stored.
    hits : Path or None
        Truth map (image of the true signal) of cosmic rays, which are then removed; None to keep them.
    contents : tuple of str
        SHA-256 of the image file, and of the truth map ("" without one). They select the cached result and are not
        checked.

    Returns
    -------
    list of float32 array, shape (ny, nx)
        The image in full resolution, then with 1/2, 1/4 and so on, until it fits into one tile of 512 pixels. The
        arrays are memory-mapped files.
    """
    key = cache.content_key(code_key(__name__), *contents, TILE)
    arrays = cache.cached_arrays("pyramid", key, lambda: _build_levels(path, has_unit, hits))
    return [arrays[str(level)] for level in range(len(arrays))]


def _build_levels(path: Path, has_unit: bool, hits: Path | None) -> dict[str, Array]:
    image = np.asarray((read_back.electrons(path) if has_unit else read_back.frame(path)).data)
    if hits is not None:
        truth = np.asarray(read_back.frame(hits).data)
        image = preview.repair_cosmic_rays(image.astype(float), truth > 0)
    images = [image.astype(np.float32)]
    while max(images[-1].shape) > TILE:
        images.append(_halve(images[-1]))
    return {str(number): level for number, level in enumerate(images)}


def _halve(image: Array) -> Array:
    """Return an image with half the resolution: means of 2 x 2 pixels. An odd last row or column is repeated first."""
    ny, nx = image.shape
    padded = np.pad(image, ((0, ny % 2), (0, nx % 2)), mode="edge")
    mean: Array = padded.reshape(padded.shape[0] // 2, 2, padded.shape[1] // 2, 2).mean(axis=(1, 3), dtype=np.float32)
    return mean
