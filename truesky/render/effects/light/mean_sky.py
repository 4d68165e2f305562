"""Mean of the diffuse light that the effects of the sky add to the pixels of a detector, without drawing a frame.

Each function returns the mean contribution of an effect to the pixels of the detector, in electrons. Fringes are left
out, because bright and dark fringes cancel in the mean.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping

import numpy as np

from lake_schema.arrays import Float
from truesky.render.effects.light import background, pixel_area, straylight
from truesky.render.effects.scene import Frame, Scene


def mean_electrons(scene: Scene, applied: Container[str]) -> float:
    """Return the mean of the diffuse light in the pixels of a detector.

    Parameters
    ----------
    scene : Scene
        Properties of the exposure.
    applied : container of str
        Names of the effects that are applied; others add nothing.

    Returns
    -------
    float
        Electrons per pixel in the exposure.
    """
    return sum(mean(scene) for name, mean in _MEANS.items() if name in applied)


def _background(scene: Scene) -> float:
    electrons, slopes, start = background.parameters(scene)
    middle = (first + (n - 1) / 2 for first, n in zip(start, (scene.nx, scene.ny), strict=True))
    return electrons * max(1.0 + sum(slope * at for slope, at in zip(slopes, middle, strict=True)), 0.0)


def _dispersed_sky(scene: Scene) -> float:
    nodes = scene.sky_change
    if nodes is None:
        return 0.0
    positions = (np.linspace(0.0, count - 1.0, n) for count, n in zip(nodes.shape, (scene.ny, scene.nx), strict=True))
    return mean_between_nodes(nodes, *positions)


def _pixel_area(scene: Scene) -> float:
    electrons, u, v, stretch = pixel_area.parameters(scene)
    # The mean of a sum of products u^p v^q over a rectangle is the sum of the products of the means.
    powers = [np.array([np.mean(at**n) for n in range(count)]) for at, count in zip((u, v), stretch.shape, strict=True)]
    return electrons * float(np.einsum("i,j,ij", *powers, stretch))


def _straylight(scene: Scene) -> float:
    nodes, step = straylight.halo_nodes((scene.ny, scene.nx), *straylight.parameters(scene))
    if nodes is None:
        return 0.0
    return mean_between_nodes(nodes, np.arange(scene.ny) / step, np.arange(scene.nx) / step)


def mean_between_nodes(nodes: Frame, rows: Float, columns: Float) -> float:
    """Return the mean over all pixels of a grid that is interpolated linearly between its nodes.

    Parameters
    ----------
    nodes : float array, shape (gy, gx)
        Values at the nodes of the grid.
    rows, columns : float array, shape (ny,) and (nx,)
        Places of the rows and columns of pixels in the grid, in nodes from 0.

    Returns
    -------
    float
        The mean.
    """
    weights = []
    for at, count in zip((rows, columns), nodes.shape, strict=True):
        node = np.minimum(at.astype(np.int64), count - 2)
        weight = np.bincount(node, 1.0 - (at - node), count) + np.bincount(node + 1, at - node, count)
        weights.append(weight / len(at))
    return float(np.einsum("i,j,ij", *weights, nodes))


# Function that returns the mean contribution of an effect, by the name of the effect.
_MEANS: Mapping[str, Callable[[Scene], float]] = {
    "background": _background,
    "dispersed_sky": _dispersed_sky,
    "pixel_area": _pixel_area,
    "straylight": _straylight,
}
