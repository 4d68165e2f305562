"""One measurement beside what it should be, and its verdict.

Row       a row of the table `validation`
verdict   pass, fail or undecided, of a value, its error, what is expected and the tolerance
"""

from __future__ import annotations

import math
from dataclasses import dataclass

PASS, FAIL, UNDECIDED, NOT_APPLICABLE = "pass", "fail", "undecided", "not_applicable"
AROUND, LEAST, MOST = "around", "least", "most"
# Standard errors beyond the tolerance from which a value is wrong, whatever chance does.
SURE = 3.0


@dataclass(frozen=True, slots=True)
class Place:
    """Where something was measured: an exposure's detector, a band of a channel, or the whole lake (all None)."""

    channel: str | None = None
    band: str | None = None
    exposure_id: int | None = None
    detector: str | None = None

    @property
    def text(self) -> str:
        """Parts that are known, one after the other; "lake" of the whole."""
        number = None if self.exposure_id is None else f"{self.exposure_id:06d}"
        return "/".join(part for part in (self.channel, self.band, number, self.detector) if part) or "lake"


@dataclass(frozen=True, slots=True)
class Row:
    """What was measured, where, and what it should be.

    check, quantity : names;  place : where
    value, error    : measured, and its standard error, in `unit`; NaN where nothing could be measured
    expected, tolerance : of the value; kind : "around" within the tolerance, "least" or "most" beyond it on one side
    source          : where the expectation and the tolerance are from
    note            : what was sampled; why the check does not apply
    known           : why it is known to fail, "" where it has to pass
    """

    check: str
    quantity: str
    place: Place
    value: float
    error: float
    expected: float
    tolerance: float
    unit: str
    source: str
    kind: str = AROUND
    note: str = ""
    applies: bool = True
    known: str = ""

    @property
    def verdict(self) -> str:
        """Of the value; "not_applicable" where there was nothing to measure."""
        if not self.applies:
            return NOT_APPLICABLE
        return verdict(self.value, self.error, self.expected, self.tolerance, self.kind)


def not_applicable(check: str, place: Place, why: str, source: str, quantity: str = "") -> Row:
    """A check that found nothing that it could measure.

    check, source : its name, and where its expectations are from;  place : where;  why : in a few words
    quantity      : that could not be measured, "" = none of the check's
    """
    nan = math.nan
    return Row(check, quantity, place, nan, nan, nan, nan, "", source, note=why, applies=False)


def verdict(value: float, error: float, expected: float, tolerance: float, kind: str = AROUND) -> str:
    """pass, fail or undecided.

    value, error : measured, and its standard error;  expected, tolerance : of it
    kind         : "around", "least" (at least expected - tolerance) or "most" (at most expected + tolerance)

    It fails where it lies more than three standard errors beyond the tolerance, passes where it lies within and its
    error is no larger than the tolerance (or it lies three errors within); else there is too little to tell.
    """
    if not (math.isfinite(value) and math.isfinite(error)):
        return UNDECIDED
    off = {AROUND: abs(value - expected), LEAST: expected - value, MOST: value - expected}[kind]
    beyond = off - tolerance
    if beyond > SURE * error:
        return FAIL
    sure = error <= tolerance or beyond < -SURE * error
    return PASS if beyond <= 0.0 and sure else UNDECIDED
