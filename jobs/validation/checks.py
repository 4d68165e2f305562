"""Expectations: what a figure should be, from where, and whether it is.

checks   of all figures that expectations.csv has a line for;  report : as a table
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

_EXPECTED = Path(__file__).with_name("expectations.csv")


@dataclass(frozen=True, slots=True)
class Check:
    """One expectation: what was found lies between two values.

    known : why it is known to fail; empty where it has to pass
    """

    name: str
    found: float
    least: float
    most: float
    source: str
    known: str = ""

    @property
    def passed(self) -> bool:
        return self.least <= self.found <= self.most

    @property
    def unexpected(self) -> bool:
        """Does it fail, and is not known to?"""
        return not self.passed and not self.known


def checks(figures: Mapping[str, float], errors: float = 0.0) -> list[Check]:
    """Every expectation of a figure that was measured; errors : how many of its own a tolerance is widened by."""
    found = []
    with _EXPECTED.open(newline="") as file:
        for row in csv.DictReader(file):
            name, expected = row["name"], float(row["expected"])
            if name not in figures:
                continue
            around = float(row["tolerance"]) * (expected if row["kind"] == "relative" else 1.0)
            around += max(float(row["errors"]), errors) * figures.get(f"{name}_error", 0.0)
            least = -np.inf if row["kind"] == "most" else expected - around
            most = np.inf if row["kind"] == "least" else expected + around
            found.append(Check(name, figures[name], least, most, row["source"], row["known_to_fail"]))
    return found


def report(figures: Mapping[str, float], results: Sequence[Check]) -> list[str]:
    """Print every figure and every check; returns the names of those that fail."""
    expected = {check.name for check in results}
    for name, value in figures.items():
        if name not in expected and not name.endswith("_error"):
            print(f"     {name:34} {value:12,.4g}")
    for check in results:
        error = f" +- {figures[check.name + '_error']:.2g}" if f"{check.name}_error" in figures else ""
        verdict, span = "PASS" if check.passed else "FAIL", f"{check.least:.4g} .. {check.most:.4g}"
        print(f"{verdict} {check.name:34} {check.found:12,.4g}{error:10} {span:20} {check.source}")
    failed = [check for check in results if not check.passed]
    print(f"{len(results) - len(failed)} of {len(results)} as expected")
    for check in failed:
        print(f"  not: {check.name}{', known to fail: ' if check.known else ''}{check.known}")
    for check in results:
        if check.passed and check.known:
            print(f"  passes, listed as known to fail: {check.name}")
    return [check.name for check in failed]
