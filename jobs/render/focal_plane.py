"""Cameras: where detectors lie in the focal plane, and where their pixels look.

Focal-plane coordinates (x, y) are arcsec on the tangent plane about the boresight, as the sky is seen from
inside: with y to the north, x points west (east is left).  Where the optics distort, they are those of the
detectors' own places, and `distortion` tells what is seen there.  Pixel coordinates (column, row) are 0-based,
and whole at a pixel's centre.

detectors       the detectors of a camera, from the layout rules
boresight_for   the pointing that puts a detector's centre on a target
wcs             the world coordinate system of a detector (astropy): TAN, with SIP where the optics distort
sky_of_pixel, pixel_of_sky, jacobian
sky_of_plane, outline    all detectors of an exposure at once
corners, s_region, radius
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from astropy.wcs import WCS, Sip

from jobs import sums
from jobs.render import distortion
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.parameter import CAMERAS

Float = npt.NDArray[np.float64]

# VIS CCDs of the right half of the focal plane are mounted upside down (Euclid Data Product Description
# Document, LE1 VIS).
_VIS_FIRST_ROTATED_COLUMN = 4
# NISP detectors of the lower half likewise (Euclid Data Product Description Document, LE1 NISP).
_NISP_FIRST_ROTATED_ROW = 3
_ARCSEC = np.pi / 180.0 / 3600.0


@dataclass(frozen=True, slots=True)
class Detector:
    """One detector of a camera.

    section     : prefix of its parameters in the mission database, "vis", "nisp" or "ext.lsstcam"
    nx, ny      : columns and rows of its image
    middle      : of the rows, those of charge injection between its halves, which are not read
    x, y        : arcsec, its centre in the focal plane
    rotation    : deg, of its columns-rows axes against the focal plane's, from x to y
    pixel_scale : arcsec
    bending     : distortion of its camera's optics
    """

    name: str
    section: str
    nx: int
    ny: int
    x: float
    y: float
    rotation: float
    pixel_scale: float
    bending: distortion.Terms = ()
    middle: int = 0

    @property
    def upside_down(self) -> bool:
        """Whether it is mounted so."""
        return float(np.cos(np.radians(self.rotation))) < 0.0

    @property
    def half_diagonal(self) -> float:
        """Centre to corner, arcsec."""
        return 0.5 * self.pixel_scale * float(np.hypot(self.nx, self.ny))


def detectors(camera: str, mission: MissionConfiguration) -> tuple[Detector, ...]:
    """The detectors of a camera, in the order of its layout: "vis", "nisp" or a ground camera.

    Ref : VIS and NISP, Scaramella et al. 2022, Table 1 (gaps); ground cameras, the mission database's layouts
    """
    if camera == "vis":
        _refuse_odd("vis", mission)
        planned = _grid(mission, "vis", lambda row, column: (f"{row}-{column}", column >= _VIS_FIRST_ROTATED_COLUMN))
        bending = distortion.terms("vis", mission)
        return tuple(replace(d, bending=bending) for d in _mounted(planned, "vis", mission))
    if camera == "nisp":
        return tuple(_grid(mission, "nisp", lambda row, column: (f"DET{row}{column}", row >= _NISP_FIRST_ROTATED_ROW)))
    if camera in CAMERAS:
        return _listed(f"ext.{camera}", mission)
    raise BadInput(f"camera {camera!r} is not one of vis, nisp, {', '.join(CAMERAS)}")


def detector(camera: str, name: str, mission: MissionConfiguration) -> Detector:
    """One detector of a camera by name."""
    for candidate in detectors(camera, mission):
        if candidate.name == name:
            return candidate
    raise BadInput(f"camera {camera} has no detector {name!r}")


def _refuse_odd(section: str, mission: MissionConfiguration) -> None:
    """Detectors are read as four equal quadrants."""
    for name in ("nx", "ny", "charge_injection_rows"):
        count = mission.value(f"{section}.fpa.{name}", "pix")
        if count % 2.0:
            raise BadInput(f"mission parameter {section}.fpa.{name} = {count:g}: must be an even number")


def _grid(
    mission: MissionConfiguration, section: str, label: Callable[[int, int], tuple[str, bool]]
) -> Iterator[Detector]:
    """Rows from the top, columns from the left; `label` gives the name, and whether it is mounted upside down.

    The pitch is of the published rows, without those of charge injection, and gaps: VIS fills 0.7781 deg.
    Error : VIS, 0.4": so much less than the published gap is left between the images of neighbours in a column
    """
    scale = mission.value(f"{section}.fpa.pixel_scale", "arcsec / pix")
    nx, ny, rows, columns = (int(mission.value(f"{section}.fpa.{key}")) for key in ("nx", "ny", "rows", "columns"))
    key = f"{section}.fpa.charge_injection_rows"
    middle = int(mission.value(key, "pix")) if key in mission else 0
    pitch_x = nx * scale + mission.value(f"{section}.fpa.gap_x", "arcsec")
    pitch_y = ny * scale + mission.value(f"{section}.fpa.gap_y", "arcsec")
    for row in range(1, rows + 1):
        for column in range(1, columns + 1):
            name, turned = label(row, column)
            yield Detector(
                name=name,
                section=section,
                nx=nx,
                ny=ny + middle,
                x=(column - (columns + 1) / 2) * pitch_x,
                y=((rows + 1) / 2 - row) * pitch_y,
                rotation=180.0 if turned else 0.0,
                pixel_scale=scale,
                middle=middle,
            )


def _mounted(planned: Iterable[Detector], section: str, mission: MissionConfiguration) -> Iterator[Detector]:
    """Detectors as they were mounted: shifted and turned a little, each in its own way."""
    key = f"{section}.fpa.metrology"
    if key not in mission:
        yield from planned
        return
    measured = {row["detector"]: row for row in mission.rows(key)}
    shift, turn = (mission.value(f"{key}_{kind}", unit) for kind, unit in (("shift", "pix"), ("rotation", "deg")))
    for d in planned:
        row = measured.get(d.name)
        if row is None:
            yield d
            continue
        x, y = (d.pixel_scale * shift * float(row[f"shift_{axis}"]) for axis in "xy")
        yield replace(d, x=d.x + x, y=d.y + y, rotation=d.rotation + turn * float(row["rotation"]))


def _listed(section: str, mission: MissionConfiguration) -> tuple[Detector, ...]:
    """Detectors of a layout in millimetres."""
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
        )
        for row in mission.rows(f"{section}.layout")
    )


# ------------------------------------------------------------------------------------------------ pointing


def boresight_for(detector: Detector, ra: float, dec: float, position_angle: float) -> tuple[float, float, float]:
    """The pointing that puts a detector's centre on a target.

    ra, dec        : deg, target
    position_angle : deg, of the focal plane's y axis *at the target*, north through east
    returns        : ra, dec, position angle of the boresight, deg; the angle differs from the one at the
                     target because meridians converge; defined everywhere, poles included
    """
    # Right-handed: (east-like = -x, y, outward).
    x, y = (float(place) for place in distortion.bent(detector.x, detector.y, detector.bending))
    centre = np.array([-x * _ARCSEC, y * _ARCSEC, 1.0])
    camera = _triad(centre, np.array([0.0, 1.0, 0.0]))
    east, north, out = basis(ra, dec)
    angle = np.radians(position_angle)
    sky = _triad(out, np.sin(angle) * east + np.cos(angle) * north)
    rotation = sums.product(sky, camera.T)
    boresight, up = rotation[:, 2], rotation[:, 1]
    ra0 = float(np.degrees(np.arctan2(boresight[1], boresight[0])) % 360.0)
    dec0 = float(np.degrees(np.arctan2(boresight[2], np.hypot(boresight[0], boresight[1]))))
    east0, north0, _ = basis(ra0, dec0)
    return ra0, dec0, float(np.degrees(np.arctan2(sums.product(up, east0), sums.product(up, north0))))


def sky_of_plane(
    x: npt.ArrayLike, y: npt.ArrayLike, ra: float, dec: float, position_angle: float
) -> tuple[Float, Float]:
    """Focal-plane coordinates [n] arcsec on the tangent plane -> ra [n] in [0, 360), dec [n], deg.

    ra, dec, position_angle : deg, of the boresight and of the y axis there
    """
    angle = np.radians(position_angle)
    u, v = np.asarray(x, float) * _ARCSEC, np.asarray(y, float) * _ARCSEC
    east, north, out = basis(ra, dec)
    to_east, to_north = np.sin(angle) * v - np.cos(angle) * u, np.cos(angle) * v + np.sin(angle) * u
    to = out[:, None] + east[:, None] * to_east.ravel() + north[:, None] * to_north.ravel()
    lon = np.degrees(np.arctan2(to[1], to[0])) % 360.0
    lat = np.degrees(np.arctan2(to[2], np.hypot(to[0], to[1])))
    return lon.reshape(u.shape), lat.reshape(u.shape)


def outline(some: Sequence[Detector]) -> tuple[Float, Float]:
    """x, y [n, 5] arcsec on the tangent plane: what each detector's centre and corners see; corners as of `corners`."""
    column = np.array([0.0, -0.5, 0.5, 0.5, -0.5])
    row = np.array([0.0, -0.5, -0.5, 0.5, 0.5])
    width = np.array([[d.nx * d.pixel_scale] for d in some]) * column
    height = np.array([[d.ny * d.pixel_scale] for d in some]) * row
    turn = np.radians([[d.rotation] for d in some])
    x = np.array([[d.x] for d in some]) + np.cos(turn) * width - np.sin(turn) * height
    y = np.array([[d.y] for d in some]) + np.sin(turn) * width + np.cos(turn) * height
    for bending in {d.bending for d in some if d.bending}:
        bends = np.array([d.bending == bending for d in some])
        x[bends], y[bends] = distortion.bent(x[bends], y[bends], bending)
    return x, y


def basis(ra: npt.ArrayLike, dec: npt.ArrayLike) -> tuple[Float, Float, Float]:
    """East, north and outward unit vectors [3, ...] at sky positions, deg."""
    lon, lat = np.radians(np.asarray(ra, float)), np.radians(np.asarray(dec, float))
    zero = np.zeros_like(lon * lat)
    east = np.stack([-np.sin(lon) + zero, np.cos(lon) + zero, zero])
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat) + zero])
    out = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat) + zero])
    return east, north, out


def _triad(direction: Float, along: Float) -> Float:
    """Orthonormal columns: direction, `along` made perpendicular to it, their cross product."""
    first = direction / np.sqrt(sums.product(direction, direction))
    second = along - first * sums.product(first, along)
    second = second / np.sqrt(sums.product(second, second))
    return np.stack([first, second, np.cross(first, second)], axis=1)


# ------------------------------------------------------------------------------------------------ pixels


def wcs(detector: Detector, ra: float, dec: float, position_angle: float) -> WCS:
    """The world coordinate system of a detector: ICRS, TAN about the boresight, and the distortion as SIP.

    ra, dec        : deg, boresight
    position_angle : deg, of the focal plane's y axis at the boresight, north through east
    """
    angle, turn = np.radians(position_angle), np.radians(detector.rotation)
    # Columns: the directions (east, north) of the focal plane's x and y axes.
    axes = np.array([[-np.cos(angle), np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    from_centre = sums.product(rotation.T, np.array([-detector.x, -detector.y])) / detector.pixel_scale
    system = WCS(naxis=2)
    bends = bool(detector.bending)
    system.wcs.ctype = [f"{axis}{_PROJECTIONS[bends]}" for axis in ("RA---", "DEC--")]
    system.wcs.cunit = ["deg", "deg"]
    system.wcs.crval = [ra, dec]
    system.wcs.crpix = [(detector.nx + 1) / 2 + from_centre[0], (detector.ny + 1) / 2 + from_centre[1]]
    system.wcs.cd = sums.product(axes, rotation) * detector.pixel_scale / 3600.0
    system.wcs.radesys = "ICRS"
    # Else north would be turned by 180 deg for a boresight at the pole itself.
    system.wcs.lonpole = 180.0
    if bends:
        system.sip = Sip(*distortion.sip(detector.bending, detector.pixel_scale * rotation), None, None, _crpix(system))
    system.wcs.set()
    return system


# Without and with SIP.
_PROJECTIONS = ("TAN", "TAN-SIP")


def _crpix(system: WCS) -> Float:
    return np.asarray(system.wcs.crpix, float)


def sky_of_pixel(system: WCS, column: npt.ArrayLike, row: npt.ArrayLike) -> tuple[Float, Float]:
    """0-based pixel coordinates [n] -> ra [n] in [0, 360), dec [n], deg."""
    ra, dec = system.all_pix2world(np.asarray(column, float), np.asarray(row, float), 0)
    return np.mod(ra, 360.0), np.asarray(dec)


def pixel_of_sky(system: WCS, ra: npt.ArrayLike, dec: npt.ArrayLike) -> tuple[Float, Float]:
    """ra, dec [n] deg -> 0-based column [n], row [n]; only for positions within 90 deg of the boresight.

    Error : 1e-8 pixels (rounding)
    """
    column, row = system.wcs_world2pix(np.asarray(ra, float), np.asarray(dec, float), 0)
    if system.sip is None:
        return np.asarray(column), np.asarray(row)
    x0, y0 = _crpix(system) - 1.0
    u, v = distortion.straight(column - x0, row - y0, system.sip.a, system.sip.b)
    return u + x0, v + y0


def jacobian(system: WCS, column: npt.ArrayLike, row: npt.ArrayLike) -> Float:
    """Derivative of the local tangent plane (u west, v north), arcsec, by pixel coordinates.

    column, row : [n] 0-based
    returns     : [n, 2, 2] ((du/dx, du/dy), (dv/dx, dv/dy))
    Error       : 2e-8 relative (central difference of one pixel; rounding of the positions)
    """
    x, y = np.asarray(column, float), np.asarray(row, float)
    east, north, _ = basis(*sky_of_pixel(system, x, y))
    step_x = _direction(system, x + 0.5, y) - _direction(system, x - 0.5, y)
    step_y = _direction(system, x, y + 0.5) - _direction(system, x, y - 0.5)
    rows = [
        [-np.sum(east * step, 0) for step in (step_x, step_y)],
        [np.sum(north * step, 0) for step in (step_x, step_y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1)) / _ARCSEC


def _direction(system: WCS, x: Float, y: Float) -> Float:
    return basis(*sky_of_pixel(system, x, y))[2]


def corners(detector: Detector, system: WCS) -> Float:
    """[4, 2] ra, dec deg of the detector's outer corners, in order around it."""
    x = np.array([-0.5, detector.nx - 0.5, detector.nx - 0.5, -0.5])
    y = np.array([-0.5, -0.5, detector.ny - 0.5, detector.ny - 0.5])
    return np.stack(sky_of_pixel(system, x, y), axis=1)


def centre(detector: Detector, system: WCS) -> tuple[float, float]:
    """ra, dec of the detector's centre, deg."""
    ra, dec = sky_of_pixel(system, [(detector.nx - 1) / 2], [(detector.ny - 1) / 2])
    return float(ra[0]), float(dec[0])


def s_region(detector: Detector, system: WCS) -> str:
    """The footprint as an STC-S polygon.  Error: its sides are straight; VIS's distortion bends them by 2 pixels."""
    return "POLYGON ICRS " + " ".join(f"{value:.7f}" for value in corners(detector, system).ravel())


def cards(system: WCS) -> tuple[tuple[str, Any, str], ...]:
    """The world coordinate system as FITS cards (a card holds 16 characters of a number: 1e-14)."""
    header, bends = system.wcs, system.sip is not None
    projection = "gnomonic projection" + (", distortion as SIP" if bends else "")
    return (
        ("WCSAXES", 2, "number of world coordinate axes"),
        ("CTYPE1", f"RA---{_PROJECTIONS[bends]}", projection),
        ("CTYPE2", f"DEC--{_PROJECTIONS[bends]}", projection),
        ("CUNIT1", "deg", "unit of CRVAL1, CD1_1, CD1_2"),
        ("CUNIT2", "deg", "unit of CRVAL2, CD2_1, CD2_2"),
        ("CRVAL1", float(header.crval[0]), "[deg] boresight right ascension"),
        ("CRVAL2", float(header.crval[1]), "[deg] boresight declination"),
        ("CRPIX1", float(header.crpix[0]), "[pix] boresight, first pixel = 1"),
        ("CRPIX2", float(header.crpix[1]), "[pix] boresight, first pixel = 1"),
        ("CD1_1", float(header.cd[0, 0]), "[deg/pix]"),
        ("CD1_2", float(header.cd[0, 1]), "[deg/pix]"),
        ("CD2_1", float(header.cd[1, 0]), "[deg/pix]"),
        ("CD2_2", float(header.cd[1, 1]), "[deg/pix]"),
        ("LONPOLE", 180.0, "[deg] native longitude of the celestial pole"),
        ("RADESYS", "ICRS", "celestial reference system"),
        *(_sip_cards(system.sip) if bends else ()),
    )


def _sip_cards(sip: Sip) -> Iterator[tuple[str, Any, str]]:
    """Polynomials of SIP, terms that are not 0."""
    for name, coefficients in (("A", sip.a), ("B", sip.b)):
        yield f"{name}_ORDER", len(coefficients) - 1, f"distortion of {'columns' if name == 'A' else 'rows'}"
        for p, q in np.argwhere(coefficients).tolist():
            yield f"{name}_{p}_{q}", float(coefficients[p, q]), f"[pix] times u^{p} v^{q}"


def shifted(system: WCS, columns: float, rows: float) -> WCS:
    """The same sky on a frame in which every pixel lies so many columns and rows farther on."""
    out = system.deepcopy()
    out.wcs.crpix = [out.wcs.crpix[0] + columns, out.wcs.crpix[1] + rows]
    if out.sip is not None:
        out.sip = Sip(out.sip.a, out.sip.b, None, None, _crpix(out))
    out.wcs.set()
    return out


def from_cards(header: Iterable[tuple[str, Any, str]]) -> WCS:
    """The world coordinate system that `cards` wrote."""
    values = {keyword: value for keyword, value, _ in header}
    try:
        system = WCS(naxis=2)
        system.wcs.ctype = [values["CTYPE1"], values["CTYPE2"]]
        system.wcs.cunit = [values["CUNIT1"], values["CUNIT2"]]
        system.wcs.crval = [values["CRVAL1"], values["CRVAL2"]]
        system.wcs.crpix = [values["CRPIX1"], values["CRPIX2"]]
        system.wcs.cd = [[values["CD1_1"], values["CD1_2"]], [values["CD2_1"], values["CD2_2"]]]
        system.wcs.lonpole = values["LONPOLE"]
        system.wcs.radesys = values["RADESYS"]
        if str(values["CTYPE1"]).endswith("-SIP"):
            system.sip = Sip(*(_coefficients(values, name) for name in "AB"), None, None, _crpix(system))
    except KeyError as error:
        raise BadInput(f"the header has no card {error.args[0]}") from None
    system.wcs.set()
    return system


def _coefficients(values: dict[str, Any], name: str) -> Float:
    side = int(values[f"{name}_ORDER"]) + 1
    return np.array([[float(values.get(f"{name}_{p}_{q}", 0.0)) for q in range(side)] for p in range(side)])
