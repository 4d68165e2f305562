"""A ground camera that a user describes in a folder of CSV files, beside the cameras of the mission database.

    my_camera/parameters.csv    name, value, unit, source            numbers of the camera
    my_camera/layout.csv        detector, type, nx, ny, x_mm, y_mm, rotation_deg     where detectors lie
    my_camera/amplifiers.csv    type, amplifier, x, y, nx, ny, ...   parts of a detector of each type
    my_camera/bands.csv         band, curve, medium, zero_point, sky_brightness, seeing, extinction, fringes
    my_camera/wavefront.csv     noll, x_power, y_power, coefficient_nm     optional, aberrations of the telescope

The folder's name is the camera's name. Gain, read noise and full well stand in amplifiers.csv alone. Blank values of
bands.csv: without a curve the band is the passband of truesky of this name, and without fringes it has none. Columns
may have any order, and lines that begin with ``#`` are comments. ``python -m lake_schema mission camera FOLDER --like
decam`` writes such a folder with the values of a known camera, to be edited.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from lake_schema import user_files
from lake_schema.errors import BadInput
from lake_schema.mission import bounds, camera_tables
from lake_schema.mission.camera_tables import (
    AMPLIFIERS,
    BANDS,
    LAYOUT,
    NAME,
    OF_AMPLIFIERS,
    OF_BAND,
    OPTIONAL_OF_BAND,
    PARAMETERS,
    WAVEFRONT,
    Row,
)
from lake_schema.mission.model import Model, read_models
from lake_schema.mission.parameter import CAMERAS, SPACE_CAMERAS, Parameter, convert, read_all

_STATUS = "SIM"
_MODELS = {"layout": LAYOUT, "amplifiers": AMPLIFIERS, "psf.wavefront": WAVEFRONT}


@dataclass(frozen=True, slots=True)
class Curve:
    """Response of a band that truesky does not have.

    Attributes
    ----------
    band : str
        Name of the band.
    file : Path
        File of the response, the fraction of photons that are detected.
    medium : str
        Medium in which its wavelengths are measured, "air" or "vacuum".
    place : str
        File and line that name it, for messages.
    """

    band: str
    file: Path
    medium: str
    place: str


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera from a user's folder.

    Attributes
    ----------
    name : str
        Name of the folder, and of the camera.
    parameters : tuple of Parameter
        Numbers of the camera and of its bands, under names that begin with ``ext.<name>.``
    models : tuple of Model
        Layout, amplifiers and wavefront.
    contents : tuple of (str, bytes)
        Contents of the models' files, by their sha256: the checked tables without comments, columns in their order.
    curves : tuple of Curve
        Responses of bands that truesky does not have.
    """

    name: str
    parameters: tuple[Parameter, ...]
    models: tuple[Model, ...]
    contents: tuple[tuple[str, bytes], ...]
    curves: tuple[Curve, ...]

    @property
    def sha256(self) -> str:
        """Checksum of all numbers and files of the camera, without its place on the disc."""
        lines = [f"{p.key}={p.value.hex()} {p.unit}\n" for p in self.parameters]
        lines += [f"{m.key}={m.sha256}\n" for m in self.models]
        lines += [f"{curve.band} {curve.medium}\n" for curve in self.curves]
        return hashlib.sha256("".join(lines).encode()).hexdigest()


def read(folder: Path) -> Camera:
    """Read and check the folder of a camera.

    Parameters
    ----------
    folder : Path
        Folder with the files that the head of this module lists.

    Returns
    -------
    Camera
        The camera. A request's overrides can still make its detectors overlap
        (`lake_schema.mission.checks.camera_faults`).

    Raises
    ------
    BadInput
        If a file or a parameter is missing, a column, name, unit or number is wrong, or detectors or amplifiers
        overlap. The message names the file and the line.
    """
    name = _name(folder)
    prefix = f"ext.{name}."
    parameters = _parameters(folder, prefix)
    of_bands, curves = _bands(folder, name)
    pixel = next(p for p in parameters if p.key == f"{prefix}fpa.pixel_size")
    layout = camera_tables.checked_layout(folder, convert(pixel.value, pixel.unit, "mm / pix", pixel.key))
    tables = {LAYOUT: layout, AMPLIFIERS: camera_tables.checked_amplifiers(folder, layout)}
    # The other amplifiers differ from the first one by the ratios of their values in the table.
    first = tables[AMPLIFIERS][0]
    parameters += [
        _parameter(first.place, prefix + key, first.number(key), unit, f"{name}/{AMPLIFIERS}")
        for key, unit in OF_AMPLIFIERS.items()
    ]
    # A link that leads nowhere is a mistake: it is no choice of the default wavefront.
    if os.path.lexists(folder / WAVEFRONT):
        tables[WAVEFRONT] = camera_tables.checked_wavefront(folder)
    models, contents = [], []
    for key, file in _MODELS.items():
        if file in tables:
            data = camera_tables.csv_text(tables[file]).encode()
            sha256 = hashlib.sha256(data).hexdigest()
            models.append(Model(prefix + key, _STATUS, f"{name}_{file}", sha256, source=f"{name}/{file}"))
            contents.append((sha256, data))
    if WAVEFRONT not in tables:
        ours = next(m for m in read_models() if m.file == "ground_wavefront.csv")
        models.append(Model(f"{prefix}psf.wavefront", _STATUS, ours.file, ours.sha256, source=ours.source))
    return Camera(name, (*parameters, *of_bands), tuple(models), tuple(contents), tuple(curves))


def _name(folder: Path) -> str:
    with user_files.reachable(folder):
        if not folder.is_dir():
            raise BadInput(f"{user_files.shown(folder)}: no such folder")
    return checked_name(folder)


def checked_name(folder: Path) -> str:
    """Name of the camera of a folder; BadInput if no camera may have it."""
    with user_files.reachable(folder):
        name = folder.resolve().name
    if NAME.fullmatch(name) is None:
        what = "a camera has the name of its folder: at most 40 letters a-z, digits and _"
        raise BadInput(f"{user_files.shown(folder)}: {what}")
    if name in (*CAMERAS, *SPACE_CAMERAS):
        raise BadInput(f"{user_files.shown(folder)}: truesky has a camera {name}: choose another name")
    return name


def _parameter(place: str, key: str, value: float, unit: str, source: str) -> Parameter:
    """Make a parameter; BadInput names its place, file and line, if it is outside its bounds."""
    try:
        parameter = Parameter(key, _STATUS, value, unit, source=source)
        bounds.check(parameter, key)
    except BadInput as error:
        raise BadInput(f"{place}: {error}") from None
    return parameter


def _parameters(folder: Path, prefix: str) -> list[Parameter]:
    """Read parameters.csv."""
    rows, known = camera_tables.read_rows(folder, PARAMETERS), parameter_units()
    camera_tables.refuse_repeated(rows, lambda row: row.text("name"))
    found = []
    for row in rows:
        name, unit = row.text("name"), row.values["unit"]
        if name not in known:
            raise BadInput(f"{row.place}: a ground camera has no parameter {name!r}")
        convert(1.0, unit, known[name], f"{row.place}: {name}")
        found.append(_parameter(row.place, prefix + name, row.number("value"), unit, row.text("source")))
    there = {row.text("name") for row in rows}
    if missing := [name for name in required_parameters() if name not in there]:
        raise BadInput(f"{user_files.shown(folder / PARAMETERS)}: parameter {missing[0]} is missing")
    return found


def _bands(folder: Path, name: str) -> tuple[list[Parameter], list[Curve]]:
    rows = camera_tables.read_rows(folder, BANDS)
    camera_tables.refuse_repeated(rows, lambda row: row.text("band"))
    reserved = {key.partition(".")[0] for key in (*parameter_units(), *OF_AMPLIFIERS, *_MODELS)}
    parameters, curves = [], []
    for row in rows:
        band = row.text("band")
        if NAME.fullmatch(band) is None:
            raise BadInput(f"{row.place}: band = {band!r}: a name has letters a-z, digits and _")
        if band in reserved:
            raise BadInput(f"{row.place}: band = {band!r} is the name of a parameter or table: choose another name")
        units = OF_BAND | {key: unit for key, unit in OPTIONAL_OF_BAND.items() if row.values[key]}
        parameters += [
            _parameter(row.place, f"ext.{name}.{band}.{key}", row.number(key), unit, f"{name}/{BANDS}")
            for key, unit in units.items()
        ]
        if row.values["curve"]:
            curves.append(_curve(folder, row))
    return parameters, curves


def _curve(folder: Path, row: Row) -> Curve:
    file, medium = row.text("curve"), row.text("medium")
    if medium not in ("air", "vacuum"):
        raise BadInput(f"{row.place}: medium = {medium!r} is not air or vacuum")
    if Path(file).is_absolute() or ".." in Path(file).parts:
        raise BadInput(f"{row.place}: curve = {file!r} is outside the camera's folder: give a file in it")
    return Curve(row.text("band"), user_files.checked(folder / file, "curve", row.place), medium, row.place)


# -------------------------------------------------------------------------------------------------- known parameters


@cache
def known_units() -> Mapping[str, Mapping[str, str]]:
    """Units by parameter, without the camera's prefix and without those of bands, of each known ground camera."""
    found: dict[str, dict[str, str]] = {camera: {} for camera in CAMERAS}
    bands = {p.key.split(".")[2] for p in read_all() if p.key.startswith("ext.") and p.key.endswith(".zero_point")}
    for parameter in read_all():
        first, *rest = parameter.key.split(".")
        if first == "ext" and rest[1] not in (*bands, *OF_AMPLIFIERS):
            found[rest[0]][".".join(rest[1:])] = parameter.unit
    return found


def parameter_units() -> dict[str, str]:
    """Units of all parameters that a ground camera may have, by name."""
    return {key: unit for units in known_units().values() for key, unit in units.items()}


def required_parameters() -> tuple[str, ...]:
    """Names of the parameters that every ground camera has, sorted."""
    return tuple(sorted(set.intersection(*(set(units) for units in known_units().values()))))
