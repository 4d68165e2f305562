"""Measure the speed of other programs with the galaxies of the benchmarks.

galsim draws images object by object, UFig draws images photon by photon, and SkyPy draws catalogues.
"""

from __future__ import annotations

import time

import galsim
import numpy as np

from benchmarks import _scenes as scenes
from benchmarks._scenes import BINS, Scene
from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from truesky.catalogue.halos import luminosity_function
from truesky.cosmology import FIDUCIAL
from truesky.render.drawing import transfer
from truesky.render.psf import model
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.source_list import Sources

# Width and height of the PSF image for galsim in samples; it covers 10 arcsec for VIS and 30 arcsec for LSST.
_SIDE = 301


def galsim_seconds(scene: Scene, each: int, seed: int = 3) -> tuple[float, float]:
    """Return the CPU time that galsim with its default parameters needs to draw all galaxies of a detector.

    Parameters
    ----------
    scene : Scene
        Detector with pixel scale, exposure time, noise and numbers of sources.
    each : int
        Number of galaxies per magnitude bin that are drawn; the times are scaled to all galaxies.
    seed : int, optional
        Seed of the sample.

    Returns
    -------
    default : float
        Time in seconds if each galaxy has a separate PSF for its colour and position.
    cached : float
        Time in seconds with one PSF for all galaxies and Sersic indices rounded to 0.1. Each galaxy is drawn once
        before the clock starts, so galsim has its profile in its cache.
    """
    sources, full_psf = scenes.sample(scene, seed, each * (len(BINS) - 1)), scenes.scene_psf(scene)
    bins = scenes.magnitude_bins(sources, scene)
    all_galaxies = scenes.sources(scene, 1, stars=0)
    counts = np.bincount(scenes.magnitude_bins(all_galaxies, scene), minlength=len(BINS) - 1)
    weights = transfer.basis_weights(full_psf, sources.photons, sources.column, sources.row)
    mean_psf = _psf_image(full_psf, weights.mean(axis=0))
    mean_psf.drawKImage()
    default, cached = np.zeros(len(sources)), np.zeros(len(sources))
    for i in range(len(sources)):
        start = time.process_time()
        _draw(sources, i, _psf_image(full_psf, weights[i]), sources.shapes.sersic_index[sources.shape[i]])
        default[i] = time.process_time() - start
        index = np.round(sources.shapes.sersic_index[sources.shape[i]], 1)
        _draw(sources, i, mean_psf, index)
        start = time.process_time()
        _draw(sources, i, mean_psf, index)
        cached[i] = time.process_time() - start
    return tuple(  # type: ignore[return-value]
        float(sum(counts[b] * spent[bins == b].mean() for b in range(len(counts)) if (bins == b).any()))
        for spent in (default, cached)
    )


def _psf_image(psf: model.Psf, weights: Float) -> galsim.GSObject:
    """Return the weighted sum of the images of a PSF (by wavelength and position) as a galsim object, in pixels."""
    assert psf.planes is not None
    image = transfer.image_of(psf.planes, weights)
    middle = slice((len(image) - _SIDE) // 2, (len(image) + _SIDE) // 2)
    return galsim.InterpolatedImage(galsim.Image(image[middle, middle], scale=1.0 / psf.planes.samples))


def _draw(sources: Sources, i: int, psf: galsim.GSObject, index: float) -> None:
    shape = sources.shapes.take(sources.shape[i : i + 1])
    shape.sersic_index[0] = index
    body = galsim.JacobianWCS(*sources.jacobian[i].ravel()).toImage(galaxy_shapes.profile(shape, 0, 1e-6))
    convolved = galsim.Convolve([body.withFlux(sources.electrons[i]), psf])
    convolved.drawImage(scale=1.0, offset=(sources.column[i] % 1, sources.row[i] % 1))


def galsim_image(source: Sources, psf: model.Psf, side: int) -> Float:
    """Draw a single galaxy with galsim at its default parameters, on a stamp whose size galsim chooses.

    Parameters
    ----------
    source : Sources
        List of one galaxy.
    psf : Psf
        PSF of this galaxy, the same at all positions and wavelengths.
    side : int
        Width and height of the image in pixels.

    Returns
    -------
    float array, shape (side, side)
        Expected electrons per pixel; 0 outside the stamp.
    """
    assert psf.planes is not None
    body = galsim.JacobianWCS(*source.jacobian[0].ravel()).toImage(
        galaxy_shapes.profile(source.shapes, int(source.shape[0]), 1e-6)
    )
    convolved = galsim.Convolve([body.withFlux(source.electrons[0]), _psf_image(psf, np.ones(1))])
    drawn = convolved.drawImage(scale=1.0, center=galsim.PositionD(source.column[0], source.row[0]), dtype=float)
    frame = galsim.ImageD(galsim.BoundsI(0, side - 1, 0, side - 1), init_value=0.0)
    shared = frame.bounds & drawn.bounds
    frame[shared] = drawn[shared]
    return np.asarray(frame.array)


def ufig_seconds(scene: Scene) -> float | None:
    """Return the CPU time (s) that UFig needs to draw the photons of all galaxies, or None if it is not installed.

    Bulge and disc of a galaxy are drawn as two objects. The PSF is a Moffat profile for all wavelengths. The shorter of
    two times counts.
    """
    try:
        from ufig import rendering_util
        from ufig.plugins.gamma_interpolation_table import load_intrinsicTable
        from ufig.plugins.render_galaxies_flexion import integrate_image
    except ImportError:
        print("UFig is not installed (pip install ufig) and is not compared")
        return None
    sources = scenes.sources(scene, 1, stars=0)
    shape, n = sources.shapes, len(sources)
    fraction = np.concatenate([shape.bulge_fraction, 1 - shape.bulge_fraction])
    photons = np.rint(np.tile(sources.electrons, 2) * fraction).astype(np.int64)
    radius = np.concatenate([shape.bulge_radius, shape.disk_radius]) / scene.scale
    index = np.concatenate([shape.sersic_index, np.ones(n)])
    cosine = np.concatenate([shape.bulge_axis_ratio, np.cos(np.radians(shape.inclination))])
    slim = (1 - cosine**2) / (1 + cosine**2)
    ellipticity = [slim * turn(2 * np.tile(shape.beta, 2)) for turn in (np.cos, np.sin)]
    has_photons = photons > 0
    m = int(has_photons.sum())
    fwhm, beta = (0.16 / scene.scale, 3.5) if scene.name == "vis" else (scenes.SEEING / scene.scale, scenes.BETA)
    zeros, ones = np.zeros((m, 1)), np.ones((m, 1))
    np.random.seed(1)  # noqa: NPY002  (UFig draws from this global generator)
    arguments = [
        13,
        4,
        9,
        load_intrinsicTable(9, 13, 4),
        np.zeros((scene.ny, scene.nx)),
        np.tile(sources.column, 2)[has_photons],
        np.tile(sources.row, 2)[has_photons],
        photons[has_photons, None],
        index[has_photons],
        rendering_util.compute_ellip_matrices(radius[has_photons], *(e[has_photons] for e in ellipticity)),
        beta * ones,
        rendering_util.compute_ellip_matrices(np.full(m, fwhm), np.full(m, 0.01), np.zeros(m)),
        np.zeros((m, 2, 2, 2)),
        zeros,
        zeros,
        zeros,
        -9.0,
        False,
    ]
    best = np.inf
    for is_warm_up in (True, False, False):
        arguments[7] = np.minimum(photons[has_photons, None], 10) if is_warm_up else photons[has_photons, None]
        start = time.process_time()
        integrate_image(rendering_util.rng_buffer(), *arguments)
        best = best if is_warm_up else min(best, time.process_time() - start)
    return best


# Parameters of SkyPy for the spectra of blue galaxies (Herbel et al. 2017): coefficients of the five templates of
# k-correct at z = 0, at z = 1, and weights of the templates.
_TEMPLATE_MIX = (
    [2.079, 3.524, 1.917, 1.992, 2.536], [2.265, 3.862, 1.921, 1.685, 2.480], [3.47e9, 3.31e6, 2.13e9, 1.64e10, 1.01e9],
)  # fmt: skip
# Largest redshift of galaxies drawn by SkyPy. At higher redshifts the templates of k-correct do not cover the passband
# I_E.
_MAX_REDSHIFT = 3.9


def skypy_photometry(area: float, seed: int) -> float:
    """Return the number of galaxies per CPU second that SkyPy draws, with positions and magnitudes in I_E, Y and H.

    The galaxies are brighter than magnitude 26 in the reference band of the luminosity function and have z < 3.9.

    Parameters
    ----------
    area : float
        Area of the sky in deg2.
    seed : int
        Seed of the legacy random generator of NumPy, which SkyPy uses.

    Returns
    -------
    float
        Galaxies per CPU second.

    Raises
    ------
    BadInput
        If SkyPy is not installed.
    """
    try:
        from astropy.cosmology import FlatLambdaCDM
        from astropy.units import Quantity
        from skypy.galaxies import schechter_lf
        from skypy.galaxies.spectrum import dirichlet_coefficients, kcorrect
    except ImportError as error:
        raise BadInput(f"SkyPy is required for the comparison: {error} (pip install skypy)") from None
    np.random.seed(seed)  # noqa: NPY002
    ours, z = FlatLambdaCDM(67.0, 0.319), np.linspace(0.002, _MAX_REDSHIFT, 400)
    m_star, phi_star, alpha = luminosity_function.schechter().parameters_at(z)
    scale = 5.0 * np.log10(FIDUCIAL.h)
    start = time.process_time()
    redshift, m_r = schechter_lf(
        z, m_star + scale, phi_star * FIDUCIAL.h**3, float(alpha.mean()), 26.0, Quantity(area, "deg2"), ours
    )
    mix = dirichlet_coefficients(redshift, *_TEMPLATE_MIX[:2], weight=_TEMPLATE_MIX[2])
    mass = kcorrect.stellar_mass(mix, m_r, "sdss2010-r")
    bands = ["Euclid-VIS", "Euclid-Y", "Euclid-H"]
    magnitudes = kcorrect.apparent_magnitudes(mix, redshift, bands, ours, stellar_mass=mass)
    side = np.sqrt(area)
    place = np.random.uniform(0.0, side, (2, redshift.size))  # noqa: NPY002
    return float(np.concatenate([place, magnitudes.T]).shape[1] / (time.process_time() - start))
