"""How the embedded universe lenses: C_l of the convergence, its rms, B modes, and the shear about massive halos.

maps         what the maps of the catalogue hold
power_of     C_l of the convergence over that of linear theory, of these maps;  power_of_box : of another seed's
sight_rms    of the convergence along lines of sight, before it becomes a map;  skipping_rms : of too few cells
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

# Patches of the sky whose scatter gives the error of a mean: cells of this nside.
_PATCHES = 2
_STEPS = 1500
_SIGHT_NSIDE = 128
# Rings about halos, deg, and directions.
RINGS, _DIRECTIONS = (0.1, 0.2, 0.4, 0.8), 8


def linear_theory(ell: Float, chi: float) -> Float:
    """C_l of the convergence of sources at chi Mpc/h, linear theory, by Limber's approximation."""
    return theories.convergence_power(ell, np.array([chi]), np.ones(1), theories.linear_power, _distances(chi))


def _distances(chi: float) -> Float:
    """Distances[n] that linear theory is summed over, Mpc/h, up to sources at chi."""
    return np.linspace(2.0, chi - 0.5, _STEPS)


def band_ratio(power: Float, chi: float, edges: Sequence[int]) -> Float:
    """C_l / theory between multipoles, each l counting as its number of modes."""
    ell = np.arange(edges[0], edges[-1] + 1)
    nodes = np.unique(np.geomspace(edges[0], edges[-1], 60).astype(int))
    expected = np.exp(np.interp(np.log(ell), np.log(nodes), np.log(linear_theory(nodes.astype(float), chi))))
    ratio = (2 * ell + 1) * power[ell] / expected
    modes = 2.0 * ell + 1.0
    place = np.digitize(ell, edges) - 1
    place[-1] = len(edges) - 2
    return np.bincount(place, ratio) / np.bincount(place, modes)


def convergence_maps(box: Box, nside: int, redshifts: Sequence[float], l_max: int) -> tuple[Float32, Float]:
    """Convergence [plane, pixel] (nested) along lines of sight, and what its multipoles are multiplied by for maps.

    box       : of matter;  nside : of the maps;  redshifts : of the sources, a plane each;  l_max : highest multipole
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
    """A box without its smoothed fields and velocities, which lensing does not ask for; not kept."""
    model = density_box.box_model()
    g = density_box._gaussian(seed, n, model.cell)
    return Box(model, n, seed, (g,), np.array([g.var(dtype=float)]), ())


def power_of_box(seed: int, n: int, nside: int, redshifts: Sequence[float], edges: Sequence[int]) -> Float:
    """C_l / theory [plane, band] of the maps that the catalogue would have of another seed.

    seed, n   : of the box of matter, and its cells a side;  nside : of the maps
    redshifts : of the sources, a plane each;  edges : of the bands in l
    """
    kappa, gain = convergence_maps(gaussian_box(seed, n), nside, redshifts, edges[-1])
    rows = []
    for plane, z in enumerate(redshifts):
        power = hp.anafast(hp.reorder(kappa[plane].astype(float), n2r=True), lmax=edges[-1], iter=0)
        rows.append(band_ratio(power * gain[plane] ** 2, float(cosmology.comoving_distance(z)), edges))
    return np.array(rows)


def power_of_maps(planes: Planes, numbers: Sequence[int], edges: Sequence[int]) -> Float:
    """C_l / theory [plane, band] of the catalogue's own maps."""
    rows = []
    for number in numbers:
        ring = hp.reorder(planes.maps[number][:, lensing.KAPPA].astype(float), n2r=True)
        rows.append(band_ratio(hp.anafast(ring, lmax=edges[-1], iter=0), float(planes.chi[number]), edges))
    return np.array(rows)


def line_of_sight_rms(box: Box, redshifts: Sequence[float]) -> list[tuple[float, float]]:
    """rms of the convergence along lines of sight through cells of the box, and what linear theory gives such cells."""
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
    """rms of the sums over single cells every `step` Mpc/h, as if each stood for all between: too large."""
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
    """rms that linear theory gives a map to that multipole."""
    ell = np.arange(2, l_max + 1)
    nodes = np.unique(np.geomspace(2, l_max, 80).astype(int))
    power = np.exp(np.interp(np.log(ell), np.log(nodes), np.log(linear_theory(nodes.astype(float), chi))))
    return float(np.sqrt(np.sum((2 * ell + 1) / (4 * np.pi) * power)))


def map_statistics(planes: Planes, number: int, name: str) -> dict[str, float]:
    """Moments of one plane's maps, and the share of B modes."""
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
    """Mean tangential shear[ring] of sources at chi about halos, and its error."""
    mean, error = [], []
    for radius in RINGS:
        shear_sum = np.zeros(halos.ra.size)
        for turn in 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS:
            east, north = radius * np.sin(turn), radius * np.cos(turn)
            offset = np.radians(np.full((2, halos.ra.size), [[east], [north]]))
            ra, dec = lensing.displace(halos.ra, halos.dec, *offset)
            lens_values = lensing.interpolate(planes, ra, dec, np.full(ra.size, chi))
            # Position angle from north to east; gamma1 > 0 is north-south.
            shear_sum += lens_values[1] * np.cos(2 * turn) - lens_values[2] * np.sin(2 * turn)
        mean.append(np.mean(shear_sum) / _DIRECTIONS)
        error.append(np.std(shear_sum) / _DIRECTIONS / np.sqrt(shear_sum.size))
    return np.array(mean), np.array(error)
