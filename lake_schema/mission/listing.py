"""The parameters of the mission database as a list: python -m lake_schema mission list [PATTERN].

listed    a configuration -> entries, one a parameter or model
aligned   entries -> lines of text, columns below each other
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass
from fnmatch import fnmatchcase

from lake_schema.errors import BadInput
from lake_schema.mission import detector_overrides
from lake_schema.mission.bounds import bounds_of_parameter
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.model import Model
from lake_schema.mission.parameter import Parameter, convert

_HEAD = ("name", "value", "unit", "bounds", "may differ by", "status", "source")


@dataclass(frozen=True, slots=True)
class Entry:
    """A parameter: its value, or of a model its file.

    bounds : (lowest, highest) in its unit, None = none are declared;  by : "detector" or "amplifier" where a
             request may give each a value of its own, else ""
    """

    name: str
    value: float | str
    unit: str
    bounds: tuple[float, float] | None
    by: str
    status: str
    confidence: str
    source: str


def list_entries(configuration: MissionConfiguration, pattern: str = "*") -> list[Entry]:
    """By name; pattern : with *, ? and [..] for the whole name, without them a part of it.  BadInput: none matches."""
    full_pattern = pattern if any(c in pattern for c in "*?[") else f"*{pattern}*"
    records: list[Parameter | Model] = [*configuration.parameters, *configuration.models]
    matching = [record for record in records if fnmatchcase(record.key.lower(), full_pattern.lower())]
    if not matching:
        raise BadInput(f"no name of the mission database matches {pattern!r}")
    return [_entry(record, configuration) for record in sorted(matching, key=lambda record: record.key)]


def _entry(record: Parameter | Model, configuration: MissionConfiguration) -> Entry:
    provenance = (record.status, record.confidence, record.source)
    if isinstance(record, Model):
        return Entry(record.key, record.file, "", None, detector_overrides.CAMERA, *provenance)
    key, _ = detector_overrides.split_name(record.key, configuration)
    return Entry(
        record.key,
        record.value,
        record.unit,
        _bounds_in_unit(key, record.unit),
        detector_overrides.variation_scope(key),
        *provenance,
    )


def _bounds_in_unit(key: str, unit: str) -> tuple[float, float] | None:
    """What all bounds of a parameter allow, in its unit."""
    where = f"mission parameter {key}"
    ends = [
        (convert(lo, bound_unit, unit, where), convert(hi, bound_unit, unit, where))
        for lo, hi, bound_unit in bounds_of_parameter(key)
    ]
    return (max(lo for lo, _ in ends), min(hi for _, hi in ends)) if ends else None


def align_columns(entries: Sequence[Entry]) -> Iterator[str]:
    """A line a parameter below a line of headings; the source comes last, at its length."""
    table = [_HEAD, *map(_format_fields, entries)]
    widths = [max(len(row[i]) for row in table) for i in range(len(_HEAD))]
    for row in table:
        yield "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()


def _format_fields(entry: Entry) -> tuple[str, ...]:
    name, value, unit, bounds, by, status, confidence, source = astuple(entry)
    source_text = source if confidence in source else f"{source} ({confidence})"
    bounds_text = f"{bounds[0]:g} .. {bounds[1]:g}" if bounds else ""
    return name, value if isinstance(value, str) else f"{value:.10g}", unit, bounds_text, by, status, source_text
