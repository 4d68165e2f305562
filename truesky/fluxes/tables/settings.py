"""Choose the smallest flux tables whose measured error is within the accuracy that the user allows.

flux_errors.csv has the errors of fluxes from tables relative to direct integration, measured with 20,000 random
galaxies with emission lines. Update it with `python -m benchmarks.fluxes --measure`.
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

# Assumed largest error of all galaxies, divided by the largest error of the measured sample.
MARGIN = 1.5
# If the allowed relative error is at most this, all fluxes are integrated instead of interpolated: errors of tables are
# known only relative to integration.
_MIN_TABLE_ERROR = 1e-4
# Relative error of integrated fluxes, because templates are stored in single precision.
_INTEGRATION_ERROR = 1e-6

COVERED_RANGES = {"z_obs": [Z_FIRST, Z_LAST], "ebv": [0.0, EBV_LAST], "a_v": [0.0, A_V_LAST]}


@dataclass(frozen=True, slots=True)
class Choice:
    """How fluxes in a band are computed, from a table or by integration, and the measured errors.

    Attributes
    ----------
    setting : Setting, optional
        Resolution of the flux table; None for direct integration.
    rms, largest : float
        Root mean square and largest error of the measured galaxies, as fractions of the flux.
    """

    setting: Setting | None
    rms: float
    largest: float

    def facts(self) -> dict[str, Any]:
        """Return the method and errors as JSON values; `setting` is [step, n_ebv, n_av], or None for integration."""
        setting = [self.setting.step, self.setting.n_ebv, self.setting.n_av] if self.setting else None
        return {"setting": setting, "rms": self.rms, "largest": self.largest}


INTEGRATED = Choice(None, _INTEGRATION_ERROR, _INTEGRATION_ERROR)


def choose(bands: Sequence[str], accuracy: Accuracy) -> tuple[Choice, ...]:
    """Return for each band the smallest flux table whose largest error times `MARGIN` is at most accuracy.flux.

    Parameters
    ----------
    bands : sequence of str
        Names of passbands.
    accuracy : Accuracy
        Errors that the user allows; `accuracy.flux` is relative to the flux.

    Returns
    -------
    tuple of Choice
        Resolution of each band's table and its errors; `INTEGRATED` if no table is accurate enough.

    Notes
    -----
    A user's passband is not in flux_errors.csv. It gets a resolution that is accurate enough for all bands of the file.
    """
    measured = _read_errors()
    return tuple(_smallest(measured, band, accuracy.flux) for band in bands)


def measured_bands() -> frozenset[str]:
    """Return the names of the bands whose table errors were measured in advance (flux_errors.csv)."""
    return frozenset(name for of_bands in _read_errors().values() for name in of_bands)


def stars_tabulated(accuracy: Accuracy) -> bool:
    """Return True if fluxes of stars are interpolated in tables, False if they are integrated.

    Tables are used if the allowed relative error is above 1e-4. Their error for stars is 1e-6 in all bands.
    """
    return accuracy.flux > _MIN_TABLE_ERROR


def star_error_facts(accuracy: Accuracy) -> dict[str, Any]:
    """Return errors of stellar fluxes as JSON values, for the manifest (JSON description) of a table of fluxes.

    `covered` is the range of A(V) (mag) of the tables, None if all stars are integrated. `largest` is the largest
    relative error.
    """
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
