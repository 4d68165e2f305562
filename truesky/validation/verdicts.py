"""Verdicts on figures that are compared with an expectation, for the simulated universe and for lakes."""

from __future__ import annotations

import math

PASS, FAIL, UNDECIDED, NOT_APPLICABLE = "pass", "fail", "undecided", "not_applicable"
WITHIN, AT_LEAST, AT_MOST = "around", "least", "most"
# Standard errors beyond the tolerance above which a value fails; chance does not explain such a deviation.
FAIL_SIGMAS = 3.0


def verdict(value: float, error: float, expected: float, tolerance: float, kind: str = WITHIN) -> str:
    """Return "pass", "fail" or "undecided".

    A value fails if it lies more than three standard errors beyond the tolerance. It passes if it lies within the
    tolerance and either its error does not exceed the tolerance or it lies at least three errors inside. All other
    values are undecided.

    Parameters
    ----------
    value, error : float
        The measured value and its standard error. The verdict is undecided if one is not finite.
    expected, tolerance : float
        Expected value and allowed deviation.
    kind : str
        "around", "least" (at least expected - tolerance) or "most" (at most expected + tolerance).

    Returns
    -------
    str
        PASS, FAIL or UNDECIDED.
    """
    if not (math.isfinite(value) and math.isfinite(error)):
        return UNDECIDED
    deviation = {WITHIN: abs(value - expected), AT_LEAST: expected - value, AT_MOST: value - expected}[kind]
    excess = deviation - tolerance
    if excess > FAIL_SIGMAS * error:
        return FAIL
    is_precise = error <= tolerance or excess < -FAIL_SIGMAS * error
    return PASS if excess <= 0.0 and is_precise else UNDECIDED
