"""Random galaxies and stars on a VIS, NISP or LSST detector, with which the drawing of sources is measured.

A scene is a detector with its exposure time, noise and numbers of sources. The VIS and NISP scenes have 4,701 galaxies
(magnitudes 17 to 26, dN/dm ~ 10^(0.3 m)) and 300 stars, each with a separate colour and position. The LSST scene has
18,223 galaxies and 1,160 stars.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lake_schema.arrays import Float, Int
from lake_schema.mission.configuration import resolve
from truesky.fluxes import passbands
from truesky.render.camera import detectors
from truesky.render.drawing import stamp_sizes, stamps, transfer
from truesky.render.drawing.settings import Settings
from truesky.render.psf import euclid, ground, model, sub_bands
from truesky.render.sources.galaxy_shapes import Shapes
from truesky.render.sources.source_list import Sources

# Edges of the magnitude bins in which errors are reported.
BINS = (17.0, 20.0, 22.0, 23.0, 24.0, 25.0, 26.0)
# Edges of the ranges of magnitude (layers) that have equal numbers of sources in `stratified_sample`.
LAYERS = (14.5, 16.0, 18.0, 20.0, 22.0, 24.0, 26.0)
# FWHM of the seeing on the LSST detector, arcsec.
SEEING = 0.7
# Exponent of the Moffat profile that represents the seeing on the LSST detector in other programs.
BETA = 3.0
# Atmosphere above the LSST telescope at an airmass of 1.2.
_AIR = ground.Air(SEEING, (0.01, 0.005), slope=-0.3, tan_zenith_distance=0.66, zenith=0.5, height=2663.0)


@dataclass(frozen=True)
class Scene:
    """A detector with the properties of an exposure, and the numbers of sources on it.

    Attributes
    ----------
    name : str
        Name of the camera: "vis", "nisp" or "lsst".
    nx, ny : int
        Numbers of columns and rows.
    scale : float
        Pixel scale in arcsec.
    exposure : float
        Exposure time in seconds.
    zero_point : float
        Magnitude of a source of 1 electron per second.
    noise : float
        Noise of a sky pixel in electrons.
    galaxies, stars : int
        Numbers of galaxies and of stars.
    """

    name: str
    nx: int
    ny: int
    scale: float
    exposure: float
    zero_point: float
    noise: float
    galaxies: int
    stars: int


VIS = Scene("vis", 4096, 4132, 0.1, 565.0, 25.7, 12.45, 4701, 300)
# A detector of NISP in the passband Y, with the exposure time (s) of one photometric exposure.
NISP = Scene("nisp", 2040, 2040, 0.3, 87.24, 25.0, 12.0, 4701, 300)
# For each camera in space: name of the detector, passband, and function that computes the PSF.
SPACE = {"vis": ("3-4", "euclid_vis", euclid.vis_psf), "nisp": ("DET23", "euclid_y", euclid.nisp_psf)}
LSST = Scene("lsst", 4096, 4004, 0.2, 30.0, 28.17, 38.3, 18223, 1160)


def scene_psf(scene: Scene, positions: int = 9, colours: int = sub_bands.N_SUB_BANDS) -> model.Psf:
    """Return the PSF on the detector of a scene.

    Parameters
    ----------
    scene : Scene
        Detector with pixel scale, exposure time, noise and numbers of sources.
    positions : int, optional
        Number of positions on the detector at which the PSF is computed.
    colours : int, optional
        Number of wavelengths.

    Returns
    -------
    Psf
        The PSF.
    """
    mission = resolve()
    if scene.name == "lsst":
        detector = detectors.detector("lsstcam", "R22_S11", mission)
        return model.reduce_colours(
            ground.atmospheric_psf(_AIR, detector, passbands.load("lsst_i"), mission, positions), colours
        )
    name, band, psf = SPACE[scene.name]
    detector = detectors.detector(scene.name, name, mission)
    return model.reduce_colours(psf(detector, passbands.load(band), mission, positions), colours)


def sources(scene: Scene, seed: int, galaxies: int | None = None, stars: int | None = None) -> Sources:
    """Return random galaxies, followed by random stars, on the detector of a scene.

    Parameters
    ----------
    scene : Scene
        Detector with pixel scale, exposure time, noise and numbers of sources.
    seed : int
        Seed of the random numbers.
    galaxies, stars : int, optional
        Numbers of galaxies and of stars. The default is the numbers of the scene.

    Returns
    -------
    Sources
        The sources: positions are uniform on the detector, and magnitudes follow power laws.
    """
    rng = np.random.default_rng(seed)
    n, m = galaxies if galaxies is not None else scene.galaxies, stars if stars is not None else scene.stars
    mag = np.concatenate([_magnitudes(rng, 17.0, 26.0, 0.3, n), _magnitudes(rng, 14.0, 25.5, 0.15, m)])
    total = n + m
    fraction = np.where(rng.random(n) < 0.3, 0.0, np.where(rng.random(n) < 0.14, 1.0, 0.6 * rng.random(n)))
    half_light = 0.32 * 10 ** (-0.14 * (mag[:n] - 24.5) + 0.18 * rng.normal(size=n))
    g = 0.03 * rng.normal(size=(2, n))
    shapes = Shapes(
        bulge_radius=half_light * np.where(fraction < 1, 0.5, 1.0),
        disk_radius=half_light * 1.1,
        bulge_fraction=fraction,
        sersic_index=np.clip(2.2 * np.exp(0.45 * rng.normal(size=n)), 0.5, 6.0),
        bulge_axis_ratio=rng.uniform(0.5, 1.0, n),
        inclination=np.degrees(np.arccos(rng.random(n))),
        beta=np.pi * rng.random(n),
        g1=g[0],
        g2=g[1],
        magnification=1 + 0.04 * rng.normal(size=n),
    )
    jacobian = scene.scale * np.array([[1.001, 0.002], [-0.003, 0.998]])
    photons = colours(total, rng)
    return Sources(
        np.arange(total),
        rng.uniform(0, scene.nx - 1, total),
        rng.uniform(0, scene.ny - 1, total),
        np.tile(jacobian, (total, 1, 1)),
        scene.exposure * 10 ** (0.4 * (scene.zero_point - mag)),
        np.where(np.arange(total) < n, np.arange(total), -1),
        shapes,
        photons / photons.sum(axis=1, keepdims=True),
    )


def colours(n: int, rng: np.random.Generator) -> Float:
    """Return the relative numbers of photons of `n` sources in the sub-bands of the PSF [n, sub-bands].

    They are exponentials in wavelength with random slopes, and are not normalised.
    """
    waves = np.linspace(-0.25, 0.25, sub_bands.N_SUB_BANDS)
    return np.asarray(np.exp(np.outer(rng.normal(0.5, 1.5, n), waves)))


def _magnitudes(rng: np.random.Generator, bright: float, faint: float, slope: float, n: int) -> Float:
    low, high = 10 ** (slope * bright), 10 ** (slope * faint)
    return np.asarray(np.log10(low + (high - low) * rng.random(n)) / slope)


def magnitudes(source_list: Sources, scene: Scene) -> Float:
    """Return the AB magnitudes of sources from their electrons, the exposure time and the zero point of the scene."""
    return np.asarray(scene.zero_point - 2.5 * np.log10(source_list.electrons / scene.exposure))


def magnitude_bins(source_list: Sources, scene: Scene) -> Int:
    """Return the index of the bin of BINS in which the magnitude of each source lies.

    Sources outside all bins belong to the first or to the last bin.
    """
    return np.clip(np.searchsorted(BINS, magnitudes(source_list, scene)) - 1, 0, len(BINS) - 2)


def sample(scene: Scene, seed: int, n: int) -> Sources:
    """Return a random sample of galaxies, with equal numbers in all magnitude bins of BINS.

    Parameters
    ----------
    scene : Scene
        Detector with pixel scale, exposure time, noise and numbers of sources.
    seed : int
        Seed of the random numbers.
    n : int
        Number of galaxies, rounded up to a multiple of the number of bins, 6.

    Returns
    -------
    Sources
        The galaxies in random order, that is, not sorted by magnitude.
    """
    candidates = sources(scene, seed, galaxies=max(60 * n, 3000), stars=0)
    bins, rng = magnitude_bins(candidates, scene), np.random.default_rng(seed)
    each = -(-n // (len(BINS) - 1))
    chosen = [rng.permutation(np.flatnonzero(bins == b))[:each] for b in range(len(BINS) - 1)]
    return candidates.take(np.sort(np.concatenate(chosen)))


def stratified_sample(scene: Scene, seed: int, each: int) -> Sources:
    """Return a random sample with equal numbers of galaxies and of stars in each range of magnitude of LAYERS.

    Parameters
    ----------
    scene : Scene
        Detector with pixel scale, exposure time, noise and numbers of sources.
    seed : int
        Seed of the random numbers.
    each : int
        Number of galaxies, and number of stars, per range of magnitude.

    Returns
    -------
    Sources
        The galaxies, followed by the stars.
    """
    layers, n = len(LAYERS) - 1, each * (len(LAYERS) - 1)
    candidates, rng = sources(scene, seed, galaxies=n, stars=n), np.random.default_rng([seed, 1])
    low, high = np.array(LAYERS[:-1]), np.array(LAYERS[1:])
    layer = np.tile(np.arange(layers), 2 * each)
    mag = low[layer] + (high - low)[layer] * rng.random(2 * n)
    # The magnitudes of the galaxies are replaced, so scale their sizes: fainter galaxies are smaller.
    size = 10 ** (-0.14 * (mag - magnitudes(candidates, scene)))[:n]
    shapes = candidates.shapes
    shapes = replace(shapes, bulge_radius=shapes.bulge_radius * size, disk_radius=shapes.disk_radius * size)
    return replace(candidates, shapes=shapes, electrons=scene.exposure * 10 ** (0.4 * (scene.zero_point - mag)))


def draw_sources(
    source_list: Sources, psf: model.Psf, scene: Scene, settings: Settings, side: int | None = None
) -> Float:
    """Draw an image of sources without noise, in the way in which an exposure is simulated.

    Parameters
    ----------
    source_list : Sources
        The sources with their positions on the image.
    psf : Psf
        PSF on the detector.
    scene : Scene
        Detector, of which the size and the noise are used.
    settings : Settings
        Parameters of the drawing code, such as limits for the sizes of stamps.
    side : int, optional
        Width and height of the image in pixels. The default is the size of the detector.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons per pixel.
    """
    sizes = stamp_sizes.stamp_sizes(
        source_list.electrons, source_list.shape, source_list.shapes, psf, scene.noise, settings
    )
    neglected = stamp_sizes.neglected_flux(source_list.electrons, scene.noise, settings)
    nx, ny = (scene.nx, scene.ny) if side is None else (side, side)
    return stamps.draw(source_list, sizes, psf, nx, ny, None, neglected)


def psf_of_source(psf: model.Psf, source_list: Sources, i: int) -> model.Psf:
    """Return a PSF that is the same at all positions and wavelengths, equal to the PSF of one source.

    The wings of the PSF beyond its sampled image are left out.

    Parameters
    ----------
    psf : Psf
        PSF on the detector, which depends on position and wavelength.
    source_list : Sources
        Sources with their positions and colours.
    i : int
        Index of the source in the list.

    Returns
    -------
    Psf
        PSF of source `i`. If `psf` has no sampled images (`planes` is None), it is returned unchanged.
    """
    planes = psf.planes
    if planes is None:
        return psf
    weights = transfer.basis_weights(psf, source_list.photons, source_list.column, source_list.row)[i]
    image = transfer.image_of(planes, weights)
    constant_planes = replace(
        planes, wavelength=planes.wavelength[:1], images=image[None], drift=planes.drift[:0], powers=()
    )
    return replace(psf, planes=constant_planes, edges=None)


def centred_source(source_list: Sources, i: int, side: int) -> Sources:
    """Return one source of a list, shifted by whole pixels to the middle of a square image.

    Parameters
    ----------
    source_list : Sources
        The sources.
    i : int
        Index of the source in the list.
    side : int
        Width and height of the image in pixels.

    Returns
    -------
    Sources
        List of this source without its colour, because it is drawn with the PSF from `psf_of_source`.
    """
    source = source_list.take(np.array([i]))
    shift = [side // 2 - np.rint(position) for position in (source.column, source.row)]
    return replace(source, column=source.column + shift[0], row=source.row + shift[1], photons=None)
