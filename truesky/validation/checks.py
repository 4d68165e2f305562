"""Expectations: what a figure should be, from where, and whether it is.

checks   of all figures that expectations.csv and observed.csv have a line for;  read : of one such file
report   as a table
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

# What follows from the models' own sources, and what surveys observed.
_LISTS = (Path(__file__).with_name("expectations.csv"), Path(__file__).with_name("observed.csv"))


@dataclass(frozen=True, slots=True)
class Check:
    """One expectation: what was found lies between two values.

    known : why it is known to fail; empty where it has to pass
    gates : whether a failure is one of the whole; not where the expectation is itself remembered
    """

    name: str
    found: float
    least: float
    most: float
    source: str
    known: str = ""
    gates: bool = True

    @property
    def passed(self) -> bool:
        return self.least <= self.found <= self.most

    @property
    def unexpected(self) -> bool:
        """Does it fail, and is not known to?"""
        return self.gates and not self.passed and not self.known


def checks(figures: Mapping[str, float], errors: float = 0.0) -> list[Check]:
    """Every expectation of a figure that was measured; errors : how many of its own a tolerance is widened by."""
    return [check for path in _LISTS for check in read(path, figures, errors)]


def read(path: Path, figures: Mapping[str, float], errors: float = 0.0) -> list[Check]:
    """The expectations of a file.

    path : of a CSV with columns name, expected, kind (relative, absolute, factor, least, most), tolerance, source,
           known_to_fail, and maybe errors (how many of the figure's own widen the tolerance), confidence (M: no gate)
    figures, errors : as of `checks`
    """
    found = []
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            name, expected, tolerance = row["name"], float(row["expected"]), float(row["tolerance"])
            if name not in figures:
                continue
            around = tolerance * (expected if row["kind"] == "relative" else 1.0)
            least, most = expected - around, expected + around
            if row["kind"] == "factor":
                least, most = expected / tolerance, expected * tolerance
            chance = max(float(row.get("errors") or 0.0), errors) * figures.get(f"{name}_error", 0.0)
            least = -np.inf if row["kind"] == "most" else least - chance
            most = np.inf if row["kind"] == "least" else most + chance
            about = row["source"], row["known_to_fail"], row.get("confidence") != "M"
            found.append(Check(name, figures[name], least, most, *about))
    return found


def _verdict(check: Check) -> str:
    """A remembered number is neither passed nor failed."""
    return ("PASS" if check.passed else "FAIL") if check.gates else ("near" if check.passed else "far ")


def report(figures: Mapping[str, float], results: Sequence[Check]) -> list[str]:
    """Print every figure and every check; returns the names of those that fail."""
    expected = {check.name for check in results}
    for name, value in figures.items():
        if name not in expected and not name.endswith("_error"):
            print(f"     {name:34} {value:12,.4g}")
    for check in results:
        error = f" +- {figures[check.name + '_error']:.2g}" if f"{check.name}_error" in figures else ""
        verdict, span = _verdict(check), f"{check.least:.4g} .. {check.most:.4g}"
        print(f"{verdict} {check.name:34} {check.found:12,.4g}{error:10} {span:20} {check.source}")
    failed = [check for check in results if not check.passed]
    print(f"{len(results) - len(failed)} of {len(results)} as expected")
    for check in (check for check in failed if check.gates):
        print(f"  not: {check.name}{', known to fail: ' if check.known else ''}{check.known}")
    for check in results:
        if check.passed and check.known:
            print(f"  passes, listed as known to fail: {check.name}")
    return [check.name for check in failed]
