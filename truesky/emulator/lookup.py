"""Find examples that are similar to a source: from lists at the nodes of a grid, or the nearest ones directly.

The grid has three axes: brightness, width and blending, and each node has a list of its nearest examples. A source gets
a list of one of the eight nodes around it at random, with the weights of linear interpolation, and an example of this
list at random. This takes a hundredth of the time of a search for the examples nearest to each source.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from lake_schema.arrays import Float, Int
from truesky.emulator.examples import Examples
from truesky.emulator.features import Features

# First node, step and number of nodes of each axis: brightness (mag), width and blending (log10).
AXES = ((-9.0, 0.125, 85), (0.0, 0.05, 25), (-2.0, 0.25, 17))
# Largest number of examples of a node's list, and smallest number, which may be far from the node.
MOST, LEAST = 48, 12
# The other examples of a list are at most this far from the node, in steps of the grid.
_RADIUS = 1.0
# Positions in the grid are rounded to this fraction of a step, so that distances are exact on any processor.
_FRACTION = 64.0


@dataclass(frozen=True, slots=True)
class Lookup:
    """Lists of examples at the nodes of the grid.

    Attributes
    ----------
    lists : int32 array, shape (nodes, most)
        Indices of examples, in the order of MAG_AUTO minus the true magnitude, from bright to faint and then not
        detected. Nodes of extended sources come first, then those of points, which have no axis of widths.
    counts : int array, shape (nodes,)
        Number of examples of each list.
    """

    lists: Int
    counts: Int


def build(examples: Examples) -> Lookup:
    """Return the lists of the nodes of the grid, for at least one example.

    If there are no points (or no extended sources) among the examples, their nodes have examples of the other type.
    """
    example_is_point = examples.features.is_point
    lists, counts = [], []
    for is_point_list in (False, True):
        members = np.flatnonzero(example_is_point == is_point_list)
        members = members if members.size else np.arange(len(examples))
        shape = _shape(is_point_list)
        nodes = np.stack(np.unravel_index(np.arange(int(np.prod(shape))), shape), axis=1).astype(float)
        indices, distance = _nearest(_positions(examples.features.select(members)), nodes, MOST)
        is_near = distance <= _RADIUS
        is_near[:, :LEAST] = np.isfinite(distance[:, :LEAST])
        indices = members[np.minimum(indices, len(members) - 1)]
        rank = np.where(is_near, np.nan_to_num(examples.outcomes.mag_auto[indices], nan=1e3), np.inf)
        order = np.lexsort((indices, rank), axis=1)
        lists.append(np.take_along_axis(indices, order, axis=1).astype(np.int32))
        counts.append(is_near.sum(axis=1))
    return Lookup(np.concatenate(lists), np.concatenate(counts))


def draw(lookup: Lookup, features: Features, uniforms: tuple[Float, Float, Float, Float]) -> Int:
    """Return the index of an example for each of n sources.

    Parameters
    ----------
    lookup : Lookup
        Lists of examples.
    features : Features
        Features of the sources.
    uniforms : tuple of 4 float arrays, shape (n,)
        Uniform numbers in (0, 1): for the node on each axis, and for the place in its list. Sources with equal places
        have similar outcomes, see `Lookup.lists`.

    Returns
    -------
    int array, shape (n,)
        Indices of examples.
    """
    values = (features.brightness, features.width, features.blending)
    places = []
    for value, (first, step, size), uniform in zip(values, AXES, uniforms[:3], strict=True):
        place = np.clip((value - first) / step, 0.0, size - 1.0)
        # The sum with a number just below 1 may be rounded up, to a node beyond the last.
        places.append(np.minimum(np.floor(place + uniform).astype(np.int64), size - 1))
    extended, points = _shape(False), _shape(True)
    node = np.where(
        features.is_point,
        int(np.prod(extended)) + places[0] * points[2] + places[2],
        (places[0] * extended[1] + places[1]) * extended[2] + places[2],
    )
    rank = (uniforms[3] * lookup.counts[node]).astype(np.int64)
    return np.asarray(lookup.lists[node, rank], np.int64)


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
        indices, distance = _nearest(_positions(examples.features.select(members)), np.stack(inside, axis=1), MOST)
        is_near = distance <= _RADIUS
        is_near[:, :LEAST] = np.isfinite(distance[:, :LEAST])
        rank = (uniform[chosen] * is_near.sum(axis=1)).astype(np.int64)
        out[chosen] = members[indices[np.arange(len(chosen)), rank]]
    return out


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
