"""Handle values of mission parameters that apply to one detector or amplifier instead of a whole camera.

Names of such values are::

    vis.gain@3-4      a detector
    vis.gain.E        an amplifier of every detector
    vis.gain@3-4.E    an amplifier of one detector

If several values apply, the most specific one is used: the value of an amplifier of one detector, then of the detector,
then of the amplifier of every detector, then of the camera.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Container, Mapping
from dataclasses import dataclass
from fnmatch import translate
from functools import cache
from importlib.resources import files
from typing import Protocol

from lake_schema.errors import BadInput

# Format of the names of the detectors of each Euclid camera. Rows and columns of the grid of detectors are counted from
# 1 (Euclid Data Product Description Document, LE1 VIS and NISP).
GRID_NAMES = {"vis": "{row}-{column}", "nisp": "DET{row}{column}"}
# Levels at which the value of a parameter may differ, as in places.csv: one value per camera, detector or amplifier.
CAMERA, DETECTOR, AMPLIFIER = "", "detector", "amplifier"
# Parameters that the table `amplifier_values` of a camera may have for each amplifier, in columns of the same name.
AMPLIFIER_COLUMNS = ("gain", "read_noise", "bias", "full_well")


class MissionValues(Protocol):
    """Methods of MissionConfiguration that this module uses; importing the class itself would be circular.

    `value` returns the number of a parameter, `rows` the rows of a table, and `in` tests whether a name exists.
    """

    def value(self, key: str) -> float: ...
    def rows(self, key: str) -> tuple[Mapping[str, str], ...]: ...
    def __contains__(self, key: object) -> bool: ...


@dataclass(frozen=True, slots=True)
class DetectorPlace:
    """Part of a camera to which a value applies: the names of a detector and of an amplifier.

    "" stands for all detectors or all amplifiers. An instance is False if both are "": the whole camera.
    """

    detector: str = ""
    amplifier: str = ""

    def __bool__(self) -> bool:
        return bool(self.detector or self.amplifier)


def split_name(name: str, parameter_names: Container[str]) -> tuple[str, DetectorPlace]:
    """Split a name such as vis.gain@3-4.E into the name of the parameter and the detector and amplifier.

    `parameter_names` contains the known names of parameters, by which the ending of vis.gain.E is recognised as an
    amplifier. A name without a detector or amplifier is returned unchanged, and so is an unknown name without "@".
    """
    key, at, place = name.partition("@")
    if at:
        detector, _, amplifier = place.partition(".")
        return key, DetectorPlace(detector, amplifier)
    # If the name without its last part is a parameter, the last part is an amplifier: no name of a parameter is another
    # one's name with a further part.
    parent, _, last = name.rpartition(".")
    if parent in parameter_names:
        return parent, DetectorPlace(amplifier=last)
    return name, DetectorPlace()


def names_at_place(key: str, place: DetectorPlace) -> tuple[str, str, str, str]:
    """Return the four names under which a value of a parameter for an amplifier of a detector can be given.

    The order is: this amplifier of this detector, this detector, this amplifier of all detectors, the whole camera.
    """
    detector, amplifier = f"@{place.detector}", f".{place.amplifier}"
    return f"{key}{detector}{amplifier}", f"{key}{detector}", f"{key}{amplifier}", key


@cache
def _read_scopes() -> tuple[tuple[re.Pattern[str], str], ...]:
    with (files("lake_schema.mission") / "places.csv").open(encoding="utf-8") as stream:
        return tuple((re.compile(translate(row["pattern"])), row["by"]) for row in csv.DictReader(stream))


@cache
def variation_scope(key: str) -> str:
    """Return the smallest part of a camera that may have a separate value of a parameter.

    It is `AMPLIFIER`, `DETECTOR`, or `CAMERA` if the whole camera must have one value.
    """
    return next((by for pattern, by in _read_scopes() if pattern.fullmatch(key)), CAMERA)


def check_override(name: str, configuration: MissionValues) -> None:
    """Raise BadInput if a user cannot give a value for the detector or amplifier in a name such as vis.gain@3-4.E.

    Reasons are a parameter that must have one value per camera or detector, and an unknown detector or amplifier. A
    name without a detector or amplifier is accepted only if the parameter may differ between them.
    """
    key, place = split_name(name, configuration)
    where, scope = f"mission override {name}", variation_scope(key)
    if ("@" in name and not place.detector) or name.endswith("."):
        raise BadInput(f"{where}: the name of the {AMPLIFIER if name.endswith('.') else DETECTOR} is missing")
    if scope == CAMERA:
        raise BadInput(f"{where}: {key} must have one value for the whole camera")
    if place.amplifier and scope == DETECTOR:
        raise BadInput(f"{where}: {key} may differ between detectors ({key}@NAME), not between their amplifiers")
    section = camera_prefix(key)
    for element, name_at_place, existing in (
        ("detector", place.detector, detectors(section, configuration)),
        ("amplifier", place.amplifier, amplifiers(section, configuration)),
    ):
        if name_at_place and name_at_place not in existing:
            raise BadInput(f"{where}: {section} has no {element} {name_at_place!r}, only {_format_names(existing)}")


def _format_names(existing: tuple[str, ...]) -> str:
    return ", ".join(existing) if len(existing) <= 16 else f"{len(existing)} from {existing[0]} to {existing[-1]}"


def camera_prefix(key: str) -> str:
    """Return the part of a parameter's name that identifies the camera, such as vis, nisp or ext.lsstcam."""
    parts = key.split(".")
    return ".".join(parts[:2] if parts[0] == "ext" else parts[:1])


def detectors(section: str, configuration: MissionValues) -> tuple[str, ...]:
    """Return the names of a camera's detectors: row by row for Euclid, else in the order of the camera's layout.

    `section` is the beginning of the names of the camera's parameters, such as "vis" or "ext.lsstcam". The result is ()
    if no camera has this name.
    """
    if section in GRID_NAMES:
        rows, columns = (int(configuration.value(f"{section}.fpa.{key}")) for key in ("rows", "columns"))
        name = GRID_NAMES[section]
        return tuple(
            name.format(row=row, column=column) for row in range(1, rows + 1) for column in range(1, columns + 1)
        )
    key = f"{section}.layout"
    return tuple(row["detector"] for row in configuration.rows(key)) if key in configuration else ()


def amplifiers(section: str, configuration: MissionValues) -> tuple[str, ...]:
    """Return the names of the amplifiers of a camera's detectors, in the order in which they are read.

    `section` is the beginning of the names of the camera's parameters, such as "vis". The result is () for a camera
    without a table of amplifiers.
    """
    key = f"{section}.amplifiers"
    if key not in configuration:
        return ()
    # Remove repeated names: the table has rows for each type of detector, and types may share names of amplifiers.
    return tuple(dict.fromkeys(row["amplifier"] for row in configuration.rows(key)))
