"""Declaration of the table `validation`: results of the checks of a lake's catalogues and images.

A row contains a measured quantity with its error, the expected value with its tolerance, and the verdict.
"""

from __future__ import annotations

from lake_schema.columns import Column, Table
from lake_schema.tables.exposures import CHANNELS

VERDICTS = (
    ("pass", "within the tolerance, with an error small enough for a decision"),
    ("fail", "beyond the tolerance by more than three standard errors"),
    ("undecided", "too few data or too large an error for a decision"),
    ("not_applicable", "the lake has no data for this check"),
)
CRITERIA = (
    ("around", "within the tolerance of the expected value"),
    ("least", "at least the expected value minus the tolerance"),
    ("most", "at most the expected value plus the tolerance"),
)


def _number(name: str, ucd: str, doc: str) -> Column:
    return Column(name, "float64", "", ucd, doc, nullable=True)


VALIDATION = Table(
    "validation",
    1,
    (
        Column("check_name", "string", ucd="meta.id", doc="name of the check"),
        Column("quantity", "string", ucd="meta.id", doc="quantity that the check measured"),
        Column("place", "string", ucd="meta.id", doc="channel/band/exposure/detector without parts that do not apply"),
        Column("channel", "string", ucd="instr", doc="channel", nullable=True, codes=CHANNELS),
        Column("band", "string", ucd="instr.bandpass", doc="passband name", nullable=True),
        Column("exposure_id", "int64", "", "meta.id;obs.exposure", "exposure", 0, nullable=True),
        Column("detector", "string", ucd="meta.id;instr.det", doc="detector name", nullable=True),
        _number("value", "meta.number", "measured value, in the unit of `value_unit`"),
        _number("error", "stat.error", "standard error of `value`"),
        _number("expected", "meta.number", "expected value"),
        _number("tolerance", "stat.error", "largest allowed difference from the expected value"),
        Column(
            "kind",
            "string",
            ucd="meta.code",
            doc="kind of bound that expected value and tolerance define",
            codes=CRITERIA,
        ),
        Column("value_unit", "string", ucd="meta.unit", doc="unit of the numbers; empty for a ratio"),
        Column("source", "string", ucd="meta.bib", doc="source of the expected value and the tolerance"),
        Column(
            "note", "string", ucd="meta.note", doc="sample that was measured, or reason why the check does not apply"
        ),
        Column("known", "string", ucd="meta.note", doc="reason why the check is known to fail; empty if it must pass"),
        Column("verdict", "string", ucd="meta.code.qual", doc="verdict", codes=VERDICTS),
    ),
    "Quantities measured in a lake, with their expected values.",
    key=("check_name", "quantity", "place"),
)
