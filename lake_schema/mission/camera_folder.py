"""Read a ground camera that a user describes in a folder of CSV files.

The camera is used in addition to the cameras of the mission database, which is part of the package. The folder
contains::

    my_camera/parameters.csv    name, value, unit, source            numbers of the camera
    my_camera/layout.csv        detector, type, nx, ny, x_mm, y_mm, rotation_deg     positions of detectors
    my_camera/amplifiers.csv    type, amplifier, x, y, nx, ny, ...   areas of a detector of each type
    my_camera/bands.csv         band, curve, medium, zero_point, sky_brightness, extinction, fringes
    my_camera/wavefront.csv     noll, x_power, y_power, coefficient_nm     optional, aberrations of the telescope

The folder's name is the camera's name. Gain, read noise and full well are given in amplifiers.csv only. Blank values
in bands.csv: without a curve, truesky's passband of this name is used; without fringes, the band has no fringes.
Optional columns are flip and serial in layout.csv, and prescan_rows and interleaved in amplifiers.csv.
Columns may have any order, and lines that begin with ``#`` are comments. ``truesky mission camera FOLDER
--like decam`` writes such a folder with the values of a known camera, to be edited.
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
    AMPLIFIER_UNITS,
    AMPLIFIERS,
    BAND_UNITS,
    BANDS,
    LAYOUT,
    NAME_PATTERN,
    OPTIONAL_BAND_UNITS,
    PARAMETERS,
    WAVEFRONT,
    Row,
)
from lake_schema.mission.model import Model, read_models
from lake_schema.mission.parameter import CAMERAS, SPACE_CAMERAS, Parameter, convert, read_all_parameters

_STATUS = "SIM"
# Parameters that all ground cameras of the mission database have, but that a user's camera may omit.
_OPTIONAL = frozenset({"first_light"})
_MODEL_FILES = {"layout": LAYOUT, "amplifiers": AMPLIFIERS, "psf.wavefront": WAVEFRONT}


@dataclass(frozen=True, slots=True)
class Curve:
    """Response curve of a band of a user's camera, given as a file.

    Attributes
    ----------
    band : str
        Name of the band.
    file : Path
        File of the response: the fraction of photons that are detected, against wavelength.
    medium : str
        Medium in which its wavelengths are measured, "air" or "vacuum".
    location : str
        File and line that name the curve, for error messages.
    """

    band: str
    file: Path
    medium: str
    location: str


@dataclass(frozen=True, slots=True)
class Camera:
    """A ground camera that a user describes in a folder.

    Attributes
    ----------
    name : str
        Name of the folder, and of the camera.
    parameters : tuple of Parameter
        Numbers of the camera and of its bands, with names that begin with ``ext.<name>.``
    models : tuple of Model
        Records of the tables of detectors (layout), amplifiers and wavefront.
    contents : tuple of (str, bytes)
        sha256 and contents of these tables, as checked CSV texts without comments and with columns in a fixed order.
    curves : tuple of Curve
        Response curves of the bands for which the folder contains a file.
    """

    name: str
    parameters: tuple[Parameter, ...]
    models: tuple[Model, ...]
    contents: tuple[tuple[str, bytes], ...]
    curves: tuple[Curve, ...]

    @property
    def sha256(self) -> str:
        """sha256 (hexadecimal) of all numbers and tables of the camera, and of the names and media of its curves.

        The contents of the curves' files, and the location of the folder, have no effect.
        """
        lines = [f"{p.key}={p.value.hex()} {p.unit}\n" for p in self.parameters]
        lines += [f"{m.key}={m.sha256}\n" for m in self.models]
        lines += [f"{curve.band} {curve.medium}\n" for curve in self.curves]
        return hashlib.sha256("".join(lines).encode()).hexdigest()


def read(folder: Path) -> Camera:
    """Read and check the folder in which a user describes a ground camera.

    Parameters
    ----------
    folder : Path
        Folder with parameters.csv, layout.csv, amplifiers.csv, bands.csv and optionally wavefront.csv. Its name is the
        name of the camera.

    Returns
    -------
    Camera
        The camera. If a user later replaces parameters such as the size of a pixel, its detectors may overlap;
        `lake_schema.mission.checks.camera_faults` finds that.

    Raises
    ------
    BadInput
        If a file or a parameter is missing, a column, name, unit or number is wrong, or detectors or amplifiers
        overlap. The message names the file and the line.
    """
    name = _camera_name(folder)
    prefix = f"ext.{name}."
    parameters = _read_parameters(folder, prefix)
    band_parameters, curves = _read_bands(folder, name)
    pixel = next(p for p in parameters if p.key == f"{prefix}fpa.pixel_size")
    layout = camera_tables.read_layout(folder, convert(pixel.value, pixel.unit, "mm / pix", pixel.key))
    tables = {LAYOUT: layout, AMPLIFIERS: camera_tables.read_amplifiers(folder, layout)}
    # Take gain, read noise and full well of the camera from its first amplifier. For the other amplifiers, their ratios
    # to the first one are used, which follow from the table.
    first_amplifier = tables[AMPLIFIERS][0]
    parameters += [
        _make_parameter(
            first_amplifier.location, prefix + key, first_amplifier.number(key), unit, f"{name}/{AMPLIFIERS}"
        )
        for key, unit in AMPLIFIER_UNITS.items()
    ]
    # Use `lexists`: a link to a missing file must cause an error, not select the default wavefront.
    if os.path.lexists(folder / WAVEFRONT):
        tables[WAVEFRONT] = camera_tables.read_wavefront(folder)
    models, contents = [], []
    for key, file in _MODEL_FILES.items():
        if file in tables:
            data = camera_tables.csv_text(tables[file]).encode()
            sha256 = hashlib.sha256(data).hexdigest()
            models.append(Model(prefix + key, _STATUS, f"{name}_{file}", sha256, source=f"{name}/{file}"))
            contents.append((sha256, data))
    if WAVEFRONT not in tables:
        default_wavefront = next(m for m in read_models() if m.file == "ground_wavefront.csv")
        models.append(
            Model(
                f"{prefix}psf.wavefront",
                _STATUS,
                default_wavefront.file,
                default_wavefront.sha256,
                source=default_wavefront.source,
            )
        )
    return Camera(name, (*parameters, *band_parameters), tuple(models), tuple(contents), tuple(curves))


def _camera_name(folder: Path) -> str:
    with user_files.check_reachable(folder):
        if not folder.is_dir():
            raise BadInput(f"{user_files.format_path(folder)}: no such folder")
    return check_name(folder)


def check_name(folder: Path) -> str:
    """Return the name of a folder, which is the name of the camera that it describes.

    Raise BadInput if it is not a letter a-z followed by at most 39 letters, digits and _, or truesky has a camera of
    this name.
    """
    with user_files.check_reachable(folder):
        name = folder.resolve().name
    if NAME_PATTERN.fullmatch(name) is None:
        reason = "the folder's name is the camera's name: it must have at most 40 letters a-z, digits and _"
        raise BadInput(f"{user_files.format_path(folder)}: {reason}")
    if name in (*CAMERAS, *SPACE_CAMERAS):
        raise BadInput(f"{user_files.format_path(folder)}: truesky already has a camera {name}: choose another name")
    return name


def _make_parameter(location: str, key: str, value: float, unit: str, source: str) -> Parameter:
    """Return a record of a parameter; raise BadInput if its value or unit is not allowed.

    `location` is the file and line of the value, with which the error message begins.
    """
    try:
        parameter = Parameter(key, _STATUS, value, unit, source=source)
        bounds.check_bounds(parameter, key)
    except BadInput as error:
        raise BadInput(f"{location}: {error}") from None
    return parameter


def _read_parameters(folder: Path, prefix: str) -> list[Parameter]:
    """Read the numbers of a user's camera from parameters.csv, and return them as records with `prefix` in their names.

    Raise BadInput if a name is unknown, missing or given twice, or a unit or value is not allowed.
    """
    rows, known_parameters = camera_tables.read_rows(folder, PARAMETERS), parameter_units()
    camera_tables.refuse_repeated(rows, lambda row: row.text("name"))
    parameters = []
    for row in rows:
        name, unit = row.text("name"), row.values["unit"]
        if name not in known_parameters:
            raise BadInput(f"{row.location}: a ground camera has no parameter {name!r}")
        convert(1.0, unit, known_parameters[name], f"{row.location}: {name}")
        parameters.append(_make_parameter(row.location, prefix + name, row.number("value"), unit, row.text("source")))
    given_names = {row.text("name") for row in rows}
    if missing := [name for name in required_parameters() if name not in given_names]:
        raise BadInput(f"{user_files.format_path(folder / PARAMETERS)}: parameter {missing[0]} is missing")
    return parameters


def _read_bands(folder: Path, name: str) -> tuple[list[Parameter], list[Curve]]:
    rows = camera_tables.read_rows(folder, BANDS)
    camera_tables.refuse_repeated(rows, lambda row: row.text("band"))
    reserved = {key.partition(".")[0] for key in (*parameter_units(), *AMPLIFIER_UNITS, *_MODEL_FILES)}
    parameters, curves = [], []
    for row in rows:
        band = row.text("band")
        if NAME_PATTERN.fullmatch(band) is None:
            raise BadInput(f"{row.location}: band = {band!r}: a name must have letters a-z, digits and _")
        if band in reserved:
            raise BadInput(f"{row.location}: band = {band!r} is the name of a parameter or table: choose another name")
        units = BAND_UNITS | {key: unit for key, unit in OPTIONAL_BAND_UNITS.items() if row.values[key]}
        parameters += [
            _make_parameter(row.location, f"ext.{name}.{band}.{key}", row.number(key), unit, f"{name}/{BANDS}")
            for key, unit in units.items()
        ]
        if row.values["curve"]:
            curves.append(_read_curve(folder, row))
    return parameters, curves


def _read_curve(folder: Path, row: Row) -> Curve:
    file, medium = row.text("curve"), row.text("medium")
    if medium not in ("air", "vacuum"):
        raise BadInput(f"{row.location}: medium = {medium!r} is neither air nor vacuum")
    if Path(file).is_absolute() or ".." in Path(file).parts:
        raise BadInput(f"{row.location}: curve = {file!r} is outside the camera's folder: give a file in it")
    return Curve(row.text("band"), user_files.check_file(folder / file, "curve", row.location), medium, row.location)


# ------------------------------------- parameters that a ground camera may or must have


@cache
def units_by_camera() -> Mapping[str, Mapping[str, str]]:
    """Return the units of the parameters of each ground camera in the mission database: {camera: {parameter: unit}}.

    The names of the parameters have no prefix ``ext.<camera>.``. Parameters of bands and amplifiers are left out.
    """
    units: dict[str, dict[str, str]] = {camera: {} for camera in CAMERAS}
    bands = {
        p.key.split(".")[2] for p in read_all_parameters() if p.key.startswith("ext.") and p.key.endswith(".zero_point")
    }
    for parameter in read_all_parameters():
        first, *rest = parameter.key.split(".")
        if first == "ext" and rest[1] not in (*bands, *AMPLIFIER_UNITS):
            units[rest[0]][".".join(rest[1:])] = parameter.unit
    return units


def parameter_units() -> dict[str, str]:
    """Return the units of all parameters that a ground camera may have, by name without the prefix of the camera."""
    return {key: unit for units in units_by_camera().values() for key, unit in units.items()}


def required_parameters() -> tuple[str, ...]:
    """Return the sorted names of the parameters that every ground camera must have, without the prefix of the camera.

    They are the parameters that all ground cameras of the mission database have, except those in `_OPTIONAL`.
    """
    common = set.intersection(*(set(units) for units in units_by_camera().values()))
    return tuple(sorted(common.difference(_OPTIONAL)))
