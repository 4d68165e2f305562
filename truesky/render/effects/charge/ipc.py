"""Inter-pixel capacitance: the voltage of a pixel moves with the charge of its neighbours.

A pixel with N electrons shows N (1 - 4 s - 4 d), its four neighbours s N each, the four at its corners d N.  The sum is
kept where the detector ends, too: what has no neighbour there gives nothing to it.  The law is linear and acts on the
charge of every group of a ramp, so that counted photons of neighbours are correlated and read noise is not.

Ref : Moore, Ning & Tamrazian 2004, Proc. SPIE 5167, 204
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.errors import BadInput, OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects.effect import Effect, zero_contribution
from truesky.render.effects.scene import Frame, Scene


def apply(frame: Frame, side: float, diagonal: float, rng: np.random.Generator) -> Frame:
    """Planes of charge [.., ny, nx] e- -> what is seen of it; the sum of each plane stays.

    side, diagonal : share of a pixel's charge that each neighbour sees, at its sides and at its corners
    frame          : the planes;  rng : not used
    """
    for name, share in (("side", side), ("diagonal", diagonal)):
        if not 0.0 <= share <= 0.1:
            raise OutOfRange(f"inter-pixel capacitance, {name}", share, 0.0, 0.1)
    if 4.0 * (side + diagonal) > 0.5:
        raise BadInput(f"inter-pixel capacitance: {4.0 * (side + diagonal):g} of a pixel's charge is seen by others")
    out = np.empty_like(frame)
    for plane, coupled in zip(frame.reshape(-1, *frame.shape[-2:]), out.reshape(-1, *frame.shape[-2:]), strict=True):
        _couple_plane(np.ascontiguousarray(plane), coupled, side, diagonal)
    return out


@jit
def _couple_plane(plane: Any, coupled: Any, side: float, diagonal: float) -> None:
    ny, nx = plane.shape
    for y in range(ny):
        for x in range(nx):
            charge, change = float(plane[y, x]), 0.0
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    if 0 <= y + dy < ny and 0 <= x + dx < nx:
                        share = side if dx == 0 or dy == 0 else diagonal
                        # Its own difference is 0.
                        change += share * (float(plane[y + dy, x + dx]) - charge)
            coupled[y, x] = charge + change


def _parameters(scene: Scene) -> tuple[float, float]:
    """A mission may have it in one of its ramps and not in the other."""
    key = f"ipc_{scene.ramp}"
    scaling = scene.value(key, "") if f"{scene.section}.{key}" in scene.mission else 1.0
    return scaling * scene.value("ipc.side", ""), scaling * scene.value("ipc.diagonal", "")


def _contribution(scene: Scene) -> float:
    """Of the brightest pixel, what its neighbours see: a cosmic ray may fill any."""
    side, diagonal = _parameters(scene)
    return 4.0 * (side + diagonal) * scene.value("full_well", "electron")


EFFECT = Effect("ipc", apply, _parameters, _contribution, cost=1.1e-2, systematic=zero_contribution)
