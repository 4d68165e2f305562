"""Measure lensing by the simulated universe: C_l and rms of the convergence, B modes, and shear around massive halos.

The lensing maps of the catalogue, and maps of universes with other random seeds, are compared with linear theory.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from lake_schema.arrays import Float, Float32
from lake_schema.lazy_healpy import healpy as hp
from truesky.catalogue.galaxies import lensing
from truesky.catalogue.galaxies.lensing import Planes
from truesky.catalogue.matter import convergence, density_box, lightcone
from truesky.catalogue.matter.density_box import Box
from truesky.cosmology import Cosmology
from truesky.validation import theory as theories
from truesky.validation.model.clustering import Tracers

# The error of the mean convergence is computed from the scatter between HEALPix cells of this nside.
_PATCHES = 2
# Number of distances over which linear theory is integrated.
_STEPS = 1500
# HEALPix nside of the directions in which the convergence is computed along single lines of sight.
_SIGHT_NSIDE = 128
# Radii, in deg, of the rings around halos in which the tangential shear is measured.
RINGS = (0.1, 0.2, 0.4, 0.8)
# Number of points on each ring around a halo at which the shear is measured.
_DIRECTIONS = 8


def linear_theory(cosmology: Cosmology, ell: Float, chi: float) -> Float:
    """Return C_l of the convergence from linear theory in Limber's approximation.

    Parameters
    ----------
    cosmology : Cosmology
        Parameters of the universe.
    ell : float array, shape (n,)
        Multipoles l.
    chi : float
        Comoving distance of all sources, Mpc/h.

    Returns
    -------
    float array, shape (n,)
        C_l at each multipole.
    """
    linear, weight = partial(theories.matter_power, is_linear=True), np.ones(1)
    return theories.convergence_power(cosmology, ell, np.array([chi]), weight, linear, _distances(chi))


def _distances(chi: float) -> Float:
    """Return evenly spaced comoving distances (Mpc/h) in front of sources at `chi` (Mpc/h), for integrals."""
    return np.linspace(2.0, chi - 0.5, _STEPS)


def band_ratio(cosmology: Cosmology, power: Float, chi: float, edges: Sequence[int]) -> Float:
    """Return measured C_l of the convergence divided by linear theory, averaged in bands of l.

    Parameters
    ----------
    cosmology : Cosmology
        Parameters of the universe.
    power : float array, shape (l_max + 1,)
        Measured C_l, beginning at l = 0, at least up to the last edge.
    chi : float
        Comoving distance of the sources, Mpc/h.
    edges : sequence of int
        Edges of the bands in l, ascending, above 0.

    Returns
    -------
    float array, shape (bands,)
        Mean ratio in each band, weighted by 2 l + 1.
    """
    ell = np.arange(edges[0], edges[-1] + 1)
    nodes = np.unique(np.geomspace(edges[0], edges[-1], 60).astype(int))
    expected = np.exp(np.interp(np.log(ell), np.log(nodes), np.log(linear_theory(cosmology, nodes.astype(float), chi))))
    ratio = (2 * ell + 1) * power[ell] / expected
    modes = 2.0 * ell + 1.0
    place = np.digitize(ell, edges) - 1
    place[-1] = len(edges) - 2
    return np.bincount(place, ratio) / np.bincount(place, modes)


def convergence_maps(box: Box, nside: int, redshifts: Sequence[float], l_max: int) -> tuple[Float32, Float]:
    """Compute maps of the convergence from a box of matter, like the maps of the catalogue before their last step.

    In the last step, which is left out here, the multipoles of the maps are multiplied by `gain`.

    Parameters
    ----------
    box : Box
        Periodic box with the density field; its replicas fill the light cone.
    nside : int
        HEALPix resolution of the maps.
    redshifts : sequence of float
        Redshift of the sources of each map (plane).
    l_max : int
        Highest multipole.

    Returns
    -------
    kappa : float32 array, shape (planes, pixels)
        Convergence along the line of sight to the centre of each pixel, in nested order.
    gain : float array, shape (planes, l_max + 1)
        Factors by which the multipoles of these maps are multiplied in the maps of the catalogue.
    """
    chosen = lensing.settings()
    direction = np.stack(hp.pix2vec(nside, np.arange(hp.nside2npix(nside)), nest=True)).astype(np.float32)
    chi = np.asarray(box.model.cosmology.comoving_distance(np.array(redshifts)))
    width, step_settings = hp.nside2resol(nside), (chosen.coarsest, chosen.stretch)
    return (
        convergence.convergence(box, direction, width, chi, *step_settings),
        convergence.transfer(box, width, chi, l_max, *step_settings),
    )


def gaussian_box(cosmology: Cosmology, seed: int, n: int) -> Box:
    """Return a box of matter with `n` cells per side that has only the density field, for lensing.

    Smoothed fields and velocities are left out, and the box is not stored in the disc cache.

    Parameters
    ----------
    cosmology : Cosmology
        Parameters of the universe.
    seed : int
        Seed of the random numbers.
    n : int
        Number of cells along each side of the box.

    Returns
    -------
    Box
        The box.
    """
    model = density_box.box_model(cosmology)
    g = density_box._gaussian(model, seed, n)
    return Box(model, n, seed, (g,), np.array([g.var(dtype=float)]), ())


def power_of_box(box: Box, nside: int, redshifts: Sequence[float], edges: Sequence[int]) -> Float:
    """Return C_l of the convergence divided by linear theory, for the lensing maps of a universe with another seed.

    Parameters
    ----------
    box : Box
        The box of matter of this universe, from `gaussian_box`.
    nside : int
        HEALPix resolution of the maps.
    redshifts : sequence of float
        Redshift of the sources of each map (plane).
    edges : sequence of int
        Edges of the bands in l, ascending.

    Returns
    -------
    float array, shape (planes, bands)
        Mean ratio to linear theory in each band.
    """
    kappa, gain = convergence_maps(box, nside, redshifts, edges[-1])
    rows, cosmology = [], box.model.cosmology
    for plane, z in enumerate(redshifts):
        power = hp.anafast(hp.reorder(kappa[plane].astype(float), n2r=True), lmax=edges[-1], iter=0)
        chi = float(cosmology.comoving_distance(z))
        rows.append(band_ratio(cosmology, power * gain[plane] ** 2, chi, edges))
    return np.array(rows)


def power_of_maps(cosmology: Cosmology, planes: Planes, numbers: Sequence[int], edges: Sequence[int]) -> Float:
    """Return C_l of the convergence divided by linear theory, for the lensing maps of the catalogue.

    Parameters
    ----------
    cosmology : Cosmology
        Parameters of the universe.
    planes : Planes
        Lensing maps for sources at several distances (planes).
    numbers : sequence of int
        Indices of the planes to measure.
    edges : sequence of int
        Edges of the bands in l, ascending.

    Returns
    -------
    float array, shape (len(numbers), bands)
        Mean ratio to linear theory in each band.
    """
    rows = []
    for number in numbers:
        ring = hp.reorder(planes.maps[number][:, lensing.KAPPA].astype(float), n2r=True)
        power = hp.anafast(ring, lmax=edges[-1], iter=0)
        rows.append(band_ratio(cosmology, power, float(planes.chi[number]), edges))
    return np.array(rows)


def line_of_sight_rms(box: Box, redshifts: Sequence[float]) -> list[tuple[float, float]]:
    """Return, for sources at each redshift, the rms of the convergence of single lines of sight, and linear theory.

    Each pair has the rms that is measured with rays through the box (with its finite cells), and the rms predicted for
    the same cells.
    """
    chosen, cosmology = lensing.settings(), box.model.cosmology
    chi = np.asarray(cosmology.comoving_distance(np.array(redshifts)))
    direction = np.stack(hp.pix2vec(_SIGHT_NSIDE, np.arange(12 * _SIGHT_NSIDE**2), nest=True)).astype(np.float32)
    kappa = convergence.convergence(box, direction, hp.nside2resol(_SIGHT_NSIDE), chi, 1, chosen.stretch)
    k = np.geomspace(1e-3, 2.0 * np.pi, 300)
    power = density_box.linear_power(cosmology, k) * convergence.window(box.model, 1, k)
    inside, rms_values = np.trapezoid(k * power / (2 * np.pi), k), []
    for plane, source_chi in zip(kappa, chi, strict=True):
        x = _distances(float(source_chi))
        weight = theories.lensing_weight(cosmology, x, np.array([source_chi]), np.ones(1))
        weight = weight * cosmology.growth(cosmology.redshift(x))
        rms_values.append((float(plane.std(dtype=float)), float(np.sqrt(np.trapezoid(weight**2, x) * inside))))
    return rms_values


def skipping_rms(box: Box, redshift: float, step: float) -> float:
    """Return the rms of the convergence if the density is sampled only in single cells along the line of sight.

    It shows the error of a too large step: the rms is larger than with all cells along the line of sight.

    Parameters
    ----------
    box : Box
        Periodic box with the density field.
    redshift : float
        Redshift of the sources.
    step : float
        Distance between sampled cells along the line of sight, Mpc/h.

    Returns
    -------
    float
        rms of the convergence.
    """
    cosmology = box.model.cosmology
    source_chi, width = float(cosmology.comoving_distance(redshift)), 0.5 * step
    direction = np.stack(hp.pix2vec(_SIGHT_NSIDE // 2, np.arange(3 * _SIGHT_NSIDE**2), nest=True), 1)
    box_replicas, kappa = lightcone.draw_replicas(box, source_chi), np.zeros(len(direction))
    for chi in np.arange(width, source_chi, step):
        z = cosmology.redshift(chi)
        growths = np.full(len(direction), cosmology.growth(z))
        place, _ = lightcone.box_cells(box, box_replicas, direction, np.full(len(direction), chi))
        lens = float(theories.lensing_weight(cosmology, np.array([chi]), np.array([source_chi]), np.ones(1))[0])
        kappa += step * lens * density_box.overdensity(box, place, growths)
    return float(kappa.std())


def map_rms(cosmology: Cosmology, chi: float, l_max: int) -> float:
    """Return the rms that linear theory predicts for a map of the convergence.

    Parameters
    ----------
    cosmology : Cosmology
        Parameters of the universe.
    chi : float
        Comoving distance of all sources, Mpc/h.
    l_max : int
        Highest multipole; the lowest is 2.

    Returns
    -------
    float
        The rms.
    """
    ell = np.arange(2, l_max + 1)
    nodes = np.unique(np.geomspace(2, l_max, 80).astype(int))
    power = np.exp(np.interp(np.log(ell), np.log(nodes), np.log(linear_theory(cosmology, nodes.astype(float), chi))))
    return float(np.sqrt(np.sum((2 * ell + 1) / (4 * np.pi) * power)))


def map_statistics(cosmology: Cosmology, planes: Planes, number: int, name: str) -> dict[str, float]:
    """Measure means, rms values and the B-mode fraction of the lensing maps for sources at one distance.

    Parameters
    ----------
    cosmology : Cosmology
        Parameters of the universe.
    planes : Planes
        Lensing maps for sources at several distances (planes).
    number : int
        Index of the plane.
    name : str
        Text that identifies the plane in the names of the results, such as "z1.0".

    Returns
    -------
    dict of str to float
        Measured values by name. The mean convergence is in units of its standard error, deflections are in arcmin, and
        the B modes are the ratio of B-mode to E-mode power.
    """
    fields, chi, l_max = planes.maps[number], float(planes.chi[number]), int(lensing.settings().l_max * planes.nside)
    kappa = fields[:, lensing.KAPPA].astype(float)
    patches = kappa.reshape(12 * _PATCHES**2, -1).mean(1)
    gamma = [hp.reorder(fields[:, i].astype(float), n2r=True) for i in (lensing.GAMMA_1, lensing.GAMMA_2)]
    e_mode, b_mode = hp.map2alm_spin(gamma, 2, lmax=l_max)
    bend = np.hypot(fields[:, lensing.EAST], fields[:, lensing.NORTH]).astype(float)
    return {
        f"kappa_mean_{name}_in_errors": float(patches.mean() / (patches.std(ddof=1) / np.sqrt(patches.size))),
        f"kappa_rms_{name}": float(kappa.std()),
        f"kappa_rms_{name}_to_theory": float(kappa.std() / map_rms(cosmology, chi, l_max)),
        f"gamma_rms_{name}": float(np.std(gamma[0])),
        f"b_modes_{name}": float(np.sum(np.abs(b_mode) ** 2) / np.sum(np.abs(e_mode) ** 2)),
        f"deflection_rms_arcmin_{name}": float(60 * np.degrees(np.sqrt(np.mean(bend**2)))),
        f"deflection_max_arcmin_{name}": float(60 * np.degrees(bend.max())),
    }


def tangential_shear(planes: Planes, halos: Tracers, chi: float) -> tuple[Float, Float]:
    """Measure the mean tangential shear of sources around halos, interpolated from the lensing maps.

    Parameters
    ----------
    planes : Planes
        Lensing maps for sources at several distances.
    halos : Tracers
        Halos, at least one.
    chi : float
        Comoving distance of the sources, Mpc/h.

    Returns
    -------
    mean, error : float array, shape (rings,)
        Mean tangential shear at each radius of RINGS, and its standard error from the scatter between halos.
    """
    mean, error = [], []
    for radius in RINGS:
        shear_sum = np.zeros(halos.ra.size)
        for turn in 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS:
            east, north = radius * np.sin(turn), radius * np.cos(turn)
            offset = np.radians(np.full((2, halos.ra.size), [[east], [north]]))
            ra, dec = lensing.displace(halos.ra, halos.dec, *offset)
            lens_values = lensing.interpolate(planes, ra, dec, np.full(ra.size, chi))
            # The position angle `turn` counts from north to east; gamma1 > 0 elongates images along east-west.
            shear_sum += lens_values[1] * np.cos(2 * turn) - lens_values[2] * np.sin(2 * turn)
        mean.append(np.mean(shear_sum) / _DIRECTIONS)
        error.append(np.std(shear_sum) / _DIRECTIONS / np.sqrt(shear_sum.size))
    return np.array(mean), np.array(error)
