"""Resample calibrated images to the pixels of another map of the sky, by drizzle with pixfrac = 1.

The light of an input pixel is distributed evenly over the pixel's area on the sky. A pixel of the output grid receives
the light that falls into it. The total light is conserved except at the edges, where partly covered pixels get the
light of completely covered ones. Neighbouring pixels of the grid have correlated noise.

References
----------
Fruchter & Hook 2002, PASP 114, 144.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from astropy.wcs import WCS
from drizzle.resample import Drizzle
from scipy.interpolate import RectBivariateSpline

from lake_schema.arrays import Array, Float, Float32
from lake_schema.errors import BadInput, OutOfRange
from truesky.reduction.calibration import ReducedImage
from truesky.render.camera import astrometry, pointing

# Spacing in pixels of the positions that are projected with the WCS. Cubic splines between them are exact to 1e-6.
_NODES = 64
# Largest allowed side of an output grid in pixels.
_MAX_SIDE = 60_000


@dataclass(frozen=True, slots=True)
class Grid:
    """Map of the sky to which images are resampled: its WCS, and its shape (ny, nx) in pixels."""

    wcs: WCS
    shape: tuple[int, int]

    def window(self, x: int, y: int, shape: tuple[int, int]) -> Grid:
        """Return a rectangular section of the grid, whose pixels have the same positions on the sky.

        Parameters
        ----------
        x, y : int
            Column and row of the section's first pixel, from 0. The section may extend beyond the grid.
        shape : (int, int)
            Shape (ny, nx) of the section.

        Returns
        -------
        Grid
            The section, whose pixel coordinates begin at 0.
        """
        return Grid(astrometry.shift_pixels(self.wcs, -x, -y), shape)


@dataclass(frozen=True, slots=True)
class ResampledImage:
    """An image that was resampled to an output grid; all arrays are float32[ny, nx] of this grid.

    Attributes
    ----------
    image : float32 array
        Light in each pixel of the grid, in the unit of the input image; 0 without data. A pixel that is only partly
        covered has the light that it would have if it were covered completely with the same mean brightness.
    cover : float32 array
        Fraction of the area of each grid pixel that is covered by good input pixels, 0 to about 1.
    variance : float32 array
        Variance of each single pixel.
    density : float32 array
        Variance of the sum over a large area, divided by its number of pixels. It is larger than `variance`, because
        neighbouring pixels have correlated noise.
    """

    image: Float32
    cover: Float32
    variance: Float32
    density: Float32


def covering_grid(images: Sequence[tuple[WCS, tuple[int, ...]]], scale: float) -> Grid:
    """Return a grid in gnomonic projection with north up that covers several images.

    Parameters
    ----------
    images : sequence of (WCS, tuple of int)
        WCS and shape (ny, nx) of each image, at least one image.
    scale : float
        Pixel scale of the grid in arcsec, 0.001 to 100.

    Returns
    -------
    Grid
        The grid. The mean of the images' positions is the reference point of its projection.

    Raises
    ------
    OutOfRange
        If the scale is out of range.
    BadInput
        If a side of the grid would be longer than 60,000 pixels.
    """
    if not 1e-3 <= scale <= 100.0:
        raise OutOfRange("scale of the stack, arcsec", scale, 1e-3, 100.0)
    corners = [astrometry.sky_of_pixel(system, *_corners(shape)) for system, shape in images]
    ra, dec = (np.concatenate([corner[i] for corner in corners]) for i in (0, 1))
    middle = np.mean(pointing.basis(ra, dec)[2], axis=1)
    centre = (
        float(np.degrees(np.arctan2(middle[1], middle[0])) % 360.0),
        float(np.degrees(np.arctan2(middle[2], np.hypot(*middle[:2])))),
    )
    system = WCS(naxis=2)
    system.wcs.ctype, system.wcs.cunit = ["RA---TAN", "DEC--TAN"], ["deg", "deg"]
    system.wcs.crval, system.wcs.crpix = list(centre), [1.0, 1.0]
    system.wcs.cd = np.array([[-1.0, 0.0], [0.0, 1.0]]) * scale / 3600.0
    system.wcs.radesys, system.wcs.lonpole = "ICRS", 180.0
    system.wcs.set()
    x, y = astrometry.pixel_of_sky(system, ra, dec)
    # Add a pixel on each side, because the edges of images are curved on the sky.
    first = [int(np.floor(v.min())) - 1 for v in (x, y)]
    nx, ny = (int(np.ceil(v.max())) + 2 - low for v, low in zip((x, y), first, strict=True))
    if max(nx, ny) > _MAX_SIDE:
        raise BadInput(f"images are too far apart: {ny} x {nx} pixels, at most {_MAX_SIDE} are allowed along a side")
    return Grid(astrometry.shift_pixels(system, -first[0], -first[1]), (ny, nx))


def _corners(shape: tuple[int, ...]) -> tuple[Float, Float]:
    ny, nx = shape
    # Include the centres of the four sides: distortion may bend a side outwards, beyond its corners.
    x, y = np.meshgrid([-0.5, nx / 2, nx - 0.5], [-0.5, ny / 2, ny - 0.5])
    return x.ravel(), y.ravel()


def pixel_map(system: WCS, shape: tuple[int, ...], grid: Grid) -> tuple[Float, Float]:
    """Return the position and the area of each pixel of an image, in pixels of an output grid.

    Parameters
    ----------
    system : WCS
        WCS of the image.
    shape : tuple of int
        Shape (ny, nx) of the image.
    grid : Grid
        The output grid.

    Returns
    -------
    pixmap : float array, shape (ny, nx, 2)
        Coordinates (x, y) of each image pixel's centre on the grid, from 0. They may be outside the grid.
    area : float array, shape (ny, nx)
        Area of each image pixel in units of a grid pixel.
    """
    nodes = [np.linspace(0.0, n - 1.0, max(n // _NODES + 1, 4)) for n in shape]
    columns, rows = np.meshgrid(nodes[1], nodes[0])
    sky = astrometry.sky_of_pixel(system, columns.ravel(), rows.ravel())
    at = [place.reshape(columns.shape) for place in astrometry.pixel_of_sky(grid.wcs, *sky)]
    splines = [RectBivariateSpline(nodes[0], nodes[1], values) for values in at]
    y, x = (np.arange(float(n)) for n in shape)
    (dx_dy, dx_dx), (dy_dy, dy_dx) = ((spline(y, x, dx=1), spline(y, x, dy=1)) for spline in splines)
    return np.stack([spline(y, x) for spline in splines], axis=-1), np.abs(dx_dx * dy_dy - dx_dy * dy_dx)


def resample(image: ReducedImage, pixmap: Float, area: Float, shape: tuple[int, int]) -> ResampledImage:
    """Resample an image to an output grid; only its pixels with a weight above 0 are used.

    Parameters
    ----------
    image : ReducedImage
        The image.
    pixmap : float array, shape (ny, nx, 2)
        Coordinates (x, y) of the image's pixels on the grid, from `pixel_map`.
    area : float array, shape (ny, nx)
        Areas of the image's pixels in grid pixels, from `pixel_map`.
    shape : (int, int)
        Shape (ny, nx) of the grid.

    Returns
    -------
    ResampledImage
        The image on the grid, with cover 0 in grid pixels that no good image pixel reaches.

    Notes
    -----
    Results are in single precision. Pixels are assumed to have straight sides and uniform light.
    """
    good = image.weight > 0.0
    variance = np.zeros(image.weight.shape, np.float32)
    np.divide(1.0, image.weight, out=variance, where=good)
    brightness = np.where(good, image.image / area, 0.0).astype(np.float32)
    image_drizzle = Drizzle(kernel="square", out_shape=shape, fillval="0", disable_ctx=True)
    common = {"exptime": 1.0, "pixmap": pixmap, "weight_map": good.astype(np.float32), "pixfrac": 1.0}
    image_drizzle.add_image(brightness, data2=(variance / area**2).astype(np.float32), **common)
    density_drizzle = Drizzle(kernel="square", out_shape=shape, fillval="0", disable_ctx=True)
    density_drizzle.add_image((variance / area).astype(np.float32), **common)
    # Drizzle's weights are sums of fractions of image pixels. Times the area of an image pixel they are the covered
    # fraction of a grid pixel.
    cover = np.asarray(image_drizzle.out_wht, np.float32) * float(np.mean(area))
    return ResampledImage(
        _without_nan(image_drizzle.out_img),
        cover,
        _without_nan(image_drizzle.out_img2[0]),
        _without_nan(density_drizzle.out_img),
    )


def _without_nan(values: Array) -> Float32:
    return np.nan_to_num(np.asarray(values, np.float32), copy=False, nan=0.0)
