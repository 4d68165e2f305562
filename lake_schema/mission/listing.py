"""List the parameters (numbers) and models (files) of the mission database.

The command is truesky mission list [PATTERN].
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
from lake_schema.texts import spelling, text_tables

_HEAD = ("name", "value", "unit", "bounds", "may differ by", "status", "source")


@dataclass(frozen=True, slots=True)
class Entry:
    """A parameter (number) or a model (file) of the mission database, as it is listed.

    Attributes
    ----------
    name : str
        Name, such as vis.gain.
    value : float or str
        Value of a parameter, or name of the file of a model.
    unit : str
        Unit of the value, "" for a pure number or a model.
    bounds : tuple of (float, float) or None
        Lowest and highest allowed value in this unit, or None if no bounds are declared.
    by : str
        "detector" or "amplifier" if a user may give each detector or amplifier a different value, else "".
    status : str
        REQ (required), DES (designed), BLT (built), CBE (current best estimate) or SIM (simulated).
    confidence : str
        How far the record can be trusted: published, quoted, derived or assumed.
    source : str
        Reference for the record.
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
    r"""Return the parameters and models of a configuration whose names match a pattern, sorted by name.

    Parameters
    ----------
    configuration : MissionConfiguration
        One record per name of the mission database.
    pattern : str, optional
        Shell pattern for the whole name, with \*, ? and [..]. A text without these characters matches all names that
        contain it. Upper and lower case are equal. By default, all names match.

    Returns
    -------
    list of Entry
        At least one parameter or model.

    Raises
    ------
    BadInput
        If no name matches.
    """
    full_pattern = pattern if any(c in pattern for c in "*?[") else f"*{pattern}*"
    records: list[Parameter | Model] = [*configuration.parameters, *configuration.models]
    matching = [record for record in records if fnmatchcase(record.key.lower(), full_pattern.lower())]
    if not matching:
        names = [record.key for record in records]
        hint = spelling.did_you_mean(pattern, names) or 'patterns such as "vis.*noise*" select several'
        raise BadInput(f"no name of the mission database matches {pattern!r}; {hint}")
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
    """Return the lowest and highest value of a parameter that all its declared bounds allow, in a given unit.

    Return None if no bounds are declared for the name `key`.
    """
    where = f"mission parameter {key}"
    ends = [
        (convert(lo, bound_unit, unit, where), convert(hi, bound_unit, unit, where))
        for lo, hi, bound_unit in bounds_of_parameter(key)
    ]
    return (max(lo for lo, _ in ends), min(hi for _, hi in ends)) if ends else None


def align_columns(entries: Sequence[Entry]) -> Iterator[str]:
    """Yield a line of headings and one line per parameter or model, in aligned columns; no line ends in blanks."""
    yield from text_tables.format_table(_HEAD, [_format_fields(entry) for entry in entries])


def _format_fields(entry: Entry) -> tuple[str, ...]:
    name, value, unit, bounds, by, status, confidence, source = astuple(entry)
    source_text = source if confidence in source else f"{source} ({confidence})"
    bounds_text = f"{bounds[0]:g} .. {bounds[1]:g}" if bounds else ""
    return name, value if isinstance(value, str) else f"{value:.10g}", unit, bounds_text, by, status, source_text
