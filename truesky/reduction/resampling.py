"""Calibrated images onto the pixels of another map of the sky: drizzle, with pixels of their full size.

A pixel's electrons are spread evenly over its place on the sky; a pixel of the grid gets what falls onto it. No light
is lost or made, and neighbours of the grid share noise.

Grid          the pixels of the stack
grid_of       one that covers images, north up
pixel_map     where an image's pixels lie on a grid, and their areas there
resampled     an image on a grid

Ref : Fruchter & Hook 2002, PASP 114, 144
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

# Pixels between the places that are projected; between them the map is a cubic spline: 1e-6 pixels.
_NODES = 64
# Side of a grid.
_MAX_SIDE = 60_000


@dataclass(frozen=True, slots=True)
class Grid:
    """Pixels of a map of the sky; shape : (ny, nx)."""

    wcs: WCS
    shape: tuple[int, int]

    def window(self, x: int, y: int, shape: tuple[int, int]) -> Grid:
        """A part of it, of which (x, y) is the first pixel."""
        return Grid(astrometry.shift_pixels(self.wcs, -x, -y), shape)


@dataclass(frozen=True, slots=True)
class ResampledImage:
    """An image on a grid, float32[ny, nx].

    image    : light in a pixel of the grid, 0 where there is none
    cover    : which part of the pixel good pixels of the image cover
    variance : of the pixel;  density : of a sum over many pixels, divided by their number: neighbours share noise
    """

    image: Float32
    cover: Float32
    variance: Float32
    density: Float32


def covering_grid(images: Sequence[tuple[WCS, tuple[int, ...]]], scale: float) -> Grid:
    """A gnomonic map, north up, that covers images (their systems and shapes); scale : arcsec a pixel."""
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
    # Edges bend: a pixel more on every side.
    first = [int(np.floor(v.min())) - 1 for v in (x, y)]
    nx, ny = (int(np.ceil(v.max())) + 2 - low for v, low in zip((x, y), first, strict=True))
    if max(nx, ny) > _MAX_SIDE:
        raise BadInput(f"images so far apart make a stack of {ny} x {nx} pixels: more than {_MAX_SIDE} along a side")
    return Grid(astrometry.shift_pixels(system, -first[0], -first[1]), (ny, nx))


def _corners(shape: tuple[int, ...]) -> tuple[Float, Float]:
    ny, nx = shape
    # The middles of the sides, too: distortion bends them.
    x, y = np.meshgrid([-0.5, nx / 2, nx - 0.5], [-0.5, ny / 2, ny - 0.5])
    return x.ravel(), y.ravel()


def pixel_map(system: WCS, shape: tuple[int, ...], grid: Grid) -> tuple[Float, Float]:
    """(x and y on the grid [ny, nx, 2] of an image's pixels, their areas there [ny, nx], in its pixels)."""
    nodes = [np.linspace(0.0, n - 1.0, max(n // _NODES + 1, 4)) for n in shape]
    columns, rows = np.meshgrid(nodes[1], nodes[0])
    sky = astrometry.sky_of_pixel(system, columns.ravel(), rows.ravel())
    at = [place.reshape(columns.shape) for place in astrometry.pixel_of_sky(grid.wcs, *sky)]
    splines = [RectBivariateSpline(nodes[0], nodes[1], values) for values in at]
    y, x = (np.arange(float(n)) for n in shape)
    (dx_dy, dx_dx), (dy_dy, dy_dx) = ((spline(y, x, dx=1), spline(y, x, dy=1)) for spline in splines)
    return np.stack([spline(y, x) for spline in splines], axis=-1), np.abs(dx_dx * dy_dy - dx_dy * dy_dx)


def resample(image: ReducedImage, pixmap: Float, area: Float, shape: tuple[int, int]) -> ResampledImage:
    """An image on a grid of a shape; of its pixels those that have weight.

    pixmap, area : where its pixels lie, of `pixel_map`
    Error : float32; a pixel's sides are taken as straight, and its light as even
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
    # The weight of a pixel is the part of its own area that falls onto the grid's.
    cover = np.asarray(image_drizzle.out_wht, np.float32) * float(np.mean(area))
    return ResampledImage(
        _without_nan(image_drizzle.out_img),
        cover,
        _without_nan(image_drizzle.out_img2[0]),
        _without_nan(density_drizzle.out_img),
    )


def _without_nan(values: Array) -> Float32:
    return np.nan_to_num(np.asarray(values, np.float32), copy=False, nan=0.0)
