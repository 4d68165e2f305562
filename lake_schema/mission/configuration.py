"""Mission configurations: one record for each name in the mission database.

The database has several records of a quantity, with different statuses (required, designed, built, current best
estimate, simulated). A ladder, an order of preference of the statuses, determines which record is chosen.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from lake_schema.errors import BadInput, Mistakes
from lake_schema.mission import bounds, detector_overrides, model
from lake_schema.mission.camera_folder import Camera
from lake_schema.mission.detector_overrides import DetectorPlace
from lake_schema.mission.model import Model, read_models
from lake_schema.mission.parameter import STATUSES, Parameter, convert, read_all_parameters
from lake_schema.tables.mission import LADDER
from lake_schema.texts import spelling

__all__ = ["LADDER", "MissionConfiguration", "differences", "resolve"]

# Remedy in the error message about an unknown parameter.
_LISTING_HINT = "truesky mission list prints all names"

Chosen = TypeVar("Chosen", Parameter, Model)


@dataclass(frozen=True, slots=True, eq=False)
class MissionConfiguration:
    """The numbers and model files of telescope, cameras and survey that a simulation uses.

    They are records of the mission database, sorted by name, some of which a user's request has replaced. A value for
    one detector or amplifier has a separate name, such as vis.gain@3-4.

    Attributes
    ----------
    parameters : tuple of Parameter
        Chosen values, one per name.
    ladder : tuple of str
        Statuses in order of preference, such as CBE (current best estimate) before REQ (required).
    overridden : tuple of str
        Names of the parameters whose values come from a request.
    models : tuple of Model
        Chosen models (files such as layouts and throughput curves), one per name.
    folder : Path or None
        Folder with copies of the models' files, which is searched if the installed files have changed; None without
        such a folder.
    contents : tuple of (str, bytes)
        sha256 and contents of the models of cameras that a user has described; the package does not contain them.
    ground_cameras : tuple of str
        Names of the ground cameras with a layout of detectors, sorted.
    """

    parameters: tuple[Parameter, ...]
    ladder: tuple[str, ...] = LADDER
    overridden: tuple[str, ...] = ()
    models: tuple[Model, ...] = ()
    folder: Path | None = None
    contents: tuple[tuple[str, bytes], ...] = field(default=(), repr=False, compare=False)
    ground_cameras: tuple[str, ...] = field(init=False, repr=False, compare=False)
    _parameters_by_key: dict[str, Parameter] = field(init=False, repr=False, compare=False)
    _models_by_key: dict[str, Model] = field(init=False, repr=False, compare=False)
    _places_by_key: dict[str, tuple[DetectorPlace, ...]] = field(init=False, repr=False, compare=False)
    _fingerprint: str = field(init=False, repr=False, compare=False)
    _digest: str = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_parameters_by_key", {p.key: p for p in self.parameters})
        object.__setattr__(self, "_models_by_key", {m.key: m for m in self.models})
        layouts = [m.key.split(".") for m in self.models if m.key.startswith("ext.") and m.key.endswith(".layout")]
        object.__setattr__(self, "ground_cameras", tuple(sorted(parts[1] for parts in layouts)))
        places_by_key: dict[str, tuple[DetectorPlace, ...]] = {}
        for name in self.overridden:
            key, place = detector_overrides.split_name(name, self._parameters_by_key)
            if key != name:
                places_by_key[key] = (*places_by_key.get(key, ()), place)
        object.__setattr__(self, "_places_by_key", places_by_key)
        lines = [f"{p.key}={p.value.hex()} {p.unit}\n" for p in self.parameters]
        lines += [f"{m.key}={m.sha256}\n" for m in self.models]
        lines += [f"{key} is set\n" for key in self.overridden if self._may_differ(key)]
        object.__setattr__(self, "_fingerprint", hashlib.sha256("".join(lines).encode()).hexdigest())
        everything = repr((self.parameters, self.ladder, self.overridden, self.models, self.folder))
        object.__setattr__(self, "_digest", hashlib.sha256(everything.encode()).hexdigest())

    def __hash__(self) -> int:
        # Include the folder: configurations of two lakes are not equal even if all numbers are, so their hashes should
        # differ.
        return hash((self._fingerprint, self.folder))

    def __eq__(self, other: object) -> bool:
        # Compare digests instead of all records, because caches compare configurations thousands of times per exposure.
        return self._digest == other._digest if isinstance(other, MissionConfiguration) else NotImplemented

    def parameter(self, key: str) -> Parameter:
        """Return the record of a parameter (value, unit, status, source); raise BadInput if the name is unknown."""
        if key not in self._parameters_by_key:
            raise BadInput(f"the mission database has no parameter {key}")
        return self._parameters_by_key[key]

    def model(self, key: str) -> Model:
        """Return the record of a model (file name, sha256, status, source); raise BadInput if the name is unknown."""
        if key not in self._models_by_key:
            raise BadInput(f"the mission database has no model {key}")
        return self._models_by_key[key]

    def __contains__(self, key: object) -> bool:
        return key in self._parameters_by_key or key in self._models_by_key

    def _may_differ(self, key: str) -> bool:
        """Return True if a parameter has values for places or dates, which an override of the camera's value replaces.

        Such an override changes images even if it equals the value of the database.
        """
        section, name = detector_overrides.camera_prefix(key), key.rpartition(".")[2]
        in_table = f"{section}.amplifier_values" in self and name in detector_overrides.AMPLIFIER_COLUMNS
        return in_table or any(f"{key}{ending}" in self for ending in ("_spread", "_growth"))

    def is_overridden(self, key: str, place: DetectorPlace) -> bool:
        """Return True if the request sets a parameter: for the whole camera, or for a detector or amplifier."""
        return key in self.overridden or self.is_overridden_at(key, place)

    def is_overridden_at(self, key: str, place: DetectorPlace) -> bool:
        """Return True if a parameter has a value for a detector or amplifier that replaces the value of the camera.

        Values for all amplifiers of the detector, and for this amplifier of all detectors, count, too.
        """
        return any(narrow in self for narrow in detector_overrides.names_at_place(key, place)[:-1])

    def value(self, key: str, unit: str | None = None, place: DetectorPlace | None = None) -> float:
        """Return the value of a parameter of the telescope, a camera or the survey.

        Parameters
        ----------
        key : str
            Name of the parameter, such as vis.gain.
        unit : str, optional
            astropy unit string of the result; by default the unit of the record.
        place : DetectorPlace, optional
            Detector or amplifier whose value is returned. By default, and if there is no separate value for it, the
            value of the whole camera is returned.

        Returns
        -------
        float
            The value.

        Raises
        ------
        BadInput
            If the name is unknown or the unit cannot be converted to `unit`.
        """
        record = self.parameter(key)
        if place and key in self._places_by_key:
            record = next(
                self._parameters_by_key[name]
                for name in detector_overrides.names_at_place(key, place)
                if name in self._parameters_by_key
            )
        if unit is None or unit == record.unit:
            return record.value
        return convert(record.value, record.unit, unit, f"mission parameter {key}")

    def amplifier_values(self, key: str, unit: str, detector: str) -> tuple[float, ...]:
        """Return the value of a parameter for each amplifier of a detector.

        Parameters
        ----------
        key : str
            Name of the parameter of the camera, such as vis.gain.
        unit : str
            astropy unit string of the result.
        detector : str
            Name of the detector, such as "3-4".

        Returns
        -------
        tuple of float
            Values in the order in which the amplifiers are read, or a single value if all are equal. BadInput is raised
            if the name is unknown or the unit does not fit.
        """
        if not any(place.amplifier and place.detector in ("", detector) for place in self._places_by_key.get(key, ())):
            return (self.value(key, unit, DetectorPlace(detector)),)
        names = detector_overrides.amplifiers(detector_overrides.camera_prefix(key), self)
        values = tuple(self.value(key, unit, DetectorPlace(detector, name)) for name in names)
        return values if len(set(values)) > 1 else values[:1]

    def numbers(self, key: str) -> tuple[tuple[float, ...], ...]:
        """Return the rows of a model (file) that is a CSV table of numbers, without its line of column names.

        A blank entry is NaN. BadInput is raised for an unknown name `key`, Damaged if the file has changed.
        """
        return model.parse_numbers(self.content(self.model(key)))

    def rows(self, key: str) -> tuple[Mapping[str, str], ...]:
        """Return the rows of a model (file) that is a CSV table, as mappings from column name to text.

        BadInput is raised for an unknown name `key`, Damaged if the file has changed.
        """
        return model.parse_rows(self.content(self.model(key)))

    def content(self, record: Model) -> bytes:
        """Return the bytes of the file of a model; raise Damaged if no file with the sha256 of the record is found."""
        user_contents = dict(self.contents)
        return (
            user_contents[record.sha256] if record.sha256 in user_contents else model.read_content(record, self.folder)
        )

    def with_overrides(self, overrides: Mapping[str, tuple[float, str]]) -> MissionConfiguration:
        """Return a copy of the configuration in which the values of some parameters are replaced.

        `overrides` contains the new value and its unit by name of the parameter. A name may end in a detector or an
        amplifier, such as vis.gain@3-4. The new records have the status SIM (simulated) and the source "request".

        Raises
        ------
        BadInput
            If a parameter, detector or amplifier is unknown, a value is not finite or must be a whole number, or a unit
            cannot be converted. The message names the parameter.
        OutOfRange
            If a value is outside its allowed range.
        """
        chosen = dict(self._parameters_by_key)
        with Mistakes() as mistakes:
            for name, (value, unit) in overrides.items():
                record: Parameter | None = mistakes.read(_override_record, self._parameters_by_key, name, value, unit)
                if record is not None:
                    chosen[name] = record
            names = tuple(sorted({*self.overridden, *overrides}))
            configuration = replace(self, parameters=tuple(chosen[key] for key in sorted(chosen)), overridden=names)
            for name in names:
                key, _ = detector_overrides.split_name(name, self._parameters_by_key)
                # A wrong value does not hide that the detector does not exist.
                if key in chosen and key != name:
                    mistakes.read(detector_overrides.check_override, name, configuration)
        return configuration

    @property
    def fingerprint(self) -> str:
        """sha256 (hexadecimal) of all names, values and units of parameters, and of the sha256 of all models.

        It does not depend on statuses and sources. An override with the value of the database changes it only if it
        replaces differences between amplifiers, or a growth with time.
        """
        return self._fingerprint


def resolve(
    records: Iterable[Parameter] | None = None,
    ladder: Sequence[str] = LADDER,
    overrides: Mapping[str, tuple[float, str]] | None = None,
    mjd: float | None = None,
    models: Iterable[Model] | None = None,
    cameras: Iterable[Camera] = (),
) -> MissionConfiguration:
    """Choose one record of the mission database for each name, by an order of preference of their statuses.

    Parameters
    ----------
    records : iterable of Parameter, optional
        Records of parameters in any order; by default those of the package.
    ladder : sequence of str, optional
        Statuses in order of preference, by default CBE, BLT, DES, REQ, SIM. Records with other statuses are not chosen.
    overrides : mapping of str to (float, str), optional
        Value and unit by name of the parameter, which replace the chosen records.
    mjd : float, optional
        Date (MJD) at which the records must be valid; by default all records are valid. If several valid records have
        the preferred status, the one with the latest date `valid_from` is chosen.
    models : iterable of Model, optional
        Records of models (files) in any order; by default those of the package if `records` is None, else none.
    cameras : iterable of Camera, optional
        Ground cameras that a user has described, in addition to the cameras in `records`.

    Returns
    -------
    MissionConfiguration
        The configuration, with one record per name.

    Raises
    ------
    BadInput
        If the ladder is empty or has an unknown or repeated status, a record is given twice, units of one quantity
        cannot be converted into each other, or a name has no record of a suitable status and date.
    OutOfRange
        If a value is outside its allowed range.
    """
    unknown = [status for status in ladder if status not in STATUSES]
    if unknown or not ladder or len(set(ladder)) != len(ladder):
        raise BadInput(f"mission ladder {list(ladder)} must name some of {', '.join(STATUSES)}, each once")
    if models is None:
        models = read_models() if records is None else ()
    cameras = tuple(cameras)
    camera_parameters = [parameter for camera in cameras for parameter in camera.parameters]
    parameters = _group_by_key([*(read_all_parameters() if records is None else records), *camera_parameters])
    for key, group in parameters.items():
        for record in group[1:]:
            # Check that the units of all records of a quantity can be converted into each other.
            convert(1.0, record.unit, group[0].unit, f"mission parameter {key} ({record.status})")
    chosen = {key: _choose_record(key, group, ladder, mjd) for key, group in parameters.items()}
    chosen_models = {
        key: _choose_record(key, group, ladder, mjd)
        for key, group in _group_by_key([*models, *(m for c in cameras for m in c.models)]).items()
    }
    if duplicates := sorted(set(chosen) & set(chosen_models)):
        raise BadInput(f"mission parameter {duplicates[0]} is both a value and a model")
    # The tests check the values of the package.
    for parameter in chosen.values() if records is not None else camera_parameters:
        bounds.check_bounds(parameter, parameter.key)
    configuration = MissionConfiguration(
        tuple(chosen[key] for key in sorted(chosen)),
        tuple(ladder),
        models=tuple(chosen_models[key] for key in sorted(chosen_models)),
        contents=tuple(item for camera in cameras for item in camera.contents),
    )
    return configuration.with_overrides(overrides) if overrides else configuration


def _group_by_key(records: Iterable[Chosen]) -> dict[str, list[Chosen]]:
    groups: dict[str, list[Chosen]] = {}
    identities = set()
    for record in records:
        if record.identity in identities:
            raise BadInput(f"mission parameter {record.key} ({record.status}, version {record.version}) is given twice")
        identities.add(record.identity)
        groups.setdefault(record.key, []).append(record)
    return groups


def _choose_record(key: str, group: Sequence[Chosen], ladder: Sequence[str], mjd: float | None) -> Chosen:
    for status in ladder:
        valid = [
            p for p in group if p.status == status and (mjd is None or p.valid_from is None or p.valid_from <= mjd)
        ]
        if valid:
            return max(valid, key=lambda p: (-math.inf if p.valid_from is None else p.valid_from, p.version))
    raise BadInput(f"mission parameter {key} has no record of status {', '.join(ladder)} at this date")


def _override_record(parameters: Mapping[str, Parameter], name: str, value: float, unit: str) -> Parameter:
    where = f"mission override {name}"
    key, _ = detector_overrides.split_name(name, parameters)
    if key not in parameters:
        suggestion = spelling.did_you_mean(key, parameters)
        raise BadInput(f"{where}: the mission database has no such parameter: {suggestion or _LISTING_HINT}")
    if not math.isfinite(value):
        raise BadInput(f"{where} = {value} is not finite")
    parameter_unit = parameters[key].unit
    record = replace(
        parameters[key],
        key=name,
        status="SIM",
        value=convert(value, unit, parameter_unit, where),
        confidence="assumed",
        source="request",
    )
    bounds.check_bounds(record, key)
    return record


def differences(first: MissionConfiguration, second: MissionConfiguration) -> Iterator[str]:
    """Yield a line "NAME: FIRST -> SECOND" for each parameter or model (file) that differs in two configurations.

    They differ if the value, the unit or the sha256 of the file differs, or if only one configuration has the name.
    """
    first_records, second_records = _records_by_key(first), _records_by_key(second)
    for key in sorted(set(first_records) | set(second_records)):
        first_record, second_record = first_records.get(key), second_records.get(key)
        if _describe_record(first_record).content != _describe_record(second_record).content:
            yield f"{key}: {_describe_record(first_record).text} -> {_describe_record(second_record).text}"


def _records_by_key(configuration: MissionConfiguration) -> dict[str, Parameter | Model]:
    return {p.key: p for p in configuration.parameters} | {m.key: m for m in configuration.models}


@dataclass(frozen=True, slots=True)
class _RecordText:
    """Two descriptions of a record of the mission database.

    `content` is compared with other records; `text` is shown to the user and also contains the status.
    """

    content: str
    text: str


def _describe_record(record: Parameter | Model | None) -> _RecordText:
    if record is None:
        return _RecordText("", "absent")
    if isinstance(record, Model):
        return _RecordText(record.sha256, f"{record.file} ({record.sha256[:12]}, {record.status})")
    value = f"{record.value!r} {record.unit}".strip()
    return _RecordText(f"{record.value.hex()} {record.unit}", f"{value} ({record.status})")
