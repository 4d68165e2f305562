"""Write the folder of a new ground camera with the numbers of a camera in the mission database, for a user to edit."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Sequence
from pathlib import Path

from lake_schema import user_files
from lake_schema.errors import BadInput
from lake_schema.mission.camera_folder import check_name, units_by_camera
from lake_schema.mission.camera_tables import (
    AMPLIFIER_UNITS,
    AMPLIFIERS,
    BAND_UNITS,
    BANDS,
    COLUMNS,
    LAYOUT,
    OPTIONAL_BAND_UNITS,
    OPTIONAL_COLUMNS,
    PARAMETERS,
    WAVEFRONT,
)
from lake_schema.mission.configuration import MissionConfiguration, resolve
from lake_schema.mission.parameter import CAMERAS
from lake_schema.texts import spelling


def write_like(camera: str, folder: Path) -> list[Path]:
    """Create the folder of a new camera, with CSV files that contain the numbers of a known ground camera.

    Parameters
    ----------
    camera : str
        Name of a ground camera of the mission database, such as "decam".
    folder : Path
        Folder to create. Its name is the new camera's name.

    Returns
    -------
    list of Path
        The files that were written.

    Raises
    ------
    BadInput
        If there is no such camera, the folder already exists or cannot be created, or its name is not allowed.
    """
    if camera not in CAMERAS:
        raise BadInput(f"--like {camera} is not one of {', '.join(CAMERAS)}{spelling.suggestion(camera, CAMERAS)}")
    if os.path.lexists(folder):
        raise BadInput(f"{user_files.format_path(folder)}: already exists")
    check_name(folder)
    mission, prefix = resolve(), f"ext.{camera}."
    units = units_by_camera()[camera]
    numbers = [mission.parameter(prefix + name) for name in sorted(units)]
    tables: dict[str, Sequence[Sequence[str]]] = {
        PARAMETERS: [(p.key.removeprefix(prefix), repr(p.value), p.unit, f"{camera}: {p.source}") for p in numbers],
        BANDS: [_band_row(prefix, band, mission) for band in _band_names(prefix, mission)],
        AMPLIFIERS: _amplifier_rows(prefix, mission),
    }
    texts = {
        name: _csv_text(_amplifier_columns(prefix, mission) if name == AMPLIFIERS else COLUMNS[name], rows)
        for name, rows in tables.items()
    }
    for key, file in (("layout", LAYOUT), ("psf.wavefront", WAVEFRONT)):
        texts[file] = mission.content(mission.model(prefix + key)).decode()
    new_folder = user_files.check_folder(folder)
    new_folder.mkdir(parents=True)
    for name, text in texts.items():
        (new_folder / name).write_text(text, encoding="utf-8")
    return [new_folder / name for name in texts]


def _amplifier_rows(prefix: str, mission: MissionConfiguration) -> list[tuple[str, ...]]:
    """Return the rows of amplifiers.csv for a camera of the mission database.

    Gain and read noise are the camera's values, times the ratio of the amplifier's value to that of the first amplifier
    in the database. The full well is equal for all amplifiers. `prefix` is ``ext.<camera>.``
    """
    rows = mission.rows(f"{prefix}amplifiers")
    mean = {key: mission.value(prefix + key, unit) for key, unit in AMPLIFIER_UNITS.items()}
    ratios = {key: [float(row[key]) / float(rows[0][key]) for row in rows] for key in ("gain", "read_noise")}
    ratios["full_well"] = [1.0] * len(rows)
    columns = _amplifier_columns(prefix, mission)
    return [
        tuple(
            f"{mean[column] * ratios[column][i]:.7g}" if column in AMPLIFIER_UNITS else row[column]
            for column in columns
        )
        for i, row in enumerate(rows)
    ]


def _amplifier_columns(prefix: str, mission: MissionConfiguration) -> tuple[str, ...]:
    """Return the columns of amplifiers.csv: all necessary ones, and the optional ones that the camera's table has."""
    first = mission.rows(f"{prefix}amplifiers")[0]
    return (*COLUMNS[AMPLIFIERS], *(column for column in OPTIONAL_COLUMNS[AMPLIFIERS] if column in first))


def _band_names(prefix: str, mission: MissionConfiguration) -> list[str]:
    keys = (p.key for p in mission.parameters if p.key.startswith(prefix) and p.key.endswith(".zero_point"))
    return [key.removeprefix(prefix).partition(".")[0] for key in keys]


def _band_row(prefix: str, band: str, mission: MissionConfiguration) -> tuple[str, ...]:
    values = {}
    for key, unit in (BAND_UNITS | OPTIONAL_BAND_UNITS).items():
        name = f"{prefix}{band}.{key}"
        values[key] = repr(mission.value(name, unit)) if name in mission else ""
    if not values["sky_brightness"]:
        # The mission database has no sky brightness of this band, but a rate in electrons per s and pixel: convert it.
        scale = mission.value(f"{prefix}fpa.pixel_scale", "arcsec / pix")
        rate = mission.value(f"{prefix}{band}.sky", "electron / (s pix)") / scale**2
        values["sky_brightness"] = f"{float(values['zero_point']) - 2.5 * math.log10(rate):.4f}"
    return (band, "", "", *values.values())


def _csv_text(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerows([columns, *rows])
    return stream.getvalue()
