"""Verdicts (pass, fail, undecided, not applicable) on measured values that are compared with expected values."""

from __future__ import annotations

import math

# Verdicts on a check; NOT_APPLICABLE means that the lake does not contain what the check measures.
PASS, FAIL, UNDECIDED, NOT_APPLICABLE = "pass", "fail", "undecided", "not_applicable"
# Kinds of comparison: the value must be near, not below, or not above the expected value.
WITHIN, AT_LEAST, AT_MOST = "around", "least", "most"
# A value fails if it is beyond the tolerance by more than this number of standard errors, which is hardly chance.
FAIL_SIGMAS = 3.0


def verdict(value: float, error: float, expected: float, tolerance: float, kind: str = WITHIN) -> str:
    """Compare a measured value with an expected value.

    The value fails if it lies more than three standard errors beyond the tolerance. It passes if it lies within the
    tolerance and either its error does not exceed the tolerance or it lies more than three errors inside. All other
    values are undecided.

    Parameters
    ----------
    value, error : float
        Measured value and its standard error. The verdict is undecided if one of them is NaN or infinite.
    expected, tolerance : float
        Expected value and allowed deviation, in the unit of `value`.
    kind : str
        "around" (within the tolerance on both sides), "least" (at least `expected` - `tolerance`) or "most" (at most
        `expected` + `tolerance`). Other values give a KeyError.

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
