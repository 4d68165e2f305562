"""World coordinate systems (WCS) of frames of other telescopes: read and check them, and find pixels of sky positions.

All projections and distortions that astropy knows are allowed, such as TAN, TAN-SIP and TPV.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from truesky.numerics import matrices
from truesky.render.camera import astrometry, pointing
from truesky.render.camera.pointing import ARCSEC

if TYPE_CHECKING:
    # Imported in the functions that use it, because its import takes a second.
    from astropy.wcs import WCS

# Number of positions along each side of the frame at which it is checked that the WCS can be inverted.
_CHECKED = 5
# Pixel positions are found by iteration until the last step is below this number of pixels.
_TOLERANCE = 1e-8
# Largest number of steps of this iteration.
_MAX_STEPS = 30
# Difference, in pixels, up to which a pixel must be found again from its position on the sky.
_SAME_PIXEL = 1e-3
# Positions farther from the middle of the frame than this multiple of the distance of its corners are ignored.
_MAX_DISTANCE = 3.0
# Smallest and largest pixel scale, arcsec.
_SCALES = (1e-4, 3600.0)


def read_wcs(place: str, header: Any, nx: int, ny: int) -> WCS:
    """Return the WCS in a header of a frame, after checking that it can be inverted in the whole frame.

    Parameters
    ----------
    place : str
        Name of the file, for error messages.
    header : astropy.io.fits.Header
        Header of the image.
    nx, ny : int
        Number of columns and rows of the image.

    Returns
    -------
    WCS
        The WCS.

    Raises
    ------
    BadInput
        If the header has no celestial WCS, its axes are not right ascension and declination in this order, or a sky
        position may appear on several pixels.
    """
    from astropy.wcs import WCS

    if not all(f"CTYPE{axis}" in header for axis in (1, 2)):
        raise BadInput(f"{place}: has no WCS: the cards CTYPE1 and CTYPE2 are missing")
    axes = [str(header[f"CTYPE{axis}"]) for axis in (1, 2)]
    if [axis[:4] for axis in axes] != ["RA--", "DEC-"]:
        raise BadInput(
            f"{place}: CTYPE1, CTYPE2 = {axes[0]!r}, {axes[1]!r} must be RA and DEC, such as RA---TAN, DEC--TAN"
        )
    try:
        with warnings.catch_warnings():
            # astropy warns, for example, if it only changes the format of a date.
            warnings.simplefilter("ignore")
            system = WCS(header, naxis=2)
            system.wcs.set()
            _check_invertible(system, nx, ny)
    except BadInput as error:
        raise BadInput(f"{place}: {error}") from None
    except Exception as error:
        # astropy raises many types of exceptions for wrong headers.
        raise BadInput(f"{place}: its WCS cannot be used: {' '.join(str(error).split())[:300]}") from None
    return system


def pixel_scale(system: WCS, nx: int, ny: int) -> float:
    """Return the side of a pixel in the middle of a frame.

    Parameters
    ----------
    system : WCS
        World coordinate system of the frame.
    nx, ny : int
        Number of columns and rows of the frame.

    Returns
    -------
    float
        Square root of the sky area of the pixel, arcsec.
    """
    middle = astrometry.jacobian(system, [(nx - 1) / 2], [(ny - 1) / 2])
    return float(np.sqrt(np.abs(_determinant(middle)))[0])


def pixels_of_sky(system: WCS, ra: Float, dec: Float, nx: int, ny: int) -> tuple[Float, Float]:
    """Return the pixels of sky positions on and near a frame, by Newton's method.

    Parameters
    ----------
    system : WCS
        World coordinate system of the frame.
    ra, dec : float array, shape (n,)
        Positions in the coordinates of the WCS, deg.
    nx, ny : int
        Number of columns and rows of the frame.

    Returns
    -------
    (float array, float array), each of shape (n,)
        Columns and rows, 0-based, to 1e-8 pixels; NaN for positions that are far from the frame. The result for a
        position does not depend on the other positions.
    """
    column, row = np.full((2, len(ra)), np.nan)
    middle = (nx - 1) / 2, (ny - 1) / 2
    start = pointing.basis(*astrometry.sky_of_pixel(system, [middle[0]], [middle[1]]))
    corner = pointing.basis(*astrometry.sky_of_pixel(system, [-0.5, nx, nx, -0.5], [-0.5, -0.5, ny, ny]))[2]
    target = pointing.basis(ra, dec)[2]
    # Chords on the unit sphere instead of angles. All of them are small.
    is_near = _length(target - start[2]) < _MAX_DISTANCE * _length(corner - start[2]).max()
    active = np.flatnonzero(is_near)
    x, y = np.full(len(ra), middle[0]), np.full(len(ra), middle[1])
    for _ in range(_MAX_STEPS):
        if not len(active):
            break
        east, north, outward = pointing.basis(*astrometry.sky_of_pixel(system, x[active], y[active]))
        towards = target[:, active]
        depth = np.sum(outward * towards, 0)
        west_north = np.stack([-np.sum(east * towards, 0), np.sum(north * towards, 0)]) / depth / ARCSEC
        slopes = astrometry.jacobian(system, x[active], y[active])
        with np.errstate(all="ignore"):
            step = matrices.matmul(matrices.inverse(slopes), west_north.T[:, :, None])[:, :, 0]
        x[active] += step[:, 0]
        y[active] += step[:, 1]
        finite = np.isfinite(step).all(axis=1)
        done = finite & (np.abs(step).max(axis=1) < _TOLERANCE)
        column[active[done]], row[active[done]] = x[active[done]], y[active[done]]
        active = active[finite & ~done]
    return column, row


def _length(vectors: Float) -> Float:
    return np.asarray(np.sqrt(np.sum(vectors**2, axis=0)))


def _determinant(slopes: Float) -> Float:
    return np.asarray(slopes[:, 0, 0] * slopes[:, 1, 1] - slopes[:, 0, 1] * slopes[:, 1, 0])


def _check_invertible(system: WCS, nx: int, ny: int) -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(0, nx - 1, _CHECKED), np.linspace(0, ny - 1, _CHECKED)))
    areas = _determinant(astrometry.jacobian(system, x, y))
    scales = np.sqrt(np.abs(areas))
    if not (np.isfinite(areas).all() and (np.sign(areas) == np.sign(areas[0])).all()):
        raise BadInput("its WCS cannot be inverted: some positions on the sky appear on several pixels or on none")
    if not ((scales >= _SCALES[0]) & (scales <= _SCALES[1])).all():
        raise BadInput(
            f"its WCS has pixels of {scales.min():.3g} arcsec, but {_SCALES[0]:g} to {_SCALES[1]:g} is allowed"
        )
    column, row = pixels_of_sky(system, *astrometry.sky_of_pixel(system, x, y), nx, ny)
    if not (np.hypot(column - x, row - y) < _SAME_PIXEL).all():
        raise BadInput("its WCS cannot be inverted: some positions on the sky appear on several pixels or on none")
