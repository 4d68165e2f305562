"""Measure errors of drawn galaxies: against galsim with its tightest parameters, and of their response to shear."""

from __future__ import annotations

import resource
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, TypeVar

import numpy as np

from benchmarks import _references as references
from benchmarks import _scenes as scenes
from benchmarks._scenes import BINS, Scene
from lake_schema.arrays import Float, Int
from truesky.render.drawing.settings import Settings
from truesky.render.psf import model
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.source_list import Sources

Result = TypeVar("Found")
# Limit of the address space of a process in bytes. Without it galsim would use all memory of the machine for steep
# bulges.
MEMORY = 4 << 30
# Sigma of the Gaussian weight for moments, arcsec.
WEIGHT_SIGMA = 0.75
# Radius of the aperture for fluxes, arcsec.
APERTURE_RADIUS = 1.0
# Shear that is applied, with both signs, to pairs of galaxies rotated by 90 degrees.
SHEAR = 0.02
# Width and height of the images that are compared, pixels.
COMPARED_SIDE = 256
NAMES = ("aperture_mag", "centroid_mas", "r2", "ellipticity", "pixel_sigma")
# Settings of the most accurate drawing by truesky. Its only approximation is a finite stamp, at least 51.2 arcsec wide.
FULL_SETTINGS = Settings(edge=1e-7, aliased=1e-9, floor=0.0, min_size_arcsec=51.2, positions=9)


def run_with_memory_limit(work: Callable[..., Result], *args: Any) -> Result:
    """Run work(*args) in a forked process with at most 4 GiB of memory, and return its result.

    The process inherits the arguments, so they need not be copied. RuntimeError is raised if the process ends without a
    result. This works on Unix only.
    """
    context = get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_send_result, args=(theirs, work, args))
    process.start()
    theirs.close()
    try:
        result: Result = ours.recv()
    except EOFError:
        raise RuntimeError(f"{work.__name__} failed in its process") from None
    process.join()
    return result


def _send_result(out: Connection, work: Callable[..., Any], args: tuple[Any, ...]) -> None:
    _limit_memory()
    out.send(work(*args))


def _limit_memory() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))


def measure_image(image: Float, scale: float, x: float, y: float) -> Float:
    """Measure the aperture flux and the weighted moments of a source on an image.

    Parameters
    ----------
    image : float array, shape (ny, nx)
        Image of one source without background.
    scale : float
        Pixel scale in arcsec.
    x, y : float
        True column and row of the source, the centre of the aperture and of the Gaussian weight.

    Returns
    -------
    float array, shape (6,)
        Aperture flux, centroid (x, y) relative to the true position in arcsec, R2 in arcsec2, e1, e2.
    """
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    dx, dy = (columns - x) * scale, (rows - y) * scale
    r2 = dx**2 + dy**2
    weighted = image * np.exp(-0.5 * r2 / WEIGHT_SIGMA**2)
    total = weighted.sum()
    xx, yy, xy = ((weighted * a).sum() / total for a in (dx * dx, dy * dy, dx * dy))
    aperture = image[r2 < APERTURE_RADIUS**2].sum()
    centroid = (weighted * dx).sum() / total, (weighted * dy).sum() / total
    return np.array([aperture, *centroid, xx + yy, (xx - yy) / (xx + yy), 2 * xy / (xx + yy)])


def errors(image: Float, truth: Float, scene: Scene, source: Sources) -> Float:
    """Return the errors of an image of one source.

    Parameters
    ----------
    image, truth : float array, shape (ny, nx)
        Image to test, and true image.
    scene : Scene
        Detector with pixel scale, exposure time, noise and numbers of sources.
    source : Sources
        List of one source, with its true position.

    Returns
    -------
    float array, shape (5,)
        Absolute errors in the order of NAMES: aperture magnitude, centroid (mas), dR2 / R2, ellipticity, and largest
        error of a pixel in units of the noise.
    """
    position = float(source.column[0]), float(source.row[0])
    ours, theirs = measure_image(image, scene.scale, *position), measure_image(truth, scene.scale, *position)
    return np.array(
        [
            abs(2.5 * np.log10(ours[0] / theirs[0])),
            1e3 * np.hypot(*(ours - theirs)[1:3]),
            abs(ours[3] / theirs[3] - 1),
            np.hypot(*(ours - theirs)[4:6]),
            np.abs(image - truth).max() / scene.noise,
        ]
    )


def against_galsim(scene: Scene, tiers: Mapping[str, Settings], seed: int, n: int) -> tuple[dict[str, Float], Int, int]:
    """Measure the errors of galaxies drawn with several settings, against galsim with its tightest parameters.

    Parameters
    ----------
    scene : Scene
        Detector with pixel scale, exposure time, noise and numbers of sources.
    tiers : mapping of str to Settings
        Settings (parameters of the drawing code) by name.
    seed : int
        Seed of the sample of galaxies.
    n : int
        Number of galaxies, rounded up to a multiple of the number of magnitude bins.

    Returns
    -------
    errors : dict of str to float array, shape (m, 5)
        Errors of each galaxy, by name of the settings: aperture magnitude, centroid (mas), dR2 / R2, ellipticity, and
        largest error of a pixel in units of the noise.
    bins : int array, shape (m,)
        Index of the magnitude bin of each galaxy.
    refused : int
        Number of galaxies that were left out, because galsim could not draw them.
    """
    sources, full_psf = scenes.sample(scene, seed, n), scenes.scene_psf(scene)
    out: dict[str, list[Float]] = {name: [] for name in tiers}
    bins, refused = [], 0
    for i, b in enumerate(scenes.magnitude_bins(sources, scene)):
        source, source_psf = (
            scenes.centred_source(sources, i, COMPARED_SIDE),
            scenes.psf_of_source(full_psf, sources, i),
        )
        truth = references.reference_image(source, source_psf, COMPARED_SIDE)
        if truth is None:
            refused += 1
            continue
        bins.append(b)
        for name, settings in tiers.items():
            out[name].append(
                errors(scenes.draw_sources(source, source_psf, scene, settings, COMPARED_SIDE), truth, scene, source)
            )
    return {name: np.array(rows) for name, rows in out.items()}, np.array(bins), refused


def shear_response(
    scene: Scene, tiers: Mapping[str, Settings], seed: int, n: int, g: float = SHEAR
) -> tuple[dict[str, Float], Sources]:
    """Measure the bias of shear that errors of drawing cause, with noise-free pairs rotated by 90 degrees.

    Parameters
    ----------
    scene : Scene
        Detector with pixel scale, exposure time, noise and numbers of sources.
    tiers : mapping of str to Settings
        Settings (parameters of the drawing code) by name.
    seed : int
        Seed of the sample of galaxies.
    n : int
        Number of galaxies, rounded up to a multiple of the number of magnitude bins.
    g : float, optional
        Shear, applied with both signs.

    Returns
    -------
    biases : dict of str to float array, shape (n, 2)
        Bias (m, c) of each galaxy, by name of the settings.
    sources : Sources
        The galaxies.

    Notes
    -----
    The bias is relative to the same galaxy with the same PSF, drawn by truesky on a very large stamp (FULL_SETTINGS).
    Relative to galsim, such a drawing has |m| <= 1e-5.
    """
    sources, full_psf = scenes.sample(scene, seed, n), scenes.scene_psf(scene)
    out: dict[str, list[tuple[float, float]]] = {name: [] for name in tiers}
    for i in range(len(sources)):
        source_psf, source = (
            scenes.psf_of_source(full_psf, sources, i),
            scenes.centred_source(sources, i, 2 * COMPARED_SIDE),
        )
        truth = response(make_drawer(source_psf, scene, FULL_SETTINGS), source, scene.scale, g)
        for name, settings in tiers.items():
            out[name].append(bias(response(make_drawer(source_psf, scene, settings), source, scene.scale, g), truth))
    return {name: np.array(rows) for name, rows in out.items()}, sources


def make_drawer(psf: model.Psf, scene: Scene, settings: Settings) -> Callable[[Sources], Float]:
    """Return a function that draws a single galaxy.

    Parameters
    ----------
    psf : Psf
        PSF of the galaxy, the same at all positions and wavelengths.
    scene : Scene
        Detector with pixel scale, exposure time, noise and numbers of sources.
    settings : Settings
        Parameters of the drawing code, such as limits for the sizes of stamps.

    Returns
    -------
    callable
        Function of a list of one galaxy that returns its image (expected electrons) of 512 x 512 pixels.
    """
    return lambda source: scenes.draw_sources(source, psf, scene, settings, 2 * COMPARED_SIDE)


def response(draw: Callable[[Sources], Float], source: Sources, scale: float, g: float = SHEAR) -> Float:
    """Measure the mean response to shear of a galaxy and of the same galaxy rotated by 90 degrees.

    Parameters
    ----------
    draw : callable
        Function of a list of one galaxy that returns its image without noise.
    source : Sources
        List of one galaxy with its position on the image. Its shear is replaced.
    scale : float
        Pixel scale in arcsec.
    g : float, optional
        Shear, applied with both signs.

    Returns
    -------
    float array, shape (4,)
        de1 / dg1, de2 / dg2, mean e1, mean e2.
    """
    slopes, means = np.zeros(2), np.zeros(2)
    for turn in (0.0, np.pi / 2):
        for component in (0, 1):
            for sheared in (-g, g):
                shapes = source.shapes.take(source.shape)
                shears = [np.array([sheared if k == component else 0.0]) for k in (0, 1)]
                shapes = replace(shapes, g1=shears[0], g2=shears[1], beta=shapes.beta + turn)
                image = draw(replace(source, shapes=shapes, shape=np.zeros(1, np.int64)))
                e = measure_image(image, scale, float(source.column[0]), float(source.row[0]))[4:6]
                slopes[component] += 0.25 * e[component] / sheared
                means += 0.125 * e
    return np.concatenate([slopes, means])


def bias(measured: Float, truth: Float) -> tuple[float, float]:
    """Return the multiplicative and the additive bias of shear (m, c) from a measured and a true response.

    Both arguments are results of `response`. Each bias is the one of the two shear components with the larger absolute
    value, with its sign.
    """
    m, c = measured[:2] / truth[:2] - 1, measured[2:] - truth[2:]
    return float(m[np.argmax(np.abs(m))]), float(c[np.argmax(np.abs(c))])


def worst_by_group(biases: Float, sources: Sources, scene: Scene) -> dict[str, tuple[int, float, float]]:
    """Return the largest biases of shear in bins of magnitude, half-light radius, and Sersic index of the bulge.

    Parameters
    ----------
    biases : float array, shape (n, 2)
        Bias of shear (m, c) of each galaxy.
    sources : Sources
        The galaxies.
    scene : Scene
        Detector with pixel scale, exposure time, noise and numbers of sources.

    Returns
    -------
    dict of str to (int, float, float)
        Number of galaxies, largest |m| and largest |c| by name of the bin, such as "m 20-22". Empty bins are left out.
    """
    shapes = sources.shapes.take(sources.shape)
    size, index = galaxy_shapes.half_light(shapes), np.where(shapes.bulge_fraction > 0, shapes.sersic_index, 1.0)
    groups = (
        ("m", scenes.magnitudes(sources, scene), BINS),
        ("r", size, (0.0, 0.2, 0.4, 0.8, np.inf)),
        ("n", index, (0.0, 1.5, 2.5, 4.0, np.inf)),
    )
    out = {}
    for name, values, edges in groups:
        for low, high in pairwise(edges):
            in_bin = (values >= low) & (values < high)
            if in_bin.any():
                m, c = np.abs(biases[in_bin]).max(axis=0)
                out[f"{name} {low:g}-{high:g}"] = int(in_bin.sum()), float(m), float(c)
    return out


def figures(error_values: Float) -> dict[str, float]:
    """Return the rms and the largest value of each of five errors, by name such as `r2_rms` and `r2_worst`.

    `error_values` has one row per galaxy. Its columns are the errors of aperture magnitude, centroid (mas), R2,
    ellipticity, and of a pixel in units of the noise.
    """
    rms, worst = np.sqrt((error_values**2).mean(axis=0)), error_values.max(axis=0)
    named = zip(NAMES, rms, worst, strict=True)
    return {key: float(value) for name, a, b in named for key, value in ((f"{name}_rms", a), (f"{name}_worst", b))}


def figures_by_bin(error_values: Float, bins: Int) -> dict[str, float]:
    """Return the rms and the largest value of five errors in each magnitude bin, by names such as `r2_rms_m20`.

    The number at the end of a name is the bright edge of the bin (mag). `error_values` has one row per galaxy and the
    columns that `figures` requires. `bins` contains the index of each galaxy's bin.
    """
    return {
        f"{key}_m{BINS[b]:.0f}": value
        for b in np.unique(bins)
        for key, value in figures(error_values[bins == b]).items()
    }


def print_table(title: str, error_values: Float, bins: Int) -> None:
    """Print a table of the rms and the largest errors of galaxies, in each magnitude bin and in total.

    Parameters
    ----------
    title : str
        Title of the table.
    error_values : float array, shape (n, 5)
        Errors of each galaxy: aperture magnitude, centroid (mas), dR2 / R2, ellipticity, and largest error of a pixel
        in units of the noise.
    bins : int array, shape (n,)
        Index of the magnitude bin of each galaxy.
    """
    print(f"{title:24}" + "".join(f"{name:>20}" for name in NAMES))
    rows = [(f"m {BINS[b]:.0f}-{BINS[b + 1]:.0f}", error_values[bins == b]) for b in range(len(BINS) - 1)]
    for label, bin_errors in [*rows, ("all", error_values)]:
        if len(bin_errors):
            rms, worst = np.sqrt((bin_errors**2).mean(axis=0)), bin_errors.max(axis=0)
            cells = "".join(f"{a:>10.1e}/{b:<9.1e}" for a, b in zip(rms, worst, strict=True))
            print(f"  {label:12}{len(bin_errors):>6}    {cells}")
