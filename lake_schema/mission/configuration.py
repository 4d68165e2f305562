"""A mission configuration: exactly one value for every name, chosen by a ladder of statuses.

resolve                 records + ladder + overrides -> MissionConfiguration
MissionConfiguration    .value(key, unit), .fingerprint
"""

from __future__ import annotations

import csv
import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cache
from importlib.resources import files

from lake_schema.errors import BadInput, OutOfRange
from lake_schema.mission.parameter import STATUSES, Parameter, convert, read_all

# Best knowledge first; as simulated only where nothing better exists.
LADDER = ("CBE", "BLT", "DES", "REQ", "SIM")


@dataclass(frozen=True, slots=True)
class MissionConfiguration:
    """One record a name, sorted by name.

    overridden : names whose value a request replaced
    """

    parameters: tuple[Parameter, ...]
    ladder: tuple[str, ...] = LADDER
    overridden: tuple[str, ...] = ()
    _index: dict[str, Parameter] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_index", {p.key: p for p in self.parameters})

    def parameter(self, key: str) -> Parameter:
        """The record chosen for a name; BadInput for an unknown one."""
        if key not in self._index:
            raise BadInput(f"the mission database has no parameter {key}")
        return self._index[key]

    def value(self, key: str, unit: str | None = None) -> float:
        """The value of a name, in `unit` where one is given, else in its record's own."""
        record = self.parameter(key)
        if unit is None or unit == record.unit:
            return record.value
        return convert(record.value, record.unit, unit, f"mission parameter {key}")

    @property
    def fingerprint(self) -> str:
        """sha256 of every name, value and unit, hexadecimal: equal for configurations that act alike."""
        lines = (f"{p.key}={p.value.hex()} {p.unit}\n" for p in self.parameters)
        return hashlib.sha256("".join(lines).encode()).hexdigest()


def resolve(
    records: Iterable[Parameter] | None = None,
    ladder: Sequence[str] = LADDER,
    overrides: Mapping[str, tuple[float, str]] | None = None,
    mjd: float | None = None,
) -> MissionConfiguration:
    """Choose one value a name.

    records   : in any order; None = the package's
    ladder    : statuses, the preferred first; statuses that it does not name are never chosen
    overrides : name -> (value, unit), replaces what the ladder would choose
    mjd       : date at which the records must hold; None = the latest
    returns   : configuration.  Errors: BadInput / OutOfRange name the parameter
    """
    unknown = [status for status in ladder if status not in STATUSES]
    if unknown or not ladder or len(set(ladder)) != len(ladder):
        raise BadInput(f"mission ladder {list(ladder)} must name some of {', '.join(STATUSES)}, each once")
    by_key = _group(read_all() if records is None else records)
    chosen = {key: _choose(key, group, ladder, mjd) for key, group in by_key.items()}
    for key, (value, unit) in (overrides or {}).items():
        chosen[key] = _overridden(chosen, key, value, unit)
    for parameter in chosen.values():
        _check_bounds(parameter)
    return MissionConfiguration(
        tuple(chosen[key] for key in sorted(chosen)), tuple(ladder), tuple(sorted(overrides or {}))
    )


def _group(records: Iterable[Parameter]) -> dict[str, list[Parameter]]:
    groups: dict[str, list[Parameter]] = {}
    seen = set()
    for record in records:
        if record.identity in seen:
            raise BadInput(f"mission parameter {record.key} ({record.status}, version {record.version}) is given twice")
        seen.add(record.identity)
        group = groups.setdefault(record.key, [])
        if group:
            # Records of one quantity may differ in unit, never in kind.
            convert(1.0, record.unit, group[0].unit, f"mission parameter {record.key} ({record.status})")
        group.append(record)
    return groups


def _choose(key: str, group: Sequence[Parameter], ladder: Sequence[str], mjd: float | None) -> Parameter:
    for status in ladder:
        valid = [
            p for p in group if p.status == status and (mjd is None or p.valid_from is None or p.valid_from <= mjd)
        ]
        if valid:
            return max(valid, key=lambda p: (-math.inf if p.valid_from is None else p.valid_from, p.version))
    raise BadInput(f"mission parameter {key} has no record of status {', '.join(ladder)} at this date")


def _overridden(chosen: Mapping[str, Parameter], key: str, value: float, unit: str) -> Parameter:
    if key not in chosen:
        raise BadInput(f"mission override {key}: the mission database has no such parameter")
    where = f"mission override {key}"
    if not math.isfinite(value):
        raise BadInput(f"{where} = {value} is not finite")
    own = chosen[key].unit
    return replace(
        chosen[key],
        status="SIM",
        value=convert(value, unit, own, where),
        confidence="assumed",
        source="request",
    )


@cache
def _bounds() -> tuple[tuple[str, float, float, str], ...]:
    with (files("lake_schema.mission") / "bounds.csv").open(encoding="utf-8") as stream:
        return tuple((r["pattern"], float(r["lo"]), float(r["hi"]), r["unit"]) for r in csv.DictReader(stream))


def _check_bounds(parameter: Parameter) -> None:
    for pattern, lo, hi, unit in _bounds():
        if fnmatchcase(parameter.key, pattern):
            value = convert(parameter.value, parameter.unit, unit, f"mission parameter {parameter.key}")
            if not lo <= value <= hi:
                raise OutOfRange(f"mission parameter {parameter.key} [{unit}]", value, lo, hi)
