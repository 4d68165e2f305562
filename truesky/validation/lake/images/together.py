"""What all detectors of an exposure have in common: a bias that none of them alone is sure of.

rows   of every exposure of several detectors, and of all exposures of a channel and band
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lake_schema.arrays import Float
from truesky.validation.lake.images.astrometry import TOLERANCE
from truesky.validation.lake.measure.rows import Place, Row, not_applicable
from truesky.validation.lake.measure.seen import Result, Several

SOURCE = "Serrano et al. 2024, app. C: absolute astrometry below 1 mas (ground cameras 5 mas), 0.02 mag"
_MAGNITUDE, _LEAST = 0.02, 2
_NAMES = ("east", "north", "magnitude")


def rows(results: Sequence[Result]) -> list[Row]:
    """Means over the detectors, weighted by their errors."""
    out: list[Row] = []
    seen = [result for result in results if "mean_off" in result.series]
    for channel, band in dict.fromkeys((result.place.channel, result.place.band) for result in seen):
        own = [result for result in seen if (result.place.channel, result.place.band) == (channel, band)]
        numbers = list(dict.fromkeys(result.place.exposure_id for result in own))
        found = [
            row
            for number in numbers
            for row in _of(
                Place(channel, band, number), [each for each in own if each.place.exposure_id == number], "detectors"
            )
        ]
        if len(numbers) > 1:
            found += _of(Place(channel, band), own, f"detectors of {len(numbers)} exposures")
        why = "no exposure with stars on several detectors"
        out += found or [not_applicable("common_offset", Place(channel, band), why, SOURCE)]
    return out


def _of(place: Place, results: Sequence[Result], what: str) -> list[Row]:
    """Of results that are averaged; what : they are."""
    out = []
    tolerances = TOLERANCE[str(place.channel)], TOLERANCE[str(place.channel)], _MAGNITUDE
    for name, tolerance in zip(_NAMES, tolerances, strict=True):
        values = np.array([found for each in results if np.isfinite(found := _value(each.series, name)).all()])
        if len(values) >= _LEAST:
            mean, error = average(*values.T)
            unit = "mag" if name == "magnitude" else "mas"
            note = f"{len(values)} {what}"
            out.append(Row("common_offset", name, place, mean, error, 0.0, tolerance, unit, SOURCE, note=note))
    return out


def _value(series: Mapping[str, Float], name: str) -> Float:
    """(offset of a detector, its error); NaN where it has none."""
    if name == "magnitude":
        return np.asarray(series.get("mean_dm", (np.nan, np.nan)))
    return np.asarray(series["mean_off"][_NAMES.index(name)])


def average(values: Float, errors: Float) -> tuple[float, float]:
    """(weighted mean, its error), which is no smaller than the scatter of the values [n] makes it."""
    middle = float(np.median(values))
    # What the detectors have of their own comes on top of what photons do.
    own = max(float(np.mean((values - middle) ** 2 - errors**2)), 0.0)
    weight = 1.0 / (errors**2 + own)
    return float((weight * values).sum() / weight.sum()), float(weight.sum() ** -0.5)


TOGETHER = Several("common_offset", SOURCE, rows)
