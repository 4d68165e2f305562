"""Weak lensing by the simulated matter: full-sky maps of convergence, shear and deflection, and observed positions.

There is one map per source plane (comoving distance). The matter fills a periodic box, which is repeated along the line
of sight. A uniform shear, or a shear of 0, can replace the maps. gamma1 and gamma2 are in the frame (x, y) = (east,
north): gamma1 < 0 east and west of a mass, and gamma2 < 0 north-east of it. Deflections point away from a mass.

Notes
-----
The maps use the Born approximation. The convergence has the power of linear theory within 10 % up to l = nside for
sources at z > 0.4 (tests), and no power above 1.5 nside.

References
----------
Bartelmann & Schneider 2001, Phys. Rep. 340, 291; Hu 2000, PhRvD 62, 043007
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from lake_schema import sky
from lake_schema.arrays import Array, Bool, Float, Float32
from lake_schema.errors import BadInput
from lake_schema.lazy_healpy import healpy as hp
from truesky.catalogue import parameters
from truesky.catalogue.matter import boltzmann
from truesky.catalogue.matter.density_box import Box
from truesky.fluxes import sources
from truesky.numerics import activity
from truesky.numerics.cache import cached_arrays, content_key
from truesky.numerics.cache_labels import label_lensing
from truesky.numerics.code_fingerprints import code_key

# Columns of a map: convergence, two components of the shear, and deflection to the east and north (rad).
KAPPA, GAMMA_1, GAMMA_2, EAST, NORTH = range(5)


@dataclass(frozen=True, slots=True)
class Settings:
    """Source planes, resolution and limits of the lensing maps; explained in lensing.toml, [lensing]."""

    planes: tuple[float, ...]
    far_planes: tuple[float, ...]
    coarsest: int
    stretch: float
    l_max: float
    caustic: float


@dataclass(frozen=True, slots=True, eq=False)
class Planes:
    """Lensing maps for sources at p comoving distances (source planes).

    Attributes
    ----------
    nside : int
        HEALPix resolution of the maps.
    chi : float array, shape (p,)
        Comoving distances of the planes, ascending, Mpc/h.
    maps : tuple of float32 array, shape (12 nside^2, 5)
        One map per plane in nested order. The columns are kappa, gamma1, gamma2, and deflection to the east and to the
        north (rad).
    """

    nside: int
    chi: Float
    maps: tuple[Float32, ...]


@dataclass(frozen=True, slots=True)
class Shear:
    """Uniform shear without convergence, which replaces the lensing by the simulated matter.

    g1 and g2 are gamma1 and gamma2 in the frame (east, north); because kappa = 0, they equal the reduced shear.
    Sources are observed at their true positions, because a uniform shear has no fixed point on the sphere.
    """

    g1: float = 0.0
    g2: float = 0.0


Lens = Planes | Shear


def settings() -> Settings:
    """Return the built-in source planes, resolution and limits of the lensing maps."""
    return Settings(**parameters.section("lensing.toml", "lensing"))


def load(box: Box, nside: int, with_far_planes: bool = False) -> Planes:
    """Return the lensing maps of a box of simulated matter, from the disc cache if they have been made before.

    Parameters
    ----------
    box : Box
        Periodic box of matter, which is repeated along the line of sight.
    nside : int
        HEALPix resolution of the maps, a power of 2 from 16 to 2048.
    with_far_planes : bool
        If True, include source planes at z = 6 and 10 for distant quasars and galaxies. Galaxies in halos end at z = 6.

    Returns
    -------
    Planes
        The maps.

    Raises
    ------
    BadInput
        If `nside` is not a power of 2 from 16 to 2048.

    Notes
    -----
    Making the maps takes 15 CPU s for nside = 64, 27 for 256, 72 for 512 and 320 for 1024.
    """
    if nside not in (1 << order for order in range(4, 12)):
        raise BadInput(f"lensing_nside = {nside} is not a power of two from 16 to 2048")
    chosen = settings()
    z = np.array(chosen.planes + (chosen.far_planes if with_far_planes else ()))
    numbers = [np.atleast_1d(value).astype(float) for value in astuple(chosen)]
    cosmology, maps = box.model.cosmology, (nside, int(with_far_planes))
    numbers_of_box = box.seed, box.n, cosmology.fingerprint(), boltzmann.camb_version(cosmology)
    key = content_key(code_key(__name__), *numbers_of_box, *map(float, np.concatenate(numbers)), *maps)
    chi = cosmology.comoving_distance(z)
    name = f"lensing_{nside}"
    summed = cached_arrays(f"{name}_kappa", key, lambda: _convergence_maps(box, nside, chi, chosen))
    # The label is that of the last map, which is made after all others.
    labels = [""] * (z.size - 1) + [label_lensing(cosmology.fingerprint(), box.seed, box.n, nside, with_far_planes)]

    def plane(i: int) -> Array:
        make = _plane_of(summed["kappa"][i], nside, summed["transfer"][i])
        return cached_arrays(f"{name}_{i}", key, make, labels[i])["field"]

    planes = [plane(i) for i in activity.track(range(z.size), "lensing map")]
    return Planes(nside, chi, tuple(planes))


def interpolate(planes: Planes, ra: Float, dec: Float, chi: Float) -> Float:
    """Interpolate the lensing of sources, bilinearly on the sky and linearly in distance between source planes.

    Parameters
    ----------
    planes : Planes
        The maps.
    ra, dec : float array, shape (n,)
        True positions, deg.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h. Sources beyond the last plane get the values of the last plane. Between the observer,
        where the lensing is 0, and the first plane the interpolation is also linear.

    Returns
    -------
    float array, shape (5, n)
        kappa, gamma1, gamma2, deflection to the east and north (rad).
    """
    pixel, weight = hp.get_interp_weights(planes.nside, ra, dec, nest=True, lonlat=True)
    node, chi = np.concatenate([[0.0], planes.chi]), np.minimum(chi, planes.chi[-1])
    upper = np.clip(np.searchsorted(node, chi, side="right"), 1, planes.chi.size)
    part = (chi - node[upper - 1]) / (node[upper] - node[upper - 1])
    total = np.zeros((5, chi.size))
    # Plane -1 is the observer: the lensing is 0 there, so nothing is added.
    for plane, share in ((upper - 1, part), (upper - 2, 1.0 - part)):
        for number in np.unique(plane[plane >= 0]).tolist():
            rows = np.flatnonzero(plane == number)
            for corner in range(4):
                values = planes.maps[number][pixel[corner, rows]]
                total[:, rows] += values.T * (weight[corner, rows] * share[rows])
    return total


def columns(lens: Lens, ra: Float, dec: Float, chi: Float) -> dict[str, Array]:
    """Return positions and lensing of sources as columns of table `galaxies`.

    Parameters
    ----------
    lens : Lens
        Maps, or a uniform shear.
    ra, dec : float array, shape (n,)
        True positions, deg.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h; not used for a uniform shear.

    Returns
    -------
    dict of str to array, shape (n,)
        Columns by name: the columns of `position_columns`, kappa, gamma1 and gamma2.
    """
    if isinstance(lens, Shear):
        gamma = {"gamma1": np.full(ra.size, lens.g1), "gamma2": np.full(ra.size, lens.g2)}
        return {**position_columns((ra, dec), (ra, dec)), "kappa": np.zeros(ra.size), **gamma}
    kappa, gamma1, gamma2, east, north = interpolate(lens, ra, dec, chi)
    shear = {"kappa": kappa, "gamma1": gamma1, "gamma2": gamma2}
    return {**position_columns(displace(ra, dec, east, north), (ra, dec)), **shear}


def position_columns(observed: tuple[Float, Float], true: tuple[Float, Float]) -> dict[str, Array]:
    """Return the columns ra, dec, _healpix_29, ra_true and dec_true from observed and true (ra, dec) in deg.

    Right ascensions are wrapped to [0, 360). _healpix_29 is the order-29 cell of the observed position.
    """
    return {
        "ra": sky.wrap_angle(observed[0]),
        "dec": observed[1],
        "_healpix_29": sky.healpix_29(*observed),
        "ra_true": sky.wrap_angle(true[0]),
        "dec_true": true[1],
    }


def max_deflection(planes: Planes, order: int, cell: int) -> float:
    """Return an upper limit of the deflection of sources in a HEALPix cell.

    Parameters
    ----------
    planes : Planes
        The maps.
    order, cell : int
        Order and nested index of the cell.

    Returns
    -------
    float
        Largest deflection (rad) of all planes at the pixels in and around the cell. Sources have weighted means of
        these values, which are not larger.
    """
    map_order = int(np.log2(planes.nside))
    coarse = min(order, map_order)
    nearby_cells = np.append(
        sky.margin_cells(coarse, cell >> 2 * (order - coarse), coarse), cell >> 2 * (order - coarse)
    )
    fine = 2 * (map_order - coarse)
    pixels = (nearby_cells[:, None] << fine) + np.arange(1 << fine)
    return max(float(np.hypot(*field[pixels.ravel(), EAST:].T).max()) for field in planes.maps)


# Function that moves positions (ra, dec, deg) by angles to the east and north (rad).
displace = sky.offset_positions


def rotate_position_angles(rows: pa.Table, angle: float) -> pa.Table:
    """Return rows of table `galaxies` with `angle` (deg) added to each position angle; the lensing is not changed."""
    if angle % 180.0 == 0.0:
        return rows
    number = rows.schema.get_field_index("position_angle")
    angles = sky.wrap_position_angle(rows["position_angle"].to_numpy() + angle)
    field = rows.schema.field(number)
    return rows.set_column(number, field, pa.array(angles, field.type))


def is_near_caustic(kappa: Float, gamma1: Float, gamma2: Float, caustic: float) -> Bool:
    """Return True for sources near a caustic or inside it, where weak lensing is not valid.

    Parameters
    ----------
    kappa, gamma1, gamma2 : float array, shape (n,)
        Convergence and shear.
    caustic : float
        Smallest determinant (1 - kappa)^2 - gamma^2 for which weak lensing is valid.

    Returns
    -------
    bool array, shape (n,)
        True if the determinant is smaller, or if kappa >= 1.
    """
    return np.asarray((sources.determinant(kappa, gamma1, gamma2) < caustic) | (kappa >= 1.0))


def maps_of_convergence(kappa: Float32, nside: int, gain: Float) -> Float32:
    """Compute full-sky maps of filtered convergence, shear and deflection from a map of the convergence.

    Parameters
    ----------
    kappa : float32 array, shape (12 nside^2,)
        Convergence in nested order.
    nside : int
        HEALPix resolution of the map.
    gain : float array, shape (l_max + 1,)
        Factor by which the spherical harmonic coefficients kappa_lm are multiplied, by multipole l.

    Returns
    -------
    float32 array, shape (12 nside^2, 5)
        Maps in nested order; the columns are kappa, gamma1, gamma2, deflection to the east and north (rad).

    References
    ----------
    Hu 2000, eqs. 35 and 36
    """
    top = gain.size - 1
    ring_of = hp.nest2ring(nside, np.arange(kappa.size))
    ring = np.empty(kappa.size)
    ring[ring_of] = kappa
    # Without iterations (iter=0) the error of the coefficients is 5e-4, a hundredth of the smoothing by the pixels.
    alm = hp.almxfl(hp.map2alm(ring, lmax=top, iter=0), gain)
    ell = np.arange(top + 1)
    inner = np.maximum(ell * (ell + 1.0), 1.0)
    shear_alm = hp.almxfl(alm, -np.sqrt(np.maximum((ell + 2.0) * (ell - 1.0), 0.0) / inner))
    deflection_alm = hp.almxfl(alm, np.where(ell > 0, -2.0 / np.sqrt(inner), 0.0))
    zero_alm = np.zeros_like(alm)
    gamma = hp.alm2map_spin([shear_alm, zero_alm], nside, 2, top)
    south, east = hp.alm2map_spin([deflection_alm, zero_alm], nside, 1, top)
    fields = (hp.alm2map(alm, nside, lmax=top), *gamma, east, -south)
    return np.stack([field.astype(np.float32)[ring_of] for field in fields], 1)


def _convergence_maps(box: Box, nside: int, chi: Float, chosen: Settings) -> dict[str, npt.NDArray[np.generic]]:
    # Import here, because compiling takes a second and is not needed if the maps are in the disc cache.
    from truesky.catalogue.matter import convergence

    direction = np.stack(hp.pix2vec(nside, np.arange(hp.nside2npix(nside)), nest=True)).astype(np.float32)
    width, averaging = hp.nside2resol(nside), (chosen.coarsest, chosen.stretch)
    return {
        "kappa": convergence.convergence(box, direction, width, chi, *averaging),
        "transfer": convergence.transfer(box, width, chi, int(chosen.l_max * nside), *averaging),
    }


def _plane_of(kappa: Float32, nside: int, gain: Float) -> Callable[[], dict[str, npt.NDArray[np.generic]]]:
    return lambda: {"field": maps_of_convergence(kappa, nside, gain)}
