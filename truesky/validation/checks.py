"""Compare figures (numbers measured in the simulated universe, by name) with expected values from CSV files."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from truesky.validation.verdicts import AT_LEAST, AT_MOST, FAIL, PASS, UNDECIDED, WITHIN, verdict

# CSV files with expected values: from the papers on which the models are based, and from observations by surveys.
_LISTS = (Path(__file__).with_name("expectations.csv"), Path(__file__).with_name("observed.csv"))


@dataclass(frozen=True, slots=True)
class Check:
    """A figure (a number measured in the simulated universe) and the value that is expected for it.

    Attributes
    ----------
    name : str
        Name of the figure.
    value : float
        Measured value.
    expected, tolerance : float
        Expected value and allowed deviation, in the unit of `value`. For the kinds "least" and "most" the tolerance is
        0, because it is already included in `expected`.
    kind : str
        "around" (within the tolerance of the expected value), "least" (at least the expected value) or "most".
    source : str
        Publication from which the expected value is taken.
    group : str
        Heading under which a report lists the check; "" for none.
    known_failure : str
        Reason why the check is known to fail; "" if it must pass.
    is_binding : bool
        True if a failure counts. False if the expected value is quoted from memory: the verdict is then undecided.
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
        """Return the smallest value that passes the check, -inf for the kind "most"."""
        return -math.inf if self.kind == AT_MOST else self.expected - self.tolerance

    @property
    def upper_limit(self) -> float:
        """Return the largest value that passes the check, inf for the kind "least"."""
        return math.inf if self.kind == AT_LEAST else self.expected + self.tolerance

    @property
    def passes(self) -> bool:
        """Return True if the value is within its limits.

        The measurement error is not considered, because the tolerance already includes it. NaN does not pass.
        """
        return verdict(self.value, 0.0, self.expected, self.tolerance, self.kind) == PASS

    @property
    def verdict(self) -> str:
        """Return PASS or FAIL, or UNDECIDED if the expected value is quoted from memory (`is_binding` is False)."""
        return (PASS if self.passes else FAIL) if self.is_binding else UNDECIDED

    @property
    def is_unexpected_failure(self) -> bool:
        """Return True if the verdict is FAIL and no reason for a known failure is given."""
        return self.verdict == FAIL and not self.known_failure


def evaluate(figures: Mapping[str, float], n_sigma: float = 0.0) -> list[Check]:
    """Check figures (measured values by name) against expectations.csv and observed.csv; others are ignored.

    The standard error of a figure is expected under its name + "_error", and is 0 if missing. Tolerances are increased
    by at least `n_sigma` standard errors.
    """
    return [check for path in _LISTS for check in read(path, figures, n_sigma)]


def read(path: Path, figures: Mapping[str, float], n_sigma: float = 0.0) -> list[Check]:
    """Check figures (measured values by name) against the expected values in a file.

    Parameters
    ----------
    path : Path
        CSV file with columns name, expected, kind, tolerance, source and known_to_fail (a reason, or empty). The
        tolerance is a fraction of the expected value (kind relative), an absolute deviation (absolute, least, most) or
        a factor of at least 1 (factor). Optional columns: group (a heading), errors (number of standard errors by which
        the tolerance is increased) and confidence (M: quoted from memory, so a failure does not count).
    figures : mapping of str to float
        Measured values by name, and their standard errors by name + "_error" (0 if missing).
    n_sigma : float
        Tolerances are increased by at least this number of standard errors.

    Returns
    -------
    list of Check
        One check for each row of the file whose figure was measured, in the order of the file.
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
    """Print every figure (measured value) and every check, and return the names of checks that do not pass.

    The names include known failures and checks whose expected value is quoted from memory.
    """
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
