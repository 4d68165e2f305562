"""Displaced borders of pixels: electric fields along a thick detector carry charge into its neighbours.

Charge that crosses a border lies in a strip beside it: of the light in the strip, interpolated between the pixels. So
one pass moves sources, changes their shapes and makes the pattern of a flat, and loses no charge.

apply_rings, RINGS   tree rings: the doping of the wafer varies with the distance from its axis
apply_edges, EDGES   the last pixels before the detector's edges
displacement         of tree rings, by distance from the wafer's axis

Ref : Plazas, Bernstein & Sheldon 2014 (DECam)
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

# Pixels between entries of the table of displacements.
_STEP = 0.25
# Of a pixel's charge, the part that can leave it over one border: strips are thin.
_MAX_CROSSING = 0.2
# Lengths of the falling off beyond which an edge is not felt.
_EDGE_RANGE = 8.0
# Of a displacement, the change of a star's pixel over the star's brightest: the steepest slope of a Gaussian of one
# pixel rms is 0.6 of its peak a pixel.
_MAX_SLOPE = 0.6


def apply_rings(
    frame: Frame, amplitude: float, inner: float, outer: float, centre: float, rng: np.random.Generator
) -> Frame:
    """frame [ny, nx] expected e- -> the same sum, with tree rings.

    amplitude    : of the flat, relative;  inner, outer : periods of the nearest and of the farthest rings, pixels
    frame        : without noise
    centre       : pixels from the detector's middle to the wafer's axis, along columns and along rows, either way
    rng          : random numbers of the detector: on which side the axis lies, and the phase
    Error        : of displacements up to 0.05 pixels 1e-4 pixels in a centroid, 6e-4 in second moments
    """
    if not 0.0 <= amplitude <= 0.1:
        raise OutOfRange("tree rings", amplitude, 0.0, 0.1)
    side, phase = np.sign(rng.random(2) - 0.5), 2.0 * np.pi * rng.random()
    ny, nx = frame.shape
    axis = (nx - 1) / 2 + side[0] * centre, (ny - 1) / 2 + side[1] * centre
    r_min, r_max = distance_range(nx, ny, axis)
    table = radial_displacement(amplitude, (inner, outer), phase, r_min, r_max)
    out = np.array(frame, dtype=float, order="C")
    _cross_borders(np.ascontiguousarray(frame, dtype=float), table, r_min, axis, np.zeros(nx), np.zeros(ny), out)
    return out


def distance_range(nx: int, ny: int, axis: tuple[float, float]) -> tuple[float, float]:
    """Of the nearest and of the farthest place of a detector from the wafer's axis, pixels."""
    sides = list(zip((nx, ny), axis, strict=True))
    r_min = [max(-0.5 - at, at - n + 0.5, 0.0) for n, at in sides]
    r_max = [max(abs(at + 0.5), abs(n - 0.5 - at)) for n, at in sides]
    return math.hypot(*r_min), math.hypot(*r_max)


def radial_displacement(
    amplitude: float, periods: tuple[float, float], phase: float, r_min: float, r_max: float
) -> Frame:
    """Pixels outwards that charge is carried at distances near, near + _STEP .. far from the axis.

    A flat changes by minus its divergence: amplitude times a wave whose period goes from the first to the second.
    amplitude : of the flat;  periods : pixels, at `near` and at `far`;  phase : at `near`
    near, far : pixels
    """
    for period in periods:
        if not 2.0 <= period <= 1e5:
            raise OutOfRange("period of tree rings", period, 2.0, 1e5)
    distance = r_min + _STEP * np.arange(int((r_max - r_min) / _STEP) + 3)
    period = np.interp(distance, [r_min, max(r_max, r_min + 1.0)], periods)
    waves = phase + 2.0 * np.pi * np.cumsum(_STEP / period)
    return np.asarray(amplitude * period / (2.0 * np.pi) * np.sin(waves))


def apply_edges(frame: Frame, shift: float, length: float, rng: np.random.Generator | None = None) -> Frame:
    """frame [ny, nx] expected e- -> the same sum, charge carried towards the edges (from them, where it is negative).

    shift  : pixels, at the edge;  length : over which it falls off by e, pixels;  rng : not used
    """
    if not -0.5 <= shift <= 0.5:
        raise OutOfRange("displacement at the edge", shift, -0.5, 0.5)
    if not 1e-2 <= length <= 1e3:
        raise OutOfRange("length of the edge", length, 1e-2, 1e3)
    out = np.array(frame, dtype=float, order="C")
    columns, rows = (_edge_displacement(n, shift, length) for n in frame.shape[::-1])
    _cross_borders(np.ascontiguousarray(frame, dtype=float), np.zeros(2), 0.0, (0.0, 0.0), columns, rows, out)
    return out


def _edge_displacement(n: int, shift: float, length: float) -> Frame:
    """[n] displacement at the borders behind pixels 0 .. n - 1."""
    border = np.arange(n) + 0.5
    to_start, to_end = border + 0.5, n - 0.5 - border
    displacement = shift * (np.exp(-to_end / length) - np.exp(-to_start / length))
    return np.where(np.minimum(to_start, to_end) < _EDGE_RANGE * length, displacement, 0.0)


@jit
def _cross_borders(frame: Any, table: Any, r_min: float, axis: Any, columns: Any, rows: Any, out: Any) -> None:
    """Adds to `out` what crosses the borders of `frame`.

    table : displacement away from the axis;  near : its first distance
    columns, rows : besides, at the borders behind each column and each row
    """
    ny, nx = frame.shape
    rings = table.min() != table.max()
    for r in range(ny):
        up = r - axis[1]
        for c in range(nx):
            if c + 1 < nx:
                d = columns[c] + (_component(table, r_min, c + 0.5 - axis[0], up) if rings else 0.0)
                if d != 0.0:
                    previous, following = frame[r, max(c - 1, 0)], frame[r, min(c + 2, nx - 1)]
                    moved = _strip_charge(d, previous, frame[r, c], frame[r, c + 1], following, 0 < c < nx - 2)
                    out[r, c] -= moved
                    out[r, c + 1] += moved
            if r + 1 < ny:
                d = rows[r] + (_component(table, r_min, up + 0.5, c - axis[0]) if rings else 0.0)
                if d != 0.0:
                    previous, following = frame[max(r - 1, 0), c], frame[min(r + 2, ny - 1), c]
                    moved = _strip_charge(d, previous, frame[r, c], frame[r + 1, c], following, 0 < r < ny - 2)
                    out[r, c] -= moved
                    out[r + 1, c] += moved


@jit
def _component(table: Any, r_min: float, along: float, across: float) -> Any:
    """Component along the first direction of the displacement away from the axis."""
    distance = math.sqrt(along * along + across * across)
    position = (distance - r_min) / _STEP
    i = min(max(int(position), 0), len(table) - 2)
    fraction = position - i
    return (table[i] + fraction * (table[i + 1] - table[i])) * along / max(distance, 1e-9)


@jit
def _strip_charge(d: float, q0: float, q1: float, q2: float, q3: float, inside: bool) -> float:
    """Charge that a displacement by d pixels carries from `here` over the border to `there`; less, where d < 0."""
    level = (7.0 * (q1 + q2) - q0 - q3) / 12.0 if inside else 0.5 * (q1 + q2)
    moved = d * (level - 0.5 * d * (q2 - q1))
    # Beside a sharp peak the interpolation overshoots.
    return min(max(moved, -_MAX_CROSSING * max(q2, 0.0)), _MAX_CROSSING * max(q1, 0.0))


def _value_or_zero(scene: Scene, key: str, unit: str) -> float:
    """0 of a camera that does not have it."""
    return scene.value(key, unit) if f"{scene.section}.{key}" in scene.mission else 0.0


def _ring_parameters(scene: Scene) -> tuple[float, float, float, float]:
    amplitude = _value_or_zero(scene, "tree_rings.amplitude", "")
    if amplitude == 0.0:
        return 0.0, 2.0, 2.0, 0.0
    inner, outer = (scene.value(f"tree_rings.period_{end}", "pix") for end in ("in", "out"))
    return amplitude, inner, outer, scene.value("tree_rings.centre", "pix")


def _ring_contribution(scene: Scene) -> float:
    amplitude, inner, outer, _ = _ring_parameters(scene)
    displacement = amplitude * max(inner, outer) / (2.0 * np.pi)
    return max(
        amplitude * (scene.peak_electrons + scene.sky_electrons), _MAX_SLOPE * displacement * scene.peak_electrons
    )


def _edge_parameters(scene: Scene) -> tuple[float, float]:
    shift = _value_or_zero(scene, "edge.shift", "pix")
    return shift, scene.value("edge.length", "pix") if shift else 1.0


RINGS = Effect("tree_rings", apply_rings, _ring_parameters, _ring_contribution, fixed=True, cost=1.5e-2)
EDGES = Effect(
    "edge_displacement",
    apply_edges,
    _edge_parameters,
    lambda scene: abs(_edge_parameters(scene)[0]) * (scene.peak_electrons + scene.sky_electrons),
    cost=3e-3,
)
