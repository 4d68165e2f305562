"""Diffuse sky seen through a grism: its difference from the uniform background of the undispersed passband.

A pixel receives light of each wavelength from a different point of the sky, in each spectral order of the grism. For a
uniform sky the sum is the undispersed background, with two differences. Orders other than the first add light, and
points of the sky outside the field stop contribute none.
"""

from __future__ import annotations

import numpy as np

from lake_schema.errors import BadInput
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene


def apply(frame: Frame, nodes: Frame | None, rng: np.random.Generator | None = None) -> Frame:
    """Add the difference between the dispersed and the undispersed sky, given at nodes of a grid, to a frame.

    Between the nodes the difference is interpolated linearly.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    nodes : float array, shape (gy, gx), or None
        Difference in electrons per pixel on an even grid. The outer nodes lie on the corner pixels of the frame. None
        to add nothing.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons including the change of the sky.

    Raises
    ------
    BadInput
        If the grid has fewer than two nodes along a side, or values that are infinite or NaN.
    """
    if nodes is None:
        return np.array(frame, dtype=float)
    if min(nodes.shape) < 2 or not np.isfinite(nodes).all():
        raise BadInput(f"dispersed sky must have finite values on 2 x 2 nodes or more, got the shape {nodes.shape}")
    ny, nx = frame.shape
    x_fraction, x_node = _node_fractions(nodes.shape[1], nx)
    across = nodes[:, x_node] * (1.0 - x_fraction) + nodes[:, x_node + 1] * x_fraction
    y_fraction, y_node = _node_fractions(nodes.shape[0], ny)
    out = across[y_node] * (1.0 - y_fraction)[:, None]
    out += across[y_node + 1] * y_fraction[:, None]
    out += frame
    return np.asarray(out)


def _node_fractions(nodes: int, pixels: int) -> tuple[Frame, np.ndarray[tuple[int], np.dtype[np.int64]]]:
    """Return, for each pixel along an axis, (fraction of the way to the next node, index of the previous node).

    The nodes are grid points, at which the sky is given, evenly spaced from the first to the last pixel. `nodes` and
    `pixels` are their numbers along the axis.
    """
    position = np.linspace(0.0, nodes - 1.0, pixels)
    node = np.minimum(position.astype(np.int64), nodes - 2)
    return position - node, node


def _contribution(scene: Scene) -> float:
    return 0.0 if scene.sky_change is None else float(np.abs(scene.sky_change).max())


EFFECT = Effect("dispersed_sky", apply, lambda scene: (scene.sky_change,), _contribution, cost=2e-2)
