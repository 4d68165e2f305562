"""Expectations: what a figure should be, from where, and whether it is.

checks   of all figures that expectations.csv and observed.csv have a line for;  read : of one such file
report   as a table
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from truesky.validation.verdicts import AT_LEAST, AT_MOST, FAIL, PASS, UNDECIDED, WITHIN, verdict

# What follows from the models' own sources, and what surveys observed.
_LISTS = (Path(__file__).with_name("expectations.csv"), Path(__file__).with_name("observed.csv"))


@dataclass(frozen=True, slots=True)
class Check:
    """One figure and its expectation.

    expected, tolerance : of the value that was `found`; kind : "around", "least" or "most", the latter with tolerance 0
    group : of the expectation, "" = none
    known : why it is known to fail; empty where it has to pass
    gates : whether a failure is one of the whole; not where the expectation is itself remembered
    """

    name: str
    value: float
    expected: float
    tolerance: float
    kind: str
    source: str
    group: str = ""
    known_failure: str = ""
    is_binding: bool = True

    @property
    def lower_limit(self) -> float:
        """Smallest value that is as expected."""
        return -math.inf if self.kind == AT_MOST else self.expected - self.tolerance

    @property
    def upper_limit(self) -> float:
        """Largest value that is as expected."""
        return math.inf if self.kind == AT_LEAST else self.expected + self.tolerance

    @property
    def passes(self) -> bool:
        """True if the value is as expected; the tolerance has room for its error."""
        return verdict(self.value, 0.0, self.expected, self.tolerance, self.kind) == PASS

    @property
    def verdict(self) -> str:
        """PASS or FAIL; UNDECIDED if the expectation is remembered."""
        return (PASS if self.passes else FAIL) if self.is_binding else UNDECIDED

    @property
    def is_unexpected_failure(self) -> bool:
        """Does it fail, and is not known to?"""
        return self.verdict == FAIL and not self.known_failure


def evaluate(figures: Mapping[str, float], n_sigma: float = 0.0) -> list[Check]:
    """Every expectation of a figure that was measured; errors : how many of its own a tolerance is widened by."""
    return [check for path in _LISTS for check in read(path, figures, n_sigma)]


def read(path: Path, figures: Mapping[str, float], n_sigma: float = 0.0) -> list[Check]:
    """The expectations of a file.

    path : of a CSV with columns name, expected, kind (relative, absolute, factor, least, most), tolerance, source,
           known_to_fail, and maybe errors (how many of the figure's own widen the tolerance), confidence (M: no gate)
    figures, errors : as of `checks`
    """
    results = []
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            name, expected, tolerance, kind = row["name"], float(row["expected"]), float(row["tolerance"]), row["kind"]
            if name not in figures:
                continue
            if kind == "relative":
                tolerance *= abs(expected)
            elif kind == "factor":
                lower, upper = expected / tolerance, expected * tolerance
                expected, tolerance = 0.5 * (lower + upper), 0.5 * (upper - lower)
            tolerance += max(float(row.get("errors") or 0.0), n_sigma) * figures.get(f"{name}_error", 0.0)
            if kind in (AT_LEAST, AT_MOST):
                expected, tolerance = expected + (tolerance if kind == AT_MOST else -tolerance), 0.0
            else:
                kind = WITHIN
            details = row["source"], row.get("group") or "", row["known_to_fail"], row.get("confidence") != "M"
            results.append(Check(name, figures[name], expected, tolerance, kind, *details))
    return results


def report(figures: Mapping[str, float], results: Sequence[Check]) -> list[str]:
    """Print every figure and every check; returns the names of those that fail."""
    expected = {check.name for check in results}
    for name, value in figures.items():
        if name not in expected and not name.endswith("_error"):
            print(f"{'':9} {name:34} {value:12,.4g}")
    for check in results:
        error = f" +- {figures[check.name + '_error']:.2g}" if f"{check.name}_error" in figures else ""
        span = f"{check.lower_limit:.4g} .. {check.upper_limit:.4g}"
        print(f"{check.verdict:9} {check.name:34} {check.value:12,.4g}{error:10} {span:20} {check.source}")
    failed = [check for check in results if not check.passes]
    print(f"{len(results) - len(failed)} of {len(results)} as expected")
    for check in (check for check in failed if check.is_binding):
        print(f"  not: {check.name}{', known to fail: ' if check.known_failure else ''}{check.known_failure}")
    for check in results:
        if check.passes and check.known_failure:
            print(f"  passes, listed as known to fail: {check.name}")
    return [check.name for check in failed]
