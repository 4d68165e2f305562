"""World coordinate systems (WCS) of detectors: conversion between pixels and the sky, and FITS cards.

Focal-plane coordinates (x, y) are arcsec on the tangent plane about the boresight. The sky is seen from the inside: if
y points north, x points west (east is left). If the optics distort, (x, y) are the positions of the detectors, and the
module `distortion` gives the sky positions seen there. Pixel coordinates (column, row) are 0-based, with integers at
pixel centres.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lake_schema import sky
from lake_schema.arrays import Float
from lake_schema.errors import BadInput, LakeError
from truesky.numerics import matrices
from truesky.render.camera import distortion, pointing, tpv
from truesky.render.camera.detectors import Detector
from truesky.render.camera.pointing import ARCSEC

if TYPE_CHECKING:
    # Imported in the functions that use it, because its import takes a second.
    from astropy.wcs import WCS, Sip

# Largest degree of a distortion in the SIP convention.
_MAX_ORDER = 9


def wcs(detector: Detector, ra: float, dec: float, position_angle: float) -> WCS:
    """Return the world coordinate system (WCS) of a detector: ICRS, tangent plane about the boresight, SIP distortion.

    Parameters
    ----------
    detector : Detector
        The detector.
    ra, dec : float
        Right ascension and declination of the boresight, deg.
    position_angle : float
        Angle of the focal plane's y axis at the boresight, deg from north through east.

    Returns
    -------
    WCS
        World coordinate system with the projection TAN or, if the optics distort, TAN-SIP.
    """
    from astropy.wcs import WCS, Sip

    angle = np.radians(position_angle)
    # The columns of `axes` are the directions (east, north) of the focal plane's x and y axes.
    axes = np.array([[-np.cos(angle), np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    from_centre = matrices.matmul(detector.axes.T, np.array([-detector.x, -detector.y])) / detector.pixel_scale
    system = WCS(naxis=2)
    has_distortion = bool(detector.distortion_terms)
    system.wcs.ctype = [f"{axis}{_PROJECTIONS[has_distortion]}" for axis in ("RA---", "DEC--")]
    system.wcs.cunit = ["deg", "deg"]
    system.wcs.crval = [ra, dec]
    system.wcs.crpix = [(detector.nx + 1) / 2 + from_centre[0], (detector.ny + 1) / 2 + from_centre[1]]
    system.wcs.cd = matrices.matmul(axes, detector.axes) * detector.pixel_scale / 3600.0
    system.wcs.radesys = "ICRS"
    # Set the longitude of the pole: with the default, north is turned by 180 deg for a boresight exactly at the pole.
    system.wcs.lonpole = 180.0
    if has_distortion:
        system.sip = Sip(
            *distortion.sip(detector.distortion_terms, detector.pixel_scale * detector.axes), None, None, _crpix(system)
        )
    system.wcs.set()
    return system


# Names of the projections in FITS headers, without and with SIP distortion.
_PROJECTIONS = ("TAN", "TAN-SIP")


def _crpix(system: WCS) -> Float:
    return np.asarray(system.wcs.crpix, float)


def sky_of_pixel(system: WCS, column: npt.ArrayLike, row: npt.ArrayLike) -> tuple[Float, Float]:
    """Convert 0-based pixel coordinates to positions on the sky.

    Parameters
    ----------
    system : WCS
        World coordinate system of the detector.
    column, row : array_like
        0-based pixel coordinates, also outside the detector.

    Returns
    -------
    (float array, float array)
        Right ascension in [0, 360) and declination, deg.
    """
    ra, dec = system.all_pix2world(np.asarray(column, float), np.asarray(row, float), 0)
    return sky.wrap_angle(ra), np.asarray(dec)


def pixel_of_sky(system: WCS, ra: npt.ArrayLike, dec: npt.ArrayLike) -> tuple[Float, Float]:
    """Convert positions on the sky to 0-based pixel coordinates.

    Parameters
    ----------
    system : WCS
        World coordinate system of the detector.
    ra, dec : array_like
        Positions within 90 deg of the boresight, deg.

    Returns
    -------
    (float array, float array)
        Columns and rows, 0-based, with rounding errors of 1e-8 pixels. Positions far outside the camera are not
        corrected for distortion.
    """
    column, row = system.wcs_world2pix(np.asarray(ra, float), np.asarray(dec, float), 0)
    if system.sip is None:
        return np.asarray(column), np.asarray(row)
    x0, y0 = _crpix(system) - 1.0
    u, v = distortion.undo_sip(column - x0, row - y0, system.sip.a, system.sip.b)
    return u + x0, v + y0


def jacobian(system: WCS, column: npt.ArrayLike, row: npt.ArrayLike) -> Float:
    """Return the derivative of sky positions (u west, v north, local tangent plane) with respect to pixel coordinates.

    Parameters
    ----------
    system : WCS
        World coordinate system of the detector.
    column, row : array_like, shape (n,)
        0-based pixel coordinates.

    Returns
    -------
    float array, shape (n, 2, 2)
        ((du/dx, du/dy), (dv/dx, dv/dy)) in arcsec per pixel.

    Notes
    -----
    The relative error is 2e-8. It comes from the central difference over one pixel and from rounding of positions.
    """
    x, y = np.asarray(column, float), np.asarray(row, float)
    east, north, _ = pointing.basis(*sky_of_pixel(system, x, y))
    step_x = _direction(system, x + 0.5, y) - _direction(system, x - 0.5, y)
    step_y = _direction(system, x, y + 0.5) - _direction(system, x, y - 0.5)
    rows = [
        [-np.sum(east * step, 0) for step in (step_x, step_y)],
        [np.sum(north * step, 0) for step in (step_x, step_y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1)) / ARCSEC


def _direction(system: WCS, x: Float, y: Float) -> Float:
    return pointing.basis(*sky_of_pixel(system, x, y))[2]


def corners(detector: Detector, system: WCS) -> Float:
    """Return right ascension and declination (deg) of the detector's outer corners, in order around it, float[4, 2]."""
    x = np.array([-0.5, detector.nx - 0.5, detector.nx - 0.5, -0.5])
    y = np.array([-0.5, -0.5, detector.ny - 0.5, detector.ny - 0.5])
    return np.stack(sky_of_pixel(system, x, y), axis=1)


def centre(detector: Detector, system: WCS) -> tuple[float, float]:
    """Return right ascension and declination of the detector's centre, deg."""
    ra, dec = sky_of_pixel(system, [(detector.nx - 1) / 2], [(detector.ny - 1) / 2])
    return float(ra[0]), float(dec[0])


def s_region(detector: Detector, system: WCS) -> str:
    """Return the footprint of a detector on the sky as text: an STC-S polygon "POLYGON ICRS ..." of its corners in deg.

    Notes
    -----
    The sides of the polygon are straight. The true edges of detectors deviate by up to 2 pixels for VIS and 7 for HSC.
    """
    return "POLYGON ICRS " + " ".join(f"{value:.7f}" for value in corners(detector, system).ravel())


def cards(system: WCS) -> tuple[tuple[str, Any, str], ...]:
    """Return the FITS cards (keyword, value, comment) of a world coordinate system with the projection TAN or TAN-SIP.

    `system` is a result of `wcs`, perhaps shifted by `shift_pixels`. In the file, a number has at most 20 characters,
    so that its relative precision is 1e-13.
    """
    header, has_distortion = system.wcs, system.sip is not None
    projection = "gnomonic projection" + (", distortion as SIP" if has_distortion else "")
    return (
        ("WCSAXES", 2, "number of world coordinate axes"),
        ("CTYPE1", f"RA---{_PROJECTIONS[has_distortion]}", projection),
        ("CTYPE2", f"DEC--{_PROJECTIONS[has_distortion]}", projection),
        ("CUNIT1", "deg", "unit of CRVAL1, CD1_1, CD1_2"),
        ("CUNIT2", "deg", "unit of CRVAL2, CD2_1, CD2_2"),
        ("CRVAL1", float(header.crval[0]), "[deg] right ascension of the reference point"),
        ("CRVAL2", float(header.crval[1]), "[deg] declination of the reference point"),
        ("CRPIX1", float(header.crpix[0]), "[pix] column of the reference point, from 1"),
        ("CRPIX2", float(header.crpix[1]), "[pix] row of the reference point, from 1"),
        ("CD1_1", float(header.cd[0, 0]), "[deg/pix] linear transformation"),
        ("CD1_2", float(header.cd[0, 1]), "[deg/pix] linear transformation"),
        ("CD2_1", float(header.cd[1, 0]), "[deg/pix] linear transformation"),
        ("CD2_2", float(header.cd[1, 1]), "[deg/pix] linear transformation"),
        ("LONPOLE", 180.0, "[deg] native longitude of the celestial pole"),
        ("RADESYS", "ICRS", "celestial reference system"),
        *(_sip_cards(system.sip) if has_distortion else ()),
    )


def _sip_cards(sip: Sip) -> Iterator[tuple[str, Any, str]]:
    """Yield the FITS cards (keyword, value, comment) of the SIP polynomials, without coefficients that are 0."""
    for name, coefficients in (("A", sip.a), ("B", sip.b)):
        yield f"{name}_ORDER", len(coefficients) - 1, f"degree of distortion in {'columns' if name == 'A' else 'rows'}"
        for p, q in np.argwhere(coefficients).tolist():
            yield f"{name}_{p}_{q}", float(coefficients[p, q]), f"[pix] coefficient of u^{p} v^{q}"


def shift_pixels(system: WCS, columns: float, rows: float) -> WCS:
    """Return the world coordinate system of an image in which pixel coordinates are larger by given numbers.

    Parameters
    ----------
    system : WCS
        World coordinate system of the original image.
    columns, rows : float
        Numbers that are added to the columns and rows, such as the number of prescan columns.

    Returns
    -------
    WCS
        World coordinate system of the shifted image; `system` is unchanged.
    """
    from astropy.wcs import Sip

    out = system.deepcopy()
    out.wcs.crpix = [out.wcs.crpix[0] + columns, out.wcs.crpix[1] + rows]
    if out.sip is not None:
        out.sip = Sip(out.sip.a, out.sip.b, None, None, _crpix(out))
    out.wcs.set()
    return out


def flip_pixels(system: WCS, steps: tuple[int, int], size: tuple[int, int]) -> WCS:
    """Return the world coordinate system of an image whose columns or rows are in the opposite order.

    Parameters
    ----------
    system : WCS
        World coordinate system of the original image.
    steps : (int, int)
        For columns and rows: -1 to reverse their order, 1 to keep it.
    size : (int, int)
        Numbers of columns and rows of the image.

    Returns
    -------
    WCS
        World coordinate system of the flipped image; `system` is unchanged.
    """
    from astropy.wcs import Sip

    out, signs = system.deepcopy(), np.array(steps, float)
    out.wcs.crpix = np.where(signs < 0.0, np.array(size) + 1.0 - _crpix(system), _crpix(system))
    out.wcs.cd = system.wcs.cd * signs
    if system.sip is not None:
        powers = np.arange(len(system.sip.a))
        of_terms = signs[0] ** powers[:, None] * signs[1] ** powers
        out.sip = Sip(signs[0] * of_terms * system.sip.a, signs[1] * of_terms * system.sip.b, None, None, _crpix(out))
    out.wcs.set()
    return out


def follow_axes(
    cards: Iterable[tuple[str, Any, str]], header: Iterable[tuple[str, Any, str]]
) -> tuple[tuple[str, Any, str], ...]:
    """Return the cards of a WCS with the matrix CD for an array whose columns or rows are in the opposite order.

    Parameters
    ----------
    cards : iterable of Card
        Cards (keyword, value, comment) of a WCS.
    header : iterable of Card
        Header of the array, with a matrix CD that differs from that of `cards` by a small rotation, and perhaps by the
        order of columns or rows.

    Returns
    -------
    tuple of Card
        The cards, with the signs of the matrix CD for the order of columns and rows in `header`.
    """
    of_wcs, of_header = tuple(cards), {key: value for key, value, _ in header}
    values = {key: value for key, value, _ in of_wcs}
    signs: dict[str, float] = {}
    for axis in (1, 2):
        keys = [f"CD{i}_{axis}" for i in (1, 2)]
        if all(key in values and key in of_header for key in keys):
            is_opposite = sum(float(values[key]) * float(of_header[key]) for key in keys) < 0.0
            signs |= dict.fromkeys(keys, -1.0 if is_opposite else 1.0)
    return tuple((key, signs[key] * value if key in signs else value, text) for key, value, text in of_wcs)


def from_cards(header: Iterable[tuple[str, Any, str]]) -> WCS:
    """Build the world coordinate system from FITS cards (keyword, value, comment) that truesky has written.

    The cards are the result of `cards`, or the same cards with the distortion converted to TPV by `tpv.from_sip`.

    Raises
    ------
    BadInput
        If a necessary card is missing; the message names its keyword. Also if a value is wrong.
    """
    values = {keyword: value for keyword, value, _ in header}
    try:
        return _system(values)
    except KeyError as error:
        raise BadInput(f"the header has no card {error.args[0]}") from None
    except (LakeError, MemoryError):
        raise
    except Exception as error:
        # astropy raises many types of exceptions for wrong values.
        raise BadInput(f"the WCS of the header cannot be used: {' '.join(str(error).split())[:300]}") from None


def _system(values: Mapping[str, Any]) -> WCS:
    from astropy.wcs import WCS, Sip

    system = WCS(naxis=2)
    system.wcs.ctype = [values["CTYPE1"], values["CTYPE2"]]
    for keyword in ("CUNIT1", "CUNIT2"):
        if values[keyword] != "deg":
            raise ValueError(f"{keyword} = {values[keyword]!r} must be 'deg'")
    system.wcs.cunit = ["deg", "deg"]
    system.wcs.crval = [values["CRVAL1"], values["CRVAL2"]]
    system.wcs.crpix = [values["CRPIX1"], values["CRPIX2"]]
    system.wcs.cd = [[values["CD1_1"], values["CD1_2"]], [values["CD2_1"], values["CD2_2"]]]
    system.wcs.lonpole = values["LONPOLE"]
    system.wcs.radesys = values["RADESYS"]
    if str(values["CTYPE1"]).endswith("-SIP"):
        system.sip = Sip(*(_coefficients(values, name) for name in "AB"), None, None, _crpix(system))
    if str(values["CTYPE1"]).endswith("-TPV"):
        system.wcs.ctype = [f"{axis}{_PROJECTIONS[True]}" for axis in ("RA---", "DEC--")]
        system.sip = Sip(*tpv.to_sip(values), None, None, _crpix(system))
    system.wcs.set()
    for attribute, keywords in (("crval", "CRVAL1, CRVAL2"), ("crpix", "CRPIX1, CRPIX2"), ("cd", "CD1_1 to CD2_2")):
        if not np.isfinite(getattr(system.wcs, attribute)).all():
            raise ValueError(f"{keywords} must be finite")
    return system


def _coefficients(values: Mapping[str, Any], name: str) -> Float:
    order = int(values[f"{name}_ORDER"])
    if not 0 <= order <= _MAX_ORDER:
        raise ValueError(f"{name}_ORDER = {order} must be from 0 to {_MAX_ORDER}")
    powers = range(order + 1)
    return np.array([[float(values.get(f"{name}_{p}_{q}", 0.0)) for q in powers] for p in powers])
