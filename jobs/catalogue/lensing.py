"""Weak lensing by the box itself: convergence, shear and deflection maps on source planes, and lensed positions.

load        the planes of a box, from the cache or made now
at          kappa, gamma1, gamma2, deflection of sources: bilinear on the sky, linear in distance between planes
displaced   true positions -> observed ones

gamma1, gamma2 are in the frame (x, y) = (east, north): east or west of a mass gamma1 < 0, north-east of it
gamma2 < 0.  Deflections point away from a mass.
Error: Born approximation; the convergence has the power of linear theory within 10 % up to l = nside (tests), none
       above 1.5 nside
Ref: Bartelmann & Schneider 2001, Phys. Rep. 340, 291; Hu 2000, PhRvD 62, 043007
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass
from pathlib import Path

import healpy as hp
import numpy as np
import numpy.typing as npt

from jobs.cache import cached_arrays, content_key
from jobs.catalogue import density_box, lightcone, parameters
from jobs.catalogue.density_box import Box
from jobs.fluxes import cosmology
from lake_schema.errors import BadInput

Float = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Int = npt.NDArray[np.int64]

KAPPA, GAMMA_1, GAMMA_2, EAST, NORTH = range(5)
_GAIN_NODES = 9


@dataclass(frozen=True, slots=True)
class Settings:
    """How the maps are made (lensing.toml, [lensing])."""

    planes: tuple[float, ...]
    far_planes: tuple[float, ...]
    coarsest: int
    stretch: float
    l_max: float
    caustic: float


@dataclass(frozen=True, slots=True, eq=False)
class Planes:
    """Lensing of sources at distances chi[p] Mpc/h.

    maps : one float32[12 nside^2, 5] a plane, nested: kappa, gamma1, gamma2, deflection east and north in rad
    """

    nside: int
    chi: Float
    maps: tuple[Float32, ...]


def settings() -> Settings:
    """The lensing of the embedded universe."""
    return Settings(**parameters.section("lensing.toml", "lensing"))


def load(box: Box, nside: int, far: bool = False) -> Planes:
    """The planes of a box; far : also those beyond the galaxies, for sources up to z = 10.

    Made once: 20 s for nside = 256, four times as long for twice the resolution.
    Errors: BadInput where nside is not a power of two from 16 to 2048
    """
    if nside not in (1 << order for order in range(4, 12)):
        raise BadInput(f"lensing_nside = {nside} is not a power of two from 16 to 2048")
    chosen = settings()
    z = np.array(chosen.planes + (chosen.far_planes if far else ()))
    code = [(Path(__file__).parent / name).read_bytes() for name in ("density_box.py", "lightcone.py", "lensing.py")]
    about = [np.atleast_1d(value).astype(float) for value in astuple(chosen)]
    key = content_key(*code, box.seed, box.n, *map(float, np.concatenate(about)), nside, int(far))
    chi = cosmology.comoving_distance(z)
    name = f"lensing_{nside}"
    kappa = cached_arrays(f"{name}_kappa", key, lambda: {"field": convergence(box, nside, chi, chosen)})["field"]
    planes = [
        cached_arrays(f"{name}_{i}", key, _plane_of(kappa[i], nside, chosen.l_max))["field"] for i in range(z.size)
    ]
    return Planes(nside, chi, tuple(planes))


def convergence(box: Box, nside: int, chi: Float, chosen: Settings) -> Float32:
    """kappa of sources at chi[p], float32[p, 12 nside^2] nested, Born approximation.

    kappa = 3/2 Om (H0 / c)^2 int dchi' chi' (chi - chi') / chi (1 + z') delta
    """
    direction = np.stack(hp.pix2vec(nside, np.arange(hp.nside2npix(nside)), nest=True), 1).astype(np.float32)
    turned = lightcone.replicas(box, float(chi[-1]))
    table = lightcone.distances(float(cosmology.redshift(float(chi[-1]))) + 0.01)
    # kappa(chi) = first - second / chi: two sums serve every plane.
    first, second = np.zeros(len(direction), np.float32), np.zeros(len(direction), np.float32)
    planes = np.empty((chi.size, len(direction)), np.float32)
    done, at = 0, 0.0
    averaged: tuple[int, int, Float32] | None = None
    pixel = hp.nside2resol(nside)
    nodes = np.linspace(float(density_box.growth(table.z[-1])), 1.0, _GAIN_NODES)
    gain = density_box.matter_gain(box.model, nodes)
    while done < chi.size:
        factor = _coarse(pixel * at / box.model.cell, chosen.coarsest)
        width = factor * box.model.cell
        middle = at + 0.5 * width
        stretch = int(middle // chosen.stretch)
        growth = float(density_box.growth(table.redshift((stretch + 0.5) * chosen.stretch)))
        if averaged is None or averaged[:2] != (stretch, factor):
            averaged = (stretch, factor, _averaged(box, growth, factor))
        delta = averaged[2].ravel()[_places(box, turned, direction, middle, factor)]
        z = float(table.redshift(middle))
        now = float(density_box.growth(z))
        weight = 1.5 * cosmology.OMEGA_M / cosmology.HUBBLE_DISTANCE**2 * width * middle * (1.0 + z)
        weight *= now / growth * float(np.interp(now, nodes, gain))
        while done < chi.size and chi[done] <= middle:
            planes[done] = first - second / np.float32(chi[done])
            done += 1
        first += np.float32(weight) * delta
        second += np.float32(weight * middle) * delta
        at += width
    return planes


def at(planes: Planes, ra: Float, dec: Float, chi: Float) -> Float:
    """[5, n] kappa, gamma1, gamma2, deflection east, north (rad) of sources at chi[n] Mpc/h."""
    pixel, weight = hp.get_interp_weights(planes.nside, ra, dec, nest=True, lonlat=True)
    node = np.concatenate([[0.0], planes.chi])
    upper = np.clip(np.searchsorted(node, chi, side="right"), 1, planes.chi.size)
    part = (chi - node[upper - 1]) / (node[upper] - node[upper - 1])
    found = np.zeros((5, chi.size))
    # Nothing is lensed at the observer: the plane below the first is empty.
    for plane, share in ((upper - 1, part), (upper - 2, 1.0 - part)):
        for number in np.unique(plane[plane >= 0]).tolist():
            rows = np.flatnonzero(plane == number)
            for corner in range(4):
                values = planes.maps[number][pixel[corner, rows]]
                found[:, rows] += values.T * (weight[corner, rows] * share[rows])
    return found


def displaced(ra: Float, dec: Float, east: Float, north: Float) -> tuple[Float, Float]:
    """Positions moved along great circles by (east, north) rad; all [n], ra, dec deg."""
    angle = np.hypot(east, north)
    # sin(angle) / angle without the division by zero.
    ratio = np.sinc(angle / np.pi)
    lat, lon = np.radians(dec), np.radians(ra)
    forward = np.cos(angle) * np.cos(lat) - ratio * north * np.sin(lat)
    up = np.cos(angle) * np.sin(lat) + ratio * north * np.cos(lat)
    sideways = ratio * east
    moved = lon + np.arctan2(sideways, forward)
    return np.degrees(moved) % 360.0, np.degrees(np.arctan2(up, np.hypot(forward, sideways)))


def magnification(kappa: Float, gamma1: Float, gamma2: Float) -> Float:
    """mu[n] = 1 / ((1 - kappa)^2 - gamma^2)."""
    return np.asarray(1.0 / ((1.0 - kappa) ** 2 - gamma1**2 - gamma2**2))


def near_caustic(kappa: Float, gamma1: Float, gamma2: Float, caustic: float) -> npt.NDArray[np.bool_]:
    """Sources[n] that weak lensing cannot describe."""
    return np.asarray(((1.0 - kappa) ** 2 - gamma1**2 - gamma2**2 < caustic) | (kappa >= 1.0))


def transform(kappa: Float32, nside: int, l_max: float) -> Float32:
    """Shear and deflection of a convergence map: float32[12 nside^2, 5] nested; kappa without power above l_max.

    Ref: Hu 2000, eqs. 35 and 36
    """
    top = int(l_max * nside)
    ring = hp.reorder(np.asarray(kappa, float), n2r=True)
    alm = hp.map2alm(ring, lmax=top, iter=1)
    ell = np.arange(top + 1)
    inner = np.maximum(ell * (ell + 1.0), 1.0)
    shear = hp.almxfl(alm, -np.sqrt(np.maximum((ell + 2.0) * (ell - 1.0), 0.0) / inner))
    bend = hp.almxfl(alm, np.where(ell > 0, -2.0 / np.sqrt(inner), 0.0))
    none = np.zeros_like(alm)
    gamma = hp.alm2map_spin([shear, none], nside, 2, top)
    south, east = hp.alm2map_spin([bend, none], nside, 1, top)
    fields = (hp.alm2map(alm, nside, lmax=top), *gamma, east, -south)
    return np.stack([hp.reorder(field, r2n=True) for field in fields], 1).astype(np.float32)


def _plane_of(kappa: Float32, nside: int, l_max: float) -> Callable[[], dict[str, npt.NDArray[np.generic]]]:
    return lambda: {"field": transform(kappa, nside, l_max)}


def _coarse(width: float, most: int) -> int:
    """Cells of the box, a power of two a side, that a pixel of `width` cells is averaged over."""
    return min(1 << max(int(np.log2(max(width, 1.0))), 0), most)


def _averaged(box: Box, growth: float, factor: int) -> Float32:
    """Matter overdensity at a growth, in cubes of factor^3 cells."""
    n = box.n // factor
    mean = np.empty((n, n, n), np.float32)
    offset = np.float32(0.5 * growth**2 * box.variance[0])
    for x in range(n):
        slab = np.expm1(np.float32(growth) * box.smoothed[0][x * factor : (x + 1) * factor] - offset)
        mean[x] = slab.reshape(factor, n, factor, n, factor).mean((0, 2, 4))
    return mean


def _places(box: Box, turned: lightcone.Replicas, direction: Float32, chi: float, factor: int) -> npt.NDArray[np.int32]:
    """Cubes of factor^3 cells that all directions meet at chi: flat indices [n]."""
    shell = int(chi // box.length)
    width, n = box.model.cell * factor, box.n // factor
    index = np.zeros(len(direction), np.int32)
    for axis in range(3):
        along = direction[:, turned.axes[shell, axis]] * np.float32(turned.sign[shell, axis] * chi / width)
        along += np.float32(turned.shift[shell, axis] / width)
        index = index * n + np.mod(np.floor(along, out=along).astype(np.int32), n)
    return index
