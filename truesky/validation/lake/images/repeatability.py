"""Check that positions and magnitudes of the same stars agree between consecutive exposures of a channel and band."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from lake_schema.arrays import Float
from truesky.validation.lake.images.astrometry import TOLERANCE
from truesky.validation.lake.measure.frame_context import ExposureCheck, Result
from truesky.validation.lake.measure.rows import Place, Row, not_applicable

SOURCE = "Serrano et al. 2024, app. C: below 1 mas rms between images (ground cameras 5 mas), 0.02 mag"
# Tolerance of the mean magnitude difference of the same stars in two exposures, mag.
_MAGNITUDE = 0.02
# Two exposures with fewer stars in common than this number are not compared.
_MIN_STARS = 8
# Names of the measured series: offsets to the east and north (mas), and AB magnitudes.
_NAMES = ("east", "north", "measured")


def rows(results: Sequence[Result]) -> list[Row]:
    """Check the mean differences of positions and magnitudes of stars between consecutive exposures.

    `results` are the results of all frames (exposures of one detector). Each returned row is a mean difference with its
    expected value 0 and a verdict. A channel and band without two consecutive exposures with eight common stars gets a
    row "not_applicable".
    """
    out: list[Row] = []
    with_offsets = [result for result in results if "east" in result.series]
    for channel, band in dict.fromkeys((result.place.channel, result.place.band) for result in with_offsets):
        group = [result for result in with_offsets if (result.place.channel, result.place.band) == (channel, band)]
        exposures = {
            number: _star_offsets([result for result in group if result.place.exposure_id == number])
            for number in dict.fromkeys(result.place.exposure_id for result in group)
        }
        place = Place(channel, band)
        group_rows = [
            row
            for (first, a), (second, b) in pairwise(exposures.items())
            for row in _pair_rows(Place(channel, band, second), str(first), a, b)
        ]
        out += group_rows or [not_applicable("between_images", place, "no two exposures with stars in common", SOURCE)]
    return out


def _star_offsets(results: Sequence[Result]) -> Mapping[int, Float]:
    """Return, by identifier of the star, its offsets to the east and north (mas) and its magnitude, NaN if unknown."""
    by_star: dict[int, Float] = {}
    for result in results:
        n = len(result.series["id"])
        columns = [np.asarray(result.series.get(name, np.full(n, np.nan))) for name in _NAMES]
        by_star |= dict(zip(result.series["id"].tolist(), np.stack(columns, axis=1), strict=True))
    return by_star


def _pair_rows(place: Place, other: str, a: Mapping[int, Float], b: Mapping[int, Float]) -> list[Row]:
    shared = sorted(set(a) & set(b))
    if len(shared) < _MIN_STARS:
        return []
    offset = np.array([b[star] - a[star] for star in shared])
    position = TOLERANCE[str(place.channel)]
    out = []
    for column, name, tolerance, unit in ((0, "east", position, "mas"), (1, "north", position, "mas"),
                                          (2, "magnitude", _MAGNITUDE, "mag")):  # fmt: skip
        values = offset[np.isfinite(offset[:, column]), column]
        if len(values) >= _MIN_STARS:
            mean, error = _clipped_mean(values)
            note = f"{len(values)} stars, against exposure {other}"
            out.append(Row("between_images", name, place, mean, error, 0.0, tolerance, unit, SOURCE, note=note))
    return out


def _clipped_mean(values: Float) -> tuple[float, float]:
    """Return the mean of the values within 4 sigma of their median, and its standard error."""
    middle = np.median(values)
    spread = 1.4826 * float(np.median(np.abs(values - middle))) + 1e-9
    used = values[np.abs(values - middle) < 4.0 * spread]
    return float(used.mean()), float(max(used.std(ddof=1), 0.5 * spread) / np.sqrt(len(used)))


REPEATABILITY = ExposureCheck("between_images", SOURCE, rows)
