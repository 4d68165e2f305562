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
from truesky.render.effects.effect import Effect, copy_frame
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
    frame: Frame,
    amplitude: float,
    inner: float,
    outer: float,
    centre: float,
    rng: np.random.Generator,
    out: Frame | None = None,
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
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

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
    out = copy_frame(frame, out)
    if amplitude > 0.0:
        _cross_ring_borders(out, table, r_min, axis)
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


def apply_edges(
    frame: Frame, shift: float, length: float, rng: np.random.Generator | None = None, out: Frame | None = None
) -> Frame:
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
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

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
    out = copy_frame(frame, out)
    columns, rows = (_edge_displacement(n, shift, length) for n in frame.shape[::-1])
    if shift != 0.0:
        _cross_edge_borders(out, columns, rows, np.flatnonzero(columns[:-1]))
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
def _cross_ring_borders(frame: Any, table: Any, r_min: float, axis: Any) -> None:
    """Move charge of a frame across the borders of pixels by tree rings, in place.

    `table` contains displacements of charge away from `axis` (column, row) in pixels, at distances from `r_min` in
    steps of `_STEP` pixels.
    """
    ny, nx = frame.shape
    # Charge of the previous row, of this row and of the next row before any charge moved.
    previous, line, following = frame[0].copy(), frame[0].copy(), frame[0].copy()
    column = np.arange(nx) - axis[0]
    border = column[: nx - 1] + 0.5
    shift, moved = np.empty(nx), np.zeros(nx)
    for r in range(ny):
        up, row = r - axis[1], frame[r]
        if nx > 1:
            _compute_component(table, r_min, border, up, True, shift)
            _move_strips(shift[1 : nx - 2], (line, line[1:], line[2:], line[3:]), True, moved[1 : nx - 2])
            for c in (0, nx - 2):
                moved[c] = _strip_charge(shift[c], 0.0, line[c], line[c + 1], 0.0, False)
            row[0] -= moved[0]
            # No charge crosses the border after the last pixel: the last number of `moved` is 0.
            moved[nx - 1] = 0.0
            for c in range(1, nx):
                row[c] = row[c] + moved[c - 1] - moved[c]
        if r + 1 < ny:
            following[:] = frame[r + 1]
            _compute_component(table, r_min, column, up + 0.5, False, shift)
            neighbours = previous, line, following, frame[min(r + 2, ny - 1)]
            _move_strips(shift, neighbours, 0 < r < ny - 2, moved)
            _move_up(moved, row, frame[r + 1])
        previous, line, following = line, following, previous


@jit
def _cross_edge_borders(frame: Any, columns: Any, rows: Any, moving: Any) -> None:
    """Move charge of a frame across the borders of pixels near the edges of the detector, in place.

    `columns` and `rows` contain displacements in pixels at the border of each column or row with the next one, positive
    towards the next one. `moving` are the indices of columns with a displacement other than 0 and a next column.
    """
    ny, nx = frame.shape
    # Charge of the previous row, of this row and of the next row before any charge moved.
    previous, line, following = frame[0].copy(), frame[0].copy(), frame[0].copy()
    shift, moved = np.empty(nx), np.empty(nx)
    for r in range(ny):
        row = frame[r]
        for c in moving:
            outer = line[max(c - 1, 0)], line[min(c + 2, nx - 1)]
            charge = _strip_charge(columns[c], outer[0], line[c], line[c + 1], outer[1], 0 < c < nx - 2)
            row[c] -= charge
            row[c + 1] += charge
        if r + 1 < ny:
            following[:] = frame[r + 1]
            if rows[r] != 0.0:
                shift[:] = rows[r]
                neighbours = previous, line, following, frame[min(r + 2, ny - 1)]
                _move_strips(shift, neighbours, 0 < r < ny - 2, moved)
                _move_up(moved, row, frame[r + 1])
        previous, line, following = line, following, previous


@jit
def _move_up(moved: Any, row: Any, next_row: Any) -> None:
    for c in range(len(moved)):
        row[c] -= moved[c]
    for c in range(len(moved)):
        next_row[c] += moved[c]


@jit
def _compute_component(table: Any, r_min: float, columns: Any, row: float, across: bool, component: Any) -> None:
    """Fill `component` with one component of the displacement away from the axis of the wafer, in pixels.

    The positions are `columns` and `row`, in pixels from the axis of the wafer. The component is that along the row if
    `across`, and otherwise along the column. The displacement is interpolated in `table`, from the distance `r_min` in
    steps of `_STEP` pixels.
    """
    places = np.empty(len(columns))
    for c in range(len(columns)):
        distance = math.sqrt(columns[c] * columns[c] + row * row)
        places[c] = (distance - r_min) / _STEP
        component[c] = (columns[c] if across else row) / max(distance, 1e-9)
    # A separate loop for the table lets the compiler vectorise both loops.
    for c in range(len(columns)):
        i = min(max(int(places[c]), 0), len(table) - 2)
        fraction = places[c] - i
        component[c] *= table[i] + fraction * (table[i + 1] - table[i])


@jit
def _move_strips(shift: Any, charges: tuple[Any, Any, Any, Any], inside: bool, moved: Any) -> None:
    """Fill `moved` with the charge that moves between pixels whose common borders are displaced by `shift` pixels.

    `charges` are the charges of four successive pixels of each border, as for `_strip_charge`.
    """
    q0, q1, q2, q3 = charges
    for c in range(len(shift)):
        moved[c] = _strip_charge(shift[c], q0[c], q1[c], q2[c], q3[c], inside)


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


RINGS = Effect("tree_rings", apply_rings, _ring_parameters, _ring_contribution, fixed=True, cost=1.5e-2, in_place=True)
EDGES = Effect(
    "edge_displacement",
    apply_edges,
    _edge_parameters,
    lambda scene: abs(_edge_parameters(scene)[0]) * (scene.peak_electrons + scene.sky_electrons),
    cost=3e-3,
    in_place=True,
)
