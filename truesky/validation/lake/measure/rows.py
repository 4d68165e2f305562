"""One measurement of a lake, and what it should be.

Row              a row of the table `validation`
row_of_check     the row of a check of the lists of expectations
not_applicable   the row of a check that found nothing to measure
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from truesky.validation.checks import Check
from truesky.validation.verdicts import NOT_APPLICABLE, WITHIN, verdict


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
    kind: str = WITHIN
    note: str = ""
    applies: bool = True
    known_failure: str = ""

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


def row_of_check(name: str, check: Check, error: float, note: str) -> Row:
    """Return the row of a check of the whole lake.

    Parameters
    ----------
    name : str
        Name of the check of lakes, such as "observed".
    check : Check
        The figure and its expectation.
    error : float
        Standard error of the figure; NaN if it is not known.
    note : str
        What was sampled.

    Returns
    -------
    Row
        Its verdict is undecided if the expectation is remembered.
    """
    row_error = error if check.is_binding else math.nan
    default_note = "" if check.is_binding else "a remembered number: it decides nothing"
    return Row(
        name,
        check.name,
        Place(),
        check.value,
        row_error,
        check.expected,
        check.tolerance,
        "",
        check.source,
        check.kind,
        note or default_note,
        known_failure=check.known_failure,
    )
