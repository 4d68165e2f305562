"""Find examples that are similar to a source: from lists at the nodes of a grid, or the nearest ones directly.

The grid has three axes: brightness, width and blending, and each node has a list of its nearest examples. A source gets
a list of one of the eight nodes around it at random, with the weights of linear interpolation, and an example of this
list at random. This takes a hundredth of the time of a search for the examples nearest to each source.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from lake_schema.arrays import Array, Bool, Float, Int
from truesky.emulator.examples import Examples, Outcomes
from truesky.emulator.features import Features

# First node, step and number of nodes of each axis: brightness (mag), width and blending (log10).
AXES = ((-9.0, 0.125, 85), (0.0, 0.05, 25), (-2.0, 0.25, 17))
# Smallest number of examples of a node's list, which may be far from the node, and largest number. Lists of 48 examples
# used only a fifth of those at the limit of detection, so that the completeness was wrong by 0.025.
LEAST, MOST = 12, 512
# Number of the nearest examples of a source for `draw_nearest`.
_NEAREST = 48
# The other examples of a list are at most this far from the node, in steps of the grid. Circles of 0.71 steps cover it.
_RADIUS = 0.75
# Ranks of examples that are not detected in a list: beyond the sum of the ranks of two measurements.
_LOST, _BLENDED = 1e6, 1e7
# Positions in the grid are rounded to this fraction of a step, so that distances are exact on any processor.
_FRACTION = 64.0


@dataclass(frozen=True, slots=True)
class Lookup:
    """Lists of examples at the nodes of the grid.

    Attributes
    ----------
    lists : int32 array, shape (m,)
        Indices of examples, of one node after the other. In the list of a node, those come first that were detected,
        from bright and large to faint and small measurements; then those that were lost in the noise; then blended
        ones. Nodes of extended sources come first, then those of points, which have no axis of widths.
    starts, counts : int array, shape (nodes,)
        Index of the first example of each list, and number of its examples.
    detected, blended : int array, shape (nodes,)
        Number of detected and of blended examples of each list.
    """

    lists: Int
    starts: Int
    counts: Int
    detected: Int
    blended: Int


def build(examples: Examples) -> Lookup:
    """Return the lists of the nodes of the grid, for at least one example.

    If there are no points (or no extended sources) among the examples, their nodes have examples of the other type.
    """
    example_is_point = examples.features.is_point
    parts = []
    for is_point_list in (False, True):
        members = np.flatnonzero(example_is_point == is_point_list)
        members = members if members.size else np.arange(len(examples))
        shape = _shape(is_point_list)
        places = np.stack(np.unravel_index(np.arange(int(np.prod(shape))), shape), axis=1).astype(float)
        parts.append(_lists(examples.select(members), members, places))
    lists, counts, detected, blended = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return Lookup(lists, np.cumsum(counts) - counts, counts, detected, blended)


def draw(lookup: Lookup, features: Features, uniforms: tuple[Float, Float, Float, Float]) -> Int:
    """Return the index of an example for each of n sources.

    Parameters
    ----------
    lookup : Lookup
        Lists of examples.
    features : Features
        Features of the sources.
    uniforms : tuple of 4 float arrays, shape (n,)
        Uniform numbers in (0, 1): for the node on each axis, and for the place in its list.

    Returns
    -------
    int array, shape (n,)
        Indices of examples.
    """
    node = nodes(features, uniforms[:3])
    rank = (uniforms[3] * lookup.counts[node]).astype(np.int64)
    return np.asarray(lookup.lists[lookup.starts[node] + rank], np.int64)


def draw_in_steps(lookup: Lookup, node: Int, blending: Float, detection: Float, magnitude: Float) -> Int:
    """Return the index of an example for each of n sources, as `draw` does, with one number for each kind of outcome.

    The numbers of a source in two bands may be correlated, each kind by another amount.

    Parameters
    ----------
    lookup : Lookup
        Lists of examples.
    node : int array, shape (n,)
        Node of each source, from `nodes`.
    blending, detection : float array, shape (n,)
        Uniform numbers from 0 to 1. A low number of `blending` gives a blended example; else a low one of `detection`
        gives a detected example.
    magnitude : float array, shape (n,)
        Uniform numbers from 0 to 1, for the place among detected examples, from bright to faint.

    Returns
    -------
    int array, shape (n,)
        Indices of examples.
    """
    count, detected, blended = lookup.counts[node], lookup.detected[node], lookup.blended[node]
    # A number may be rounded up to 1. In a list of blended examples only, it must not lead to the list before.
    place = np.minimum((blending * count).astype(np.int64), count - 1)
    is_blended = place < blended
    among_others = np.minimum((detection * (count - blended)).astype(np.int64), count - blended - 1)
    is_detected = ~is_blended & (among_others < detected)
    place = np.where(is_blended, count - blended + place, among_others)
    measured = np.minimum((magnitude * detected).astype(np.int64), detected - 1)
    return np.asarray(lookup.lists[lookup.starts[node] + np.where(is_detected, measured, place)], np.int64)


def nodes(features: Features, uniforms: tuple[Float, ...]) -> Int:
    """Return one of the eight nodes around each source, with the weights of linear interpolation.

    `uniforms` are three arrays of uniform numbers in (0, 1), one number per source and axis.
    """
    values = (features.brightness, features.width, features.blending)
    places = []
    for value, (first, step, size), uniform in zip(values, AXES, uniforms, strict=True):
        place = np.clip((value - first) / step, 0.0, size - 1.0)
        # The sum with a number just below 1 may be rounded up, to a node beyond the last.
        places.append(np.minimum(np.floor(place + uniform).astype(np.int64), size - 1))
    extended, points = _shape(False), _shape(True)
    return np.where(
        features.is_point,
        int(np.prod(extended)) + places[0] * points[2] + places[2],
        (places[0] * extended[1] + places[1]) * extended[2] + places[2],
    )


def draw_nearest(examples: Examples, features: Features, uniform: Float) -> Int:
    """Return the index of an example for each of n sources by a search for the nearest ones: slow, and exact.

    Parameters
    ----------
    examples : Examples
        At least one example of each type.
    features : Features
        Features of the sources.
    uniform : float array, shape (n,)
        Uniform numbers in (0, 1), for the place among the nearest examples.

    Returns
    -------
    int array, shape (n,)
        Indices of examples.
    """
    out = np.zeros(len(uniform), np.int64)
    for is_point_list in (False, True):
        chosen, members = (
            np.flatnonzero(kind == is_point_list) for kind in (features.is_point, examples.features.is_point)
        )
        if not chosen.size:
            continue
        inside = [np.clip(axis, 0.0, size - 1.0) for axis, (_, _, size) in
                  zip(_positions(features.select(chosen)).T, AXES, strict=True)]  # fmt: skip
        positions = _positions(examples.features.select(members))
        indices, distance = _nearest(positions, np.stack(inside, axis=1), _NEAREST)
        is_near = distance <= 1.0
        is_near[:, :LEAST] = np.isfinite(distance[:, :LEAST])
        rank = (uniform[chosen] * is_near.sum(axis=1)).astype(np.int64)
        out[chosen] = members[indices[np.arange(len(chosen)), rank]]
    return out


def _lists(examples: Examples, numbers: Int, places: Float) -> tuple[Array, Int, Int, Int]:
    """Return the lists of nodes at these places one after the other, and their counts, see `Lookup`.

    `numbers` are the indices of the examples that the lists contain.
    """
    positions = _positions(examples.features)
    nearest, distance = _nearest(positions, places, LEAST)
    # Few nodes have more examples near them.
    is_dense = distance[:, -1] <= _RADIUS
    more, more_distance = _nearest(positions, places[is_dense], MOST)
    counts, detected, blended = (np.zeros(len(places), np.int64) for _ in range(3))
    groups = (
        (np.flatnonzero(~is_dense), nearest[~is_dense], np.isfinite(distance[~is_dense])),
        (np.flatnonzero(is_dense), more, more_distance <= _RADIUS),
    )
    rows = []
    for node, indices, is_near in groups:
        indices = np.minimum(indices, len(numbers) - 1)
        rank = _ranks(examples.outcomes, indices, is_near)
        order = np.lexsort((indices, rank), axis=1)
        counts[node] = is_near.sum(axis=1)
        detected[node], blended[node] = (rank < _LOST).sum(axis=1), (rank == _BLENDED).sum(axis=1)
        rows.append(numbers[np.take_along_axis(indices, order, axis=1)])
    starts, lists = np.cumsum(counts) - counts, np.zeros(int(counts.sum()), np.int32)
    for (node, _, _), row in zip(groups, rows, strict=True):
        inside = np.arange(row.shape[1]) < counts[node][:, None]
        lists[(starts[node][:, None] + np.arange(row.shape[1]))[inside]] = row[inside]
    return lists, counts, detected, blended


def _ranks(outcomes: Outcomes, indices: Int, is_near: Bool) -> Float:
    """Return numbers by which the examples in each row of indices are sorted, float64[n, k], see `Lookup.lists`.

    Detected ones have the sum of the ranks of their magnitude and size, relative to the true ones. Both are common to
    several bands, as far as they follow from the profile of a galaxy. Examples that are not near are last.
    """
    detected, sums = outcomes.detected[indices] & is_near, np.zeros(indices.shape)
    for measured in (outcomes.mag_auto, -outcomes.radius):
        values = np.where(detected, measured[indices], np.inf)
        sums += np.argsort(np.argsort(values, axis=1, kind="stable"), axis=1, kind="stable")
    lost = np.where(outcomes.blended[indices], _BLENDED, _LOST)
    return np.where(is_near, np.where(detected, sums, lost), np.inf)


def _shape(is_point: bool) -> tuple[int, int, int]:
    """Return the number of nodes on each axis; points have one width."""
    return AXES[0][2], 1 if is_point else AXES[1][2], AXES[2][2]


def _positions(features: Features) -> Float:
    """Return the positions of sources in steps of the grid from its first node, float64[n, 3]."""
    values = (features.brightness, features.width, features.blending)
    steps = [(value - first) / step for value, (first, step, _) in zip(values, AXES, strict=True)]
    return np.asarray(np.rint(np.stack(steps, axis=1) * _FRACTION) / _FRACTION)


def _nearest(points: Float, places: Float, count: int) -> tuple[Int, Float]:
    """Return the indices and distances of the points nearest to each place, infinite where there are fewer points."""
    distance, indices = scipy.spatial.cKDTree(points).query(places, k=list(range(1, count + 1)))
    return np.asarray(indices, np.int64), np.asarray(distance)
