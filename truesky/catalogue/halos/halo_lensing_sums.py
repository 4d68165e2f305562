"""Compiled sums of the convergence, shear and deflection by halos.

A table of halos has the rows X to CONCENTRATION: position in the plane of the sources (rad), distance (Mpc/h,
ascending), amplitude, angles (rad) and concentration. Sources have positions (2, n) in the same plane (rad) and inverse
distances 1 / chi (h/Mpc). Sums have shape (5, n): kappa, gamma1, gamma2, deflection along x and y (rad). The lensing of
a source by a halo depends only on these two, and halos are added in the order of the table.
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float, Int
from truesky.catalogue.halos import projected_nfw
from truesky.numerics.compiling import exact_jit

X, Y, CHI, AMPLITUDE, SIZE, CLOSE, WIDE, CONCENTRATION = range(8)
_profile, _total = projected_nfw.profile, projected_nfw.total
# Inner radius in units of theta_200. Closer to the centre, values are frozen at this radius, except that shear and
# deflection are 0 at the centre.
_CENTRE = 1e-6
# Margin for rounding errors in the comparison of distances.
_ROUNDING_ERROR = 1e-9


@exact_jit
def add_halos(place: Float, inverse_distance: Float, first: Int, halo: Float, out: Float) -> None:
    """Add the short-range lensing of halos to sources behind them, with masses compensated within theta_s.

    Parameters
    ----------
    place : float array, shape (2, n)
        Positions of the sources, rad, sorted by piece of the plane, then by decreasing distance.
    inverse_distance : float array, shape (n,)
        Inverse distances of the sources, h/Mpc.
    first : int array, shape (pieces + 1,)
        Row of the first source of each piece.
    halo : float array, shape (8, h)
        Table of halos.
    out : float array, shape (5, n)
        Sums, to which the lensing is added.
    """
    for piece in range(first.size - 1):
        start, stop = first[piece], first[piece + 1]
        if stop == start:
            continue
        x, y, inverse, piece_out = (
            place[0, start:stop],
            place[1, start:stop],
            inverse_distance[start:stop],
            out[:, start:stop],
        )
        at_x, at_y = 0.5 * (x.min() + x.max()), 0.5 * (y.min() + y.max())
        radius = np.sqrt(np.max((x - at_x) ** 2 + (y - at_y) ** 2)) + _ROUNDING_ERROR
        behind_count = x.size
        for h in range(halo.shape[1]):
            while behind_count > 0 and inverse[behind_count - 1] * halo[CHI, h] >= 1.0:
                behind_count -= 1
            if behind_count == 0:
                break
            squared_separation = (halo[X, h] - at_x) ** 2 + (halo[Y, h] - at_y) ** 2
            if squared_separation <= (max(halo[SIZE, h], halo[CLOSE, h]) + radius) ** 2:
                _add_point(x[:behind_count], y[:behind_count], inverse[:behind_count], halo[:, h], piece_out)
                if squared_separation <= (halo[SIZE, h] + radius) ** 2:
                    _add_inside(x[:behind_count], y[:behind_count], inverse[:behind_count], halo[:, h], piece_out)


@exact_jit
def _add_point(x: Float, y: Float, inverse: Float, halo: Float, out: Float) -> None:
    """Add a point with the halo's mass, compensated within theta_s, so that there is no lensing beyond."""
    kappa, gamma1, gamma2, along_x, along_y = out[0], out[1], out[2], out[3], out[4]
    at_x, at_y, chi, amplitude = halo[X], halo[Y], halo[CHI], halo[AMPLITUDE]
    min_square, inverse_close = (_CENTRE * halo[SIZE]) ** 2, 1.0 / halo[CLOSE] ** 2
    for j in range(x.size):
        dx, dy = x[j] - at_x, y[j] - at_y
        square = dx * dx + dy * dy
        square = square if square > min_square else min_square
        taper = 1.0 - square * inverse_close
        taper = taper if taper > 0.0 else 0.0
        strength = amplitude * (1.0 - chi * inverse[j]) * taper * taper
        convergence = -3.0 * inverse_close * strength
        inverse_square = 1.0 / square
        mean = strength * taper * inverse_square
        shear = (mean - convergence) * inverse_square
        kappa[j] += convergence
        gamma1[j] -= shear * (dx * dx - dy * dy)
        gamma2[j] -= shear * (2.0 * dx * dy)
        along_x[j] += mean * dx
        along_y[j] += mean * dy


@exact_jit
def _add_inside(x: Float, y: Float, inverse: Float, halo: Float, out: Float) -> None:
    """Add the difference between the halo's profile and a point of its mass, inside R_200m."""
    size, concentration = halo[SIZE], halo[CONCENTRATION]
    min_square, max_square = (_CENTRE * size) ** 2, size * size
    total_mass = _total(concentration)
    peak = 0.5 * concentration * concentration / (total_mass * max_square)
    for j in range(x.size):
        dx, dy = x[j] - halo[X], y[j] - halo[Y]
        square = dx * dx + dy * dy
        if square >= max_square:
            continue
        square = max(square, min_square)
        surface, enclosed = _profile(concentration * np.sqrt(square) / size, concentration)
        strength = halo[AMPLITUDE] * (1.0 - halo[CHI] * inverse[j])
        convergence = strength * peak * surface
        mean = strength * (enclosed / total_mass - 1.0) / square
        shear = (mean - convergence) / square
        out[0, j] += convergence
        out[1, j] -= shear * (dx * dx - dy * dy)
        out[2, j] -= shear * (2.0 * dx * dy)
        out[3, j] += mean * dx
        out[4, j] += mean * dy


@exact_jit
def add_smooth(place: Float, inverse_distance: Float, halo: Float, out: Float) -> None:
    """Add the long-range lensing of halos: their mass spread within theta_s, and compensated within theta_c.

    Parameters
    ----------
    place : float array, shape (2, n)
        Positions of the nodes, rad, sorted by decreasing distance.
    inverse_distance : float array, shape (n,)
        Inverse distances of the nodes, h/Mpc.
    halo : float array, shape (8, h)
        Table of halos.
    out : float array, shape (5, n)
        Sums, to which the lensing is added.
    """
    for h in range(halo.shape[1]):
        behind_count = inverse_distance.size
        while behind_count > 0 and inverse_distance[behind_count - 1] * halo[CHI, h] >= 1.0:
            behind_count -= 1
        at_x, at_y, chi, amplitude = halo[X, h], halo[Y, h], halo[CHI, h], halo[AMPLITUDE, h]
        min_square, close, wide = (_CENTRE * halo[SIZE, h]) ** 2, 1.0 / halo[CLOSE, h] ** 2, 1.0 / halo[WIDE, h] ** 2
        for j in range(behind_count):
            dx, dy = place[0, j] - at_x, place[1, j] - at_y
            square = dx * dx + dy * dy
            square = square if square > min_square else min_square
            inner, outer = 1.0 - square * close, 1.0 - square * wide
            inner, outer = inner if inner > 0.0 else 0.0, outer if outer > 0.0 else 0.0
            strength = amplitude * (1.0 - chi * inverse_distance[j])
            convergence = 3.0 * strength * (close * inner * inner - wide * outer * outer)
            inverse_square = 1.0 / square
            mean = strength * (outer * outer * outer - inner * inner * inner) * inverse_square
            shear = (mean - convergence) * inverse_square
            out[0, j] += convergence
            out[1, j] -= shear * (dx * dx - dy * dy)
            out[2, j] -= shear * (2.0 * dx * dy)
            out[3, j] += mean * dx
            out[4, j] += mean * dy


@exact_jit
def add_nodes(place: Float, inverse_distance: Float, planes: Float, step: float, table: Float, out: Float) -> None:
    """Add values of a table to sources: cubic on the grid, linear in inverse distance between planes.

    Parameters
    ----------
    place : float array, shape (2, n)
        Positions of the sources, rad.
    inverse_distance : float array, shape (n,)
        Inverse distances of the sources, h/Mpc.
    planes : float array, shape (p,)
        Inverse distances of the planes, h/Mpc, ascending from 0.
    step : float
        Node spacing, rad.
    table : float array, shape (p, side, side, 5)
        Values at the nodes of a square around the origin; sources outside get the values of its border.
    out : float array, shape (5, n)
        Sums, to which the values are added.

    References
    ----------
    Keys 1981, IEEE Trans. Acoust. Speech Signal Process. 29, 1153
    """
    side = table.shape[1]
    across, along = np.empty(4), np.empty(4)
    for j in range(inverse_distance.size):
        if inverse_distance[j] >= planes[-1]:
            continue
        upper = np.searchsorted(planes, inverse_distance[j], side="right")
        part = (inverse_distance[j] - planes[upper - 1]) / (planes[upper] - planes[upper - 1])
        first_x, first_y = _node(place[0, j], step, side, along), _node(place[1, j], step, side, across)
        for plane, share in ((upper - 1, 1.0 - part), (upper, part)):
            for b in range(4):
                for a in range(4):
                    weight = share * across[b] * along[a]
                    for field in range(5):
                        out[field, j] += weight * table[plane, first_y + b, first_x + a, field]


@exact_jit
def _node(at: float, step: float, side: int, weight: Float) -> int:
    """Return the first of the four nodes around a position, and fill in their weights."""
    where = min(max(at / step + 0.5 * (side - 1), 1.0), side - 2.000001)
    node = int(where)
    t = where - node
    weight[0] = t * (t * (1.0 - 0.5 * t) - 0.5)
    weight[1] = 1.0 + t * t * (1.5 * t - 2.5)
    weight[2] = t * (0.5 + t * (2.0 - 1.5 * t))
    weight[3] = 0.5 * t * t * (t - 1.0)
    return node - 1
