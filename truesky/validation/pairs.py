"""Numbers of pairs of positions on the sky within a separation, and sums of products of their shears or other values.

Positions are sorted into cubes as wide as the largest separation. Right ascension 0 and the poles need no special case.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Bool, Float, Int
from truesky.randomness import rng
from truesky.validation import compiled_pairs

# Largest number of pairs of positions in neighbouring cubes that are examined; this takes 3 s.
MAX_PAIRS = 1e8
CHANNELS = 7
# Half of the 26 neighbours of a cube, and the cube itself.
_OFFSETS = [(0, 0, 0)] + [
    (x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0)
]  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """Sums of several quantities over pairs of points, for a jackknife over patches of the sky.

    Attributes
    ----------
    total : float array, shape (quantities, bins)
        Sums over all pairs.
    jackknife : float array, shape (patches, quantities, bins)
        Sums over the pairs without a point in the given patch.
    """

    total: Float
    jackknife: Float


def count_pairs(place: Float, kind: Int, patch: Int, edges: Float) -> Sums:
    """Count pairs with both ends of kind 0, with one end of each kind, and with both ends of kind 1.

    Parameters
    ----------
    place : float array, shape (n, 3)
        Unit vectors.
    kind : int array, shape (n,)
        0 or 1.
    patch : int array, shape (n,)
        Patch of each position, from 0.
    edges : float array, shape (b + 1,)
        Edges of the separation bins, rad, ascending.

    Returns
    -------
    Sums
        Numbers of pairs with c = 3.
    """
    order, cube_starts, cube_pairs = _sort_into_cubes(place, edges[-1])
    sums, sorted_rows = _empty_sums(3, edges, patch), (np.ascontiguousarray(place[order]), kind[order].astype(np.int64))
    compiled_pairs.count_pairs(
        cube_starts, cube_pairs, *sorted_rows, patch[order].astype(np.int64), _chords(edges), sums
    )
    return _sums_with_jackknife(sums)


def sum_shear_products(ra: Float, dec: Float, shear: Float, patch: Int, edges: Float) -> Sums:
    """Sum CHANNELS products over pairs: 1, xi+, xi-, cross, kappa kappa, kappa gamma_t, kappa gamma_x.

    Parameters
    ----------
    ra, dec : float array, shape (n,)
        Positions, deg.
    shear : float array, shape (n, 3)
        gamma1, gamma2 in the frame (east, north), and kappa.
    patch : int array, shape (n,)
        Patch of each position, from 0.
    edges : float array, shape (b + 1,)
        Edges of the separation bins, rad, ascending.

    Returns
    -------
    Sums
        Sums of the products with c = CHANNELS.
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
    """Sum products of values over pairs of positions, by separation.

    Parameters
    ----------
    place : float array, shape (n, 3)
        Unit vectors.
    values : float array, shape (n, k)
        Values of k kinds at each position.
    edges : float array, shape (b + 1,)
        Edges of the separation bins, rad, ascending.

    Returns
    -------
    number, separation : float array, shape (b,)
        Number of pairs, and the sum of their separations in rad.
    product : float array, shape (k, b)
        Sum of the products of the values at both ends.
    """
    order, cube_starts, cube_pairs = _sort_into_cubes(place, edges[-1])
    sums = np.zeros((len(edges) - 1, 2 + values.shape[1]))
    ordered = np.ascontiguousarray(place[order]), np.ascontiguousarray(values[order], np.float64)
    compiled_pairs.sum_products(cube_starts, cube_pairs, *ordered, _chords(edges), sums)
    return sums[:, 0], sums[:, 1], sums[:, 2:].T


def _sums_with_jackknife(sums: Float) -> Sums:
    """Total and jackknife sums from sums of shape (patch, patch, bin, c)."""
    total = sums.sum((0, 1))
    within_patch = np.einsum("iikc->ikc", sums)
    return Sums(total.T, np.swapaxes(total - sums.sum(0) - sums.sum(1) + within_patch, 1, 2))


def frames(ra: Float, dec: Float) -> Float:
    """Return unit vectors, shape (n, 3, 3), to the east, to the north and towards positions in deg."""
    lon, lat = np.radians(ra), np.radians(dec)
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros(len(lon))], 1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], 1)
    return np.stack([east, north, sky.unit_vectors(ra, dec)], 1)


def thin_sample(ids: Int, place: Float, max_separation: float, max_pairs: float = MAX_PAIRS) -> Bool:
    """Select a random subset so that at most about `max_pairs` pairs are examined; depends on the identifiers alone.

    Parameters
    ----------
    ids : int array, shape (n,)
        Identifiers.
    place : float array, shape (n, 3)
        Unit vectors.
    max_separation : float
        Largest separation, rad.
    max_pairs : float
        Number of pairs in neighbouring cubes above which positions are dropped.

    Returns
    -------
    bool array, shape (n,)
        True for the positions to keep.
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
    """Order of the positions by cube, row at which each cube begins, and pairs (2, m) of adjacent cubes."""
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
