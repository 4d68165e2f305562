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
MOST = 1e8
CHANNELS = 7
# Half of the 26 neighbours of a cube, and itself.
_OFFSETS = [(0, 0, 0)] + [
    (x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0)
]  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """total : float[c, bin] of all pairs;  without : float[patch, c, bin] of those with no end in a patch."""

    total: Float
    without: Float


def counted(place: Float, kind: Int, patch: Int, edges: Float) -> Sums:
    """Pairs of two of kind 0, of one each, and of two of kind 1.

    place : float[n, 3] unit vectors;  kind : int[n] 0 or 1;  patch : int[n] from 0 on;  edges : of separations, rad
    """
    order, first, pair = _cubes(place, edges[-1])
    sums, own = _empty(3, edges, patch), (np.ascontiguousarray(place[order]), kind[order].astype(np.int64))
    compiled_pairs.counted(first, pair, *own, patch[order].astype(np.int64), _chords(edges), sums)
    return _without(sums)


def sheared(ra: Float, dec: Float, shear: Float, patch: Int, edges: Float) -> Sums:
    """Sums of CHANNELS products: 1, xi+, xi-, cross, kappa kappa, kappa gamma_t, kappa gamma_x.

    ra, dec : float[n] deg;  shear : float[n, 3] gamma1, gamma2 in the frame (east, north), kappa
    patch   : int[n] from 0 on;  edges : of separations, rad
    """
    frame = frames(ra, dec)
    order, first, pair = _cubes(frame[:, 2], edges[-1])
    sums, own = _empty(CHANNELS, edges, patch), (np.ascontiguousarray(frame[order]), shear[order].astype(float))
    compiled_pairs.sheared(first, pair, *own, patch[order].astype(np.int64), _chords(edges), sums)
    return _without(sums)


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
    order, first, pair = _cubes(place, edges[-1])
    sums = np.zeros((len(edges) - 1, 2 + values.shape[1]))
    ordered = np.ascontiguousarray(place[order]), np.ascontiguousarray(values[order], np.float64)
    compiled_pairs.sum_products(first, pair, *ordered, _chords(edges), sums)
    return sums[:, 0], sums[:, 1], sums[:, 2:].T


def _without(sums: Float) -> Sums:
    """Of sums[patch, patch, bin, c]."""
    total = sums.sum((0, 1))
    both = np.einsum("iikc->ikc", sums)
    return Sums(total.T, np.swapaxes(total - sums.sum(0) - sums.sum(1) + both, 1, 2))


def frames(ra: Float, dec: Float) -> Float:
    """float[n, 3, 3] unit vectors to the east, to the north, and towards places; ra, dec : float[n] deg."""
    lon, lat = np.radians(ra), np.radians(dec)
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros(len(lon))], 1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], 1)
    return np.stack([east, north, sky.unit_vectors(ra, dec)], 1)


def thinned(ids: Int, place: Float, widest: float, most: float = MOST) -> Bool:
    """Which of the places are kept, so that no more than `most` pairs are looked at; by their ids alone.

    ids : int[n];  place : float[n, 3] unit vectors;  widest : separation, rad
    """
    _, first, pair = _cubes(place, widest)
    number = np.diff(first).astype(float)
    looked = float(np.sum(number[pair[0]] * number[pair[1]]))
    if looked <= most:
        return np.ones(len(ids), bool)
    chance = rng.mixed(ids.astype(np.uint64) * rng.GOLDEN) / 2.0**64
    return np.asarray(chance < np.sqrt(most / looked))


def _chords(edges: Float) -> Float:
    return np.asarray((2.0 * np.sin(0.5 * edges)) ** 2)


def _empty(channels: int, edges: Float, patch: Int) -> Float:
    many = int(patch.max(initial=-1)) + 1
    return np.zeros((many, many, len(edges) - 1, channels))


def _cubes(place: Float, widest: float) -> tuple[Int, Int, Int]:
    """Order of the places by cube, row at which each cube begins, and pairs [2, m] of cubes that touch."""
    side = 2.0 * np.sin(0.5 * widest)
    many = int(2.0 / side) + 3
    at = np.floor((place + 1.0) / side).astype(np.int64) + 1
    key = (at[:, 0] * many + at[:, 1]) * many + at[:, 2]
    order = np.argsort(key, kind="stable")
    cube, first = np.unique(key[order], return_index=True)
    found = []
    for x, y, z in _OFFSETS:
        wanted = cube + (x * many + y) * many + z
        other = np.minimum(np.searchsorted(cube, wanted), max(len(cube) - 1, 0))
        here = np.flatnonzero(cube[other] == wanted) if len(cube) else other
        found.append(np.stack([here, other[here]]))
    return order, np.append(first, len(key)), np.ascontiguousarray(np.concatenate(found, 1))
