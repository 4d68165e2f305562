"""Accuracy: how wrong a user allows a product to be.  What it buys in speed is looked up, never chosen by name.

Accuracy     what is asked for: the presets, or numbers of one's own
row_for      the cheapest measured settings of drawing (accuracy.csv) that are within it
reached      what these were measured to be wrong by
"""

from __future__ import annotations

import csv
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path

from lake_schema.errors import BadInput, OutOfRange

# Written by benchmarks/trade.py.
_TABLE = Path(__file__).with_name("accuracy.csv")


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Largest errors that are allowed.

    flux       : fraction of a source's flux
    shape      : of a reduced-shear component: the multiplicative error of the response to shear, and the additive one
    position   : pixels
    background : of the noise of a pixel of the sky, whatever light is drawn on it
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
# As fine as can be confirmed: of bright bulges the middle is known to 6e-3 of the sky's noise (3e-6 of its light: the
# table of Sersic profiles), however large the stamp.
REFERENCE = Accuracy(flux=1e-4, shape=1e-5, position=1e-5, background=0.006)
PRESETS = {"quicklook": QUICKLOOK, "draft": DRAFT, "survey": SURVEY, "reference": REFERENCE}


def preset(name: str) -> Accuracy:
    """The accuracy that a preset's name stands for."""
    if name not in PRESETS:
        raise BadInput(f"accuracy = {name!r} is not one of {', '.join(PRESETS)}")
    return PRESETS[name]


@cache
def fastest_row(allowed: Accuracy) -> dict[str, float]:
    """The row of accuracy.csv that takes the least time of those within an accuracy.

    A row is within it if its errors are, of the sources that it was chosen on and of the others (_held).
    Raises BadInput naming each number that is beyond reach, and the best there is: the last row's, in all four.
    """
    table = rows()
    good = [row for row in table if all(_error(row, name) <= value for name, value in asdict(allowed).items())]
    if good:
        return min(good, key=lambda row: row["seconds"])
    best = {name: _error(table[-1], name) for name in asdict(allowed)}
    lines = [
        f"accuracy.{name} = {value:g} is beyond reach, the best is {_round_up(best[name])}"
        for name, value in asdict(allowed).items()
        if value < best[name]
    ]
    raise BadInput("; ".join(lines))


def expected_errors(allowed: Accuracy) -> Accuracy:
    """Largest errors of drawing for an accuracy, of sources that its settings were not chosen on."""
    row = fastest_row(allowed)
    return Accuracy(**{item.name: row[f"{item.name}_held"] for item in fields(Accuracy)})


def rows() -> tuple[dict[str, float], ...]:
    """accuracy.csv: settings of drawing, the errors they make, the seconds they take."""
    return _read(_TABLE)


@cache
def _read(file: Path) -> tuple[dict[str, float], ...]:
    with file.open(newline="", encoding="utf-8") as lines:
        read = csv.DictReader(line for line in lines if not line.startswith("#"))
        return tuple({name: float(value) for name, value in row.items()} for row in read)


def _error(row: dict[str, float], name: str) -> float:
    return max(row[name], row[f"{name}_held"])


def _round_up(value: float) -> str:
    """Two digits, rounded up: what is said to be the best can be asked for."""
    low = f"{value:.1e}"
    if float(low) >= value:
        return f"{float(low):g}"
    mantissa, _, exponent = low.partition("e")
    return f"{float(f'{float(mantissa) + 0.1:.1f}e{exponent}'):g}"
