"""Fringes: red light of the sky's lines interferes with itself between the faces of a detector.

The silicon's thickness varies by some wavelengths over a detector, and fringes follow lines of equal thickness. A few
lines of hydroxyl are in a band: where their fringes coincide the contrast is large, elsewhere small. Sources, whose
light is of all wavelengths, have none.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from truesky.numerics import matrices
from truesky.numerics.compiling import jit
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

# Wave numbers of lines over their mean, and their light: four groups of lines, as in z and y (assumed).
_LINES = ((0.965, 0.2), (0.99, 0.35), (1.0, 0.25), (1.03, 0.2))
# Wavelengths in the way through the detector and back, and the changes of thickness over it by their number of half
# waves along each side, of which the longer are the larger.
_ORDERS, _MODES, _STEEPNESS = 120.0, 4, 1.5
# Pixels between places at which the thickness is told, and steps of a cycle in the table.
_NODE_SPACING, _STEPS_PER_CYCLE = 8, 64


def apply(frame: Frame, electrons: float, amplitude: float, period: float, rng: np.random.Generator) -> Frame:
    """frame [ny, nx] e- -> plus electrons times a fixed pattern of the detector.

    electrons : of the sky in a pixel
    amplitude : of the sky, where the fringes are strongest;  period : mean distance of two fringes, pixels
    rng       : random numbers of the detector
    Error     : 1e-3 of the amplitude, of the table and of the thickness between its places
    """
    if not 0.0 <= amplitude <= 1.0:
        raise OutOfRange("fringes", amplitude, 0.0, 1.0)
    if not 4.0 <= period <= 1e5:
        raise OutOfRange("period of fringes", period, 4.0, 1e5)
    out = np.array(frame, dtype=float, order="C")
    if amplitude == 0.0 or electrons == 0.0 or not out.size:
        return out
    nodes = phase(frame.shape[1], frame.shape[0], period, rng)
    first = float(nodes.min())
    steps = np.arange(math.ceil((float(nodes.max()) - first) * _STEPS_PER_CYCLE) + 2) / _STEPS_PER_CYCLE
    table = contrast(first + steps)
    _add_fringes(out, nodes, electrons * amplitude / float(np.abs(table).max()) * table, first)
    return out


def contrast(cycles: Float) -> Float:
    """In [-1, 1] where light of the mean wave number is so many cycles behind."""
    waves, light = np.array(_LINES).T
    terms = np.cos(2.0 * np.pi * np.multiply.outer(cycles, waves)) * (light / light.sum())
    return np.asarray(terms.sum(axis=1))


def phase(nx: int, ny: int, period: float, rng: np.random.Generator) -> Float:
    """[n, m] cycles at places `_NODES` pixels apart, from pixel 0 on: smooth, of the given mean distance of cycles.

    nx, ny : pixels;  period : pixels;  rng : random numbers of the detector
    """
    across, up = (np.arange((n - 1) // _NODE_SPACING + 2) * float(_NODE_SPACING) for n in (nx, ny))
    # Over the longer side, so that fringes are as wide in both directions.
    side = float(max(nx, ny, 4 * _NODE_SPACING))
    number = np.arange(_MODES + 1)
    strength = rng.standard_normal((_MODES + 1, _MODES + 1)) / (1.0 + np.hypot.outer(number, number)) ** _STEEPNESS
    strength[0, 0] = 0.0
    waves = [np.cos(np.pi * np.multiply.outer(at / side, number)) for at in (across, up)]
    slopes = [-np.pi / side * number * np.sin(np.pi * np.multiply.outer(at / side, number)) for at in (across, up)]
    slope_x, slope_y, height = (
        matrices.matmul(matrices.matmul(up_, strength), across_.T)
        for up_, across_ in ((waves[1], slopes[0]), (slopes[1], waves[0]), (waves[1], waves[0]))
    )
    rms_slope = float(np.sqrt(np.mean(slope_x**2 + slope_y**2)))
    return np.asarray(_ORDERS + height / (rms_slope * period))


@jit
def _add_fringes(frame: Any, nodes: Any, table: Any, first: float) -> None:
    """Adds the table at the phase of each pixel, bilinear between the nodes."""
    ny, nx = frame.shape
    line = np.empty(nodes.shape[1])
    for r in range(ny):
        low, part = r // _NODE_SPACING, (r % _NODE_SPACING) / _NODE_SPACING
        for k in range(len(line)):
            line[k] = nodes[low, k] + part * (nodes[low + 1, k] - nodes[low, k])
        for c in range(nx):
            k, share = c // _NODE_SPACING, (c % _NODE_SPACING) / _NODE_SPACING
            place = (line[k] + share * (line[k + 1] - line[k]) - first) * _STEPS_PER_CYCLE
            i = min(max(int(place), 0), len(table) - 2)
            frame[r, c] += table[i] + (place - i) * (table[i + 1] - table[i])


def parameters(scene: Scene) -> tuple[float, float, float]:
    """Nothing in a band of which the mission database has no amplitude, or where the band is not known."""
    key = "" if scene.band is None else f"{scene.section}.{scene.band.name}.fringes"
    amplitude = scene.mission.value(key) if key in scene.mission else 0.0
    return scene.sky_electrons, amplitude, scene.value("fringe_period", "pix") if amplitude else 1e3


def _contribution(scene: Scene) -> float:
    electrons, amplitude, _ = parameters(scene)
    return electrons * amplitude


EFFECT = Effect("fringes", apply, parameters, _contribution, fixed=True, cost=6e-3)
