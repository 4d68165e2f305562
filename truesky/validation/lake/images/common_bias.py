"""Check offsets that all detectors of an exposure share; they can be too small to detect on one detector."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lake_schema.arrays import Float
from truesky.validation.lake.images.astrometry import TOLERANCE
from truesky.validation.lake.measure.frame_context import ExposureCheck, Result
from truesky.validation.lake.measure.rows import Place, Row, not_applicable

SOURCE = "Serrano et al. 2024, app. C: absolute astrometry below 1 mas (ground cameras 5 mas), 0.02 mag"
_MAGNITUDE, _MIN_DETECTORS = 0.02, 2
_NAMES = ("east", "north", "magnitude")


def rows(results: Sequence[Result]) -> list[Row]:
    """Check the weighted means over the detectors of each exposure, and over all exposures of a channel and band."""
    out: list[Row] = []
    with_offsets = [result for result in results if "mean_off" in result.series]
    for channel, band in dict.fromkeys((result.place.channel, result.place.band) for result in with_offsets):
        group = [result for result in with_offsets if (result.place.channel, result.place.band) == (channel, band)]
        numbers = list(dict.fromkeys(result.place.exposure_id for result in group))
        group_rows = [
            row
            for number in numbers
            for row in _mean_rows(
                Place(channel, band, number), [each for each in group if each.place.exposure_id == number], "detectors"
            )
        ]
        if len(numbers) > 1:
            group_rows += _mean_rows(Place(channel, band), group, f"detectors of {len(numbers)} exposures")
        why = "no exposure with stars on several detectors"
        out += group_rows or [not_applicable("common_offset", Place(channel, band), why, SOURCE)]
    return out


def _mean_rows(place: Place, results: Sequence[Result], label: str) -> list[Row]:
    """Average results and check the means; `label` names what is averaged."""
    out = []
    tolerances = TOLERANCE[str(place.channel)], TOLERANCE[str(place.channel)], _MAGNITUDE
    for name, tolerance in zip(_NAMES, tolerances, strict=True):
        values = np.array(
            [measurement for each in results if np.isfinite(measurement := _value(each.series, name)).all()]
        )
        if len(values) >= _MIN_DETECTORS:
            mean, error = weighted_mean(*values.T)
            unit = "mag" if name == "magnitude" else "mas"
            note = f"{len(values)} {label}"
            out.append(Row("common_offset", name, place, mean, error, 0.0, tolerance, unit, SOURCE, note=note))
    return out


def _value(series: Mapping[str, Float], name: str) -> Float:
    """Offset of a detector and its error, NaN if not measured."""
    if name == "magnitude":
        return np.asarray(series.get("mean_dm", (np.nan, np.nan)))
    return np.asarray(series["mean_off"][_NAMES.index(name)])


def weighted_mean(values: Float, errors: Float) -> tuple[float, float]:
    """Return the weighted mean and its error, which includes the scatter of the values beyond their errors."""
    middle = float(np.median(values))
    # Differences between detectors add to the photon noise.
    intrinsic_variance = max(float(np.mean((values - middle) ** 2 - errors**2)), 0.0)
    weight = 1.0 / (errors**2 + intrinsic_variance)
    return float((weight * values).sum() / weight.sum()), float(weight.sum() ** -0.5)


COMMON_BIAS = ExposureCheck("common_offset", SOURCE, rows)
