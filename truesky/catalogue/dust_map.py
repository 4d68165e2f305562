"""Extinction A(V) by the Milky Way's dust: a full-sky map of the total extinction, and the extinction to a distance.

By default the map is simulated: a cosecant law of Galactic latitude times a log-normal random field. A file of the user
can replace the simulated map. Maps are in HEALPix RING ordering and Galactic coordinates. The file dust_map.toml
contains the parameters and their sources.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, astuple, dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
import numpy.typing as npt

from lake_schema import user_files
from lake_schema.arrays import Float, Float32
from lake_schema.errors import BadInput
from lake_schema.fits.external import read_map
from lake_schema.lazy_healpy import healpy as hp
from lake_schema.sky import equatorial, galactic
from lake_schema.store.provenance import canonical, file_sha256
from truesky.catalogue import parameters
from truesky.numerics.cache import cached_arrays, content_key
from truesky.numerics.cache_labels import label_dust_map
from truesky.numerics.code_fingerprints import code_key
from truesky.randomness.rng import stream
from truesky.request.files import DustMap

# Largest A(V) that table `galaxies` can store, mag.
MAX_A_V = 40.0
# A map is refused if the mean difference between neighbouring pixels in the other HEALPix ordering (RING or NESTED) is
# below this fraction of the difference in its declared ordering.
_SMOOTHNESS_RATIO = 0.5


@dataclass(frozen=True, slots=True)
class Cosecant:
    """Parameters of the simulated dust map; explained in dust_map.toml, [map]."""

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
    """Scale height of the dust layer in pc (dust_map.toml, [layer])."""

    height: float


def cosecant() -> Cosecant:
    """Return the built-in parameters of the simulated dust map."""
    return Cosecant(**parameters.section("dust_map.toml", "map"))


def layer() -> Layer:
    """Return the built-in scale height of the dust layer."""
    return Layer(**parameters.section("dust_map.toml", "layer"))


def make_map(seed: int, model: Cosecant) -> Float32:
    """Simulate a dust map from a seed: A(V) in mag, float32, shape (12 nside^2,), RING ordering, Galactic frame."""
    _, b = hp.pix2ang(model.nside, np.arange(hp.nside2npix(model.nside)), lonlat=True)
    field = _gaussian_field(seed, model)
    sin_b = np.maximum(np.abs(np.sin(np.radians(b))), model.sin_b_min)
    ebv = model.ebv_pole / sin_b * np.exp(field - 0.5 * model.sigma**2)
    return np.asarray((model.r_v * np.minimum(ebv, model.ebv_max)).astype(np.float32))


def a_v(sky_map: Float32, ra: Float, dec: Float) -> Float:
    """Interpolate A(V) bilinearly between the pixels of a map.

    Parameters
    ----------
    sky_map : float32 array, shape (pixels,)
        A(V) in mag, HEALPix RING ordering, Galactic coordinates.
    ra, dec : float array, shape (n,)
        ICRS positions, deg.

    Returns
    -------
    float array, shape (n,)
        A(V) in mag, through the whole Milky Way.
    """
    lon, lat = galactic(ra, dec)
    return np.asarray(hp.get_interp_val(sky_map, lon, lat, lonlat=True), float)


def a_v_at(to_infinity: Float, distance: Float, b: npt.ArrayLike, dust: Layer, sin_b_min: float) -> Float:
    """Return the extinction A(V) between the Sun and stars.

    Parameters
    ----------
    to_infinity : float array, shape (n,)
        A(V) through the whole Milky Way towards each star, mag.
    distance : float array, shape (n,)
        Distance of each star in pc; infinity is allowed.
    b : float array, shape (n,)
        Galactic latitude in deg.
    dust : Layer
        Scale height of the dust layer.
    sin_b_min : float
        Lower limit of |sin b|; smaller values are replaced by it.

    Returns
    -------
    float array, shape (n,)
        A(V) in mag.

    Notes
    -----
    The dust density falls exponentially with height above the plane, so that::

        A(d) = A(infinity) (1 - exp(-d |sin b| / height))
    """
    sin_b = np.maximum(np.abs(np.sin(np.radians(np.asarray(b, float)))), sin_b_min)
    return np.asarray(-to_infinity * np.expm1(-distance * sin_b / dust.height))


def load(seed: int) -> Float32:
    """Return the simulated dust map of a seed, from the disc cache or made now (1 s).

    The map is A(V) in mag, float32, shape (12 nside^2,), RING ordering, Galactic coordinates.
    """
    model = cosecant()
    key = content_key(code_key(__name__), version("healpy"), seed, *astuple(model))
    return cached_arrays("dust_map", key, lambda: {"a_v": make_map(seed, model)}, label_dust_map(seed))["a_v"]


def facts(user_map: DustMap | None) -> dict[str, Any]:
    """Return the SHA-256 and the settings of the user's dust map, by which changes of the input are recognised.

    They are in a dict under the key "dust"; without a user's map, return an empty dict. Raises BadInput if the file
    does not exist.
    """
    if user_map is None:
        return {}
    user_files.check_file(user_map.file, "map of dust", "ingest.dust.file")
    settings = {name: value for name, value in asdict(user_map).items() if name != "file"}
    return {"dust": {"sha256": file_sha256(user_map.file), **settings}}


def map_for_request(seed: int, user_map: DustMap | None) -> Float32:
    """Return the dust map of a request: the user's map, or else the simulated map.

    Parameters
    ----------
    seed : int
        Seed of the simulated map.
    user_map : DustMap or None
        File and settings of the user's dust map; None for the simulated map.

    Returns
    -------
    float32 array, shape (pixels,)
        A(V) in mag, RING ordering, Galactic coordinates. It is read from the disc cache if it has been made before.
    """
    if user_map is None:
        return load(seed)
    key = content_key(code_key(__name__), version("healpy"), canonical(facts(user_map)))
    return cached_arrays("dust_file", key, lambda: {"a_v": read(user_map)})["a_v"]


def read(user_map: DustMap) -> Float32:
    """Read a user's map and convert it to A(V), RING ordering and Galactic coordinates.

    Parameters
    ----------
    user_map : DustMap
        File, column and settings of the user's dust map, in E(B-V) or A(V).

    Returns
    -------
    float32 array, shape (pixels,)
        A(V) in mag. A map with a higher resolution than the simulated map (nside 512) is degraded to it.

    Raises
    ------
    BadInput
        If the number of pixels is not that of a full-sky HEALPix map or of NSIDE in the header, if the ordering or the
        coordinates are missing or wrong, or if a value is negative, NaN or above A(V) = 40 mag.
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
        raise BadInput(f"{where}: {values.size} pixels, but a full-sky HEALPix map has 12 nside^2")
    nside = hp.npix2nside(values.size)
    if cards.get("NSIDE", nside) != nside:
        raise BadInput(f"{where}: header says NSIDE = {cards['NSIDE']}, but {values.size} pixels mean NSIDE = {nside}")
    model = cosecant()
    to_a_v = model.r_v if user_map.quantity == "ebv" else 1.0
    bad = ~((values >= 0.0) & (values * to_a_v <= MAX_A_V))
    if bad.any():
        row = int(bad.argmax())
        raise BadInput(
            f"{where} of row {row + 1} is {values[row]:g} ({bad.sum()} bad rows): {user_map.quantity} must be from 0 "
            f"to {MAX_A_V / to_a_v:g} mag"
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
    """Return the value of a setting from the FITS header card `card` or from the request's key `key`.

    Raises BadInput if both are missing or disagree, or if the header has a value that is not in `names`.
    """
    header_value, requested = str(cards.get(card, "")).strip().upper(), getattr(user_map, key)
    if header_value and header_value not in names:
        raise BadInput(f"{user_map.file}: {card} is {header_value!r}, not one of {', '.join(names)}")
    if header_value and requested and names[header_value] != requested:
        raise BadInput(f"{user_map.file}: {card} is {header_value!r}, but ingest.dust.{key} is {requested!r}")
    if not header_value and not requested:
        raise BadInput(f"{user_map.file}: column {user_map.column}: the header has no {card}: set ingest.dust.{key}")
    return names[header_value] if header_value else str(requested)


def _refuse_other_ordering(where: str, values: Float, ordering: str) -> None:
    """Raise BadInput if the HEALPix ordering (RING or NESTED) of a map is probably wrong.

    Dust maps are smooth. The ordering is refused if neighbouring pixels differ much less in the other one.
    """
    nside = hp.npix2nside(values.size)
    pixel = np.unique(np.linspace(0, values.size - 1, 20_000).astype(np.int64))
    step = {}
    for name, nested in (("RING", False), ("NESTED", True)):
        neighbours = hp.get_all_neighbours(nside, pixel, nest=nested)
        step[name] = np.mean(np.abs(np.where(neighbours >= 0, values[neighbours] - values[pixel], 0.0)))
    other = "RING" if ordering == "NESTED" else "NESTED"
    if step[other] < _SMOOTHNESS_RATIO * step[ordering]:
        raise BadInput(
            f"{where}: ORDERING is {ordering} in the header or request, but the map is smooth only as {other}"
        )


def _gaussian_field(seed: int, model: Cosecant) -> Float:
    ell, m = hp.Alm.getlm(model.l_max)
    # Draw the coefficients here, because healpy's function synalm uses numpy's global random generator.
    normal = stream(seed, "dust_map").standard_normal((2, ell.size))
    used = ell >= model.l_min
    amplitude = np.where(used, np.where(used, ell, 1.0) ** (-0.5 * model.slope), 0.0)
    alm = amplitude * np.where(m == 0, normal[0], (normal[0] + 1j * normal[1]) / np.sqrt(2.0))
    field = hp.alm2map(alm.astype(complex), model.nside)
    return np.asarray(field * (model.sigma / field.std()))
