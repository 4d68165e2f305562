"""Stack calibrated images of one field in one band on a common map of the sky.

    truesky stack FILE .. --out FILE.fits [--scale ARCSEC] [--lake LAKE [--name REQUEST]]

The extensions of the stack are SCI (electrons per second in each pixel, including the sky), WHT and FLG (flag bits).
The sum over n pixels has the variance n / WHT. The noise of neighbouring pixels is correlated, so the variance of a
single pixel is smaller: 1 / WHT divided by the header value CORRVAR. With --lake, the extension PSF has the image of a
point source near the centre, with three samples per pixel along each axis.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from astropy.wcs import WCS
from scipy import ndimage

from lake_schema import __version__, command, user_files
from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.fits.images import Card, Image
from lake_schema.store import layout
from truesky.command_line import commands
from truesky.reduction import files, point_sources, stacking
from truesky.reduction import frames as lake_frames
from truesky.reduction.calibration import COSMIC_RAY, ReducedImage
from truesky.reduction.files import ImageFile
from truesky.reduction.frames import Frame
from truesky.reduction.resampling import Grid, ResampledImage, covering_grid, pixel_map, resample
from truesky.reduction.stacking import Contribution, Stack
from truesky.render.camera import astrometry

# Header keywords whose values must be equal in all images of a stack.
_SHARED_CARDS = ("INSTRUME", "CHANNEL", "FILTER", "ZEROPNT")
# Other keywords that each image must have.
_REQUIRED_CARDS = ("IMAGETYP", "DETECTOR")
# Keywords that each image must have with a number above 0 as value.
_NUMBER_CARDS = ("EXPOSURE", "EXPTIME", "GAIN", "PIXSCALE")


def to_rate(image: ImageFile) -> ReducedImage:
    """Convert a calibrated image from its unit (electrons or counts) to electrons per second.

    An image that is already in electrons per second is returned unchanged. Weights are converted, too. The header must
    have EXPTIME (exposure time in seconds) and GAIN (electrons per unit of the image).
    """
    if image.card("BUNIT") == "electron/s":
        return image.reduced
    # Value in the image that 1 electron per second gives: exposure time divided by electrons per unit.
    units_per_rate = float(image.card("EXPTIME")) / float(image.card("GAIN"))
    counts = image.reduced
    return ReducedImage(
        (counts.image / units_per_rate).astype(np.float32),
        (counts.weight * units_per_rate**2).astype(np.float32),
        counts.flags,
    )


def stack_images(images: Sequence[tuple[ReducedImage, WCS]], scale: float) -> tuple[Stack, Grid, list[float]]:
    """Resample images to a common grid that covers every image, and average them without outliers.

    Parameters
    ----------
    images : sequence of (ReducedImage, WCS)
        Images in electrons per second, with their WCS; at least one.
    scale : float
        Pixel scale of the stack in arcsec, 0.001 to 100.

    Returns
    -------
    stack : Stack
        The average.
    grid : Grid
        WCS and shape of the stack.
    weights : list of float
        Weight of each image: the median of its weights above 0, or 0 if it has no good pixel.
    """
    grid = covering_grid([(system, image.image.shape) for image, system in images], scale)
    placed: list[ResampledImage] = []
    weights = []
    for image, system in images:
        pixmap, area = pixel_map(system, image.image.shape, grid)
        placed.append(resample(image, pixmap, area, grid.shape))
        good = image.weight > 0.0
        weights.append(float(np.median(image.weight[good])) if good.any() else 0.0)
    return stacking.combine(placed, weights), grid, weights


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command `truesky stack`, print a line about the stack, and return the exit status.

    `argv` are the arguments of the command; None means the arguments of the process.
    """
    return commands.run("stack", run_command, argv)


def run_command(options: argparse.Namespace) -> int:
    """Run `truesky stack` with its parsed arguments, and return the exit status 0; errors are raised as LakeError."""
    out = user_files.check_target(options.out, (".fits",))
    _refuse_missing(options.images)
    images = [files.read_image(path) for path in options.images]
    _refuse_different(options.images, images)
    systems = [astrometry.from_cards(image.cards) for image in images]
    scale = float(images[0].card("PIXSCALE")) if options.scale is None else options.scale
    shapes = [image.reduced.image.shape for image in images]
    stack, grid, weights = stack_images(list(zip(map(to_rate, images), systems, strict=True)), scale)
    extensions = []
    if options.lake:
        frames = _find_frames(layout.resolve_lake(options.lake), images, options.name)
        contributions = [
            Contribution(system, shape, point_sources.profile(frame), frame.scene.detector.pixel_scale, weight)
            for system, shape, frame, weight in zip(systems, shapes, frames, weights, strict=True)
            if frame.scene.detector is not None
        ]
        extensions.append(_central_psf(contributions, grid, stack))
    correlation = stacking.noise_correlation(stack)
    files.write_image(out, stack.reduced, _stack_cards(images, grid, scale, correlation), extensions)
    ny, nx = grid.shape
    hit = float(((stack.reduced.flags & COSMIC_RAY) > 0).mean())
    print(
        f"{out}: {len(images)} images on {ny} x {nx} pixels of {scale:g} arcsec, "
        f"{100 * hit:.2f} % with a value rejected, "
        f"variance of 8x8 sums {correlation:.2f} times that of independent pixels"
    )
    return 0


def _refuse_missing(paths: Sequence[Path]) -> None:
    for path in paths:
        if not os.path.exists(path):
            problem = "no file matches this pattern" if any(mark in path.name for mark in "*?[") else "no such file"
            remedy = "give calibrated images, which truesky reduce LAKE --out FOLDER writes"
            raise BadInput(f"{user_files.format_path(path)}: {problem}; {remedy}")


def _refuse_different(paths: Sequence[Path], images: Sequence[ImageFile]) -> None:
    for path, image in zip(paths, images, strict=True):
        _refuse_other(path, image)
        for keyword in _SHARED_CARDS:
            if image.card(keyword) != images[0].card(keyword):
                problem = f"{keyword} = {image.card(keyword)}, but {paths[0].name} has {images[0].card(keyword)}"
                raise BadInput(f"{user_files.format_path(path)}: {problem}: images of a stack must have equal values")
    identities = [(image.card("EXPOSURE"), image.card("DETECTOR")) for image in images]
    for path, identity in zip(paths, identities, strict=True):
        if identities.count(identity) > 1:
            raise BadInput(
                f"{user_files.format_path(path)}: exposure {identity[0]}, detector {identity[1]} is given twice"
            )


def _refuse_other(path: Path, image: ImageFile) -> None:
    """Check that a file is a calibrated image of the command `truesky reduce` with all required keywords.

    Raises BadInput for a stack, a missing keyword, or a number that is not above 0.
    """
    if image.card("IMAGETYP") == "stack":
        raise BadInput(f"{user_files.format_path(path)}: is a stack: use the images from which it was made")
    for keyword in (*_SHARED_CARDS, *_REQUIRED_CARDS, *_NUMBER_CARDS):
        value = image.card(keyword)
        if value is None:
            raise BadInput(f"{user_files.format_path(path)}: has no card {keyword}")
        if keyword in _NUMBER_CARDS and not (isinstance(value, int | float) and 0.0 < value < np.inf):
            raise BadInput(f"{user_files.format_path(path)}: {keyword} = {value!r} must be a number above 0")


def _find_frames(root: Path, images: Sequence[ImageFile], request: str | None) -> list[Frame]:
    """Return the raw frames in the lake from which the images were made, in the order of `images`.

    Frames are identified by exposure number and detector. Raises BadInput if one is missing.
    """
    numbers = {int(image.card("EXPOSURE")) for image in images}
    names = sorted({str(image.card("DETECTOR")) for image in images})
    frames_by_key = {
        (frame.exposure.exposure_id, frame.detector): frame
        for frames in lake_frames.from_lake(root, names, numbers, request).values()
        for frame in frames
    }
    keys = [(int(image.card("EXPOSURE")), str(image.card("DETECTOR"))) for image in images]
    for number, detector in keys:
        if (number, detector) not in frames_by_key:
            raise BadInput(f"lake {root}: table products has no image of exposure {number}, detector {detector}")
    return [frames_by_key[key] for key in keys]


def _central_psf(contributions: Sequence[Contribution], grid: Grid, stack: Stack) -> Image:
    """Return the extension PSF: the effective PSF in the deepest part of the stack, with its position in the header."""
    x, y = _deepest_place(stack.reduced.weight)
    ra, dec = astrometry.sky_of_pixel(grid.wcs, [x], [y])
    cards: tuple[Card, ...] = (
        ("PSFSAMP", stacking.PSF_SAMPLES, "PSF samples per pixel along each axis"),
        ("PSFRA", float(ra[0]), "[deg] right ascension of the PSF"),
        ("PSFDEC", float(dec[0]), "[deg] declination of the PSF"),
    )
    return Image(stacking.effective_psf(contributions, grid, x, y).astype(np.float32), cards, "PSF")


def _deepest_place(weight: Float) -> tuple[float, float]:
    """Return (x, y) of a central pixel in the deepest part of a stack: the 25 % of the pixels with the highest weights.

    If possible, the pixel is at least half a PSF image away from pixels without data. The result is (0, 0) if all
    weights are 0.
    """
    if not weight.any():
        return 0.0, 0.0
    deep = weight >= np.percentile(weight[weight > 0.0], 75.0)
    inside = deep & ndimage.binary_erosion(weight > 0.0, np.ones((3, 3), bool), iterations=stacking.PSF_SIDE // 2)
    rows, columns = np.nonzero(inside if inside.any() else deep)
    nearest = int(np.argmin((columns - columns.mean()) ** 2 + (rows - rows.mean()) ** 2))
    return float(columns[nearest]), float(rows[nearest])


def _stack_cards(images: Sequence[ImageFile], grid: Grid, scale: float, correlation: float) -> tuple[Card, ...]:
    first = images[0]
    keywords = (*_SHARED_CARDS, "BAND", "SEED", "MISSION")
    shared_cards = {key: (key, value, comment) for key, value, comment in first.cards if key in keywords}
    exposures = sorted({(int(image.card("EXPOSURE")), float(image.card("EXPTIME"))) for image in images})
    return (
        *shared_cards.values(),
        ("IMAGETYP", "stack", "image type"),
        ("BUNIT", "electron/s", "unit of SCI; unit of WHT is its inverse square"),
        ("GAIN", sum(time for _, time in exposures), "[electron/BUNIT] gain of the deepest pixels"),
        ("NCOMBINE", len(images), "number of combined images"),
        ("TEXPTIME", sum(time for _, time in exposures), "[s] total exposure time"),
        ("PIXSCALE", scale, "[arcsec/pix] pixel scale"),
        *(
            ()
            if np.isnan(correlation)
            else (("CORRVAR", round(correlation, 4), "variance of 8x8 sums / (64 x pixel variance)"),)
        ),
        *((f"EXPOS{i}", number, "exposure identifier") for i, (number, _) in enumerate(exposures, start=1)),
        *astrometry.cards(grid.wcs),
        *files.flag_cards(),
        ("TRUESKY", __version__, "version of the simulator"),
    )


if __name__ == "__main__":
    command.exit_with_status(main)
