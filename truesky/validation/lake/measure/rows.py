"""Rows of the table `validation`: a measurement of a lake and its expectation."""

from __future__ import annotations

import math
from dataclasses import dataclass

from truesky.validation.checks import Check
from truesky.validation.verdicts import NOT_APPLICABLE, WITHIN, verdict


@dataclass(frozen=True, slots=True)
class Place:
    """Place of a measurement: a detector of an exposure, a band of a channel, or the whole lake (all None)."""

    channel: str | None = None
    band: str | None = None
    exposure_id: int | None = None
    detector: str | None = None

    @property
    def text(self) -> str:
        """Known parts of the place, separated by "/"; "lake" for the whole lake."""
        number = None if self.exposure_id is None else f"{self.exposure_id:06d}"
        return "/".join(part for part in (self.channel, self.band, number, self.detector) if part) or "lake"


@dataclass(frozen=True, slots=True)
class Row:
    """A measurement and its expectation.

    Attributes
    ----------
    check, quantity : str
        Names of the check and of the quantity.
    place : Place
        Place of the measurement.
    value, error : float
        Measured value and its standard error in `unit`; NaN if not measured.
    expected, tolerance : float
        Expected value and allowed deviation.
    unit : str
        Unit of the numbers, "" for a ratio.
    source : str
        Source of the expectation and the tolerance.
    kind : str
        "around" for both sides, "least" or "most" for a limit on one side.
    note : str
        Description of the sample, or reason why the check does not apply.
    applies : bool
        False if there was nothing to measure.
    known_failure : str
        Reason for which the row is known to fail, "" if it must pass.
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
        """Verdict on the value; "not_applicable" if there was nothing to measure."""
        if not self.applies:
            return NOT_APPLICABLE
        return verdict(self.value, self.error, self.expected, self.tolerance, self.kind)


def not_applicable(check: str, place: Place, why: str, source: str, quantity: str = "") -> Row:
    """Return the row of a check that found nothing to measure.

    Parameters
    ----------
    check : str
        Name of the check.
    place : Place
        Place that was checked.
    why : str
        Reason in a few words.
    source : str
        Source of the expectations.
    quantity : str
        Quantity that could not be measured, "" for all quantities of the check.

    Returns
    -------
    Row
        Row with the verdict "not_applicable".
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
        Description of the sample.

    Returns
    -------
    Row
        Its verdict is undecided if the expectation is not binding.
    """
    row_error = error if check.is_binding else math.nan
    default_note = "" if check.is_binding else "the expectation is quoted from memory: not binding"
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
