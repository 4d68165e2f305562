"""Check counts, redshifts, masses, star formation, lines and colours of galaxies against observations of surveys.

The list is observed.csv, the same as for the simulated universe. Errors are jackknife errors over patches of the lake.
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

NAME = "observed"
# Number of jackknife patches, and smallest number for which an error is estimated.
_PATCHES, _MIN_PATCHES = 8, 4
# Names of figures with a magnitude limit in i, r or I_E; margin by which a galaxy may be fainter in I_E; depth that all
# other figures require; allowed shortfall of the faintest galaxy of a catalogue.
_LIMIT = re.compile(r"(?:log_)?(?:z_)?(?:i|r|vis)_([0-9.]+)")
_REDDER, _FULL_DEPTH, _DEPTH_MARGIN = 0.5, 26.0, 0.1


# Plotted bins of redshift with limits in I_E and i; percentiles of the colours, and fewest galaxies per bin.
_REDSHIFTS, _REDSHIFT_LIMIT = np.linspace(0.0, 3.0, 31), 24.5
_COLOUR_BINS, _COLOUR_LIMIT, _LEVELS, _MIN_GALAXIES = np.linspace(0.0, 1.2, 25), 22.5, (5, 16, 50, 84, 95), 30


def measure(galaxies: read.Version) -> Result:
    """Check table `galaxies` of a lake; return one row for each figure in observed.csv."""
    sample, cell = observed.from_version(galaxies)
    return Result(Place(), compare(sample, cell), _series(sample, cell) if len(cell) else {})


def _series(sample: GalaxySample, cell: Int) -> dict[str, Float]:
    """Redshift distribution (arcmin-2 per unit z) and colours against redshift, with jackknife errors."""
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
    """Check a sample of galaxies; `cell` is the generation cell of each galaxy."""
    figures = observed.figures(sample)
    errors = _errors(sample, cell)
    out = []
    # Magnitudes here are before magnification, so some are fainter than the limit of the catalogue.
    deepest = float(np.percentile(sample.mags["euclid_vis"], 99.0)) if len(cell) else 0.0
    for check in checks.evaluate(figures):
        if (depth := _required_depth(check.name)) > deepest + _DEPTH_MARGIN:
            why = f"{check.name} requires galaxies to I_E = {depth:g}; 99 % are brighter than {deepest:.2f}"
            out.append(replace(not_applicable(NAME, Place(), why, check.source), quantity=check.name))
            continue
        out.append(row_of_check(NAME, check, errors.get(check.name, math.nan), ""))
    return out


def _required_depth(name: str) -> float:
    """I_E of the faintest galaxies that a figure contains, at most 26, which is enough for all figures."""
    match = _LIMIT.fullmatch(name)
    return min(float(match[1]) + _REDDER, _FULL_DEPTH) if match else _FULL_DEPTH


def _groups(cell: Int) -> list[Int]:
    cells = np.unique(cell)
    return [group for group in np.array_split(cells, min(_PATCHES, len(cells))) if len(group)]


def _errors(sample: GalaxySample, cell: Int) -> dict[str, float]:
    """Jackknife error of each figure, empty if there are too few cells."""
    cells, groups = np.unique(cell), _groups(cell)
    if len(groups) < _MIN_PATCHES:
        return {}
    figures = []
    for group in groups:
        remaining = ~np.isin(cell, group)
        part = GalaxySample(
            {name: values[remaining] for name, values in sample.rows.items()},
            {band: values[remaining] for band, values in sample.mags.items()},
            sample.ultraviolet[remaining], sample.area * (1.0 - len(group) / len(cells)), sample.quasars,
        )  # fmt: skip
        figures.append(observed.figures(part))
    errors = {
        name: float(fields.jackknife_error([each.get(name, math.nan) for each in figures], _MIN_PATCHES))
        for name in figures[0]
    }
    return {name: error for name, error in errors.items() if math.isfinite(error) and error > 0.0}
