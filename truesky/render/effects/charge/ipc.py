"""Inter-pixel capacitance (IPC): the voltage of a pixel also depends on the charge of its neighbours.

A pixel with N electrons reads N (1 - 4 s - 4 d); each of its four side neighbours reads s N more, and each of its four
diagonal neighbours d N more. At the detector's edge the shares of missing neighbours stay in the pixel, so that the
total is conserved. The coupling is linear and acts on the charge of every group of a ramp. Photon noise of neighbouring
pixels is therefore correlated, and read noise, which is added later, is not.

References
----------
Moore, Ning & Tamrazian 2004, Proc. SPIE 5167, 204
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.errors import BadInput, OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects.effect import Effect, zero_contribution
from truesky.render.effects.scene import Frame, Scene


def apply(frame: Frame, side: float, diagonal: float, rng: np.random.Generator) -> Frame:
    """Couple each pixel to its eight neighbours.

    Parameters
    ----------
    frame : float array, shape (..., ny, nx)
        Charge in electrons, one plane per group of a ramp.
    side, diagonal : float
        Share of a pixel's charge that appears in each side and each diagonal neighbour, 0 to 0.1.
        At most half of a pixel's charge may appear elsewhere: 4 (side + diagonal) <= 0.5.
    rng : numpy.random.Generator
        Not used.

    Returns
    -------
    float array, same shape
        Charge as it is read. The sum of each plane is unchanged.

    Raises
    ------
    OutOfRange, BadInput
        If a share, or the sum of all shares, exceeds its limit.
    """
    for name, share in (("side", side), ("diagonal", diagonal)):
        if not 0.0 <= share <= 0.1:
            raise OutOfRange(f"inter-pixel capacitance, {name}", share, 0.0, 0.1)
    if 4.0 * (side + diagonal) > 0.5:
        raise BadInput(
            f"inter-pixel capacitance: neighbours get {4.0 * (side + diagonal):g} of a pixel's charge, more than 0.5"
        )
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
                        # The pixel itself (dx = dy = 0) contributes a difference of 0.
                        change += share * (float(plane[y + dy, x + dx]) - charge)
            coupled[y, x] = charge + change


def _parameters(scene: Scene) -> tuple[float, float]:
    # A mission may switch the effect on (1) or off (0) for each of its ramps, with the key `ipc_<ramp>`.
    key = f"ipc_{scene.ramp}"
    scaling = scene.value(key, "") if f"{scene.section}.{key}" in scene.mission else 1.0
    return scaling * scene.value("ipc.side", ""), scaling * scene.value("ipc.diagonal", "")


def _contribution(scene: Scene) -> float:
    """Return the charge that the neighbours of a full pixel receive: a cosmic ray can fill any pixel."""
    side, diagonal = _parameters(scene)
    return 4.0 * (side + diagonal) * scene.value("full_well", "electron")


EFFECT = Effect("ipc", apply, _parameters, _contribution, cost=1.1e-2, systematic=zero_contribution)
