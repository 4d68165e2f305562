"""Detectors of a camera: position and rotation in the focal plane, number of pixels, distortion."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.mission import detector_overrides
from lake_schema.mission.configuration import MissionConfiguration
from truesky.render.camera import distortion

# First column of the grid of VIS CCDs, counted from 1, whose CCDs are mounted upside down. They form the right half of
# the focal plane (Euclid Data Product Description Document, LE1 VIS).
_VIS_FIRST_ROTATED_COLUMN = 4
# First row of the grid of NISP detectors, counted from 1 at the top, whose detectors are mounted upside down. They form
# the lower half of the focal plane (Euclid Data Product Description Document, LE1 NISP).
_NISP_FIRST_ROTATED_ROW = 3


@dataclass(frozen=True, slots=True)
class FilterWheel:
    """Shift and distortion of the image by a filter that its wheel leaves slightly tilted, see module `filter_wheel`.

    Attributes
    ----------
    tilt_rms : float
        Rms tilt of the filter, rad.
    shift : float
        Shift of the whole image, arcsec on the sky per rad of tilt.
    bend : float
        Distortion of the image, in arcsec on the sky per rad of tilt and per rad^2 of the squared angular distance on
        the sky from the optical axis.
    """

    tilt_rms: float
    shift: float
    bend: float


@dataclass(frozen=True, slots=True)
class Detector:
    """One detector of a camera: its size, position in the focal plane, and distortion.

    Attributes
    ----------
    name : str
        Name of the detector.
    section : str
        Prefix of the detector's parameters in the mission database: "vis", "nisp" or, for instance, "ext.lsstcam".
    nx, ny : int
        Number of columns and rows of the detector's image.
    x, y : float
        Position of the detector's centre in the focal plane, arcsec.
    rotation : float
        Angle from the x axis of the focal plane to the direction in which the detector's column index increases,
        counted from x to y, deg.
    pixel_scale : float
        Arcsec per pixel.
    distortion_terms : distortion.Terms
        Polynomial of the optical distortion of the camera; () without distortion.
    injection_rows : int
        Number of charge-injection rows between the halves of the detector. They are included in `ny` and are not read.
    filter_wheel : FilterWheel or None
        Effects of a tilt of the filter; None for a camera whose filters do not tilt.
    kind : str
        Type of the detector in the layout of a ground camera; "" for VIS and NISP.
    is_mirrored : bool
        True if the row index increases in the direction opposite to that of a detector that is only rotated. The image
        of a detector as its file has it is then a mirror image of the sky.
    serial : str
        Serial number by the manufacturer; "" if unknown.
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
    is_mirrored: bool = False
    serial: str = ""

    @property
    def axes(self) -> Float:
        """Directions in which columns and rows increase, float[2, 2].

        The first column has the unit vector (x, y) in the focal plane along which the column index increases, the
        second column that of the row index. The matrix converts vectors on the detector to the focal plane, and its
        transpose is the inverse. All code takes the rotation and the parity of a detector from here.
        """
        turn = np.radians(self.rotation)
        cosine, sine = float(np.cos(turn)), float(np.sin(turn))
        return np.array([[cosine, -self.handedness * sine], [sine, self.handedness * cosine]])

    @property
    def handedness(self) -> float:
        """Return -1 if the detector's image is mirrored against the focal plane, otherwise 1."""
        return -1.0 if self.is_mirrored else 1.0

    @property
    def upside_down(self) -> bool:
        """True if the row index increases downwards in the focal plane, against its y axis."""
        return float(self.axes[1, 1]) < 0.0

    @property
    def row_angle(self) -> float:
        """Angle from the y axis of the focal plane to the direction in which the row index increases, deg.

        It is counted like `rotation`, from x to y, and lies in no particular range.
        """
        return self.rotation + 180.0 * self.is_mirrored

    def own_degrees(self, angle: float) -> float:
        """Convert a direction in the focal plane to the detector.

        `angle` is counted from the focal plane's x axis to its y axis. The result is counted from the direction of
        increasing column index to that of increasing row index. Both are in degrees.
        """
        return self.handedness * (angle - self.rotation)

    def own_radians(self, angle: float) -> float:
        """Convert a direction in the focal plane to the detector, as `own_degrees` but in radians."""
        return self.handedness * (angle - float(np.radians(self.rotation)))

    def to_focal_plane(self, along: npt.ArrayLike, up: npt.ArrayLike) -> tuple[Float, Float]:
        """Convert positions on the detector to positions (x, y) in the focal plane, all in arcsec.

        `along` is measured from the detector's centre in the direction of columns, `up` in that of rows.
        """
        axes, along, up = self.axes, np.asarray(along, float), np.asarray(up, float)
        return self.x + axes[0, 0] * along + axes[0, 1] * up, self.y + axes[1, 0] * along + axes[1, 1] * up

    def from_focal_plane(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[Float, Float]:
        """Convert vectors (x, y) in the focal plane to the directions of columns and rows of the detector.

        For the position of a point on the detector, give its vector from the detector's centre.
        """
        axes, x, y = self.axes, np.asarray(x, float), np.asarray(y, float)
        return axes[0, 0] * x + axes[1, 0] * y, axes[0, 1] * x + axes[1, 1] * y

    def focal_plane_place(self, column: npt.ArrayLike, row: npt.ArrayLike) -> tuple[Float, Float]:
        """Return the positions (x, y) of pixels in the focal plane, arcsec; columns and rows count from 0."""
        places = ((column, self.nx), (row, self.ny))
        return self.to_focal_plane(*(self.pixel_scale * (np.asarray(at, float) - (n - 1) / 2) for at, n in places))

    def pixel_place(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[Float, Float]:
        """Return the columns and rows of positions in the focal plane (arcsec), the inverse of `focal_plane_place`."""
        along, up = self.from_focal_plane(np.asarray(x, float) - self.x, np.asarray(y, float) - self.y)
        return along / self.pixel_scale + (self.nx - 1) / 2, up / self.pixel_scale + (self.ny - 1) / 2

    @property
    def half_diagonal(self) -> float:
        """Distance from the centre of the detector to its corners, arcsec."""
        return 0.5 * self.pixel_scale * float(np.hypot(self.nx, self.ny))


def detectors(camera: str, mission: MissionConfiguration) -> tuple[Detector, ...]:
    """Return all detectors of a camera ("vis", "nisp" or a ground camera), in the order of its layout.

    BadInput is raised if the camera is unknown, if its distortion cannot be inverted at its corners, or if a VIS
    detector cannot be divided into four equal quadrants.

    References
    ----------
    Scaramella et al. 2022, Table 1 (gaps of VIS and NISP); layouts of ground cameras in the mission database.
    """
    camera_detectors = _load_detectors(camera, mission)
    farthest = field_radius(camera_detectors)
    scale = camera_detectors[0].pixel_scale
    distortion.require_invertible(camera_detectors[0].distortion_terms, farthest / scale, scale, camera)
    return camera_detectors


def field_radius(all_detectors: Sequence[Detector]) -> float:
    """Return the radius of the circle about the boresight around all detectors of a camera, arcsec."""
    return max(float(np.hypot(detector.x, detector.y)) + detector.half_diagonal for detector in all_detectors)


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
    """Return the detector of a camera that has a given name.

    Parameters
    ----------
    camera : str
        Name of the camera: "vis", "nisp" or a ground camera.
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
        If the camera is unknown or has no detector with this name.
    """
    for candidate in detectors(camera, mission):
        if candidate.name == name:
            return candidate
    raise BadInput(f"camera {camera} has no detector {name!r}")


def _refuse_odd(section: str, mission: MissionConfiguration) -> None:
    """Raise BadInput if a number of pixels of a camera's detectors is odd: they are read as four equal quadrants."""
    for name in ("nx", "ny", "charge_injection_rows"):
        count = mission.value(f"{section}.fpa.{name}", "pix")
        if count % 2.0:
            raise BadInput(f"mission parameter {section}.fpa.{name} = {count:g}: must be an even number")


def _grid_detectors(
    section: str, is_upside_down: Callable[[int, int], bool], mission: MissionConfiguration
) -> tuple[Detector, ...]:
    """Return the detectors of a camera that form a grid, with mounting errors, distortion and tilt of the filter.

    `is_upside_down` is a function of the row and column in the grid, counted from 1 at the top and at the left. It
    returns True if the detector there is turned by 180 deg.
    """
    designed, distortion_terms = _designed_grid(mission, section, is_upside_down), distortion.terms(section, mission)
    wheel = _load_filter_wheel(section, mission)
    return tuple(
        replace(d, distortion_terms=distortion_terms, filter_wheel=wheel)
        for d in _apply_metrology(designed, section, mission)
    )


def _load_filter_wheel(section: str, mission: MissionConfiguration) -> FilterWheel | None:
    """Return the shift and distortion of the image by a tilted filter, a plane-parallel plate behind the collimator.

    They are given per radian of tilt, together with the rms tilt that the filter wheel leaves. The result is None if
    the mission database has no tilt for the camera.
    """
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
    """Yield the detectors of a grid without mounting errors: rows from the top, and in each row columns from the left.

    The distance between the centres of neighbours is the published size of a detector plus the published gap. This
    gives the published extent of the VIS focal plane, 0.7781 deg. The size does not include the charge-injection rows
    of VIS, but the image of a detector does. The gap between the images of neighbours in a column is therefore smaller
    than the published gap by 0.4 arcsec.
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
    """Yield the detectors of a camera, shifted and rotated by their measured mounting errors.

    The measurements are in the mission database. Detectors without a measurement are unchanged.
    """
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
    """Return the detectors of a ground camera, whose layout in the mission database gives positions in millimetres."""
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
            is_mirrored=row.get("flip", "0") == "1",
            serial=row.get("serial", ""),
        )
        for row in mission.rows(f"{section}.layout")
    )
