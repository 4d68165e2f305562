"""Inter-pixel capacitance (IPC): the voltage of a pixel also depends on the charge of its neighbours.

A pixel with N electrons is read as N (1 - 4 s - 4 d), with the coupling constants s and d. Each of its four side
neighbours is read with s N electrons more, and each diagonal neighbour with d N more. At the detector's edge the charge
for missing neighbours stays in the pixel, so that the total is conserved. The coupling is linear. In an up-the-ramp
exposure (repeated reads), the charge of each group of averaged reads is coupled. The photon noise of neighbouring
pixels is therefore correlated. Read noise is added later and is not correlated.

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
    """Move a small fraction of each pixel's charge to its eight neighbours.

    Parameters
    ----------
    frame : float array, shape (..., ny, nx)
        Charge in electrons. For an up-the-ramp exposure there is one plane per group of averaged reads.
    side, diagonal : float
        Fraction of a pixel's charge that is read in each of its four side neighbours, and in each of its four diagonal
        neighbours, 0 to 0.1. All eight neighbours together may get at most half: 4 (side + diagonal) <= 0.5.
    rng : numpy.random.Generator
        Not used.

    Returns
    -------
    float array, shape of `frame`
        Charge as it is read, in electrons. The sum of each plane is unchanged.

    Raises
    ------
    OutOfRange
        If `side` or `diagonal` is outside 0 to 0.1 or NaN.
    BadInput
        If 4 (side + diagonal) is more than 0.5.
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
        if 0 < y < ny - 1 and nx > 2:
            _couple_row(plane[y - 1], plane[y], plane[y + 1], side, diagonal, coupled[y])
            coupled[y, 0] = _couple_pixel(plane, y, 0, side, diagonal)
            coupled[y, nx - 1] = _couple_pixel(plane, y, nx - 1, side, diagonal)
        else:
            for x in range(nx):
                coupled[y, x] = _couple_pixel(plane, y, x, side, diagonal)


@jit
def _couple_row(low: Any, row: Any, high: Any, side: float, diagonal: float, coupled: Any) -> None:
    """Fill one row of `coupled`, except its first and last pixel, from a row of the detector and its two neighbours.

    All pixels have eight neighbours, so that the loop has no branches and the compiler can vectorise it.
    """
    for x in range(1, len(row) - 1):
        charge = float(row[x])
        sides = float(low[x]) + float(high[x]) + float(row[x - 1]) + float(row[x + 1])
        diagonals = float(low[x - 1]) + float(low[x + 1]) + float(high[x - 1]) + float(high[x + 1])
        coupled[x] = charge + (side * (sides - 4.0 * charge) + diagonal * (diagonals - 4.0 * charge))


@jit
def _couple_pixel(plane: Any, y: int, x: int, side: float, diagonal: float) -> float:
    """Return the charge with which a pixel is read, which may be at the edge of the detector."""
    ny, nx = plane.shape
    charge, change = float(plane[y, x]), 0.0
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            if 0 <= y + dy < ny and 0 <= x + dx < nx:
                share = side if dx == 0 or dy == 0 else diagonal
                # The loop includes the pixel itself (dx = dy = 0), which contributes 0.
                change += share * (float(plane[y + dy, x + dx]) - charge)
    return charge + change


def _parameters(scene: Scene) -> tuple[float, float]:
    # The parameter `ipc_<ramp>` of the mission database switches the coupling on (1) or off (0) for a readout mode of
    # the ramp, "photometric" or "spectroscopic". Without this parameter it is on.
    key = f"ipc_{scene.ramp}"
    scaling = scene.value(key, "") if f"{scene.section}.{key}" in scene.mission else 1.0
    return scaling * scene.value("ipc.side", ""), scaling * scene.value("ipc.diagonal", "")


def _contribution(scene: Scene) -> float:
    """Return the electrons that a pixel at full well loses to all neighbours: a cosmic ray can fill any pixel."""
    side, diagonal = _parameters(scene)
    return 4.0 * (side + diagonal) * scene.value("full_well", "electron")


EFFECT = Effect("ipc", apply, _parameters, _contribution, cost=1.1e-2, systematic=zero_contribution)
