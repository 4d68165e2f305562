"""The dust of the Milky Way: extinction A(V) to infinity from a full-sky map, and to a distance.

embedded    the default map: a cosecant law times a log-normal field, from the universe's seed
a_v         read a map at sky positions
a_v_at      the part of it in front of a star

Maps are HEALPix, RING, Galactic.  Ref: the numbers and their sources are in dust_map.toml.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from importlib.metadata import version
from pathlib import Path

import healpy as hp
import numpy as np
import numpy.typing as npt

from jobs.cache import cached_arrays, content_key
from jobs.catalogue import parameters
from jobs.rng import stream
from lake_schema.sky import galactic

Float = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Cosecant:
    """The embedded map's numbers (dust_map.toml, [map])."""

    nside: int
    ebv_pole: float
    ebv_max: float
    sin_b_min: float
    sigma: float
    slope: float
    l_min: int
    l_max: int
    r_v: float


@dataclass(frozen=True, slots=True)
class Layer:
    """Where along the line of sight the dust lies (dust_map.toml, [layer]); height in pc."""

    height: float


def cosecant() -> Cosecant:
    """The dust of the embedded universe."""
    return Cosecant(**parameters.section("dust_map.toml", "map"))


def layer() -> Layer:
    """The dust layer of the embedded universe."""
    return Layer(**parameters.section("dust_map.toml", "layer"))


def embedded(seed: int, model: Cosecant) -> npt.NDArray[np.float32]:
    """Map of A(V), float32[12 nside^2] mag."""
    _, b = hp.pix2ang(model.nside, np.arange(hp.nside2npix(model.nside)), lonlat=True)
    field = _gaussian_field(seed, model)
    sin_b = np.maximum(np.abs(np.sin(np.radians(b))), model.sin_b_min)
    ebv = model.ebv_pole / sin_b * np.exp(field - 0.5 * model.sigma**2)
    return np.asarray((model.r_v * np.minimum(ebv, model.ebv_max)).astype(np.float32))


def a_v(sky_map: npt.NDArray[np.float32], ra: Float, dec: Float) -> Float:
    """A(V)[n] mag at ICRS positions, deg, bilinear between the map's pixels."""
    lon, lat = galactic(ra, dec)
    return np.asarray(hp.get_interp_val(sky_map, lon, lat, lonlat=True), float)


def a_v_at(to_infinity: Float, distance: Float, b: npt.ArrayLike, dust: Layer, sin_b_min: float) -> Float:
    """A(V)[n] mag on the way to a star.

    to_infinity : [n] mag; distance : [n] pc; b : Galactic latitude, deg; sin_b_min : as in the map
    """
    sin_b = np.maximum(np.abs(np.sin(np.radians(np.asarray(b, float)))), sin_b_min)
    return np.asarray(-to_infinity * np.expm1(-distance * sin_b / dust.height))


def load(seed: int) -> npt.NDArray[np.float32]:
    """The embedded map of a seed, from the cache or made now (1 s)."""
    model = cosecant()
    key = content_key(Path(__file__).read_bytes(), version("healpy"), seed, *astuple(model))
    return cached_arrays("dust_map", key, lambda: {"a_v": embedded(seed, model)})["a_v"]


def _gaussian_field(seed: int, model: Cosecant) -> Float:
    ell, m = hp.Alm.getlm(model.l_max)
    # healpy's synalm draws from numpy's global generator.
    normal = stream(seed, "dust_map").standard_normal((2, ell.size))
    used = ell >= model.l_min
    amplitude = np.where(used, np.where(used, ell, 1.0) ** (-0.5 * model.slope), 0.0)
    alm = amplitude * np.where(m == 0, normal[0], (normal[0] + 1j * normal[1]) / np.sqrt(2.0))
    field = hp.alm2map(alm.astype(complex), model.nside)
    return np.asarray(field * (model.sigma / field.std()))
