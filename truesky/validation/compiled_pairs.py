"""Loops over pairs of close positions on the sky, compiled by numba; `truesky.validation.pairs` calls them."""

from __future__ import annotations

import math

from lake_schema.arrays import Float, Int
from truesky.numerics.compiling import exact_jit


@exact_jit
def count_pairs(
    cube_starts: Int, cube_pairs: Int, place: Float, kind: Int, patch: Int, edge: Float, sums: Float
) -> None:
    """Count pairs of positions by the jackknife patches of both positions, separation, and kinds of the positions.

    Pairs outside the separation bins are ignored.

    Parameters
    ----------
    cube_starts : int array, shape (c + 1,)
        Space is divided into cubes, and positions are sorted by cube. Element k is the row of the first position in
        cube k; the last element is n.
    cube_pairs : int array, shape (2, m)
        Numbers of the cubes between which pairs are counted: each pair of cubes once, and each cube with itself.
    place : float array, shape (n, 3)
        Positions as unit vectors.
    kind : int array, shape (n,)
        0 or 1, for example galaxies and random positions.
    patch : int array, shape (n,)
        Number of the jackknife patch of each position, from 0.
    edge : float array, shape (b + 1,)
        Edges of the separation bins as squares of chords on the unit sphere, ascending.
    sums : float array, shape (patches, patches, b, 3)
        Numbers of pairs, to which the pairs are added in place. The index of the last axis is the sum of both kinds:
        0 for 0-0, 1 for 0-1 and 2 for 1-1.
    """
    last = edge.size - 1
    for p in range(cube_pairs.shape[1]):
        a, b = cube_pairs[0, p], cube_pairs[1, p]
        for i in range(cube_starts[a], cube_starts[a + 1]):
            for j in range(i + 1 if a == b else cube_starts[b], cube_starts[b + 1]):
                dx, dy, dz = place[i, 0] - place[j, 0], place[i, 1] - place[j, 1], place[i, 2] - place[j, 2]
                square = dx * dx + dy * dy + dz * dz
                if square >= edge[last] or square < edge[0]:
                    continue
                k = last - 1
                while square < edge[k]:
                    k -= 1
                sums[patch[i], patch[j], k, kind[i] + kind[j]] += 1.0


@exact_jit
def sum_products(cube_starts: Int, cube_pairs: Int, place: Float, value: Float, edge: Float, sums: Float) -> None:
    """Sum over pairs of positions, by separation: 1, the separation, and the products of quantities at both positions.

    Parameters
    ----------
    cube_starts, cube_pairs : int array
        Cubes by which positions are sorted, and pairs of adjacent cubes, see `count_pairs`.
    place : float array, shape (n, 3)
        Positions as unit vectors.
    value : float array, shape (n, k)
        k quantities at each position.
    edge : float array, shape (b + 1,)
        Edges of the separation bins as squares of chords on the unit sphere, ascending.
    sums : float array, shape (b, 2 + k)
        Number of pairs, sum of separations (rad), and sum of products of each quantity, which are increased in place.
    """
    last = edge.size - 1
    for p in range(cube_pairs.shape[1]):
        a, b = cube_pairs[0, p], cube_pairs[1, p]
        for i in range(cube_starts[a], cube_starts[a + 1]):
            for j in range(i + 1 if a == b else cube_starts[b], cube_starts[b + 1]):
                dx, dy, dz = place[i, 0] - place[j, 0], place[i, 1] - place[j, 1], place[i, 2] - place[j, 2]
                square = dx * dx + dy * dy + dz * dz
                if square >= edge[last] or square < edge[0]:
                    continue
                k = last - 1
                while square < edge[k]:
                    k -= 1
                bin_sums = sums[k]
                bin_sums[0] += 1.0
                bin_sums[1] += 2.0 * math.asin(0.5 * math.sqrt(square))
                for kind in range(value.shape[1]):
                    bin_sums[2 + kind] += value[i, kind] * value[j, kind]


@exact_jit
def sum_shear_products(
    cube_starts: Int, cube_pairs: Int, frame: Float, shear: Float, patch: Int, edge: Float, sums: Float
) -> None:
    """Sum products of shear and convergence over pairs of positions, by jackknife patches and separation.

    Pairs at the same position are ignored.

    Parameters
    ----------
    cube_starts, cube_pairs : int array
        Cubes by which positions are sorted, and pairs of adjacent cubes, see `count_pairs`.
    frame : float array, shape (n, 3, 3)
        For each position, unit vectors to the east, to the north, and from the observer to the position.
    shear : float array, shape (n, 3)
        Shear gamma1, gamma2 in the axes (east, north), and convergence kappa at each position.
    patch : int array, shape (n,)
        Number of the jackknife patch of each position, from 0.
    edge : float array, shape (b + 1,)
        Edges of the separation bins as squares of chords on the unit sphere, ascending.
    sums : float array, shape (patches, patches, b, 7)
        Number of pairs, and sums of xi+, xi-, the cross component, kappa kappa, kappa gamma_t and kappa gamma_x, which
        are increased in place.
    """
    last = edge.size - 1
    for p in range(cube_pairs.shape[1]):
        a, b = cube_pairs[0, p], cube_pairs[1, p]
        for i in range(cube_starts[a], cube_starts[a + 1]):
            for j in range(i + 1 if a == b else cube_starts[b], cube_starts[b + 1]):
                dx = frame[j, 2, 0] - frame[i, 2, 0]
                dy = frame[j, 2, 1] - frame[i, 2, 1]
                dz = frame[j, 2, 2] - frame[i, 2, 2]
                square = dx * dx + dy * dy + dz * dz
                if square >= edge[last] or square < edge[0] or square == 0.0:
                    continue
                k = last - 1
                while square < edge[k]:
                    k -= 1
                # Components of the vector from i to j along east and north: (x, y) at i, (u, v) at j.
                x = frame[i, 0, 0] * dx + frame[i, 0, 1] * dy + frame[i, 0, 2] * dz
                y = frame[i, 1, 0] * dx + frame[i, 1, 1] * dy + frame[i, 1, 2] * dz
                u = frame[j, 0, 0] * dx + frame[j, 0, 1] * dy + frame[j, 0, 2] * dz
                v = frame[j, 1, 0] * dx + frame[j, 1, 1] * dy + frame[j, 1, 2] * dz
                r2, s2 = 1.0 / (x * x + y * y), 1.0 / (u * u + v * v)
                cos_i, sin_i = (x * x - y * y) * r2, 2.0 * x * y * r2
                cos_j, sin_j = (u * u - v * v) * s2, 2.0 * u * v * s2
                t_i = -(shear[i, 0] * cos_i + shear[i, 1] * sin_i)
                x_i = -(shear[i, 1] * cos_i - shear[i, 0] * sin_i)
                t_j = -(shear[j, 0] * cos_j + shear[j, 1] * sin_j)
                x_j = -(shear[j, 1] * cos_j - shear[j, 0] * sin_j)
                kappa_i, kappa_j = shear[i, 2], shear[j, 2]
                bin_sums = sums[patch[i], patch[j], k]
                bin_sums[0] += 1.0
                bin_sums[1] += t_i * t_j + x_i * x_j
                bin_sums[2] += t_i * t_j - x_i * x_j
                bin_sums[3] += 0.5 * (t_i * x_j + x_i * t_j)
                bin_sums[4] += kappa_i * kappa_j
                bin_sums[5] += 0.5 * (kappa_i * t_j + kappa_j * t_i)
                bin_sums[6] += 0.5 * (kappa_i * x_j + kappa_j * x_i)


@exact_jit
def count_pairs_by_angle(
    cube_starts: Int, cube_pairs: Int, place: Float, kind: Int, patch: Int, edge: Float, sums: Float
) -> None:
    """Count pairs of positions in space by separation, and by the angle between the separation and the line of sight.

    The line of sight of a pair is that to its middle. Pairs outside the separation bins are ignored.

    Parameters
    ----------
    cube_starts, cube_pairs : int array
        Cubes by which positions are sorted, and pairs of adjacent cubes, see `count_pairs`.
    place : float array, shape (n, 3)
        Positions relative to the observer.
    kind : int array, shape (n,)
        0 or 1, for example galaxies and random positions.
    patch : int array, shape (n,)
        Number of the jackknife patch of each position, from 0.
    edge : float array, shape (b + 1,)
        Edges of the separation bins as squares, ascending.
    sums : float array, shape (patches, patches, b, a, 3)
        Numbers of pairs, to which the pairs are added in place, in a equal bins of the cosine of the angle from 0 to 1.
        The index of the last axis is the sum of both kinds.
    """
    last, angles = edge.size - 1, sums.shape[3]
    for p in range(cube_pairs.shape[1]):
        a, b = cube_pairs[0, p], cube_pairs[1, p]
        for i in range(cube_starts[a], cube_starts[a + 1]):
            for j in range(i + 1 if a == b else cube_starts[b], cube_starts[b + 1]):
                dx, dy, dz = place[i, 0] - place[j, 0], place[i, 1] - place[j, 1], place[i, 2] - place[j, 2]
                square = dx * dx + dy * dy + dz * dz
                if square >= edge[last] or square < edge[0] or square == 0.0:
                    continue
                k = last - 1
                while square < edge[k]:
                    k -= 1
                x, y, z = place[i, 0] + place[j, 0], place[i, 1] + place[j, 1], place[i, 2] + place[j, 2]
                cosine = abs(dx * x + dy * y + dz * z) / math.sqrt(square * (x * x + y * y + z * z))
                at = min(int(cosine * angles), angles - 1)
                sums[patch[i], patch[j], k, at, kind[i] + kind[j]] += 1.0
