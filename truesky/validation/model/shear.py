"""Lensing by the simulated universe: C_l and rms of the convergence, B modes, and the shear around massive halos.

The maps of the catalogue and those of boxes with other seeds are compared with linear theory.
"""

from __future__ import annotations

from collections.abc import Sequence

import healpy as hp
import numpy as np

from lake_schema.arrays import Float, Float32
from truesky.catalogue.galaxies import lensing
from truesky.catalogue.galaxies.lensing import Planes
from truesky.catalogue.matter import convergence, density_box, lightcone
from truesky.catalogue.matter.density_box import Box
from truesky.fluxes import cosmology
from truesky.validation import theory as theories
from truesky.validation.model.clustering import Tracers

# The error of a mean is the scatter of the cells of this nside.
_PATCHES = 2
_STEPS = 1500
_SIGHT_NSIDE = 128
# Radii of rings around halos (deg), and number of directions.
RINGS, _DIRECTIONS = (0.1, 0.2, 0.4, 0.8), 8


def linear_theory(ell: Float, chi: float) -> Float:
    """C_l of the convergence of sources at `chi` Mpc/h, from linear theory and Limber's approximation."""
    return theories.convergence_power(ell, np.array([chi]), np.ones(1), theories.linear_power, _distances(chi))


def _distances(chi: float) -> Float:
    """Comoving distances (Mpc/h) up to sources at `chi`, over which linear theory is integrated."""
    return np.linspace(2.0, chi - 0.5, _STEPS)


def band_ratio(power: Float, chi: float, edges: Sequence[int]) -> Float:
    """Return C_l over theory in bands of l, with each l weighted by its number of modes.

    Parameters
    ----------
    power : float array
        C_l from l = 0.
    chi : float
        Comoving distance of the sources, Mpc/h.
    edges : sequence of int
        Edges of the bands in l.

    Returns
    -------
    float array, shape (bands,)
        Mean ratio in each band.
    """
    ell = np.arange(edges[0], edges[-1] + 1)
    nodes = np.unique(np.geomspace(edges[0], edges[-1], 60).astype(int))
    expected = np.exp(np.interp(np.log(ell), np.log(nodes), np.log(linear_theory(nodes.astype(float), chi))))
    ratio = (2 * ell + 1) * power[ell] / expected
    modes = 2.0 * ell + 1.0
    place = np.digitize(ell, edges) - 1
    place[-1] = len(edges) - 2
    return np.bincount(place, ratio) / np.bincount(place, modes)


def convergence_maps(box: Box, nside: int, redshifts: Sequence[float], l_max: int) -> tuple[Float32, Float]:
    """Return the convergence along lines of sight, and the factors of its multipoles for maps.

    Parameters
    ----------
    box : Box
        Box of matter.
    nside : int
        Resolution of the maps.
    redshifts : sequence of float
        Redshift of the sources of each plane.
    l_max : int
        Highest multipole.

    Returns
    -------
    kappa : float32 array, shape (planes, pixels)
        Convergence, nested.
    gain : float array, shape (planes, l_max + 1)
        Factor by which multipoles are multiplied in maps of the catalogue.
    """
    chosen = lensing.settings()
    direction = np.stack(hp.pix2vec(nside, np.arange(hp.nside2npix(nside)), nest=True)).astype(np.float32)
    chi = np.asarray(cosmology.comoving_distance(np.array(redshifts)))
    width, step_settings = hp.nside2resol(nside), (chosen.coarsest, chosen.stretch)
    return (
        convergence.convergence(box, direction, width, chi, *step_settings),
        convergence.transfer(box, width, chi, l_max, *step_settings),
    )


def gaussian_box(seed: int, n: int) -> Box:
    """Return a box without smoothed fields and velocities, which lensing does not need; it is not cached."""
    model = density_box.box_model()
    g = density_box._gaussian(seed, n, model.cell)
    return Box(model, n, seed, (g,), np.array([g.var(dtype=float)]), ())


def power_of_box(seed: int, n: int, nside: int, redshifts: Sequence[float], edges: Sequence[int]) -> Float:
    """Return C_l over theory of the maps of a catalogue with another seed.

    Parameters
    ----------
    seed : int
        Seed of the box of matter.
    n : int
        Cells per side of the box.
    nside : int
        Resolution of the maps.
    redshifts : sequence of float
        Redshift of the sources of each plane.
    edges : sequence of int
        Edges of the bands in l.

    Returns
    -------
    float array, shape (planes, bands)
        Ratio to linear theory.
    """
    kappa, gain = convergence_maps(gaussian_box(seed, n), nside, redshifts, edges[-1])
    rows = []
    for plane, z in enumerate(redshifts):
        power = hp.anafast(hp.reorder(kappa[plane].astype(float), n2r=True), lmax=edges[-1], iter=0)
        rows.append(band_ratio(power * gain[plane] ** 2, float(cosmology.comoving_distance(z)), edges))
    return np.array(rows)


def power_of_maps(planes: Planes, numbers: Sequence[int], edges: Sequence[int]) -> Float:
    """Return C_l over theory of the maps of the catalogue.

    Parameters
    ----------
    planes : Planes
        Lensing maps.
    numbers : sequence of int
        Planes to measure.
    edges : sequence of int
        Edges of the bands in l.

    Returns
    -------
    float array, shape (planes, bands)
        Ratio to linear theory.
    """
    rows = []
    for number in numbers:
        ring = hp.reorder(planes.maps[number][:, lensing.KAPPA].astype(float), n2r=True)
        rows.append(band_ratio(hp.anafast(ring, lmax=edges[-1], iter=0), float(planes.chi[number]), edges))
    return np.array(rows)


def line_of_sight_rms(box: Box, redshifts: Sequence[float]) -> list[tuple[float, float]]:
    """Return the rms of the convergence along lines of sight through the box, and the rms from linear theory."""
    chosen, chi = lensing.settings(), np.asarray(cosmology.comoving_distance(np.array(redshifts)))
    direction = np.stack(hp.pix2vec(_SIGHT_NSIDE, np.arange(12 * _SIGHT_NSIDE**2), nest=True)).astype(np.float32)
    kappa = convergence.convergence(box, direction, hp.nside2resol(_SIGHT_NSIDE), chi, 1, chosen.stretch)
    k = np.geomspace(1e-3, 2.0 * np.pi, 300)
    power = density_box.linear_power(k) * convergence.window(box.model.cell, 1, k)
    inside, rms_values = np.trapezoid(k * power / (2 * np.pi), k), []
    for plane, source_chi in zip(kappa, chi, strict=True):
        x = _distances(float(source_chi))
        weight = theories.lensing_weight(x, np.array([source_chi]), np.ones(1)) * density_box.growth(
            cosmology.redshift(x)
        )
        rms_values.append((float(plane.std(dtype=float)), float(np.sqrt(np.trapezoid(weight**2, x) * inside))))
    return rms_values


def skipping_rms(box: Box, redshift: float, step: float) -> float:
    """Return the rms of the convergence from single cells at a fixed step; it is larger than that of all cells.

    Parameters
    ----------
    box : Box
        Box of matter.
    redshift : float
        Redshift of the sources.
    step : float
        Step along the line of sight, Mpc/h.

    Returns
    -------
    float
        rms of the convergence.
    """
    source_chi, width = float(cosmology.comoving_distance(redshift)), 0.5 * step
    direction = np.stack(hp.pix2vec(_SIGHT_NSIDE // 2, np.arange(3 * _SIGHT_NSIDE**2), nest=True), 1)
    box_replicas, kappa = lightcone.draw_replicas(box, source_chi), np.zeros(len(direction))
    for chi in np.arange(width, source_chi, step):
        z = cosmology.redshift(chi)
        growths = np.full(len(direction), density_box.growth(z))
        place, _ = lightcone.box_cells(box, box_replicas, direction, np.full(len(direction), chi))
        lens = float(theories.lensing_weight(np.array([chi]), np.array([source_chi]), np.ones(1))[0])
        kappa += step * lens * density_box.overdensity(box, place, growths)
    return float(kappa.std())


def map_rms(chi: float, l_max: int) -> float:
    """Return the rms of a map up to multipole `l_max` from linear theory, for sources at `chi` Mpc/h."""
    ell = np.arange(2, l_max + 1)
    nodes = np.unique(np.geomspace(2, l_max, 80).astype(int))
    power = np.exp(np.interp(np.log(ell), np.log(nodes), np.log(linear_theory(nodes.astype(float), chi))))
    return float(np.sqrt(np.sum((2 * ell + 1) / (4 * np.pi) * power)))


def map_statistics(planes: Planes, number: int, name: str) -> dict[str, float]:
    """Measure moments and the share of B modes of the maps of one plane.

    Parameters
    ----------
    planes : Planes
        Lensing maps.
    number : int
        Number of the plane.
    name : str
        Name of the plane in the names of the figures.

    Returns
    -------
    dict of str to float
        Figures by name; deflections are in arcmin.
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
        f"kappa_rms_{name}_to_theory": float(kappa.std() / map_rms(chi, l_max)),
        f"gamma_rms_{name}": float(np.std(gamma[0])),
        f"b_modes_{name}": float(np.sum(np.abs(b_mode) ** 2) / np.sum(np.abs(e_mode) ** 2)),
        f"deflection_rms_arcmin_{name}": float(60 * np.degrees(np.sqrt(np.mean(bend**2)))),
        f"deflection_max_arcmin_{name}": float(60 * np.degrees(bend.max())),
    }


def tangential_shear(planes: Planes, halos: Tracers, chi: float) -> tuple[Float, Float]:
    """Return the mean tangential shear of sources around halos, and its error.

    Parameters
    ----------
    planes : Planes
        Lensing maps.
    halos : Tracers
        Halos.
    chi : float
        Comoving distance of the sources, Mpc/h.

    Returns
    -------
    mean, error : float array, shape (rings,)
        Shear in each ring of RINGS.
    """
    mean, error = [], []
    for radius in RINGS:
        shear_sum = np.zeros(halos.ra.size)
        for turn in 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS:
            east, north = radius * np.sin(turn), radius * np.cos(turn)
            offset = np.radians(np.full((2, halos.ra.size), [[east], [north]]))
            ra, dec = lensing.displace(halos.ra, halos.dec, *offset)
            lens_values = lensing.interpolate(planes, ra, dec, np.full(ra.size, chi))
            # The position angle is from north to east; gamma1 > 0 is north-south.
            shear_sum += lens_values[1] * np.cos(2 * turn) - lens_values[2] * np.sin(2 * turn)
        mean.append(np.mean(shear_sum) / _DIRECTIONS)
        error.append(np.std(shear_sum) / _DIRECTIONS / np.sqrt(shear_sum.size))
    return np.array(mean), np.array(error)
