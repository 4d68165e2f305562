"""Compiled sums over pairs of positions on the sky, for `truesky.validation.pairs`."""

from __future__ import annotations

import math

from lake_schema.arrays import Float, Int
from truesky.numerics.compiling import exact_jit


@exact_jit
def count_pairs(
    cube_starts: Int, cube_pairs: Int, place: Float, kind: Int, patch: Int, edge: Float, sums: Float
) -> None:
    """Add pairs to `sums` by the patches of both ends, separation, and kind.

    Parameters
    ----------
    cube_starts : int array, shape (c + 1,)
        Row at which each cube begins; positions are sorted by cube.
    cube_pairs : int array, shape (2, m)
        Cubes that may contain close pairs, each pair of cubes once, and each cube with itself.
    place : float array, shape (n, 3)
        Unit vectors.
    kind : int array, shape (n,)
        0 or 1.
    patch : int array, shape (n,)
        Patch of each position, from 0.
    edge : float array, shape (b + 1,)
        Edges of the separation bins as squared chords, ascending.
    sums : float array, shape (patches, patches, b, 3)
        Numbers of pairs, changed in place; the last axis is the sum of the two kinds.
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
    """Add numbers, separations and products of values of pairs to `sums`, by separation.

    Parameters
    ----------
    cube_starts, cube_pairs : int array
        Cubes and their pairs, see `count_pairs`.
    place : float array, shape (n, 3)
        Unit vectors.
    value : float array, shape (n, k)
        Values of k kinds at each position.
    edge : float array, shape (b + 1,)
        Edges of the separation bins as squared chords, ascending.
    sums : float array, shape (b, 2 + k)
        Number of pairs, sum of separations (rad), and sums of the products of each kind; changed in place.
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
    """Add numbers of pairs and products of their shear and convergence to `sums`, by patches and separation.

    Parameters
    ----------
    cube_starts, cube_pairs : int array
        Cubes and their pairs, see `count_pairs`.
    frame : float array, shape (n, 3, 3)
        Unit vectors to the east, to the north and towards each position.
    shear : float array, shape (n, 3)
        gamma1, gamma2, kappa at each position.
    patch : int array, shape (n,)
        Patch of each position, from 0.
    edge : float array, shape (b + 1,)
        Edges of the separation bins as squared chords, ascending.
    sums : float array, shape (patches, patches, b, 7)
        Number of pairs, xi+, xi-, cross component, kappa kappa, kappa gamma_t and kappa gamma_x; changed in place.
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
                # Direction to the other position, in the frame of each.
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
