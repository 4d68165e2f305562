"""Count pairs of positions on the sky by separation, and sum products of shears or other values over these pairs.

To find close pairs fast, space is divided into cubes as wide as the largest separation, so only adjacent cubes need to
be compared. Positions are unit vectors, so right ascension 0 and the poles need no special case.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Bool, Float, Int
from truesky.randomness import rng
from truesky.validation import compiled_pairs

# Largest number of pairs of positions in adjacent cubes that are examined; this takes 3 s.
MAX_PAIRS = 1e8
# Number of sums over pairs in `sum_shear_products`: 1, xi+, xi-, cross, kappa kappa, kappa gamma_t, kappa gamma_x.
CHANNELS = 7
# Steps (x, y, z) from a cube to itself and to 13 of its 26 neighbours, so that each pair of cubes is compared once.
_OFFSETS = [(0, 0, 0)] + [
    (x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0)
]  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """Sums of several quantities over pairs of positions in bins of separation, with jackknife samples.

    Attributes
    ----------
    total : float array, shape (quantities, bins)
        Sums over all pairs.
    jackknife : float array, shape (patches, quantities, bins)
        For each patch of the sky: sums over the pairs that have no position in this patch.
    """

    total: Float
    jackknife: Float


def count_pairs(place: Float, kind: Int, patch: Int, edges: Float) -> Sums:
    """Count pairs of positions of two kinds (such as galaxies and random positions) by separation.

    Parameters
    ----------
    place : float array, shape (n, 3)
        Positions as unit vectors.
    kind : int array, shape (n,)
        Kind of each position, 0 or 1.
    patch : int array, shape (n,)
        Number of the jackknife patch of each position, from 0.
    edges : float array, shape (b + 1,)
        Edges of the separation bins, rad, ascending.

    Returns
    -------
    Sums
        Numbers of pairs of three types: both positions of kind 0, one of each kind, and both of kind 1. All numbers are
        0 without positions.
    """
    order, cube_starts, cube_pairs = _sort_into_cubes(place, edges[-1])
    sums, sorted_rows = _empty_sums(3, edges, patch), (np.ascontiguousarray(place[order]), kind[order].astype(np.int64))
    compiled_pairs.count_pairs(
        cube_starts, cube_pairs, *sorted_rows, patch[order].astype(np.int64), _chords(edges), sums
    )
    return _sums_with_jackknife(sums)


def count_pairs_in_space(place: Float, kind: Int, patch: Int, edges: Float, angles: int) -> Sums:
    """Count pairs of positions of two kinds by their distance in space and their angle to the line of sight.

    Parameters
    ----------
    place : float array, shape (n, 3)
        Positions relative to the observer, in any unit.
    kind : int array, shape (n,)
        Kind of each position, 0 or 1.
    patch : int array, shape (n,)
        Number of the jackknife patch of each position, from 0.
    edges : float array, shape (b + 1,)
        Edges of the distance bins, in the unit of `place`, ascending.
    angles : int
        Number of equal bins of the cosine of the angle, from 0 to 1.

    Returns
    -------
    Sums
        Numbers of pairs of three types, as for `count_pairs`. The second axis has a bin for each distance and angle,
        with the angle in the inner order.
    """
    scale, widest = scale_to_unit_ball(place, edges[-1])
    order, cube_starts, cube_pairs = _sort_into_cubes(place * scale, widest)
    n_patches = int(patch.max(initial=-1)) + 1
    sums = np.zeros((n_patches, n_patches, len(edges) - 1, angles, 3))
    ordered = np.ascontiguousarray(place[order]), kind[order].astype(np.int64), patch[order].astype(np.int64)
    compiled_pairs.count_pairs_by_angle(cube_starts, cube_pairs, *ordered, np.asarray(edges, float) ** 2, sums)
    return _sums_with_jackknife(sums.reshape(n_patches, n_patches, -1, 3))


def scale_to_unit_ball(place: Float, largest: float) -> tuple[float, float]:
    """Return the factor that brings positions into the unit ball, and the angle (rad) whose chord is then `largest`.

    With the factor, `thin_sample` can be used for positions in space, with the angle as the largest separation.
    """
    scale = 1.0 / max(float(np.sqrt(np.sum(place**2, 1).max(initial=0.0))), largest)
    return scale, 2.0 * float(np.arcsin(0.5 * largest * scale))


def sum_shear_products(ra: Float, dec: Float, shear: Float, patch: Int, edges: Float) -> Sums:
    """Sum products of shear and convergence over pairs of galaxies, by separation.

    Parameters
    ----------
    ra, dec : float array, shape (n,)
        Positions, deg.
    shear : float array, shape (n, 3)
        Shear gamma1, gamma2 in the axes (east, north), and convergence kappa.
    patch : int array, shape (n,)
        Number of the jackknife patch of each position, from 0.
    edges : float array, shape (b + 1,)
        Edges of the separation bins, rad, ascending.

    Returns
    -------
    Sums
        Seven sums: number of pairs, xi+, xi-, cross component, kappa kappa, kappa gamma_t and kappa gamma_x. They are
        not divided by the number of pairs.
    """
    frame = frames(ra, dec)
    order, cube_starts, cube_pairs = _sort_into_cubes(frame[:, 2], edges[-1])
    sums, sorted_rows = (
        _empty_sums(CHANNELS, edges, patch),
        (np.ascontiguousarray(frame[order]), shear[order].astype(float)),
    )
    compiled_pairs.sum_shear_products(
        cube_starts, cube_pairs, *sorted_rows, patch[order].astype(np.int64), _chords(edges), sums
    )
    return _sums_with_jackknife(sums)


def sum_products(place: Float, values: Float, edges: Float) -> tuple[Float, Float, Float]:
    """Sum the products of quantities at both positions of a pair over all pairs, by separation.

    Parameters
    ----------
    place : float array, shape (n, 3)
        Positions as unit vectors.
    values : float array, shape (n, k)
        k quantities at each position.
    edges : float array, shape (b + 1,)
        Edges of the separation bins, rad, ascending.

    Returns
    -------
    number, separation : float array, shape (b,)
        Number of pairs, and the sum of their separations in rad.
    product : float array, shape (k, b)
        Sum of the products of each quantity. No result is divided by the number of pairs.
    """
    order, cube_starts, cube_pairs = _sort_into_cubes(place, edges[-1])
    sums = np.zeros((len(edges) - 1, 2 + values.shape[1]))
    ordered = np.ascontiguousarray(place[order]), np.ascontiguousarray(values[order], np.float64)
    compiled_pairs.sum_products(cube_starts, cube_pairs, *ordered, _chords(edges), sums)
    return sums[:, 0], sums[:, 1], sums[:, 2:].T


def _sums_with_jackknife(sums: Float) -> Sums:
    """Compute sums over all pairs, and sums without the pairs that have a position in each patch.

    `sums`, shape (patches, patches, bins, quantities), has the sums by the patches of both positions.
    """
    total = sums.sum((0, 1))
    within_patch = np.einsum("iikc->ikc", sums)
    return Sums(total.T, np.swapaxes(total - sums.sum(0) - sums.sum(1) + within_patch, 1, 2))


def frames(ra: Float, dec: Float) -> Float:
    """Return three unit vectors at each position (deg): to the east, to the north and outwards, shape (n, 3, 3)."""
    lon, lat = np.radians(ra), np.radians(dec)
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros(len(lon))], 1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], 1)
    return np.stack([east, north, sky.unit_vectors(ra, dec)], 1)


def thin_sample(ids: Int, place: Float, max_separation: float, max_pairs: float = MAX_PAIRS) -> Bool:
    """Select a random subset of positions, so that the search for close pairs examines at most about `max_pairs` pairs.

    Parameters
    ----------
    ids : int array, shape (n,)
        Identifiers of the positions. They determine the random numbers, so the result is reproducible.
    place : float array, shape (n, 3)
        Positions as unit vectors.
    max_separation : float
        Largest separation of the pairs, rad.
    max_pairs : float
        Largest number of pairs in adjacent cubes (as wide as `max_separation`). With fewer pairs, all positions are
        selected.

    Returns
    -------
    bool array, shape (n,)
        True for the selected positions.
    """
    _, cube_starts, cube_pairs = _sort_into_cubes(place, max_separation)
    number = np.diff(cube_starts).astype(float)
    n_pairs = float(np.sum(number[cube_pairs[0]] * number[cube_pairs[1]]))
    if n_pairs <= max_pairs:
        return np.ones(len(ids), bool)
    chance = rng.mix_bits(ids.astype(np.uint64) * rng.GOLDEN) / 2.0**64
    return np.asarray(chance < np.sqrt(max_pairs / n_pairs))


def _chords(edges: Float) -> Float:
    return np.asarray((2.0 * np.sin(0.5 * edges)) ** 2)


def _empty_sums(channels: int, edges: Float, patch: Int) -> Float:
    n_patches = int(patch.max(initial=-1)) + 1
    return np.zeros((n_patches, n_patches, len(edges) - 1, channels))


def _sort_into_cubes(place: Float, max_separation: float) -> tuple[Int, Int, Int]:
    """Sort positions (unit vectors) into cubes whose side is the chord of `max_separation` (rad).

    Returns the order of the positions by cube, the first row of each cube that contains positions (and the number of
    positions at the end), and the pairs of cubes, shape (2, m), that are adjacent or the same.
    """
    side = 2.0 * np.sin(0.5 * max_separation)
    n_side = int(2.0 / side) + 3
    at = np.floor((place + 1.0) / side).astype(np.int64) + 1
    key = (at[:, 0] * n_side + at[:, 1]) * n_side + at[:, 2]
    order = np.argsort(key, kind="stable")
    cube, cube_starts = np.unique(key[order], return_index=True)
    neighbours = []
    for x, y, z in _OFFSETS:
        neighbour_key = cube + (x * n_side + y) * n_side + z
        neighbour_index = np.minimum(np.searchsorted(cube, neighbour_key), max(len(cube) - 1, 0))
        matches = np.flatnonzero(cube[neighbour_index] == neighbour_key) if len(cube) else neighbour_index
        neighbours.append(np.stack([matches, neighbour_index[matches]]))
    return order, np.append(cube_starts, len(key)), np.ascontiguousarray(np.concatenate(neighbours, 1))
