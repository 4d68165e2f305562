"""Positions and magnitudes of the same stars in several images of a channel and band: how these agree.

rows   of every pair of neighbouring exposures that share stars
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from lake_schema.arrays import Float
from truesky.validation.lake.images.astrometry import TOLERANCE
from truesky.validation.lake.measure.rows import Place, Row, not_applicable
from truesky.validation.lake.measure.seen import Result, Several

SOURCE = "Serrano et al. 2024, app. C: below 1 mas rms between images (ground cameras 5 mas), 0.02 mag"
_MAGNITUDE, _LEAST = 0.02, 8
_NAMES = ("east", "north", "measured")


def rows(results: Sequence[Result]) -> list[Row]:
    """Mean differences of the stars that two exposures, one after the other, have in common."""
    out: list[Row] = []
    seen = [result for result in results if "east" in result.series]
    for channel, band in dict.fromkeys((result.place.channel, result.place.band) for result in seen):
        own = [result for result in seen if (result.place.channel, result.place.band) == (channel, band)]
        exposures = {
            number: _stars([result for result in own if result.place.exposure_id == number])
            for number in dict.fromkeys(result.place.exposure_id for result in own)
        }
        place = Place(channel, band)
        found = [
            row
            for (first, a), (second, b) in pairwise(exposures.items())
            for row in _pair(Place(channel, band, second), str(first), a, b)
        ]
        out += found or [not_applicable("between_images", place, "no two exposures with stars in common", SOURCE)]
    return out


def _stars(results: Sequence[Result]) -> Mapping[int, Float]:
    """Star -> its offsets (mas) and its magnitude, NaN where one is not known."""
    found: dict[int, Float] = {}
    for result in results:
        n = len(result.series["id"])
        columns = [np.asarray(result.series.get(name, np.full(n, np.nan))) for name in _NAMES]
        found |= dict(zip(result.series["id"].tolist(), np.stack(columns, axis=1), strict=True))
    return found


def _pair(place: Place, other: str, a: Mapping[int, Float], b: Mapping[int, Float]) -> list[Row]:
    shared = sorted(set(a) & set(b))
    if len(shared) < _LEAST:
        return []
    off = np.array([b[star] - a[star] for star in shared])
    position = TOLERANCE[str(place.channel)]
    out = []
    for column, name, tolerance, unit in ((0, "east", position, "mas"), (1, "north", position, "mas"),
                                          (2, "magnitude", _MAGNITUDE, "mag")):  # fmt: skip
        values = off[np.isfinite(off[:, column]), column]
        if len(values) >= _LEAST:
            mean, error = _mean(values)
            note = f"{len(values)} stars, against exposure {other}"
            out.append(Row("between_images", name, place, mean, error, 0.0, tolerance, unit, SOURCE, note=note))
    return out


def _mean(values: Float) -> tuple[float, float]:
    """(mean but for outliers, its standard error)."""
    middle = np.median(values)
    spread = 1.4826 * float(np.median(np.abs(values - middle))) + 1e-9
    kept = values[np.abs(values - middle) < 4.0 * spread]
    return float(kept.mean()), float(max(kept.std(ddof=1), 0.5 * spread) / np.sqrt(len(kept)))


BETWEEN = Several("between_images", SOURCE, rows)
