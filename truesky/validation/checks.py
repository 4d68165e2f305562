"""Expected values of the figures of the simulated universe, and checks of the figures against them."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from truesky.validation.verdicts import AT_LEAST, AT_MOST, FAIL, PASS, UNDECIDED, WITHIN, verdict

# Expectations from the sources of the models, and observations by surveys.
_LISTS = (Path(__file__).with_name("expectations.csv"), Path(__file__).with_name("observed.csv"))


@dataclass(frozen=True, slots=True)
class Check:
    """One figure and its expectation.

    Attributes
    ----------
    name : str
        Name of the figure.
    value : float
        Measured value.
    expected, tolerance : float
        Expected value and allowed deviation, in the unit of the value; the tolerance of "least" and "most" is 0.
    kind : str
        "around", "least" or "most".
    source : str
        Source of the expectation.
    group : str
        Group of the expectation, "" if none.
    known_failure : str
        Reason for which the check is known to fail, "" if it must pass.
    is_binding : bool
        True if a failure counts. False if the expected value is quoted from memory.
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
        """Smallest value that passes."""
        return -math.inf if self.kind == AT_MOST else self.expected - self.tolerance

    @property
    def upper_limit(self) -> float:
        """Largest value that passes."""
        return math.inf if self.kind == AT_LEAST else self.expected + self.tolerance

    @property
    def passes(self) -> bool:
        """True if the value is as expected; the tolerance includes its error."""
        return verdict(self.value, 0.0, self.expected, self.tolerance, self.kind) == PASS

    @property
    def verdict(self) -> str:
        """PASS or FAIL; UNDECIDED if the expectation is not binding."""
        return (PASS if self.passes else FAIL) if self.is_binding else UNDECIDED

    @property
    def is_unexpected_failure(self) -> bool:
        """True if the check fails and is not known to fail."""
        return self.verdict == FAIL and not self.known_failure


def evaluate(figures: Mapping[str, float], n_sigma: float = 0.0) -> list[Check]:
    """Check every measured figure with an expectation; widen tolerances by at least `n_sigma` errors of the figure."""
    return [check for path in _LISTS for check in read(path, figures, n_sigma)]


def read(path: Path, figures: Mapping[str, float], n_sigma: float = 0.0) -> list[Check]:
    """Check figures against the expectations of a file.

    Parameters
    ----------
    path : Path
        CSV file with columns name, expected, kind (relative, absolute, factor, least, most), tolerance, source and
        known_to_fail. Optional columns: group, errors (number of errors of the figure that widen the tolerance) and
        confidence (M: quoted from memory, not binding).
    figures : mapping of str to float
        Measured values by name, with errors by name + "_error".
    n_sigma : float
        Smallest number of errors of the figure that widen the tolerance.

    Returns
    -------
    list of Check
        One check for each expectation of a figure that was measured.
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
    """Print every figure and every check; return the names of checks that do not pass."""
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
