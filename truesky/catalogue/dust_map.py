"""The dust of the Milky Way: extinction A(V) to infinity from a full-sky map, and to a distance.

embedded    the default map: a cosecant law times a log-normal field, from the universe's seed
chosen      the map of a request: a file of its own, else the default
facts       what stands for the file in a plan
a_v         read a map at sky positions
a_v_at      the part of it in front of a star

Maps are HEALPix, RING, Galactic.  Ref: the numbers and their sources are in dust_map.toml.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, astuple, dataclass
from importlib.metadata import version
from typing import Any

import healpy as hp
import numpy as np
import numpy.typing as npt

from lake_schema import user_files
from lake_schema.arrays import Float, Float32
from lake_schema.errors import BadInput
from lake_schema.fits.external import read_map
from lake_schema.sky import equatorial, galactic
from lake_schema.store.provenance import canonical, file_sha256
from truesky.catalogue import parameters
from truesky.numerics.cache import cached_arrays, content_key
from truesky.numerics.code_fingerprints import code_key
from truesky.randomness.rng import stream
from truesky.request.files import DustMap

# Table `galaxies` holds no more.
_MAX_A_V = 40.0
# Of the steps between neighbours, the other ordering's over that which the header says.
_SMOOTHNESS_RATIO = 0.5


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


def make_map(seed: int, model: Cosecant) -> Float32:
    """Map of A(V), float32[12 nside^2] mag."""
    _, b = hp.pix2ang(model.nside, np.arange(hp.nside2npix(model.nside)), lonlat=True)
    field = _gaussian_field(seed, model)
    sin_b = np.maximum(np.abs(np.sin(np.radians(b))), model.sin_b_min)
    ebv = model.ebv_pole / sin_b * np.exp(field - 0.5 * model.sigma**2)
    return np.asarray((model.r_v * np.minimum(ebv, model.ebv_max)).astype(np.float32))


def a_v(sky_map: Float32, ra: Float, dec: Float) -> Float:
    """A(V)[n] mag at ICRS positions, deg, bilinear between the map's pixels.

    sky_map : float32[pixel] mag, RING, Galactic;  ra, dec : float[n] deg
    """
    lon, lat = galactic(ra, dec)
    return np.asarray(hp.get_interp_val(sky_map, lon, lat, lonlat=True), float)


def a_v_at(to_infinity: Float, distance: Float, b: npt.ArrayLike, dust: Layer, sin_b_min: float) -> Float:
    """A(V)[n] mag on the way to a star.

    to_infinity : [n] mag; distance : [n] pc; b : Galactic latitude, deg; sin_b_min : as in the map
    dust        : the layer that the dust lies in
    """
    sin_b = np.maximum(np.abs(np.sin(np.radians(np.asarray(b, float)))), sin_b_min)
    return np.asarray(-to_infinity * np.expm1(-distance * sin_b / dust.height))


def load(seed: int) -> Float32:
    """The embedded map of a seed, from the cache or made now (1 s).

    returns : float32[pixel] A(V) mag, RING, Galactic
    """
    model = cosecant()
    key = content_key(code_key(__name__), version("healpy"), seed, *astuple(model))
    return cached_arrays("dust_map", key, lambda: {"a_v": make_map(seed, model)})["a_v"]


def facts(user_map: DustMap | None) -> dict[str, Any]:
    """Empty without a file; BadInput where it is not there."""
    if user_map is None:
        return {}
    user_files.check_file(user_map.file, "map of dust", "ingest.dust.file")
    settings = {name: value for name, value in asdict(user_map).items() if name != "file"}
    return {"dust": {"sha256": file_sha256(user_map.file), **settings}}


def map_for_request(seed: int, user_map: DustMap | None) -> Float32:
    """Map of A(V), RING and Galactic, of a request's file (from the cache or read now), or the embedded one.

    returns : float32[pixel] mag
    """
    if user_map is None:
        return load(seed)
    key = content_key(code_key(__name__), version("healpy"), canonical(facts(user_map)))
    return cached_arrays("dust_file", key, lambda: {"a_v": read(user_map)})["a_v"]


def read(user_map: DustMap) -> Float32:
    """An external map in the form of the embedded one: A(V), RING, Galactic, not finer than the embedded one.

    returns : float32[pixel] mag
    Errors: BadInput names the file, and what is missing or wrong: ordering, coordinates, or the row of a pixel
    """
    values, cards = read_map(user_map.file, user_map.column)
    where = f"{user_map.file}: column {user_map.column}"
    ordering = _header_or_request(
        user_map, "ORDERING", "ordering", cards, {"RING": "RING", "NESTED": "NESTED", "NEST": "NESTED"}
    )
    frame = _header_or_request(
        user_map, "COORDSYS", "coordinates", cards, {"G": "G", "GALACTIC": "G", "C": "C", "Q": "C"}
    )
    if not values.size or not hp.isnpixok(values.size):
        raise BadInput(f"{where}: {values.size} pixels are not those of a HEALPix map of the whole sky")
    nside = hp.npix2nside(values.size)
    if cards.get("NSIDE", nside) != nside:
        raise BadInput(f"{where}: NSIDE is {cards['NSIDE']}, {values.size} pixels are of {nside}")
    model = cosecant()
    to_a_v = model.r_v if user_map.quantity == "ebv" else 1.0
    bad = ~((values >= 0.0) & (values * to_a_v <= _MAX_A_V))
    if bad.any():
        row = int(bad.argmax())
        raise BadInput(
            f"{where} of row {row + 1} is {values[row]:g} ({bad.sum()} rows like it), no {user_map.quantity}"
        )
    _refuse_other_ordering(where, values, ordering)
    ring = hp.reorder(values, n2r=True) if ordering == "NESTED" else values
    if nside > model.nside:
        ring = hp.ud_grade(ring, model.nside)
    if frame == "C":
        ra, dec = equatorial(*hp.pix2ang(hp.npix2nside(ring.size), np.arange(ring.size), lonlat=True))
        ring = hp.get_interp_val(ring, ra, dec, lonlat=True)
    return np.asarray(to_a_v * ring, np.float32)


def _header_or_request(
    user_map: DustMap, card: str, key: str, cards: Mapping[str, Any], names: Mapping[str, str]
) -> str:
    """What header and request say; one of them is enough."""
    header_value, requested = str(cards.get(card, "")).strip().upper(), getattr(user_map, key)
    if header_value and header_value not in names:
        raise BadInput(f"{user_map.file}: {card} is {header_value!r}, not one of {', '.join(names)}")
    if header_value and requested and names[header_value] != requested:
        raise BadInput(f"{user_map.file}: {card} is {header_value!r}, ingest.dust.{key} says {requested!r}")
    if not header_value and not requested:
        raise BadInput(
            f"{user_map.file}: column {user_map.column}: no {card} in its header: name it by ingest.dust.{key}"
        )
    return names[header_value] if header_value else str(requested)


def _refuse_other_ordering(where: str, values: Float, ordering: str) -> None:
    """Dust is smooth: where neighbours differ much less in the other ordering, that is the map's own."""
    nside = hp.npix2nside(values.size)
    pixel = np.unique(np.linspace(0, values.size - 1, 20_000).astype(np.int64))
    step = {}
    for name, nested in (("RING", False), ("NESTED", True)):
        neighbours = hp.get_all_neighbours(nside, pixel, nest=nested)
        step[name] = np.mean(np.abs(np.where(neighbours >= 0, values[neighbours] - values[pixel], 0.0)))
    other = "RING" if ordering == "NESTED" else "NESTED"
    if step[other] < _SMOOTHNESS_RATIO * step[ordering]:
        raise BadInput(f"{where}: ORDERING is said to be {ordering}, but the map is smooth in {other} only")


def _gaussian_field(seed: int, model: Cosecant) -> Float:
    ell, m = hp.Alm.getlm(model.l_max)
    # healpy's synalm draws from numpy's global generator.
    normal = stream(seed, "dust_map").standard_normal((2, ell.size))
    used = ell >= model.l_min
    amplitude = np.where(used, np.where(used, ell, 1.0) ** (-0.5 * model.slope), 0.0)
    alm = amplitude * np.where(m == 0, normal[0], (normal[0] + 1j * normal[1]) / np.sqrt(2.0))
    field = hp.alm2map(alm.astype(complex), model.nside)
    return np.asarray(field * (model.sigma / field.std()))
