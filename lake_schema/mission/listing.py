"""List the parameters of the mission database: python -m lake_schema mission list [PATTERN]."""

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
    """A parameter or a model in a list.

    Attributes
    ----------
    name : str
        Name.
    value : float or str
        Value of a parameter, or file of a model.
    unit : str
        Unit of the value.
    bounds : tuple of (float, float) or None
        Lowest and highest value in this unit, or None if no bounds are declared.
    by : str
        "detector" or "amplifier" if a request may give each a different value, else "".
    status : str
        Status of the record.
    confidence : str
        Confidence of the record.
    source : str
        Source of the record.
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
    r"""Return the entries whose names match a pattern, sorted by name.

    Parameters
    ----------
    configuration : MissionConfiguration
        The configuration.
    pattern : str, optional
        Pattern with \*, ? and [..] for the whole name; a text without them matches names that contain it.

    Returns
    -------
    list of Entry
        At least one entry.

    Raises
    ------
    BadInput
        If no name matches.
    """
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
    """Return the range that all bounds of a parameter allow, in a given unit."""
    where = f"mission parameter {key}"
    ends = [
        (convert(lo, bound_unit, unit, where), convert(hi, bound_unit, unit, where))
        for lo, hi, bound_unit in bounds_of_parameter(key)
    ]
    return (max(lo for lo, _ in ends), min(hi for _, hi in ends)) if ends else None


def align_columns(entries: Sequence[Entry]) -> Iterator[str]:
    """Yield a line of headings and one line per entry, in aligned columns; the source comes last and is not padded."""
    table = [_HEAD, *map(_format_fields, entries)]
    widths = [max(len(row[i]) for row in table) for i in range(len(_HEAD))]
    for row in table:
        yield "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()


def _format_fields(entry: Entry) -> tuple[str, ...]:
    name, value, unit, bounds, by, status, confidence, source = astuple(entry)
    source_text = source if confidence in source else f"{source} ({confidence})"
    bounds_text = f"{bounds[0]:g} .. {bounds[1]:g}" if bounds else ""
    return name, value if isinstance(value, str) else f"{value:.10g}", unit, bounds_text, by, status, source_text
