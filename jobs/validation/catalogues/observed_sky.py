"""Counts, redshifts, masses, star formation, lines and colours of a lake's galaxies against what surveys observed.

The list is observed.csv, that of the universe; errors are those of the lake's own patches of sky, left out in turn.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np

from jobs.validation import checks, observed
from jobs.validation.measure.rows import AROUND, LEAST, MOST, Place, Row, not_applicable
from jobs.validation.observed import Sky
from lake_schema.arrays import Int
from lake_schema.store import read

NAME = "observed"
# Patches that are left out in turn.
_PATCHES = 8
# Counts to a magnitude, i, r or I_E; how much fainter in I_E a galaxy of it may be; depth that all others want, and
# by how much a catalogue's faintest galaxy may fall short of its limit.
_LIMIT = re.compile(r"(?:log_)?(?:z_)?(?:i|r|vis)_([0-9.]+)")
_REDDER, _WHOLE, _SHORT = 0.5, 26.0, 0.1


def rows(galaxies: read.Version) -> list[Row]:
    """One a figure that observed.csv has; galaxies : of the lake."""
    return compared(*observed.in_version(galaxies))


def compared(seen: Sky, cell: Int) -> list[Row]:
    """The same of a sky; cell : the generation cell of each of its galaxies."""
    found = observed.figures(seen)
    errors = _errors(seen, cell)
    out = []
    # Magnitudes here are before magnification: some are fainter than the catalogue's limit.
    deepest = float(np.percentile(seen.mags["euclid_vis"], 99.0)) if len(cell) else 0.0
    for check in checks.checks(found):
        if (needed := _needed(check.name)) > deepest + _SHORT:
            why = f"{check.name} wants galaxies to I_E = {needed:g}; 99 % are brighter than {deepest:.2f}"
            out.append(replace(not_applicable(NAME, Place(), why, check.source), quantity=check.name))
            continue
        middle, half, kind = 0.5 * (check.least + check.most), 0.5 * (check.most - check.least), AROUND
        if math.isinf(half):
            kind = LEAST if math.isfinite(check.least) else MOST
            middle, half = (check.least if kind == LEAST else check.most), 0.0
        note = "" if check.gates else "a remembered number: it decides nothing"
        error = errors.get(check.name, math.nan) if check.gates else math.nan
        out.append(Row(NAME, check.name, Place(), check.found, error, middle, half, "", check.source, kind, note,
                       known=check.known))  # fmt: skip
    return out


def _needed(name: str) -> float:
    """I_E of the faintest galaxies that a figure is of; a sky to 26 tells all of them."""
    match = _LIMIT.fullmatch(name)
    return min(float(match[1]) + _REDDER, _WHOLE) if match else _WHOLE


def _errors(seen: Sky, cell: Int) -> dict[str, float]:
    """Standard error by figure; none where there are too few cells to tell."""
    cells = np.unique(cell)
    groups = [group for group in np.array_split(cells, min(_PATCHES, len(cells))) if len(group)]
    if len(groups) < 4:
        return {}
    found = []
    for group in groups:
        kept = ~np.isin(cell, group)
        part = Sky(
            {name: values[kept] for name, values in seen.rows.items()},
            {band: values[kept] for band, values in seen.mags.items()},
            seen.ultraviolet[kept], seen.area * (1.0 - len(group) / len(cells)), seen.quasars,
        )  # fmt: skip
        found.append(observed.figures(part))
    n = len(groups)
    errors = {}
    for name in found[0]:
        values = np.array([each.get(name, math.nan) for each in found])
        error = float(np.sqrt((n - 1) * np.mean((values - values.mean()) ** 2)))
        if math.isfinite(error) and error > 0.0:
            errors[name] = error
    return errors
