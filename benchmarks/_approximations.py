"""Approximations with which other programs draw galaxies faster, built into the drawing code of truesky.

Serrano et al. 2024 describe them in sections 4 and 6.2. Each is applied only to the galaxies for which it is meant, so
that its error and its gain of time can be measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.ndimage import zoom
from scipy.special import gammaincinv

from benchmarks import _scenes as scenes
from benchmarks._scenes import Scene
from lake_schema.arrays import Float, Int
from truesky.render.drawing import stamp_sizes, stamps
from truesky.render.drawing.settings import Settings
from truesky.render.psf import model
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.source_list import Sources

# Fraction of a galaxy's light that may lie outside its stamp, called folding threshold in galsim. Serrano et al. 2024
# use this value and the next three.
FOLDING = 5e-3
# Galaxies with a smaller half-light radius (arcsec) are drawn as exponential discs.
TINY = 0.01
# Galaxies with a larger half-light radius (arcsec) are drawn at lower resolution.
HUGE = 10.0
# Fainter galaxies (mag) have one component in place of bulge and disc. In the paper this is the magnitude limit of VIS;
# in these benchmarks about two thirds of the galaxies on a detector are fainter.
FAINT = 24.5


Value = TypeVar("Anything")


def _identity(value: Value) -> Value:
    return value


def _stamp_sizes(sources: Sources, psf: model.Psf, scene: Scene, settings: Settings) -> Int:
    return stamp_sizes.stamp_sizes(sources.electrons, sources.shape, sources.shapes, psf, scene.noise, settings)


@dataclass(frozen=True)
class Approximation:
    """An approximation of drawing galaxies, given by functions; by default they change nothing.

    Attributes
    ----------
    name : str
        Name of the approximation in tables.
    select_galaxies : callable
        Function (detector, seed, number) -> Sources that draws a sample of the galaxies for which it is meant.
    simplify : callable
        Function that simplifies the profiles of galaxies.
    simplify_psf : callable
        Function that simplifies the PSF.
    sizes : callable
        Function that returns the sides of the stamps (small images of single galaxies) in pixels.
    process_image : callable
        Function that changes the drawn image.
    sample_sizes : tuple of int
        Number of galaxies to measure errors, number of galaxies to measure the bias of shear, and number of galaxies to
        measure the time (0 for all galaxies of a detector).
    timed_as : Approximation or None
        Approximation whose time is measured in place of this one, if the drawing code would not become faster by this
        one; None to measure this one.
    """

    name: str
    select_galaxies: Callable[[Scene, int, int], Sources] = scenes.sample
    simplify: Callable[[Sources], Sources] = _identity
    simplify_psf: Callable[[model.Psf], model.Psf] = _identity
    sizes: Callable[[Sources, model.Psf, Scene, Settings], Int] = _stamp_sizes
    process_image: Callable[[Float], Float] = _identity
    sample_sizes: tuple[int, int, int] = (24, 6, 0)
    timed_as: Approximation | None = None

    def draw(
        self, sources: Sources, psf: model.Psf, scene: Scene, settings: Settings, side: int | None = None
    ) -> Float:
        """Draw sources with the sizes of stamps and the change of the image that this approximation defines.

        Parameters
        ----------
        sources : Sources
            Sources, to which `simplify` has been applied.
        psf : Psf
            PSF, to which `simplify_psf` has been applied.
        scene : Scene
            Detector with pixel scale, exposure time and noise.
        settings : Settings
            Parameters of the drawing code, such as limits for the sizes of stamps.
        side : int, optional
            Width and height of the image in pixels. The default is the size of the detector.

        Returns
        -------
        float array, shape (ny, nx)
            Expected electrons per pixel.
        """
        neglected = stamp_sizes.neglected_flux(sources.electrons, scene.noise, settings)
        nx, ny = (scene.nx, scene.ny) if side is None else (side, side)
        sizes = self.sizes(sources, psf, scene, settings)
        return self.process_image(stamps.draw(sources, sizes, psf, nx, ny, None, neglected))


def _folding_sizes(sources: Sources, psf: model.Psf, scene: Scene, settings: Settings) -> Int:
    """Return sides of stamps (pixels) that contain all light except the fraction FOLDING, as galsim chooses them."""
    shapes = sources.shapes.take(sources.shape)
    stretch = np.sqrt(shapes.magnification)
    radius = np.zeros(len(shapes))
    for share, half_light, index in (
        (shapes.bulge_fraction, shapes.bulge_radius, shapes.sersic_index),
        (1 - shapes.bulge_fraction, shapes.disk_radius, np.ones(len(shapes))),
    ):
        radius_ratio = (gammaincinv(2 * index, 1 - FOLDING) / gammaincinv(2 * index, 0.5)) ** index
        radius = np.maximum(radius, np.where(share > 0, half_light * stretch * radius_ratio, 0.0))
    light = psf.outside / (psf.outside[0] + psf.surface[0])
    psf_radius = np.argmax(light < FOLDING) if (light < FOLDING).any() else len(light)
    width = 2 * np.hypot(radius / psf.pixel_scale, psf_radius)
    return np.asarray(
        stamp_sizes.SIZES[np.minimum(np.searchsorted(stamp_sizes.SIZES, width), len(stamp_sizes.SIZES) - 1)]
    )


def _round_index(sources: Sources) -> Sources:
    return replace(sources, shapes=replace(sources.shapes, sersic_index=np.round(sources.shapes.sersic_index, 1)))


def _to_exponential(sources: Sources) -> Sources:
    """Replace galaxies by single exponential discs with a half-light radius between those of bulge and disc.

    The radius is the mean of both radii, weighted with their light. A galaxy without a disc keeps the axis ratio of its
    bulge.
    """
    shapes = sources.shapes
    fraction = shapes.bulge_fraction
    radius = fraction * shapes.bulge_radius + (1 - fraction) * shapes.disk_radius
    axis_ratio = np.degrees(np.arccos(np.clip(shapes.bulge_axis_ratio, 0.0, 1.0)))
    inclination = np.where(fraction < 1, shapes.inclination, axis_ratio)
    return replace(
        sources,
        shapes=replace(shapes, disk_radius=radius, bulge_fraction=np.zeros(len(shapes)), inclination=inclination),
    )


def _faint_galaxies(scene: Scene, seed: int, n: int) -> Sources:
    """Draw at most `n` galaxies that have a bulge and a disc and are fainter than FAINT (mag)."""
    sources = scenes.sources(scene, seed, galaxies=40 * n, stars=0)
    fraction = sources.shapes.bulge_fraction
    is_faint_composite = (fraction > 0) & (fraction < 1) & (scenes.magnitudes(sources, scene) > FAINT)
    return sources.take(np.flatnonzero(is_faint_composite)[:n])


def _galaxies_of_size(scene: Scene, seed: int, n: int, radius: float, magnitude: float) -> Sources:
    sources = scenes.sources(scene, seed, galaxies=n, stars=0)
    shapes = sources.shapes
    scale = radius / galaxy_shapes.half_light(shapes)
    shapes = replace(shapes, bulge_radius=shapes.bulge_radius * scale, disk_radius=shapes.disk_radius * scale)
    electrons = np.full(n, scene.exposure * 10 ** (0.4 * (scene.zero_point - magnitude)))
    return replace(sources, shapes=shapes, electrons=electrons)


def _tiny_galaxies(scene: Scene, seed: int, n: int) -> Sources:
    return _galaxies_of_size(scene, seed, n, TINY, 23.0)


def _huge_galaxies(scene: Scene, seed: int, n: int) -> Sources:
    """Draw `n` galaxies with large half-light radii and steep profiles (Sersic indices 2.5 to 6).

    Serrano et al. 2024 had not enough memory to draw such galaxies at full resolution.
    """
    sources = _galaxies_of_size(scene, seed, n, 1.2 * HUGE, 17.0)
    index, radius = np.linspace(2.5, 6.0, n), np.full(n, 1.2 * HUGE)
    shapes = replace(sources.shapes, bulge_radius=radius, sersic_index=index, bulge_fraction=np.ones(n))
    return replace(sources, shapes=shapes)


def _resample(image: Float) -> Float:
    """Sum 2 x 2 pixels of an image, and interpolate the result back to the original pixels by biquadratic splines."""
    ny, nx = image.shape
    coarse = image.reshape(ny // 2, 2, nx // 2, 2).sum(axis=(1, 3))
    return np.asarray(zoom(coarse, 2, order=2, mode="nearest", grid_mode=True)) / 4


def _half_sizes(sources: Sources, psf: model.Psf, scene: Scene, settings: Settings) -> Int:
    sizes = _stamp_sizes(sources, psf, scene, settings)
    return np.asarray(stamp_sizes.SIZES[np.searchsorted(stamp_sizes.SIZES, sizes // 2)])


def _upsample_copy(image: Float) -> Float:
    """Interpolate a quarter of the image as `_resample` does, only to spend the time, and return the image unchanged.

    The image has been drawn with stamps of half the side. The total time is therefore that of drawing at half the
    resolution and interpolating.
    """
    zoom(image[: len(image) // 2, : len(image) // 2], 2, order=2, mode="nearest", grid_mode=True)
    return image


def _remove_colours(sources: Sources) -> Sources:
    return replace(sources, photons=None)


def _mean_colour_psf(psf: model.Psf) -> model.Psf:
    """Replace the images of the PSF at all wavelengths by their mean; the PSF still varies across the detector."""
    planes = psf.planes
    assert planes is not None
    achromatic = [i for i, power in enumerate(planes.powers) if power[2] == 0]
    mean = planes.images.mean(axis=0, keepdims=True)
    powers = tuple(planes.powers[i] for i in achromatic)
    waves = planes.wavelength.mean(keepdims=True)
    return replace(psf, planes=model.Planes(waves, mean, planes.drift[achromatic], planes.half, powers))


def _central_psf(psf: model.Psf) -> model.Psf:
    """Return a PSF that is at all positions equal to the PSF at the centre of the detector."""
    planes = psf.planes
    assert planes is not None
    return replace(psf, planes=replace(planes, drift=planes.drift[:0], powers=()))


NO_APPROXIMATION = Approximation("none")
ALL = (
    Approximation("index rounded to 0.1", simplify=_round_index),
    Approximation(
        "single component, faint", select_galaxies=_faint_galaxies, simplify=_to_exponential, sample_sizes=(24, 6, 1000)
    ),
    Approximation("folding threshold 0.5 %", sizes=_folding_sizes),
    Approximation(
        "exponential below 0.01 arcsec",
        select_galaxies=_tiny_galaxies,
        simplify=_to_exponential,
        sample_sizes=(12, 3, 1000),
    ),
    Approximation(
        "sampled down and up",
        select_galaxies=_huge_galaxies,
        process_image=_resample,
        sample_sizes=(4, 2, 4),
        timed_as=Approximation("half the side", sizes=_half_sizes, process_image=_upsample_copy),
    ),
    Approximation("one PSF for all colours", simplify=_remove_colours, simplify_psf=_mean_colour_psf),
    Approximation("one PSF for all places", simplify_psf=_central_psf),
)
