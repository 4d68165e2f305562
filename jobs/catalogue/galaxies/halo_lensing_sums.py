"""Convergence, shear and deflection by halos, summed halo by halo in small pieces of the sky."""

from __future__ import annotations

import numpy as np

from jobs.catalogue.halos import projected_nfw
from jobs.compiling import exact_jit
from lake_schema.arrays import Float, Int

_profile, _total = projected_nfw.profile, projected_nfw.total
# Closer to a centre than this, in units of theta_200, everything is as here: behind it are shear and deflection 0.
_CENTRE = 1e-6
# Reaches are compared with distances that are rounded.
_ROUNDED = 1e-9


@exact_jit
def add_halos(place: Float, near: Float, first: Int, frame: Float, halo: Float, out: Float) -> None:
    """Add to out[5, n] what each halo does to the sources behind it, in pieces of the sky with a tangent plane each.

    kappa and gamma1, gamma2 and the deflection are in the frame of the piece; what a halo does to a source depends on
    these two alone, and halos are added in the order that they come in.
    place : [2, n] stereographic coordinates of sources, rad, piece by piece;  near : [n] 1 / distance, h/Mpc, rising
            within a piece
    first : [pieces + 1] row of the first source of each piece
    frame : [pieces, 3, 3] east, north and centre of each piece
    halo  : [8, h] centre (3), distance Mpc/h (rising), amplitude, theta_200, theta_c, concentration
    """
    for piece in range(first.size - 1):
        start, stop = first[piece], first[piece + 1]
        x, y, inverse, found = place[0, start:stop], place[1, start:stop], near[start:stop], out[:, start:stop]
        radius = _ROUNDED
        for j in range(x.size):
            radius = max(radius, np.sqrt(x[j] ** 2 + y[j] ** 2) + _ROUNDED)
        east, north, out_of = frame[piece, 0], frame[piece, 1], frame[piece, 2]
        behind = x.size
        for h in range(halo.shape[1]):
            vx, vy, vz = halo[0, h], halo[1, h], halo[2, h]
            while behind > 0 and inverse[behind - 1] * halo[3, h] >= 1.0:
                behind -= 1
            if behind == 0:
                break
            reach = max(halo[5, h], halo[6, h]) + radius
            along = vx * out_of[0] + vy * out_of[1] + vz * out_of[2]
            # A chord is shorter than its stereographic image.
            if 2.0 - 2.0 * along > reach * reach:
                continue
            scale = 2.0 / (1.0 + along)
            at_x = scale * (vx * east[0] + vy * east[1] + vz * east[2])
            at_y = scale * (vx * north[0] + vy * north[1] + vz * north[2])
            away = at_x * at_x + at_y * at_y
            if away > reach * reach:
                continue
            _add_point(x[:behind], y[:behind], inverse[:behind], at_x, at_y, halo[3:, h], found)
            if away <= (halo[5, h] + radius) ** 2:
                _add_inside(x[:behind], y[:behind], inverse[:behind], at_x, at_y, halo[3:, h], found)


@exact_jit
def _add_point(x: Float, y: Float, inverse: Float, at_x: float, at_y: float, halo: Float, found: Float) -> None:
    """A point of the halo's mass, whose mass is taken away again within theta_c: nothing is left beyond."""
    chi, amplitude, size, wide = halo[0], halo[1], halo[2], halo[3]
    kappa, gamma1, gamma2, along_x, along_y = found[0], found[1], found[2], found[3], found[4]
    least, flat = (_CENTRE * size) ** 2, 1.0 / (wide * wide)
    for j in range(x.size):
        dx, dy = x[j] - at_x, y[j] - at_y
        square = dx * dx + dy * dy
        square = square if square > least else least
        rest = 1.0 - square * flat
        rest = rest if rest > 0.0 else 0.0
        strength = amplitude * (1.0 - chi * inverse[j])
        over = strength * rest * rest
        here = -3.0 * flat * over
        one = 1.0 / square
        mean = over * rest * one
        shear = (mean - here) * one
        kappa[j] += here
        gamma1[j] -= shear * (dx * dx - dy * dy)
        gamma2[j] -= shear * (2.0 * dx * dy)
        along_x[j] += mean * dx
        along_y[j] += mean * dy


@exact_jit
def _add_inside(x: Float, y: Float, inverse: Float, at_x: float, at_y: float, halo: Float, found: Float) -> None:
    """What the halo's profile is more than the point of its mass, inside R_200m."""
    chi, amplitude, size, concentration = halo[0], halo[1], halo[2], halo[4]
    least, most = (_CENTRE * size) ** 2, size * size
    whole = _total(concentration)
    peak = 0.5 * concentration * concentration / (whole * most)
    for j in range(x.size):
        dx, dy = x[j] - at_x, y[j] - at_y
        square = dx * dx + dy * dy
        if square >= most:
            continue
        square = max(square, least)
        surface, enclosed = _profile(concentration * np.sqrt(square) / size, concentration)
        strength = amplitude * (1.0 - chi * inverse[j])
        here = strength * peak * surface
        mean = strength * (enclosed / whole - 1.0) / square
        shear = (mean - here) / square
        found[0, j] += here
        found[1, j] -= shear * (dx * dx - dy * dy)
        found[2, j] -= shear * (2.0 * dx * dy)
        found[3, j] += mean * dx
        found[4, j] += mean * dy
