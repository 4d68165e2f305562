"""Check counts, redshifts, masses, star formation, emission lines and colours of galaxies against survey observations.

The observed values are in observed.csv. Errors are jackknife errors over patches of the catalogue's area.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np

from lake_schema.arrays import Float, Int
from lake_schema.store import read
from truesky.validation import checks
from truesky.validation import field as fields
from truesky.validation.lake.measure.frame_context import Result
from truesky.validation.lake.measure.rows import Place, Row, not_applicable, row_of_check
from truesky.validation.model import observed
from truesky.validation.model.observed import GalaxySample

# Name of this check in the table `validation` (measured values with expected values and verdicts).
NAME = "observed"
# Largest number of patches into which the area of a catalogue is divided for jackknife errors.
_PATCHES = 8
# With fewer patches of sky than this number, jackknife errors of the measured quantities are not estimated. Errors in
# plots require six patches.
_MIN_PATCHES = 4
# Names of measured quantities with a magnitude limit in i, r or I_E, which is the number in the name.
_LIMIT = re.compile(r"(?:log_)?(?:z_)?(?:i|r|vis)_([0-9.]+)")
# A galaxy at a magnitude limit in i or r may have an I_E that is fainter than the limit by this difference, mag.
_REDDER = 0.5
# Depth in I_E (AB mag) that a catalogue must have to measure quantities without a magnitude limit.
_FULL_DEPTH = 26.0
# A catalogue is deep enough if it ends at most this much (mag) before the required depth in I_E.
_DEPTH_MARGIN = 0.1


# Edges in redshift of the bins of the plotted redshift distribution of galaxies.
_REDSHIFTS = np.linspace(0.0, 3.0, 31)
# Magnitude limit in I_E of the plotted redshift distribution.
_REDSHIFT_LIMIT = 24.5
# Edges of the redshift bins in which the distribution of galaxy colours is plotted.
_COLOUR_BINS = np.linspace(0.0, 1.2, 25)
# Magnitude limit in i of the plotted colours.
_COLOUR_LIMIT = 22.5
# Percentiles of the distribution of colours in a redshift bin that are plotted, %.
_LEVELS = (5, 16, 50, 84, 95)
# Redshift bins with fewer galaxies than this number are left out of the plot of colours.
_MIN_GALAXIES = 30


def measure(galaxies: read.Version) -> Result:
    """Check the table `galaxies` of a lake against the observations in observed.csv.

    Returns one row (measured and observed value with verdict) for each quantity that can be measured, and arrays for
    plots.
    """
    sample, cell = observed.from_version(galaxies)
    return Result(Place(), compare(sample, cell), _series(sample, cell) if len(cell) else {})


def _series(sample: GalaxySample, cell: Int) -> dict[str, Float]:
    """Return arrays for plots: the redshift distribution (arcmin^-2 per unit z), and colours by redshift.

    Both have jackknife errors. `cell` is the number of the HEALPix cell of each galaxy. Colours are left out if no bin
    has enough galaxies.
    """
    groups = _groups(cell)
    patch = np.zeros(len(cell), np.int64)
    for number, group in enumerate(groups):
        patch[np.isin(cell, group)] = number
    z, number = sample["z_true"], len(groups)
    faint = sample.mags["euclid_vis"] < _REDSHIFT_LIMIT
    low, high = _REDSHIFTS[:-1], _REDSHIFTS[1:]
    per = sample.area * observed.ARCMIN2 * (high - low)
    count = np.array(
        [np.histogram(z[faint & (patch == patch_number)], _REDSHIFTS)[0] for patch_number in range(number)], float
    )
    area = np.array([len(group) for group in groups], float)[:, None] / len(np.unique(cell))
    jackknife = (count.sum(0) - count) / (1.0 - area) if number > 1 else count
    bright, colour = sample.mags["lsst_i"] < _COLOUR_LIMIT, sample.mags["lsst_r"] - sample.mags["lsst_i"]
    place, lines = np.digitize(z, _COLOUR_BINS) - 1, []
    for bin_number in range(len(_COLOUR_BINS) - 1):
        in_bin = np.flatnonzero(bright & (place == bin_number))
        if len(in_bin) >= _MIN_GALAXIES:
            rest = [
                np.median(remaining)
                for remaining in (colour[in_bin[patch[in_bin] != left_out]] for left_out in range(number))
                if len(remaining)
            ]
            middle = 0.5 * (_COLOUR_BINS[bin_number] + _COLOUR_BINS[bin_number + 1])
            lines.append([middle, *np.percentile(colour[in_bin], _LEVELS), float(fields.jackknife_error(rest))])
    series = {"redshifts": np.stack([low, high, count.sum(0) / per, fields.jackknife_error(jackknife) / per])}
    return series | ({"colours": np.array(lines).T} if lines else {})


def compare(sample: GalaxySample, cell: Int) -> list[Row]:
    """Check a sample of galaxies against observed.csv, and return one row with a verdict for each quantity.

    `cell` is the number of the HEALPix cell (order 8) of each galaxy, for jackknife errors. The verdict is
    "not_applicable" if the catalogue is not deep enough for a quantity, or if the model is known to differ in it.
    """
    figures = observed.figures(sample)
    errors = _errors(sample, cell)
    out = []
    # Take a percentile as depth: without lensing magnification, a few galaxies are fainter than the catalogue's limit.
    deepest = float(np.percentile(sample.mags["euclid_vis"], 99.0)) if len(cell) else 0.0
    for check in checks.evaluate(figures):
        if (depth := _required_depth(check.name)) > deepest + _DEPTH_MARGIN:
            why = f"{check.name} requires galaxies to I_E = {depth:g}; 99 % are brighter than {deepest:.2f}"
            why = why if len(cell) else "the table galaxies has no rows"
            out.append(replace(not_applicable(NAME, Place(), why, check.source), quantity=check.name))
            continue
        if check.known_failure:
            why = f"{check.name} is known to differ: {check.known_failure}"
            out.append(replace(not_applicable(NAME, Place(), why, check.source), quantity=check.name))
            continue
        error = errors.get(check.name, math.nan)
        out.append(row_of_check(NAME, check, error, _note(check.value, error, len(np.unique(cell)))))
    return out


def _note(value: float, error: float, number_of_cells: int) -> str:
    """Return why a value or its error is unknown, "" if both are known."""
    if not math.isfinite(value):
        return "no galaxy of the catalogue is in this range"
    if math.isfinite(error):
        return ""
    if number_of_cells < _MIN_PATCHES:
        return f"too small an area: {number_of_cells} HEALPix cells < {_MIN_PATCHES}"
    return f"too few galaxies in {number_of_cells} HEALPix cells"


def _required_depth(name: str) -> float:
    """Return the depth in I_E (AB mag) that a catalogue must have to measure the quantity `name`, at most 26."""
    match = _LIMIT.fullmatch(name)
    return min(float(match[1]) + _REDDER, _FULL_DEPTH) if match else _FULL_DEPTH


def _groups(cell: Int) -> list[Int]:
    cells = np.unique(cell)
    return np.array_split(cells, min(_PATCHES, len(cells))) if len(cells) else []


def _errors(sample: GalaxySample, cell: Int) -> dict[str, float]:
    """Return the jackknife error of each measured quantity by name.

    Quantities without a finite error above 0 are left out. The result is empty with fewer than four HEALPix cells.
    """
    cells, groups = np.unique(cell), _groups(cell)
    if len(groups) < _MIN_PATCHES:
        return {}
    figures = []
    for group in groups:
        remaining = ~np.isin(cell, group)
        part = GalaxySample(
            {name: values[remaining] for name, values in sample.rows.items()},
            {band: values[remaining] for band, values in sample.mags.items()},
            sample.ultraviolet[remaining], sample.area * (1.0 - len(group) / len(cells)), sample.cosmology,
            sample.quasars,
        )  # fmt: skip
        figures.append(observed.figures(part))
    errors = {
        name: float(fields.jackknife_error([each.get(name, math.nan) for each in figures], _MIN_PATCHES))
        for name in figures[0]
    }
    return {name: error for name, error in errors.items() if math.isfinite(error) and error > 0.0}
