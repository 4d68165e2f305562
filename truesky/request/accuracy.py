"""Find the fastest settings for drawing sources whose errors are within the accuracy that a request allows.

A request (a user's TOML file) sets the accuracy by the name of a preset or by numbers. Settings with measured errors
are in accuracy.csv.
"""

from __future__ import annotations

import csv
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path

from lake_schema.errors import BadInput, OutOfRange, bad_input
from lake_schema.texts import spelling

# Table of drawing settings with their measured errors and CPU times, written by benchmarks/trade.py.
_TABLE = Path(__file__).with_name("accuracy.csv")


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Largest errors that a request allows.

    Attributes
    ----------
    flux : float
        Relative error of the flux of any source.
    shape : float
        Error of each component of the reduced shear of a source. It limits both the multiplicative error and the
        additive error.
    position : float
        Error of a source's position in pixels.
    background : float
        Error of the light of any source in any pixel, as a fraction of the noise of a pixel with sky only.

    Raises
    ------
    OutOfRange
        If a value is NaN or outside 1e-12 to 1.
    """

    flux: float
    shape: float
    position: float
    background: float

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not 1e-12 <= value <= 1.0:
                raise OutOfRange(f"accuracy.{item.name}", value, 1e-12, 1.0)


QUICKLOOK = Accuracy(flux=1e-2, shape=2e-2, position=3e-2, background=0.5)
DRAFT = Accuracy(flux=5e-3, shape=1e-3, position=1e-3, background=0.1)
SURVEY = Accuracy(flux=1e-3, shape=1e-4, position=1e-4, background=0.02)
# The finest accuracy that can be verified. Even with large image stamps, the centres of bright bulges are known only to
# 6e-3 of the sky noise, since tabulated Sersic profiles have errors of 3e-6 of the light.
REFERENCE = Accuracy(flux=1e-4, shape=1e-5, position=1e-5, background=0.006)
PRESETS = {"quicklook": QUICKLOOK, "draft": DRAFT, "survey": SURVEY, "reference": REFERENCE}
# Values that a request may have, for error messages.
ALLOWED = (
    f"{', '.join(PRESETS)}, or a table such as {{ flux = 1e-3, shape = 1e-4, position = 1e-4, background = 0.02 }}"
)


def preset(name: str) -> Accuracy:
    """Return the accuracy with the given name in `PRESETS`, such as "survey"; raises BadInput for an unknown name."""
    if name not in PRESETS:
        suggestion = spelling.did_you_mean(name, PRESETS)
        problem = f"is not allowed: {suggestion} allowed:" if suggestion else "is not one of"
        raise BadInput(f"accuracy = {name!r} {problem} {ALLOWED}")
    return PRESETS[name]


@cache
def fastest_row(allowed: Accuracy) -> dict[str, float]:
    """Return the drawing settings with the least CPU time among all settings whose errors are allowed.

    Parameters
    ----------
    allowed : Accuracy
        Largest errors that are allowed.

    Returns
    -------
    dict of str to float
        A row of accuracy.csv: settings, errors, and CPU time in seconds, by column name.

    Raises
    ------
    BadInput
        If no settings are accurate enough. The message names each error that cannot be reached, and its smallest value.
        This is the value in the last row of accuracy.csv, in which all four errors are smallest.

    Notes
    -----
    Settings qualify if their errors are small enough for two sets of sources: the sources for which the settings were
    chosen, and other sources (columns that end with ``_held``).
    """
    table = rows()
    good = [row for row in table if all(_error(row, name) <= value for name, value in asdict(allowed).items())]
    if good:
        return min(good, key=lambda row: row["seconds"])
    best = {name: _error(table[-1], name) for name in asdict(allowed)}
    lines = [
        f"accuracy.{name} = {value:g} cannot be reached, the best is {_round_up(best[name])}"
        for name, value in asdict(allowed).items()
        if value < best[name]
    ]
    raise bad_input(lines)


def expected_errors(allowed: Accuracy) -> Accuracy:
    """Return the measured errors of the drawing settings that are used for an allowed accuracy.

    They were measured on other sources than the sources for which the settings were chosen. Raises BadInput if no
    settings are accurate enough.
    """
    row = fastest_row(allowed)
    return Accuracy(**{item.name: row[f"{item.name}_held"] for item in fields(Accuracy)})


def rows() -> tuple[dict[str, float], ...]:
    """Return the rows of accuracy.csv: drawing settings, their errors, and their CPU time in seconds."""
    return _read(_TABLE)


@cache
def _read(file: Path) -> tuple[dict[str, float], ...]:
    with file.open(newline="", encoding="utf-8") as lines:
        read = csv.DictReader(line for line in lines if not line.startswith("#"))
        return tuple({name: float(value) for name, value in row.items()} for row in read)


def _error(row: dict[str, float], name: str) -> float:
    return max(row[name], row[f"{name}_held"])


def _round_up(value: float) -> str:
    """Return a positive number as text, rounded up to two significant digits.

    An error message prints the number as the smallest accuracy that can be reached. Rounding up ensures that a request
    with the printed number is accepted.
    """
    low = f"{value:.1e}"
    if float(low) >= value:
        return f"{float(low):g}"
    mantissa, _, exponent = low.partition("e")
    return f"{float(f'{float(mantissa) + 0.1:.1f}e{exponent}'):g}"
