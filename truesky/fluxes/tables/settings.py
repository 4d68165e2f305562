"""Which tables are fine enough: the smallest whose measured error is inside what the user allows.

CANDIDATES      settings that were measured, smallest first
Choice, choose  setting and error of each band, for galaxies
stars_tabulated, of_stars   the same for stars
known           bands that were measured
INTEGRATED      the choice of no table
COVERED         what the tables cover, as JSON values

The errors (flux_errors.csv) are those of 20,000 random galaxies, lines included, against direct integration:
python -m benchmarks.fluxes --measure.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from truesky.fluxes.tables.build_tables import A_V_LAST, EBV_LAST, STAR_A_V_LAST, Z_FIRST, Z_LAST, Setting
from truesky.request.accuracy import Accuracy

ERRORS = Path(__file__).with_name("flux_errors.csv")

CANDIDATES = tuple(
    sorted(
        (
            Setting(step, n_ebv, n_av)
            for step, n_ebv, n_av in (
                (0.02, 3, 2), (0.02, 4, 3), (0.01, 3, 2), (0.01, 4, 3), (0.007, 4, 3), (0.007, 6, 3), (0.005, 4, 3),
                (0.005, 6, 3), (0.007, 11, 4), (0.005, 11, 4),
            )
        ),
        key=lambda setting: setting.size,
    )
)  # fmt: skip

# The measured largest error times this is taken for the largest of all galaxies.
MARGIN = 1.5
# From here on nothing is interpolated: what the tables are measured against is not measured against itself.
_MIN_TABLE_ERROR = 1e-4
# Of integration, against the whole spectrum in double precision (the templates are in single precision).
_INTEGRATION_ERROR = 1e-6

COVERED_RANGES = {"z_obs": [Z_FIRST, Z_LAST], "ebv": [0.0, EBV_LAST], "a_v": [0.0, A_V_LAST]}


@dataclass(frozen=True, slots=True)
class Choice:
    """How a band is computed: from tables, or integrated (None), and its measured errors (fractions of the flux)."""

    setting: Setting | None
    rms: float
    largest: float

    def facts(self) -> dict[str, Any]:
        """As JSON values."""
        setting = [self.setting.step, self.setting.n_ebv, self.setting.n_av] if self.setting else None
        return {"setting": setting, "rms": self.rms, "largest": self.largest}


INTEGRATED = Choice(None, _INTEGRATION_ERROR, _INTEGRATION_ERROR)


def choose(bands: Sequence[str], accuracy: Accuracy) -> tuple[Choice, ...]:
    """For each band the smallest setting with 1.5 x largest error <= accuracy.flux; without one it is integrated.

    A band that was not measured (a user's) takes a setting that is fine enough for every band that was.
    """
    measured = _read_errors()
    return tuple(_smallest(measured, band, accuracy.flux) for band in bands)


def measured_bands() -> frozenset[str]:
    """Names of the bands that were measured."""
    return frozenset(name for of_bands in _read_errors().values() for name in of_bands)


def stars_tabulated(accuracy: Accuracy) -> bool:
    """Whether stars come from tables, whose error is 1e-6 in all bands."""
    return accuracy.flux > _MIN_TABLE_ERROR


def star_error_facts(accuracy: Accuracy) -> dict[str, Any]:
    """What is stored with the fluxes of stars, as JSON values."""
    covered = {"a_v": [0.0, STAR_A_V_LAST]} if stars_tabulated(accuracy) else None
    return {"covered": covered, "largest": _INTEGRATION_ERROR}


def _smallest(measured: dict[Setting, dict[str, Choice]], band: str, allowed: float) -> Choice:
    if allowed > _MIN_TABLE_ERROR:
        for setting in CANDIDATES:
            of_bands = measured.get(setting, {})
            choice = of_bands.get(band) or _worst_choice(setting, of_bands)
            if choice is not None and MARGIN * choice.largest <= allowed:
                return choice
    return INTEGRATED


def _worst_choice(setting: Setting, of_bands: dict[str, Choice]) -> Choice | None:
    if not of_bands:
        return None
    return Choice(setting, max(c.rms for c in of_bands.values()), max(c.largest for c in of_bands.values()))


def _read_errors() -> dict[Setting, dict[str, Choice]]:
    out: dict[Setting, dict[str, Choice]] = {}
    with ERRORS.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            setting = Setting(float(row["step"]), int(row["n_ebv"]), int(row["n_av"]))
            out.setdefault(setting, {})[row["band"]] = Choice(setting, float(row["rms"]), float(row["largest"]))
    return out
