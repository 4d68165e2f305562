"""Write the folder of a new camera with the numbers of a known one, to be edited."""

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
    PARAMETERS,
    WAVEFRONT,
)
from lake_schema.mission.configuration import MissionConfiguration, resolve
from lake_schema.mission.parameter import CAMERAS


def write_like(camera: str, folder: Path) -> list[Path]:
    """Write the folder of a camera with the numbers of a known ground camera.

    Parameters
    ----------
    camera : str
        Name of a ground camera of the mission database.
    folder : Path
        Folder to create. Its name is the new camera's name.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    BadInput
        If there is no such camera, or the folder already exists.
    """
    if camera not in CAMERAS:
        raise BadInput(f"--like {camera} is not one of {', '.join(CAMERAS)}")
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
    texts = {name: _csv_text(COLUMNS[name], rows) for name, rows in tables.items()}
    for key, file in (("layout", LAYOUT), ("psf.wavefront", WAVEFRONT)):
        texts[file] = mission.content(mission.model(prefix + key)).decode()
    new_folder = user_files.check_folder(folder)
    new_folder.mkdir(parents=True)
    for name, text in texts.items():
        (new_folder / name).write_text(text, encoding="utf-8")
    return [new_folder / name for name in texts]


def _amplifier_rows(prefix: str, mission: MissionConfiguration) -> list[tuple[str, ...]]:
    """Return the rows of amplifiers.csv.

    The database contains the mean value of the camera and the ratio of each amplifier to the first one.
    """
    rows = mission.rows(f"{prefix}amplifiers")
    mean = {key: mission.value(prefix + key, unit) for key, unit in AMPLIFIER_UNITS.items()}
    ratios = {key: [float(row[key]) / float(rows[0][key]) for row in rows] for key in ("gain", "read_noise")}
    ratios["full_well"] = [1.0] * len(rows)
    geometry_columns = [column for column in COLUMNS[AMPLIFIERS] if column not in AMPLIFIER_UNITS]
    return [
        (
            *(row[column] for column in geometry_columns),
            *(f"{mean[key] * ratios[key][i]:.7g}" for key in AMPLIFIER_UNITS),
        )
        for i, row in enumerate(rows)
    ]


def _band_names(prefix: str, mission: MissionConfiguration) -> list[str]:
    keys = (p.key for p in mission.parameters if p.key.startswith(prefix) and p.key.endswith(".zero_point"))
    return [key.removeprefix(prefix).partition(".")[0] for key in keys]


def _band_row(prefix: str, band: str, mission: MissionConfiguration) -> tuple[str, ...]:
    values = {}
    for key, unit in (BAND_UNITS | OPTIONAL_BAND_UNITS).items():
        name = f"{prefix}{band}.{key}"
        values[key] = repr(mission.value(name, unit)) if name in mission else ""
    if not values["sky_brightness"]:
        # For these bands, the database gives the sky level in electrons.
        scale = mission.value(f"{prefix}fpa.pixel_scale", "arcsec / pix")
        rate = mission.value(f"{prefix}{band}.sky", "electron / (s pix)") / scale**2
        values["sky_brightness"] = f"{float(values['zero_point']) - 2.5 * math.log10(rate):.4f}"
    return (band, "", "", *values.values())


def _csv_text(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerows([columns, *rows])
    return stream.getvalue()
