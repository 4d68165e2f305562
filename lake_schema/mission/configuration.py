"""A mission configuration: exactly one value and one model for every name, chosen by a ladder of statuses.

resolve                 records + ladder + overrides -> MissionConfiguration
MissionConfiguration    .value(key, unit, place), .of_amplifiers(key, unit, detector), .numbers(key), .rows(key),
                        .fingerprint
difference              what two configurations do not have in common
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from lake_schema.errors import BadInput
from lake_schema.mission import bounds, detector_overrides, model
from lake_schema.mission.camera_folder import Camera
from lake_schema.mission.detector_overrides import Place
from lake_schema.mission.model import Model, read_models
from lake_schema.mission.parameter import STATUSES, Parameter, convert, read_all
from lake_schema.tables.mission import LADDER

__all__ = ["LADDER", "MissionConfiguration", "difference", "resolve"]

Chosen = TypeVar("Chosen", Parameter, Model)


@dataclass(frozen=True, slots=True, eq=False)
class MissionConfiguration:
    """One record a name, sorted by name; a value of a detector or an amplifier is under a name of its own (places).

    overridden : names whose value a request replaced
    folder     : where the files of its models lie, if they are not the package's
    contents   : (sha256, bytes) of models that are neither there nor in the package: those of a user's cameras
    ground_cameras : names of the cameras with a layout
    """

    parameters: tuple[Parameter, ...]
    ladder: tuple[str, ...] = LADDER
    overridden: tuple[str, ...] = ()
    models: tuple[Model, ...] = ()
    folder: Path | None = None
    contents: tuple[tuple[str, bytes], ...] = field(default=(), repr=False, compare=False)
    ground_cameras: tuple[str, ...] = field(init=False, repr=False, compare=False)
    _index: dict[str, Parameter] = field(init=False, repr=False, compare=False)
    _files: dict[str, Model] = field(init=False, repr=False, compare=False)
    _placed: dict[str, tuple[Place, ...]] = field(init=False, repr=False, compare=False)
    _fingerprint: str = field(init=False, repr=False, compare=False)
    _whole: str = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_index", {p.key: p for p in self.parameters})
        object.__setattr__(self, "_files", {m.key: m for m in self.models})
        layouts = [m.key.split(".") for m in self.models if m.key.startswith("ext.") and m.key.endswith(".layout")]
        object.__setattr__(self, "ground_cameras", tuple(sorted(parts[1] for parts in layouts)))
        placed: dict[str, tuple[Place, ...]] = {}
        for name in self.overridden:
            key, place = detector_overrides.split(name, self._index)
            if key != name:
                placed[key] = (*placed.get(key, ()), place)
        object.__setattr__(self, "_placed", placed)
        lines = [f"{p.key}={p.value.hex()} {p.unit}\n" for p in self.parameters]
        lines += [f"{m.key}={m.sha256}\n" for m in self.models]
        object.__setattr__(self, "_fingerprint", hashlib.sha256("".join(lines).encode()).hexdigest())
        everything = repr((self.parameters, self.ladder, self.overridden, self.models, self.folder))
        object.__setattr__(self, "_whole", hashlib.sha256(everything.encode()).hexdigest())

    def __hash__(self) -> int:
        # With the folder: those of different lakes are unequal, which a comparison finds only after all their records.
        return hash((self._fingerprint, self.folder))

    def __eq__(self, other: object) -> bool:
        # By a digest: caches compare a configuration with an equal one thousands of times in each exposure.
        return self._whole == other._whole if isinstance(other, MissionConfiguration) else NotImplemented

    def parameter(self, key: str) -> Parameter:
        """The record chosen for a name; BadInput for an unknown one."""
        if key not in self._index:
            raise BadInput(f"the mission database has no parameter {key}")
        return self._index[key]

    def model(self, key: str) -> Model:
        """The model chosen for a name; BadInput for an unknown one."""
        if key not in self._files:
            raise BadInput(f"the mission database has no model {key}")
        return self._files[key]

    def __contains__(self, key: object) -> bool:
        return key in self._index or key in self._files

    def is_own(self, key: str, place: Place) -> bool:
        """Whether a detector or an amplifier has a value of its own, beside the camera's."""
        return any(narrow in self for narrow in detector_overrides.names(key, place)[:-1])

    def value(self, key: str, unit: str | None = None, place: Place | None = None) -> float:
        """The value of a name, in `unit` where one is given, else in its record's own; place : where."""
        record = self.parameter(key)
        if place and key in self._placed:
            record = next(self._index[name] for name in detector_overrides.names(key, place) if name in self._index)
        if unit is None or unit == record.unit:
            return record.value
        return convert(record.value, record.unit, unit, f"mission parameter {key}")

    def of_amplifiers(self, key: str, unit: str, detector: str) -> tuple[float, ...]:
        """The value for each amplifier of a detector, in the order in which they are read; one where all have it."""
        if not any(place.amplifier and place.detector in ("", detector) for place in self._placed.get(key, ())):
            return (self.value(key, unit, Place(detector)),)
        names = detector_overrides.amplifiers(detector_overrides.section_of(key), self)
        values = tuple(self.value(key, unit, Place(detector, name)) for name in names)
        return values if len(set(values)) > 1 else values[:1]

    def numbers(self, key: str) -> tuple[tuple[float, ...], ...]:
        """A model that is a table of numbers: its rows."""
        return model.numbers(self.content(self.model(key)))

    def rows(self, key: str) -> tuple[Mapping[str, str], ...]:
        """A model that is a table of texts: its rows by column name."""
        return model.rows(self.content(self.model(key)))

    def content(self, record: Model) -> bytes:
        """Bytes of a model's file; Damaged if they are not those that the record names."""
        given = dict(self.contents)
        return given[record.sha256] if record.sha256 in given else model.content(record, self.folder)

    def overridden_with(self, overrides: Mapping[str, tuple[float, str]]) -> MissionConfiguration:
        """The same with other values of some names; BadInput / OutOfRange name the parameter."""
        chosen = dict(self._index)
        for name, (value, unit) in overrides.items():
            chosen[name] = _overridden(self._index, name, value, unit)
            bounds.check(chosen[name], detector_overrides.split(name, self._index)[0])
        names = tuple(sorted({*self.overridden, *overrides}))
        found = replace(self, parameters=tuple(chosen[key] for key in sorted(chosen)), overridden=names)
        for name in names:
            if detector_overrides.split(name, chosen)[0] != name:
                detector_overrides.check(name, found)
        return found

    @property
    def fingerprint(self) -> str:
        """sha256 of every name, value, unit and file, hexadecimal: equal for configurations that act alike."""
        return self._fingerprint


def resolve(
    records: Iterable[Parameter] | None = None,
    ladder: Sequence[str] = LADDER,
    overrides: Mapping[str, tuple[float, str]] | None = None,
    mjd: float | None = None,
    models: Iterable[Model] | None = None,
    cameras: Iterable[Camera] = (),
) -> MissionConfiguration:
    """Choose one value a name.

    records   : in any order; None = the package's
    ladder    : statuses, the preferred first; statuses that it does not name are never chosen
    overrides : name -> (value, unit), replaces what the ladder would choose
    mjd       : date at which the records must hold; None = the latest
    models    : in any order; None = the package's where the records are, else none
    cameras   : a user's own, beside those of the records
    returns   : configuration.  Errors: BadInput / OutOfRange name the parameter
    """
    unknown = [status for status in ladder if status not in STATUSES]
    if unknown or not ladder or len(set(ladder)) != len(ladder):
        raise BadInput(f"mission ladder {list(ladder)} must name some of {', '.join(STATUSES)}, each once")
    if models is None:
        models = read_models() if records is None else ()
    cameras = tuple(cameras)
    own = [parameter for camera in cameras for parameter in camera.parameters]
    parameters = _grouped([*(read_all() if records is None else records), *own])
    for key, group in parameters.items():
        for record in group[1:]:
            # Records of one quantity may differ in unit, never in kind.
            convert(1.0, record.unit, group[0].unit, f"mission parameter {key} ({record.status})")
    chosen = {key: _choose(key, group, ladder, mjd) for key, group in parameters.items()}
    files_ = {
        key: _choose(key, group, ladder, mjd)
        for key, group in _grouped([*models, *(m for c in cameras for m in c.models)]).items()
    }
    if twice := sorted(set(chosen) & set(files_)):
        raise BadInput(f"mission parameter {twice[0]} is a value and a model")
    for parameter in chosen.values():
        bounds.check(parameter, parameter.key)
    found = MissionConfiguration(
        tuple(chosen[key] for key in sorted(chosen)),
        tuple(ladder),
        models=tuple(files_[key] for key in sorted(files_)),
        contents=tuple(item for camera in cameras for item in camera.contents),
    )
    return found.overridden_with(overrides) if overrides else found


def _grouped(records: Iterable[Chosen]) -> dict[str, list[Chosen]]:
    groups: dict[str, list[Chosen]] = {}
    seen = set()
    for record in records:
        if record.identity in seen:
            raise BadInput(f"mission parameter {record.key} ({record.status}, version {record.version}) is given twice")
        seen.add(record.identity)
        groups.setdefault(record.key, []).append(record)
    return groups


def _choose(key: str, group: Sequence[Chosen], ladder: Sequence[str], mjd: float | None) -> Chosen:
    for status in ladder:
        valid = [
            p for p in group if p.status == status and (mjd is None or p.valid_from is None or p.valid_from <= mjd)
        ]
        if valid:
            return max(valid, key=lambda p: (-math.inf if p.valid_from is None else p.valid_from, p.version))
    raise BadInput(f"mission parameter {key} has no record of status {', '.join(ladder)} at this date")


def _overridden(known: Mapping[str, Parameter], name: str, value: float, unit: str) -> Parameter:
    where = f"mission override {name}"
    key, _ = detector_overrides.split(name, known)
    if key not in known:
        raise BadInput(f"{where}: the mission database has no such parameter")
    if not math.isfinite(value):
        raise BadInput(f"{where} = {value} is not finite")
    own = known[key].unit
    return replace(
        known[key],
        key=name,
        status="SIM",
        value=convert(value, unit, own, where),
        confidence="assumed",
        source="request",
    )


def difference(first: MissionConfiguration, second: MissionConfiguration) -> Iterator[str]:
    """A line for each name whose value, unit or file differs, or that only one of them has."""
    left, right = _by_key(first), _by_key(second)
    for key in sorted(set(left) | set(right)):
        a, b = left.get(key), right.get(key)
        if _shown(a).acts != _shown(b).acts:
            yield f"{key}: {_shown(a).text} -> {_shown(b).text}"


def _by_key(configuration: MissionConfiguration) -> dict[str, Parameter | Model]:
    return {p.key: p for p in configuration.parameters} | {m.key: m for m in configuration.models}


@dataclass(frozen=True, slots=True)
class _Shown:
    """What a record does, and how it is written."""

    acts: str
    text: str


def _shown(record: Parameter | Model | None) -> _Shown:
    if record is None:
        return _Shown("", "absent")
    if isinstance(record, Model):
        return _Shown(record.sha256, f"{record.file} ({record.sha256[:12]}, {record.status})")
    value = f"{record.value!r} {record.unit}".strip()
    return _Shown(f"{record.value.hex()} {record.unit}", f"{value} ({record.status})")
