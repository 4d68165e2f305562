"""Handle values that apply to one detector or one amplifier.

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

# Names of detectors of cameras with a regular grid, by row and column from 1 (Euclid Data Product Description
# Document, LE1 VIS and NISP).
GRID_NAMES = {"vis": "{row}-{column}", "nisp": "DET{row}{column}"}
CAMERA, DETECTOR, AMPLIFIER = "", "detector", "amplifier"


class MissionValues(Protocol):
    """Methods of a mission configuration that this module uses."""

    def value(self, key: str) -> float: ...
    def rows(self, key: str) -> tuple[Mapping[str, str], ...]: ...
    def __contains__(self, key: object) -> bool: ...


@dataclass(frozen=True, slots=True)
class DetectorPlace:
    """A detector, an amplifier, or both; "" stands for all."""

    detector: str = ""
    amplifier: str = ""

    def __bool__(self) -> bool:
        return bool(self.detector or self.amplifier)


def split_name(name: str, parameter_names: Container[str]) -> tuple[str, DetectorPlace]:
    """Return the name of the parameter and the place that a name contains, for a container of known parameter names."""
    key, at, place = name.partition("@")
    if at:
        detector, _, amplifier = place.partition(".")
        return key, DetectorPlace(detector, amplifier)
    # No parameter has a name that is another parameter's name plus a suffix.
    parent, _, last = name.rpartition(".")
    if parent in parameter_names:
        return parent, DetectorPlace(amplifier=last)
    return name, DetectorPlace()


def names_at_place(key: str, place: DetectorPlace) -> tuple[str, str, str, str]:
    """Return the names under which a parameter's value at a place can be given, the most specific first."""
    detector, amplifier = f"@{place.detector}", f".{place.amplifier}"
    return f"{key}{detector}{amplifier}", f"{key}{detector}", f"{key}{amplifier}", key


@cache
def _read_scopes() -> tuple[tuple[re.Pattern[str], str], ...]:
    with (files("lake_schema.mission") / "places.csv").open(encoding="utf-8") as stream:
        return tuple((re.compile(translate(row["pattern"])), row["by"]) for row in csv.DictReader(stream))


@cache
def variation_scope(key: str) -> str:
    """Return how finely the values of a parameter may vary: CAMERA, DETECTOR or AMPLIFIER."""
    return next((by for pattern, by in _read_scopes() if pattern.fullmatch(key)), CAMERA)


def check_override(name: str, configuration: MissionValues) -> None:
    """Raise BadInput if a parameter cannot be overridden at the place that the name contains."""
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
    """Return the camera's prefix of a parameter's name, such as vis, nisp or ext.lsstcam."""
    parts = key.split(".")
    return ".".join(parts[:2] if parts[0] == "ext" else parts[:1])


def detectors(section: str, configuration: MissionValues) -> tuple[str, ...]:
    """Return the names of a camera's detectors in their order, () for a section that is not a camera."""
    if section in GRID_NAMES:
        rows, columns = (int(configuration.value(f"{section}.fpa.{key}")) for key in ("rows", "columns"))
        name = GRID_NAMES[section]
        return tuple(
            name.format(row=row, column=column) for row in range(1, rows + 1) for column in range(1, columns + 1)
        )
    key = f"{section}.layout"
    return tuple(row["detector"] for row in configuration.rows(key)) if key in configuration else ()


def amplifiers(section: str, configuration: MissionValues) -> tuple[str, ...]:
    """Return the names of a detector's amplifiers in the order of reading, () if it is read as one frame."""
    key = f"{section}.amplifiers"
    if key not in configuration:
        return ()
    # Detectors of different types may have amplifiers with the same names.
    return tuple(dict.fromkeys(row["amplifier"] for row in configuration.rows(key)))
