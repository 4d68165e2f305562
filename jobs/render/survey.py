"""From pointings to exposures and render tasks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from jobs.render import focal_plane
from jobs.render.focal_plane import Detector
from jobs.render.sky import sky_rate
from jobs.request import Pointing
from lake_schema import sky
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import EXPOSURES
from lake_schema.tables.tasks import TASKS

# Cameras of a channel, and the passbands of a camera.
_CAMERAS = {"VIS": ("vis",), "EXT": ("lsstcam",)}
_BANDS = {"vis": ("euclid_vis",), "lsstcam": tuple(f"lsst_{letter}" for letter in "ugrizy")}
# Measured on one core of an AMD EPYC: a detector's PSF, sky, noise and files; each source, by channel.
_SECONDS_DETECTOR, _SECONDS_SOURCE = 8.0, {"VIS": 2.0e-3, "EXT": 0.8e-3}
# Peak memory: interpreter, PSF and tables; bytes held a pixel (frames in double precision, noise, files).
_GB_DETECTOR, _BYTES_PIXEL_HELD = 0.5, 48
# Files: uint16 science and float32 truth.
_BYTES_PIXEL_WRITTEN = 6


def plan(
    pointings: Sequence[Pointing], mission: MissionConfiguration, deflection: float = 0.0
) -> tuple[pa.Table, pa.Table]:
    """Tables `exposures` and `tasks` of the pointings, numbered from 1 in their order.

    deflection : deg, the largest distance between a source's true position (which tells its cell) and where
                 it is seen
    """
    exposures: list[dict[str, Any]] = []
    tasks: list[dict[str, Any]] = []
    for number, pointing in enumerate(pointings, start=1):
        exposure = _exposure(number, pointing, mission)
        exposures.append(exposure)
        tasks.extend(_task(exposure, detector, mission, deflection) for detector in _wanted(pointing, mission))
    tasks.sort(key=lambda task: (-task["seconds"], task["exposure_id"], task["detector"]))
    return _build(EXPOSURES, exposures), _build(TASKS, tasks)


def _build(table: Any, rows: Sequence[dict[str, Any]]) -> pa.Table:
    return table.build({name: [row[name] for row in rows] for name in table.names}) if rows else table.empty()


def _wanted(pointing: Pointing, mission: MissionConfiguration) -> tuple[Detector, ...]:
    everything = focal_plane.detectors(pointing.camera, mission)
    by_name = {detector.name: detector for detector in everything}
    unknown = [name for name in pointing.detectors if name not in by_name]
    if unknown:
        raise BadInput(f"camera {pointing.camera} has no detector {unknown[0]!r}")
    return tuple(by_name[name] for name in dict.fromkeys(pointing.detectors)) or everything


def _exposure(number: int, pointing: Pointing, mission: MissionConfiguration) -> dict[str, Any]:
    if pointing.camera not in _CAMERAS.get(pointing.channel, ()):
        raise BadInput(f"pointing[{number - 1}].camera: channel {pointing.channel} has no camera {pointing.camera!r}")
    if pointing.band not in _BANDS[pointing.camera]:
        known = ", ".join(_BANDS[pointing.camera])
        raise BadInput(f"pointing[{number - 1}].band: camera {pointing.camera} has no band {pointing.band!r} ({known})")
    ra, dec, angle = pointing.ra % 360.0, pointing.dec, pointing.position_angle
    if pointing.centre_on is not None:
        target = focal_plane.detector(pointing.camera, pointing.centre_on, mission)
        ra, dec, angle = focal_plane.boresight_for(target, ra, dec, angle)
    first = _wanted(pointing, mission)[0]
    exposure_time = pointing.exposure_time_s
    if exposure_time is None:
        exposure_time = mission.value(f"{first.section}.exposure_time", "s")
    seeing = 0.0 if first.section == "vis" else mission.value(f"{first.section}.{pointing.band}.seeing", "arcsec")
    return {
        "exposure_id": number,
        "channel": pointing.channel,
        "camera": pointing.camera,
        "band": pointing.band,
        "image_type": "science",
        "ra": ra,
        "dec": dec,
        "position_angle": (angle + 180.0) % 360.0 - 180.0,
        "mjd": pointing.mjd,
        "exposure_time_s": exposure_time,
        "sky": sky_rate(first, pointing.band, ra, dec, pointing.mjd, mission),
        "seeing": seeing,
    }


def _task(
    exposure: dict[str, Any], detector: Detector, mission: MissionConfiguration, deflection: float
) -> dict[str, Any]:
    system = focal_plane.wcs(detector, exposure["ra"], exposure["dec"], exposure["position_angle"])
    ra, dec = focal_plane.centre(detector, system)
    radius = (detector.half_diagonal + mission.value("survey.selection_margin", "arcsec")) / 3600.0 + deflection
    pixels = detector.nx * detector.ny
    area = pixels * (detector.pixel_scale / 60.0) ** 2
    density = sum(mission.value(f"survey.{kind}_density", "arcmin-2") for kind in ("galaxy", "star"))
    sources = int(np.ceil(area * density))
    return {
        "exposure_id": exposure["exposure_id"],
        "detector": detector.name,
        "channel": exposure["channel"],
        "ra": ra,
        "dec": dec,
        "radius": radius,
        "cells": sky.cells_in_cone(ra, dec, radius, GENERATION_ORDER).tolist(),
        "s_region": focal_plane.s_region(detector, system),
        "sources": sources,
        "seconds": _SECONDS_DETECTOR + sources * _SECONDS_SOURCE[exposure["channel"]],
        "memory": _GB_DETECTOR + pixels * _BYTES_PIXEL_HELD / 1e9,
        "bytes": pixels * _BYTES_PIXEL_WRITTEN,
    }
