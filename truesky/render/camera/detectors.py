"""Detectors of a camera: position and rotation in the focal plane, number of pixels, distortion."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from lake_schema.errors import BadInput
from lake_schema.mission import detector_overrides
from lake_schema.mission.configuration import MissionConfiguration
from truesky.render.camera import distortion

# VIS CCDs of the right half of the focal plane are mounted upside down (Euclid Data Product Description
# Document, LE1 VIS).
_VIS_FIRST_ROTATED_COLUMN = 4
# NISP detectors of the lower half are also mounted upside down (Euclid Data Product Description Document, LE1 NISP).
_NISP_FIRST_ROTATED_ROW = 3


@dataclass(frozen=True, slots=True)
class FilterWheel:
    """Effects of a tilt of a camera's filter, see `filter_wheel`.

    Attributes
    ----------
    tilt_rms : float
        Rms tilt of the filter, rad.
    shift : float
        Shift of the image, arcsec on the sky per rad of tilt.
    bend : float
        Distortion in arcsec on the sky per rad of tilt and per squared distance from the axis in rad^2.
    """

    tilt_rms: float
    shift: float
    bend: float


@dataclass(frozen=True, slots=True)
class Detector:
    """One detector of a camera.

    Attributes
    ----------
    name : str
        Name of the detector.
    section : str
        Prefix of its parameters in the mission database: "vis", "nisp" or, for instance, "ext.lsstcam".
    nx, ny : int
        Columns and rows of its image.
    x, y : float
        Position of its centre in the focal plane, arcsec.
    rotation : float
        Rotation of its columns and rows against the focal plane, from x to y, deg.
    pixel_scale : float
        Arcsec per pixel.
    distortion_terms : distortion.Terms
        Distortion of its camera's optics.
    injection_rows : int
        Charge injection rows between its halves. They are included in `ny` and are not read.
    filter_wheel : FilterWheel or None
        Filter wheel of its camera; None if the filters do not tilt.
    kind : str
        Type of the detector in the layout of a ground camera; "" for VIS and NISP.
    """

    name: str
    section: str
    nx: int
    ny: int
    x: float
    y: float
    rotation: float
    pixel_scale: float
    distortion_terms: distortion.Terms = ()
    injection_rows: int = 0
    filter_wheel: FilterWheel | None = None
    kind: str = ""

    @property
    def upside_down(self) -> bool:
        """True if the detector is mounted upside down."""
        return float(np.cos(np.radians(self.rotation))) < 0.0

    @property
    def half_diagonal(self) -> float:
        """Distance from centre to corner, arcsec."""
        return 0.5 * self.pixel_scale * float(np.hypot(self.nx, self.ny))


def detectors(camera: str, mission: MissionConfiguration) -> tuple[Detector, ...]:
    """Detectors of a camera, in the order of its layout: "vis", "nisp" or a ground camera.

    References
    ----------
    Scaramella et al. 2022, Table 1 (gaps of VIS and NISP); layouts of ground cameras in the mission database.
    """
    camera_detectors = _load_detectors(camera, mission)
    farthest = max(float(np.hypot(d.x, d.y)) + d.half_diagonal for d in camera_detectors)
    scale = camera_detectors[0].pixel_scale
    distortion.require_invertible(camera_detectors[0].distortion_terms, farthest / scale, scale, camera)
    return camera_detectors


def _load_detectors(camera: str, mission: MissionConfiguration) -> tuple[Detector, ...]:
    if camera == "vis":
        _refuse_odd("vis", mission)
        return _grid_detectors("vis", lambda row, column: column >= _VIS_FIRST_ROTATED_COLUMN, mission)
    if camera == "nisp":
        return _grid_detectors("nisp", lambda row, column: row >= _NISP_FIRST_ROTATED_ROW, mission)
    if camera in mission.ground_cameras:
        return _read_layout(f"ext.{camera}", mission)
    raise BadInput(f"camera {camera!r} is not one of vis, nisp, {', '.join(mission.ground_cameras)}")


def detector(camera: str, name: str, mission: MissionConfiguration) -> Detector:
    """Return the detector of a camera with a given name.

    Parameters
    ----------
    camera : str
        "vis", "nisp" or a ground camera.
    name : str
        Name of the detector.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    Detector
        The detector.

    Raises
    ------
    BadInput
        If the camera has no detector of that name.
    """
    for candidate in detectors(camera, mission):
        if candidate.name == name:
            return candidate
    raise BadInput(f"camera {camera} has no detector {name!r}")


def _refuse_odd(section: str, mission: MissionConfiguration) -> None:
    """Raise BadInput if a number of pixels is odd, since detectors are read as four equal quadrants."""
    for name in ("nx", "ny", "charge_injection_rows"):
        count = mission.value(f"{section}.fpa.{name}", "pix")
        if count % 2.0:
            raise BadInput(f"mission parameter {section}.fpa.{name} = {count:g}: must be an even number")


def _grid_detectors(
    section: str, is_upside_down: Callable[[int, int], bool], mission: MissionConfiguration
) -> tuple[Detector, ...]:
    """Return the detectors of a grid with metrology, distortion and filter wheel."""
    designed, distortion_terms = _designed_grid(mission, section, is_upside_down), distortion.terms(section, mission)
    wheel = _load_filter_wheel(section, mission)
    return tuple(
        replace(d, distortion_terms=distortion_terms, filter_wheel=wheel)
        for d in _apply_metrology(designed, section, mission)
    )


def _load_filter_wheel(section: str, mission: MissionConfiguration) -> FilterWheel | None:
    """Effects of a tilted filter: a plane-parallel plate in the beam between collimator and camera."""
    if f"{section}.filter_wheel_error" not in mission:
        return None
    thickness, refractive_index = (
        mission.value(f"{section}.filter.thickness", "mm"),
        mission.value(f"{section}.filter.refractive_index"),
    )
    plate_scale = mission.value(f"{section}.fpa.pixel_scale", "arcsec / pix") / mission.value(
        f"{section}.fpa.pixel_size", "mm / pix"
    )
    magnification = mission.value("plm.focal_length", "m") / mission.value(f"{section}.collimator_focal_length", "m")
    cubic_term = (refractive_index**2 - 1.0) / (2.0 * refractive_index**3)
    error = mission.value(f"{section}.filter_wheel_error", "rad")
    return FilterWheel(
        error,
        plate_scale * thickness * (1.0 - 1.0 / refractive_index),
        plate_scale * thickness * cubic_term * magnification**2,
    )


def _designed_grid(
    mission: MissionConfiguration, section: str, is_upside_down: Callable[[int, int], bool]
) -> Iterator[Detector]:
    """Yield the detectors of a grid, rows from the top and columns from the left.

    The pitch is the sum of published pixels, without charge injection rows, and published gaps: VIS spans 0.7781 deg.
    For VIS the gap between images of neighbours in a column is therefore smaller than the published gap by 0.4 arcsec.
    """
    scale = mission.value(f"{section}.fpa.pixel_scale", "arcsec / pix")
    nx, ny, rows, columns = (int(mission.value(f"{section}.fpa.{key}")) for key in ("nx", "ny", "rows", "columns"))
    key = f"{section}.fpa.charge_injection_rows"
    injection_rows = int(mission.value(key, "pix")) if key in mission else 0
    pitch_x = nx * scale + mission.value(f"{section}.fpa.gap_x", "arcsec")
    pitch_y = ny * scale + mission.value(f"{section}.fpa.gap_y", "arcsec")
    for row in range(1, rows + 1):
        for column in range(1, columns + 1):
            yield Detector(
                name=detector_overrides.GRID_NAMES[section].format(row=row, column=column),
                section=section,
                nx=nx,
                ny=ny + injection_rows,
                x=(column - (columns + 1) / 2) * pitch_x,
                y=((rows + 1) / 2 - row) * pitch_y,
                rotation=180.0 if is_upside_down(row, column) else 0.0,
                pixel_scale=scale,
                injection_rows=injection_rows,
            )


def _apply_metrology(designed: Iterable[Detector], section: str, mission: MissionConfiguration) -> Iterator[Detector]:
    """Shift and rotate each detector by its measured mounting error."""
    key = f"{section}.fpa.metrology"
    if key not in mission:
        yield from designed
        return
    measured = {row["detector"]: row for row in mission.rows(key)}
    shift, turn = (mission.value(f"{key}_{kind}", unit) for kind, unit in (("shift", "pix"), ("rotation", "deg")))
    for d in designed:
        row = measured.get(d.name)
        if row is None:
            yield d
            continue
        x, y = (d.pixel_scale * shift * float(row[f"shift_{axis}"]) for axis in "xy")
        yield replace(d, x=d.x + x, y=d.y + y, rotation=d.rotation + turn * float(row["rotation"]))


def _read_layout(section: str, mission: MissionConfiguration) -> tuple[Detector, ...]:
    """Return the detectors of a layout in millimetres."""
    distortion_terms = distortion.terms(section, mission)
    scale = mission.value(f"{section}.fpa.pixel_scale", "arcsec / pix")
    plate_scale = scale / mission.value(f"{section}.fpa.pixel_size", "mm / pix")
    return tuple(
        Detector(
            name=row["detector"],
            section=section,
            nx=int(row["nx"]),
            ny=int(row["ny"]),
            x=float(row["x_mm"]) * plate_scale,
            y=float(row["y_mm"]) * plate_scale,
            rotation=float(row["rotation_deg"]),
            pixel_scale=scale,
            distortion_terms=distortion_terms,
            kind=row["type"],
        )
        for row in mission.rows(f"{section}.layout")
    )
