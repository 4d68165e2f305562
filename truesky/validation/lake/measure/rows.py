"""Rows of the table `validation`: each has a value measured in a lake, its expected value and a verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass

from truesky.validation.checks import Check
from truesky.validation.verdicts import NOT_APPLICABLE, WITHIN, verdict


@dataclass(frozen=True, slots=True)
class Place:
    """Part of a lake to which a measurement belongs: a detector of an exposure, an exposure, or a band of a channel.

    Fields that do not apply are None; all are None for the whole lake. A channel is VIS, NISP-P, NISP-S or EXT.
    """

    channel: str | None = None
    band: str | None = None
    exposure_id: int | None = None
    detector: str | None = None

    @property
    def text(self) -> str:
        """Return channel, band, exposure number (six digits) and detector, separated by "/", without missing fields.

        The text is "lake" for the whole lake.
        """
        number = None if self.exposure_id is None else f"{self.exposure_id:06d}"
        return "/".join(part for part in (self.channel, self.band, number, self.detector) if part) or "lake"


@dataclass(frozen=True, slots=True)
class Row:
    """A measured value, the value that is expected for it, and where it was measured.

    Attributes
    ----------
    check, quantity : str
        Name of the check, such as "astrometry", and of the measured quantity, such as "offset_x".
    place : Place
        Detector, exposure, band or whole lake in which the value was measured.
    value, error : float
        Measured value and its standard error; NaN if not measured.
    expected, tolerance : float
        Expected value and allowed deviation.
    unit : str
        Unit of all four numbers, "" for a ratio.
    source : str
        Publication or other source of the expected value and the tolerance.
    kind : str
        "around" if the value must be within the tolerance on both sides, "least" or "most" for a limit on one side.
    note : str
        Description of the sample, or reason why nothing could be measured.
    applies : bool
        False if there was nothing to measure; the verdict is then "not_applicable".
    known_failure : str
        Reason why the value is known to fail; "" if it must pass.
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
        """Return "pass", "fail" or "undecided", or "not_applicable" if there was nothing to measure."""
        if not self.applies:
            return NOT_APPLICABLE
        return verdict(self.value, self.error, self.expected, self.tolerance, self.kind)


def not_applicable(check: str, place: Place, why: str, source: str, quantity: str = "") -> Row:
    """Return the row of a check that found nothing to measure, with the reason as its note.

    Parameters
    ----------
    check : str
        Name of the check.
    place : Place
        Detector, exposure, band or whole lake that was checked.
    why : str
        Reason in a few words.
    source : str
        Publication or other source of the expected value.
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
    """Convert a check against a CSV file of expected values to a row for the whole lake.

    Parameters
    ----------
    name : str
        Name of the group of checks, such as "observed".
    check : Check
        Measured value and its expected value.
    error : float
        Standard error of the measured value; NaN if it is not known.
    note : str
        Description of the sample.

    Returns
    -------
    Row
        The row, without unit. If the expected value is quoted from memory, the error is NaN and the verdict undecided.
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
        "; ".join(filter(None, (note, default_note))),
        known_failure=check.known_failure,
    )
