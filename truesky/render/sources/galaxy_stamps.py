"""Draw galaxies from a user's library of postage stamps (small galaxy images) instead of Sersic profiles.

A library is a FITS file whose first image has three axes: columns, rows and stamps. The column `stamp` of the table
`galaxies` contains the number of a stamp, counted from 0. A stamp contains a galaxy at its middle, without background,
and large enough for all its visible light. Its scale, flux and orientation are arbitrary.

The galaxy of a table row is drawn with the flux of the row. The half-light semi-major axis of the stamp is scaled to
the mean of the row's bulge and disc, weighted by their light. Its major axis is turned to the row's position angle, and
the image is lensed. Axis ratio and handedness of the stamp do not change otherwise. All bands have the same picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Array, Float, Float32, Int
from lake_schema.errors import BadInput
from lake_schema.fits import external
from lake_schema.store.provenance import file_sha256
from lake_schema.tables.galaxies import DISK_SCALE_HEIGHT
from truesky.numerics import matrices
from truesky.randomness import rng
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.galaxy_shapes import EXPONENTIAL_RADIUS, Shapes
from truesky.render.sources.lensed_arcs import Picture
from truesky.request.structure import Stamps

# Limit of the absolute value of a pixel in a user's galaxy images, so that sums are finite.
_LARGEST = 1e30
# Name of this kind of user file in error messages and in lake_schema.user_files.
KIND = "library of galaxies"
# Column of the table `galaxies` with the number of the stamp (galaxy image in a user's library) to draw.
COLUMN = "stamp"
# Smallest and largest allowed side of a stamp (galaxy image in a user's library), pixels.
_SIDE_BOUNDS = (16, 1024)
# Largest allowed sum of negative pixels in a stamp (galaxy image), as a fraction of its light.
_BELOW = 0.01
# Smallest allowed half-light radius of the galaxy on a stamp, pixels.
_COARSEST = 1.5
# Largest number of iterations in which the weighted second moments of a galaxy image are measured; after them the last
# values are used.
_ROUNDS = 60
# Change of the second moments of a galaxy image, relative to their sum, below which their iteration ends.
_TOLERANCE = 1e-5
# Galaxy images with at least twice this number of pixels per side are binned before their moments are measured.
_MAX_REBINNED_SIDE = 128
# Lower limit of the measured axis ratio (minor to major) of a galaxy image; smaller values are set to this limit.
_SLIMMEST = 0.05
# Number of stamps (galaxy images) nearest to a galaxy in axis ratio and concentration. If its row has no stamp number,
# one of them is chosen at random.
_NEAREST = 8
# Largest diagonal in arcsec of a galaxy image on the sky; wider galaxies are drawn as profiles. The limit is below
# the side of the largest square in which the camera with the finest pixels draws a source.
_WIDEST = 180.0


@dataclass(frozen=True, slots=True)
class Library:
    """A library of n stamps (galaxy images) with their measured shapes; its length is n.

    Attributes
    ----------
    file : Path
        File of the library.
    images : float32 array, shape (n, ny, nx)
        Stamps without negative pixels, each with the sum 1.
    radius : float array, shape (n,)
        Half-light semi-major axis of each galaxy in pixels of its stamp.
    ratio : float array, shape (n,)
        Axis ratio, minor to major, at most 1.
    angle : float array, shape (n,)
        Angle of the major axis in radians, from the direction of increasing column to that of increasing row.
    inner : float array, shape (n,)
        Fraction of the light within half of `radius`, a measure of concentration.
    """

    file: Path
    images: Float32
    radius: Float
    ratio: Float
    angle: Float
    inner: Float

    def __len__(self) -> int:
        return len(self.images)


@lru_cache(maxsize=1)
def read(file: Path, sha256: str) -> Library:
    """Read, check and measure a library of stamps (galaxy images).

    `sha256` is the checksum of the file, which selects the cached result; it is not checked.

    Raises
    ------
    BadInput
        If the file is not an image with three axes or a stamp is too small, too large, noisy or without light. The
        message contains the file and the number of the stamp.

    Notes
    -----
    The half-light radius of a stamp has an error of 1 % if it is 3 pixels or more. Light outside the stamp is not
    counted.
    """
    data, _ = external.read_planes(file, "", KIND)
    try:
        if data.ndim != 3:
            raise BadInput(f"is an image of {data.ndim} axes, but must have three: columns, rows, stamps")
        if not all(_SIDE_BOUNDS[0] <= side <= _SIDE_BOUNDS[1] for side in data.shape[1:]):
            limits = f"{_SIDE_BOUNDS[0]} to {_SIDE_BOUNDS[1]}"
            raise BadInput(
                f"its stamps have {data.shape[2]} x {data.shape[1]} pixels, but {limits} per side is allowed"
            )
        measured = np.array([_measure_stamp(number, stamp) for number, stamp in enumerate(data)])
    except BadInput as error:
        raise BadInput(f"{file}: {error}") from None
    for stamp in data:
        np.maximum(stamp, 0.0, out=stamp)
        stamp /= stamp.sum()
    return Library(file, data.astype(np.float32), *measured.T)


def _measure_stamp(number: int, stamp: Float) -> tuple[float, float, float, float]:
    """Measure the galaxy on a stamp: half-light radius (pixels), axis ratio, angle (rad) and inner fraction of light.

    The radius is the half-light semi-major axis. The angle is that of the major axis, from increasing column to
    increasing row. The inner fraction is the light within half of the half-light radius. Raises BadInput, which quotes
    the index `number` of the stamp, if its pixels are not valid.
    """
    if not (np.abs(stamp) < _LARGEST).all():
        raise BadInput(f"stamp {number} contains values that are not numbers below {_LARGEST:g}")
    total = float(stamp.sum())
    if not total > 1.0 / _LARGEST:
        raise BadInput(f"stamp {number} sums to {total:.4g}, but must have a positive sum")
    if -float(stamp[stamp < 0.0].sum()) > _BELOW * total:
        raise BadInput(f"stamp {number}: negative pixels exceed {_BELOW:g} of its light, noise is not allowed")
    light = np.maximum(stamp, 0.0)
    ratio, angle = _ellipse(light)
    y, x = _places(light)
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    radius = np.hypot(along, across / ratio).ravel()
    order = np.argsort(radius, kind="stable")
    grown = np.cumsum(light.ravel()[order])
    grown = (grown - 0.5 * light.ravel()[order]) / grown[-1]
    half = float(np.interp(0.5, grown, radius[order]))
    if half < _COARSEST:
        raise BadInput(f"stamp {number}: half-light radius is {half:.3g} pixels, but must be at least {_COARSEST:g}")
    return half, ratio, angle, float(np.interp(0.5 * half, radius[order], grown))


def _places(light: Float) -> Float:
    """Return the row and the column of each pixel relative to the middle of an image, shape (2, ny, nx)."""
    return np.asarray(np.mgrid[: light.shape[0], : light.shape[1]] - 0.5 * (np.array(light.shape)[:, None, None] - 1))


def _rebin(light: Float) -> Float:
    """Add up square blocks of pixels of a large stamp, so that its shorter side has 128 to 191 blocks.

    Pixels that do not fill a block are cut off at opposite edges, so that the middle of the stamp stays. Stamps with a
    shorter side below 256 pixels are returned unchanged.
    """
    factor = max(min(light.shape) // _MAX_REBINNED_SIDE, 1)
    cut = [(side % factor) // 2 for side in light.shape]
    rows, columns = (side // factor for side in light.shape)
    central = light[cut[0] : cut[0] + rows * factor, cut[1] : cut[1] + columns * factor]
    return np.asarray(central.reshape(rows, factor, columns, factor).sum(axis=(1, 3)))


def _ellipse(light: Float) -> tuple[float, float]:
    """Return the axis ratio and the angle of the major axis (rad) of the galaxy on a stamp.

    The angle is measured from the direction of increasing column to that of increasing row. Both come from second
    moments with a Gaussian weight that has the shape of the galaxy. If this weight contains no light, the galaxy counts
    as round (1.0, 0.0).

    References
    ----------
    Bernstein & Jarvis 2002, AJ 123, 583 (adaptive moments).
    """
    light = _rebin(light)
    y, x = _places(light)
    xx, xy, yy = (0.05 * light.shape[1]) ** 2, 0.0, (0.05 * light.shape[0]) ** 2
    for _ in range(_ROUNDS):
        previous, area = (xx, xy, yy), xx * yy - xy**2
        weight = np.exp(-0.5 * (yy * x**2 - 2 * xy * x * y + xx * y**2) / area) * light
        total = weight.sum()
        if not total > 0.0:
            return 1.0, 0.0
        xx, xy, yy = (2.0 * float((weight * part).sum() / total) for part in (x * x, x * y, y * y))
        # Keep the Gaussian weight wider than a pixel. Otherwise it could miss all pixels.
        xx, yy = max(xx, 0.5), max(yy, 0.5)
        xy = float(np.clip(xy, -0.99 * np.sqrt(xx * yy), 0.99 * np.sqrt(xx * yy)))
        if max(abs(now - then) for now, then in zip((xx, xy, yy), previous, strict=True)) < _TOLERANCE * (xx + yy):
            break
    mean, half = 0.5 * (xx + yy), float(np.hypot(0.5 * (xx - yy), xy))
    ratio = float(np.sqrt(max(mean - half, 0.0) / (mean + half)))
    return max(ratio, _SLIMMEST), 0.5 * float(np.arctan2(2 * xy, xx - yy))


@dataclass(frozen=True, slots=True)
class GalaxyStamps:
    """Library of stamps (galaxy images) with the options of a request for their use.

    Attributes
    ----------
    library : Library
        The stamps with their measured shapes.
    options : Stamps
        Options of the request: the file, and which galaxies without a stamp number get a stamp.
    seed : int
        Seed of the request, used to draw stamps for these galaxies.
    """

    library: Library
    options: Stamps
    seed: int


def from_file(options: Stamps, seed: int, sha256: str) -> GalaxyStamps:
    """Read a library of stamps (galaxy images), after a check that the file has not changed.

    Parameters
    ----------
    options : Stamps
        Options of the request, with the file.
    seed : int
        Seed of the request, used to draw stamps for galaxies without a stamp number.
    sha256 : str
        Checksum that the file had when the rendering began.

    Returns
    -------
    GalaxyStamps
        The stamps with the options.

    Raises
    ------
    BadInput
        If the file has changed. `read` raises it if the file is not valid.
    """
    if file_sha256(options.file) != sha256:
        raise BadInput(f"{options.file}: has changed since the rendering began")
    return GalaxyStamps(read(options.file, sha256), options, seed)


def assign_pictures(galaxies: pa.Table, shape: Shapes, stamps: GalaxyStamps | None) -> tuple[Int, tuple[Picture, ...]]:
    """Choose a stamp (galaxy image) for each galaxy that has one, and scale, turn and lens it.

    Parameters
    ----------
    galaxies : pyarrow.Table
        n rows of the table `galaxies`.
    shape : Shapes
        Shapes of these galaxies.
    stamps : GalaxyStamps or None
        Library of stamps; None if all galaxies are drawn as profiles.

    Returns
    -------
    (int array, shape (n,), tuple of Picture)
        Index of each galaxy's picture in the tuple, -1 for galaxies that are drawn as profiles; and the pictures.

    Notes
    -----
    BadInput is raised if a row has the number of a stamp that does not exist. A galaxy whose picture would be wider
    than 180 arcsec is drawn as a profile.
    """
    number = np.full(len(galaxies), -1)
    if stamps is None or not len(galaxies):
        return number, ()
    ids, library = galaxies["id"].to_numpy().astype(np.int64), stamps.library
    stamp = _stamps_in_rows(galaxies, library)
    if stamps.options.nearest:
        half_light_radius = shape.bulge_fraction * shape.bulge_radius + (1 - shape.bulge_fraction) * shape.disk_radius
        free = np.flatnonzero((stamp < 0) & (half_light_radius >= stamps.options.least_radius))
        stamp[free] = _draw_stamps(ids[free], shape.take(free), library, stamps.seed)
    with_stamp = np.flatnonzero(stamp >= 0)
    stamp_matrices = _matrices(shape.take(with_stamp), library, stamp[with_stamp])
    pictures = [
        Picture(library.images[stamp_number], matrix)
        for stamp_number, matrix in zip(stamp[with_stamp], stamp_matrices, strict=True)
    ]
    fits = np.array([picture.diagonal < _WIDEST for picture in pictures], bool)
    number[with_stamp[fits]] = np.arange(int(fits.sum()))
    return number, tuple(picture for picture, fit in zip(pictures, fits, strict=True) if fit)


def _stamps_in_rows(galaxies: pa.Table, library: Library) -> Int:
    """Return the number of the stamp in each row of the table `galaxies`, -1 for rows without one.

    Raises BadInput if the library has no stamp of that number.
    """
    if COLUMN not in galaxies.column_names:
        return np.full(len(galaxies), -1)
    named: Array = galaxies[COLUMN].fill_null(-1).to_numpy().astype(np.int64)
    if (bad := named >= len(library)).any():
        row = int(bad.argmax())
        label = f"galaxy {galaxies['id'][row].as_py()}: stamp {named[row]}"
        raise BadInput(f"{label} does not exist, {library.file} has stamps 0 to {len(library) - 1}")
    return named


def _draw_stamps(ids: Int, shape: Shapes, library: Library, seed: int) -> Int:
    """Return for each galaxy the number of one of the eight stamps nearest in shape, drawn at random.

    Shape means axis ratio and concentration. The same galaxy identifier and seed always give the same stamp.
    """
    fraction = shape.bulge_fraction
    disk = np.hypot(np.cos(np.radians(shape.inclination)), DISK_SCALE_HEIGHT)
    ratio = fraction * shape.bulge_axis_ratio + (1 - fraction) * np.minimum(disk, 1.0)
    inner = 1.0 - galaxy_shapes.flux_outside(shape, 0.5 * galaxy_shapes.half_light(shape))
    count = min(_NEAREST, len(library))
    turn = (rng.uniforms(ids, 1, seed, "galaxy stamps")[0] * count).astype(np.int64)
    stamp = np.empty(len(ids), np.int64)
    for i in range(len(ids)):
        distance = (library.ratio - ratio[i]) ** 2 + (library.inner - inner[i]) ** 2
        stamp[i] = np.argsort(distance, kind="stable")[turn[i]]
    return stamp


def _matrices(shape: Shapes, library: Library, stamp: Int) -> Float:
    """Return the matrices that place stamps (galaxy images) on the sky, arcsec per pixel, shape (n, 2, 2).

    The columns of a matrix are a step of one column and of one row of the stamp, its rows the offsets to the west and
    north. `stamp` has the number of the stamp in `library` for each of the n galaxies in `shape`.
    """
    half_light_radius = shape.bulge_fraction * shape.bulge_radius + (1 - shape.bulge_fraction) * shape.disk_radius
    face_on = Shapes(
        np.zeros(len(half_light_radius)),
        half_light_radius * EXPONENTIAL_RADIUS / library.radius[stamp],
        np.zeros(len(half_light_radius)),
        shape.sersic_index,
        shape.bulge_axis_ratio,
        np.zeros(len(half_light_radius)),
        shape.beta,
        shape.g1,
        shape.g2,
        shape.magnification,
    )
    disk_matrices = galaxy_shapes.forms(face_on, np.broadcast_to(np.eye(2), (len(half_light_radius), 2, 2))).disk
    cosine, sine = np.cos(library.angle[stamp]), np.sin(library.angle[stamp])
    back = np.stack([np.stack([cosine, sine], -1), np.stack([-sine, cosine], -1)], -2)
    return np.asarray(matrices.matmul(disk_matrices, back))
