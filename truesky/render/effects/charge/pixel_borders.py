"""Displaced pixel borders: lateral electric fields in a thick detector move charge into neighbouring pixels.

The charge that crosses a border is the light in the strip between the nominal and the displaced border, interpolated
between the pixels. This transfer of charge moves sources, changes their shapes and produces a pattern in a flat field,
and it conserves charge. The effect `RINGS` describes tree rings (circular variations of the silicon's doping), and
`EDGES` the fields near the edges of the detector.

References
----------
Plazas, Bernstein & Sheldon 2014 (DECam), PASP 126, 750
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

# Step in pixels of the distance from the axis of the wafer, in the table of displacements of charge by tree rings.
_STEP = 0.25
# Largest fraction of a pixel's charge that can cross one border. More is limited to this, because the model holds only
# if charge moves by a small part of a pixel.
_MAX_CROSSING = 0.2
# Charge farther than this distance from an edge of the detector is not displaced by its field. The unit is the scale
# length, over which the displacement falls by a factor of e.
_EDGE_RANGE = 8.0
# Largest change of a pixel if the image of a star is displaced, divided by the displacement in pixels and by the peak
# of the star: the steepest slope of a Gaussian with an rms of one pixel.
_MAX_SLOPE = 0.6


def apply_rings(
    frame: Frame, amplitude: float, inner: float, outer: float, centre: float, rng: np.random.Generator
) -> Frame:
    """Displace charge radially by tree rings: circles of varying doping of the silicon, about the axis of the wafer.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons, without noise.
    amplitude : float
        Relative amplitude of the rings in a flat field, 0 to 0.1. With 0 the charge is not displaced.
    inner, outer : float
        Period of the rings in pixels, at the point of the detector nearest to the wafer's axis and at the farthest
        point, 2 to 1e5. The period is linear in between.
    centre : float
        Distance in pixels from the detector's centre to the wafer's axis, both along rows and along columns. The signs
        of the two distances are random.
    rng : numpy.random.Generator
        Random generator of the detector, in the same state in every exposure, for the signs and the phase of the rings.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons with the same sum.

    Raises
    ------
    OutOfRange
        If `amplitude`, `inner` or `outer` is outside its limits or NaN.

    Notes
    -----
    For displacements up to 0.05 pixels, the error is 1e-4 pixels in centroids and 6e-4 pixels^2 in second moments.
    """
    if not 0.0 <= amplitude <= 0.1:
        raise OutOfRange("amplitude of tree rings", amplitude, 0.0, 0.1)
    side, phase = np.sign(rng.random(2) - 0.5), 2.0 * np.pi * rng.random()
    ny, nx = frame.shape
    axis = (nx - 1) / 2 + side[0] * centre, (ny - 1) / 2 + side[1] * centre
    r_min, r_max = distance_range(nx, ny, axis)
    table = radial_displacement(amplitude, (inner, outer), phase, r_min, r_max)
    out = np.array(frame, dtype=float, order="C")
    _cross_borders(np.ascontiguousarray(frame, dtype=float), table, r_min, axis, np.zeros(nx), np.zeros(ny), out)
    return out


def distance_range(nx: int, ny: int, axis: tuple[float, float]) -> tuple[float, float]:
    """Return the smallest and the largest distance from the wafer's axis to points of a detector.

    Parameters
    ----------
    nx, ny : int
        Number of columns and rows of the detector.
    axis : (float, float)
        Column and row of the wafer's axis in pixels.

    Returns
    -------
    r_min, r_max : float
        Distances in pixels. `r_min` is 0 if the axis is on the detector.
    """
    sides = list(zip((nx, ny), axis, strict=True))
    r_min = [max(-0.5 - at, at - n + 0.5, 0.0) for n, at in sides]
    r_max = [max(abs(at + 0.5), abs(n - 0.5 - at)) for n, at in sides]
    return math.hypot(*r_min), math.hypot(*r_max)


def radial_displacement(
    amplitude: float, periods: tuple[float, float], phase: float, r_min: float, r_max: float
) -> Frame:
    """Return a table of the displacement of charge by tree rings, away from the wafer's axis.

    Parameters
    ----------
    amplitude : float
        Relative amplitude of the rings in a flat field. Not checked.
    periods : (float, float)
        Periods of the rings in pixels at `r_min` and `r_max`, 2 to 1e5; linear between them.
    phase : float
        Phase of the rings in radians, 0.25 pixels before `r_min`.
    r_min, r_max : float
        Smallest and largest distance from the wafer's axis in pixels.

    Returns
    -------
    float array, shape (n,)
        Outward displacement in pixels at the distances r_min, r_min + 0.25, ... up to at least r_max.

    Raises
    ------
    OutOfRange
        If a period is outside its limits or NaN.

    Notes
    -----
    A flat field changes by minus the divergence of the displacement. A wave of amplitude A and period P in the flat
    therefore belongs to a displacement of amplitude A P / (2 pi).
    """
    for period in periods:
        if not 2.0 <= period <= 1e5:
            raise OutOfRange("period of tree rings", period, 2.0, 1e5)
    distance = r_min + _STEP * np.arange(int((r_max - r_min) / _STEP) + 3)
    period = np.interp(distance, [r_min, max(r_max, r_min + 1.0)], periods)
    waves = phase + 2.0 * np.pi * np.cumsum(_STEP / period)
    return np.asarray(amplitude * period / (2.0 * np.pi) * np.sin(waves))


def apply_edges(frame: Frame, shift: float, length: float, rng: np.random.Generator | None = None) -> Frame:
    """Displace charge towards the nearest edges of the detector, or away from them if `shift` is negative.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    shift : float
        Displacement of the charge at the edge in pixels, -0.5 to 0.5, positive towards the edge.
    length : float
        Distance in pixels over which the displacement falls by a factor of e, 0.01 to 1000.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons with the same sum.

    Raises
    ------
    OutOfRange
        If `shift` or `length` is outside its limits or NaN.
    """
    if not -0.5 <= shift <= 0.5:
        raise OutOfRange("displacement at the edge", shift, -0.5, 0.5)
    if not 1e-2 <= length <= 1e3:
        raise OutOfRange("scale length of the edge displacement", length, 1e-2, 1e3)
    out = np.array(frame, dtype=float, order="C")
    columns, rows = (_edge_displacement(n, shift, length) for n in frame.shape[::-1])
    _cross_borders(np.ascontiguousarray(frame, dtype=float), np.zeros(2), 0.0, (0.0, 0.0), columns, rows, out)
    return out


def _edge_displacement(n: int, shift: float, length: float) -> Frame:
    """Return by how many pixels charge is displaced at the border between each of n pixels along an axis and the next.

    The result is positive towards higher pixel indices. `shift` is the displacement at both edges of the detector in
    pixels, positive towards the nearer edge. `length` is the distance in pixels over which it falls by a factor of e.
    """
    border = np.arange(n) + 0.5
    to_start, to_end = border + 0.5, n - 0.5 - border
    displacement = shift * (np.exp(-to_end / length) - np.exp(-to_start / length))
    return np.where(np.minimum(to_start, to_end) < _EDGE_RANGE * length, displacement, 0.0)


@jit
def _cross_borders(frame: Any, table: Any, r_min: float, axis: Any, columns: Any, rows: Any, out: Any) -> None:
    """Move charge of `frame` across the borders of pixels, and add the changes (electrons) to `out` in place.

    `table` contains displacements of charge away from `axis` (column, row) in pixels, at distances from `r_min` in
    steps of `_STEP` pixels. `columns` and `rows` contain additional displacements in pixels, at the border of each
    column or row with the next one, positive towards the next one.
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
    """Return the component along one axis of the detector of a displacement away from the axis of the wafer, in pixels.

    The position is `along` this axis of the detector and `across` it, in pixels from the axis of the wafer. The
    displacement is interpolated in `table`, from the distance `r_min` in steps of `_STEP` pixels.
    """
    distance = math.sqrt(along * along + across * across)
    position = (distance - r_min) / _STEP
    i = min(max(int(position), 0), len(table) - 2)
    fraction = position - i
    return (table[i] + fraction * (table[i + 1] - table[i])) * along / max(distance, 1e-9)


@jit
def _strip_charge(d: float, q0: float, q1: float, q2: float, q3: float, inside: bool) -> float:
    """Return the charge that moves from one pixel to the next if charge at their border is displaced by d pixels.

    q0 to q3 are the charges of four successive pixels in electrons, and the border is between q1 and q2. `d` and the
    result are positive from q1 to q2. At the edge of the detector (`inside` is False) q0 and q3 are not used. At most a
    fifth of the charge of a pixel moves.
    """
    # Electrons per pixel at the border, interpolated from four pixels, or from two at the edges of the detector.
    level = (7.0 * (q1 + q2) - q0 - q3) / 12.0 if inside else 0.5 * (q1 + q2)
    moved = d * (level - 0.5 * d * (q2 - q1))
    # Limit the moved charge, because the interpolation overshoots next to a sharp peak.
    return min(max(moved, -_MAX_CROSSING * max(q2, 0.0)), _MAX_CROSSING * max(q1, 0.0))


def _value_or_zero(scene: Scene, key: str, unit: str) -> float:
    """Return a parameter of the detector in the given unit, or 0 for cameras that have no such parameter."""
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
