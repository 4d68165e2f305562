"""Convergence, shear and deflection by halos: compiled sums.

add_halos   to sources, the part of each halo that ends near it
add_smooth  to nodes of a grid, the rest of it
add_nodes   to sources, what lies between nodes

Tables of halos have rows X .. CONCENTRATION: place in the plane of the sources, distance in Mpc/h (rising), amplitude,
and angles in rad. Sources have places [2, n] in the same plane, rad, and near[n] = 1 / distance, h/Mpc. Sums are
[5, n]: kappa, gamma1, gamma2, deflection along x and y. What a halo does to a source depends on these two alone, and
halos are added in the order that they come in.
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float, Int
from truesky.catalogue.halos import projected_nfw
from truesky.numerics.compiling import exact_jit

X, Y, CHI, AMPLITUDE, SIZE, CLOSE, WIDE, CONCENTRATION = range(8)
_profile, _total = projected_nfw.profile, projected_nfw.total
# Closer to a centre than this, in units of theta_200, everything is as here: behind it are shear and deflection 0.
_CENTRE = 1e-6
# Reaches are compared with distances that are rounded.
_ROUNDING_ERROR = 1e-9


@exact_jit
def add_halos(place: Float, inverse_distance: Float, first: Int, halo: Float, out: Float) -> None:
    """Add to out[5, n] what each halo does to the sources behind it, with its mass taken away again within theta_s.

    place, near, out : sources, piece by piece of the plane, in each the farthest first
    first            : [pieces + 1] row of the first source of each piece
    halo             : [8, h]
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
    """A point of the halo's mass, whose mass is taken away again within theta_s: nothing is left beyond."""
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
    """What the halo's profile is more than the point of its mass, inside R_200m."""
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
    """Add to out[5, n] what halos do with their mass within theta_s and taken away again within theta_c.

    place, near, out : nodes, the farthest first;  halo : [8, h]
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
    """Add to out[5, n] the table's values at sources: cubic on the grid, linear in 1 / distance between planes.

    place, near : of sources;  planes : [p] 1 / distance, rising from 0;  step : rad between nodes
    table  : [p, side, side, 5] at nodes of a square about the origin; sources outside have what its border has
    Ref: Keys 1981, IEEE Trans. Acoust. Speech Signal Process. 29, 1153
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
    """The first of four nodes about a place, and their weights."""
    where = min(max(at / step + 0.5 * (side - 1), 1.0), side - 2.000001)
    node = int(where)
    t = where - node
    weight[0] = t * (t * (1.0 - 0.5 * t) - 0.5)
    weight[1] = 1.0 + t * t * (1.5 * t - 2.5)
    weight[2] = t * (0.5 + t * (2.0 - 1.5 * t))
    weight[3] = 0.5 * t * t * (t - 1.0)
    return node - 1
