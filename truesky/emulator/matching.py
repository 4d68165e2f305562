"""Match true sources with detections through the pixels in which the light of a source lies.

A detection may contain the light of several sources. The one with the most light in it claims the detection, and the
others are blended. A distance alone would match a faint source with the outskirts of a bright one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Bool, Float, Int

# The light of a source is followed to this number of its half-light radii, and at least to _LEAST_REACH pixels.
_REACH = 1.0
_LEAST_REACH = 1.5
# Largest distance in pixels to which the light is followed.
_MOST_REACH = 12.0
# A source belongs to a detection only if this fraction of its light within that distance lies in its pixels.
_LEAST_FRACTION = 0.1


@dataclass(frozen=True, slots=True)
class Matches:
    """Detections of n true sources.

    Attributes
    ----------
    detection : int array, shape (n,)
        Index of the detection that a source claims, or -1.
    is_blended : bool array, shape (n,)
        True if the light of a source lies in a detection that a brighter source claims.
    """

    detection: Int
    is_blended: Bool


def match(x: Float, y: Float, flux: Float, radius: Float, segments: Int) -> Matches:
    """Match true sources with detections.

    Parameters
    ----------
    x, y : float array, shape (n,)
        True columns and rows, from 0.
    flux : float array, shape (n,)
        True fluxes, in any unit.
    radius : float array, shape (n,)
        Half-light radii after convolution with the PSF, in pixels.
    segments : int array, shape (ny, nx)
        Number of the detection to which each pixel belongs, from 1, or 0.

    Returns
    -------
    Matches
        The detection of each source. Each detection is claimed by one source at most.
    """
    source, segment, light = _light_in_segments(x, y, radius, segments)
    # For each source, the segment with the most of its light is the last one after sorting.
    order = np.lexsort((segment, light, source))
    source, segment, light = source[order], segment[order], light[order]
    is_last = np.append(source[1:] != source[:-1], True)[: len(source)]
    source, segment, light = source[is_last], segment[is_last], light[is_last]
    is_enough = light >= _LEAST_FRACTION
    source, segment, light = source[is_enough], segment[is_enough], (light * flux[source])[is_enough]
    order = np.lexsort((source, light, segment))
    source, segment = source[order], segment[order]
    claims = np.append(segment[1:] != segment[:-1], True)[: len(segment)]
    detection, is_blended = np.full(len(x), -1), np.zeros(len(x), bool)
    detection[source[claims]] = segment[claims] - 1
    is_blended[source[~claims]] = True
    return Matches(detection, is_blended)


def _light_in_segments(x: Float, y: Float, radius: Float, segments: Int) -> tuple[Int, Int, Float]:
    """Return triples of a source, a segment (from 1), and the fraction of the source's light in the segment.

    The light is that of a round Moffat profile with the given half-light radius (see `features.neighbour_light`) within
    a circle about the source.
    """
    reach = np.clip(_REACH * radius, _LEAST_REACH, _MOST_REACH)
    side, height, width = int(np.ceil(_MOST_REACH)), *segments.shape
    parts, total = [], np.zeros(len(x))
    middle_x, middle_y = np.rint(x).astype(np.int64), np.rint(y).astype(np.int64)
    for row in range(-side, side + 1):
        for column in range(-side, side + 1):
            index = np.flatnonzero(reach + 1.0 > np.hypot(row, column))
            px, py = middle_x[index] + column, middle_y[index] + row
            square = (px - x[index]) ** 2 + (py - y[index]) ** 2
            weight = np.where(square <= reach[index] ** 2, 1.0 / (1.0 + square / radius[index] ** 2) ** 2, 0.0)
            total[index] += weight
            inside = (px >= 0) & (px < width) & (py >= 0) & (py < height) & (weight > 0.0)
            index, number = index[inside], segments[py[inside], px[inside]]
            parts.append((index[number > 0], number[number > 0], weight[inside][number > 0]))
    source, segment, weight = (np.concatenate([part[i] for part in parts]) for i in range(3))
    key = source * (int(segments.max(initial=0)) + 1) + segment
    unique, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    light = np.bincount(inverse, weights=weight, minlength=len(unique))
    return source[first], segment[first].astype(np.int64), light / np.maximum(total[source[first]], 1e-30)
