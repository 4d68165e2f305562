"""Check position and magnitude offsets, averaged over all detectors of an exposure and over all exposures.

Such mean offsets can be too small to be significant on a single detector.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lake_schema.arrays import Float
from truesky.validation.lake.images.astrometry import TOLERANCE
from truesky.validation.lake.measure.frame_context import ExposureCheck, Result
from truesky.validation.lake.measure.rows import Place, Row, not_applicable

SOURCE = "Serrano et al. 2024, app. C: absolute astrometry below 1 mas (ground cameras 5 mas), 0.02 mag"
# Tolerance of the measured minus the catalogue magnitude of stars, averaged over detectors, mag.
_MAGNITUDE = 0.02
# Offsets are averaged only over at least this number of frames (one detector in one exposure).
_MIN_DETECTORS = 2
# Names of the averaged quantities: offsets of positions to the east and north, and of magnitudes.
_NAMES = ("east", "north", "magnitude")


def rows(results: Sequence[Result]) -> list[Row]:
    """Check mean offsets of stars: over the detectors of each exposure, and over all exposures of a channel and band.

    `results` are the results of all frames (exposures of one detector). Each returned row is a mean with its expected
    value and verdict. A channel and band gets a row "not_applicable" if no quantity was measured in two frames of one
    exposure or, with several exposures, in two frames of any exposures.
    """
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
    """Return rows with the mean offsets over several detectors, each with its expected value 0 and a verdict.

    `label` says in the row's note which detectors are averaged. Quantities measured in fewer than two frames are
    left out.
    """
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
    """Return the mean difference between measured and true values of a detector's stars, and its standard error.

    `name` is "east" or "north" (mas), or "magnitude" (mag; both values are NaN if no magnitude was measured).
    """
    if name == "magnitude":
        return np.asarray(series.get("mean_dm", (np.nan, np.nan)))
    return np.asarray(series["mean_off"][_NAMES.index(name)])


def weighted_mean(values: Float, errors: Float) -> tuple[float, float]:
    """Return the weighted mean of values and its standard error.

    If the values scatter more than their `errors` explain, the additional variance is included in the weights and in
    the standard error.
    """
    middle = float(np.median(values))
    # Estimate the real variance between detectors: the scatter of the values minus their photon noise.
    intrinsic_variance = max(float(np.mean((values - middle) ** 2 - errors**2)), 0.0)
    weight = 1.0 / (errors**2 + intrinsic_variance)
    return float((weight * values).sum() / weight.sum()), float(weight.sum() ** -0.5)


COMMON_BIAS = ExposureCheck("common_offset", SOURCE, rows)
