"""The diffuse sky through a grism: what its orders change of the even background that the passband gives.

A pixel sees light of each wavelength from another place of the sky, by each order; on an even sky that is as if nothing
were spread out, but for the light that other orders than the first add, and for places beyond the field stop, which
send none.
"""

from __future__ import annotations

import numpy as np

from lake_schema.errors import BadInput
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene


def apply(frame: Frame, nodes: Frame | None, rng: np.random.Generator | None = None) -> Frame:
    """frame [ny, nx] e- -> plus what the nodes have, linearly between them.

    nodes : [gy, gx] e- at places evenly over the frame, its corners among them; None = nothing;  rng : not used
    """
    if nodes is None:
        return np.array(frame, dtype=float)
    if min(nodes.shape) < 2 or not np.isfinite(nodes).all():
        raise BadInput(f"a dispersed sky of {nodes.shape} places, or one that is not finite")
    ny, nx = frame.shape
    x_fraction, x_node = _node_fractions(nodes.shape[1], nx)
    across = nodes[:, x_node] * (1.0 - x_fraction) + nodes[:, x_node + 1] * x_fraction
    y_fraction, y_node = _node_fractions(nodes.shape[0], ny)
    out = across[y_node] * (1.0 - y_fraction)[:, None]
    out += across[y_node + 1] * y_fraction[:, None]
    out += frame
    return np.asarray(out)


def _node_fractions(nodes: int, pixels: int) -> tuple[Frame, np.ndarray[tuple[int], np.dtype[np.int64]]]:
    """(part of the way to the next node, the node before) of each pixel."""
    position = np.linspace(0.0, nodes - 1.0, pixels)
    node = np.minimum(position.astype(np.int64), nodes - 2)
    return position - node, node


def _contribution(scene: Scene) -> float:
    return 0.0 if scene.sky_change is None else float(np.abs(scene.sky_change).max())


EFFECT = Effect("dispersed_sky", apply, lambda scene: (scene.sky_change,), _contribution, cost=2e-2)
