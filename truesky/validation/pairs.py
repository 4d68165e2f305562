"""Pairs of places on the sky within a separation: how many, and what their shears have in common.

counted   of galaxies and of random places;  sheared : of galaxies with shear;  sum_products : of any values
Sums      of either, with and without each patch of the sky
thinned   rows that leave few enough pairs

Places are sorted into cubes as wide as the largest separation: nothing is special about right ascension 0 or a pole.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Bool, Float, Int
from truesky.randomness import rng
from truesky.validation import compiled_pairs

# Pairs of places in neighbouring cubes that are looked at, at most: 3 s.
MAX_PAIRS = 1e8
CHANNELS = 7
# Half of the 26 neighbours of a cube, and itself.
_OFFSETS = [(0, 0, 0)] + [
    (x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0)
]  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """total : float[c, bin] of all pairs;  without : float[patch, c, bin] of those with no end in a patch."""

    total: Float
    jackknife: Float


def count_pairs(place: Float, kind: Int, patch: Int, edges: Float) -> Sums:
    """Pairs of two of kind 0, of one each, and of two of kind 1.

    place : float[n, 3] unit vectors;  kind : int[n] 0 or 1;  patch : int[n] from 0 on;  edges : of separations, rad
    """
    order, cube_starts, cube_pairs = _sort_into_cubes(place, edges[-1])
    sums, sorted_rows = _empty_sums(3, edges, patch), (np.ascontiguousarray(place[order]), kind[order].astype(np.int64))
    compiled_pairs.count_pairs(
        cube_starts, cube_pairs, *sorted_rows, patch[order].astype(np.int64), _chords(edges), sums
    )
    return _sums_with_jackknife(sums)


def sum_shear_products(ra: Float, dec: Float, shear: Float, patch: Int, edges: Float) -> Sums:
    """Sums of CHANNELS products: 1, xi+, xi-, cross, kappa kappa, kappa gamma_t, kappa gamma_x.

    ra, dec : float[n] deg;  shear : float[n, 3] gamma1, gamma2 in the frame (east, north), kappa
    patch   : int[n] from 0 on;  edges : of separations, rad
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
    """Sums over pairs of places by separation.

    Parameters
    ----------
    place : ndarray of float64, shape (n, 3)
        Unit vectors.
    values : ndarray of float64, shape (n, k)
        Values of k kinds at each place.
    edges : ndarray of float64, shape (b + 1,)
        Edges of the bins of separation, rad, ascending.

    Returns
    -------
    number, separation : ndarray of float64, shape (b,)
        Number of pairs, and the sum of their separations in rad.
    product : ndarray of float64, shape (k, b)
        Sum of the products of the values at both ends.
    """
    order, cube_starts, cube_pairs = _sort_into_cubes(place, edges[-1])
    sums = np.zeros((len(edges) - 1, 2 + values.shape[1]))
    ordered = np.ascontiguousarray(place[order]), np.ascontiguousarray(values[order], np.float64)
    compiled_pairs.sum_products(cube_starts, cube_pairs, *ordered, _chords(edges), sums)
    return sums[:, 0], sums[:, 1], sums[:, 2:].T


def _sums_with_jackknife(sums: Float) -> Sums:
    """Of sums[patch, patch, bin, c]."""
    total = sums.sum((0, 1))
    within_patch = np.einsum("iikc->ikc", sums)
    return Sums(total.T, np.swapaxes(total - sums.sum(0) - sums.sum(1) + within_patch, 1, 2))


def frames(ra: Float, dec: Float) -> Float:
    """float[n, 3, 3] unit vectors to the east, to the north, and towards places; ra, dec : float[n] deg."""
    lon, lat = np.radians(ra), np.radians(dec)
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros(len(lon))], 1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], 1)
    return np.stack([east, north, sky.unit_vectors(ra, dec)], 1)


def thin_sample(ids: Int, place: Float, max_separation: float, max_pairs: float = MAX_PAIRS) -> Bool:
    """Which of the places are kept, so that no more than `most` pairs are looked at; by their ids alone.

    ids : int[n];  place : float[n, 3] unit vectors;  widest : separation, rad
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
    """Order of the places by cube, row at which each cube begins, and pairs [2, m] of cubes that touch."""
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
