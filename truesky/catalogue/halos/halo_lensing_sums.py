"""Compiled sums of the convergence, shear and deflection by halos at the positions of sources.

Halos and sources are in the tangent plane of a sky cell. A table of halos has 8 rows: position x and y (rad), comoving
distance (Mpc/h, ascending), lensing strength, three angles (rad) and concentration. The angles are theta_200 (radius of
the halo), theta_s (within which the halo is summed for each source) and theta_c (beyond which it does not lens).

Sources have positions (2, n) in the same plane (rad) and inverse comoving distances 1 / chi (h/Mpc). Sums have shape
(5, n): kappa, gamma1, gamma2, deflection along x and y (rad). Halos are added in the order of the table, so the sum for
a source does not depend on the other sources.
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float, Int
from truesky.catalogue.halos import projected_nfw
from truesky.numerics.compiling import exact_jit

# Rows of a table of halos: position x and y, comoving distance, lensing strength, theta_200 (SIZE), theta_s (CLOSE),
# theta_c (WIDE) and concentration.
X, Y, CHI, AMPLITUDE, SIZE, CLOSE, WIDE, CONCENTRATION = range(8)
_profile, _total = projected_nfw.profile, projected_nfw.total
# Radius in units of theta_200 within which the profile of a halo is constant, to avoid a division by zero. Shear and
# deflection are 0 at the centre.
_CENTRE = 1e-6
# Angle (rad) that is added to radii before comparing distances, because of rounding errors.
_ROUNDING_ERROR = 1e-9


@exact_jit
def add_halos(place: Float, inverse_distance: Float, first: Int, halo: Float, out: Float) -> None:
    """Add the lensing by halos at short range to the sources behind them.

    At short range, the mass of a halo is compensated by an equal negative mass within the angle theta_s, beyond which
    there is no lensing. `add_smooth` adds the rest.

    Parameters
    ----------
    place : float array, shape (2, n)
        Positions of the sources in the tangent plane, rad. They are sorted by piece of the plane (for example a HEALPix
        cell), then by decreasing distance.
    inverse_distance : float array, shape (n,)
        Inverse comoving distances of the sources, h/Mpc.
    first : int array, shape (pieces + 1,)
        Row of the first source of each piece; the last value is n.
    halo : float array, shape (8, h)
        Table of halos with the rows X to CONCENTRATION, ascending in distance.
    out : float array, shape (5, n)
        kappa, gamma1, gamma2, deflection along x and y (rad), to which the lensing is added.
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
    """Add the lensing by a point with the mass of a halo at sources behind it.

    The mass is compensated by an equal negative mass within theta_s, so there is no lensing beyond this angle. `halo`
    is a column of the table of halos. The sources are at `x`, `y` (rad) and 1 / comoving distance `inverse` (h/Mpc).
    """
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
    """Add the lensing by an NFW halo minus the lensing by a point of the same mass, for sources inside R_200m.

    The arguments have the same meaning as in `_add_point`. Sources outside R_200m are not changed.
    """
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
    """Add the lensing by halos at long range to the nodes of a grid behind them.

    At long range, the mass of a halo is spread within the angle theta_s and compensated by an equal negative mass
    within theta_c, beyond which there is no lensing.

    Parameters
    ----------
    place : float array, shape (2, n)
        Positions of the nodes in the tangent plane, rad, sorted by decreasing distance.
    inverse_distance : float array, shape (n,)
        Inverse comoving distances of the nodes, h/Mpc; 0 for infinity.
    halo : float array, shape (8, h)
        Table of halos with the rows X to CONCENTRATION, in any order.
    out : float array, shape (5, n)
        kappa, gamma1, gamma2, deflection along x and y (rad), to which the lensing is added.
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
    """Add the lensing at the nodes of a grid to sources, by interpolation.

    The interpolation is cubic in position, and linear in the inverse distance between two planes.

    Parameters
    ----------
    place : float array, shape (2, n)
        Positions of the sources in the tangent plane, rad.
    inverse_distance : float array, shape (n,)
        Inverse comoving distances of the sources, h/Mpc. Nothing is added to sources nearer than the nearest plane.
    planes : float array, shape (p,)
        Inverse comoving distances of the planes, h/Mpc, ascending from 0 (infinity).
    step : float
        Distance between nodes, rad.
    table : float array, shape (p, side, side, 5)
        Lensing at the nodes of a square around the origin of the plane, by plane, y and x. The interpolation needs four
        nodes per axis, so sources in the outermost ring of cells or outside get the values one node inside the border.
    out : float array, shape (5, n)
        kappa, gamma1, gamma2, deflection along x and y (rad), to which the values are added.

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
    """Return the first of the four nodes around a position on one axis, and fill `weight` with their cubic weights.

    `at` is the position relative to the middle of the `side` nodes, and `step` the distance between nodes (both rad).
    Positions before the second or behind the last but one node are moved to that node.
    """
    where = min(max(at / step + 0.5 * (side - 1), 1.0), side - 2.000001)
    node = int(where)
    t = where - node
    weight[0] = t * (t * (1.0 - 0.5 * t) - 0.5)
    weight[1] = 1.0 + t * t * (1.5 * t - 2.5)
    weight[2] = t * (0.5 + t * (2.0 - 1.5 * t))
    weight[3] = 0.5 * t * t * (t - 1.0)
    return node - 1
