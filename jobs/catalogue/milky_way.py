"""The Milky Way's stars: density laws, and draws along a line of sight.

density         of thin disc, thick disc and halo, relative to each one's at the Sun
numbers         stars of many cells
expected        stars of a cell in every (population, shell of distance, bin of M_H)
draw            Poisson sample of it
teff, log_g, metallicity   labels of the sample

Ref: Juric et al. 2008; the numbers and their sources are in milky_way.toml.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from jobs.catalogue import parameters
from jobs.catalogue.stellar_populations import Sequence, dwarf_sequence, giant_sequence, luminosity

Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]

THIN, THICK, HALO = 0, 1, 2
COMPONENTS = 3
_FILE = "milky_way.toml"
_SR_PER_DEG2 = np.radians(1.0) ** 2
# So that the shells of all of them take 20 MB.
_CELLS_AT_A_TIME = 1024


@dataclass(frozen=True, slots=True)
class Sun:
    """The Sun's distance from the centre and height above the plane, pc."""

    radius: float
    height: float


@dataclass(frozen=True, slots=True)
class Disc:
    """Double-exponential disc: lengths in pc, density share against the thin disc at the Sun."""

    length: float
    height: float
    share: float


@dataclass(frozen=True, slots=True)
class Halo:
    """Flattened power-law halo, core in pc."""

    flattening: float
    slope: float
    core: float
    share: float


@dataclass(frozen=True, slots=True)
class Metallicity:
    """Normal distributions of [M/H] of the three components (milky_way.toml, [metallicity])."""

    mean: tuple[float, ...]
    scatter: tuple[float, ...]
    limits: tuple[float, float]
    poor: float
    hotter: float


@dataclass(frozen=True, slots=True, eq=False)
class MilkyWay:
    """Everything that stars are drawn from, made once by `milky_way`.

    distance : [s + 1] pc, edges of the shells; m_h : [b + 1] mag, edges of the bins
    local    : [6, b] pc^-3 at the Sun: dwarfs of thin disc, thick disc, halo, then giants of the three
    """

    sun: Sun
    thin: Disc
    thick: Disc
    halo: Halo
    dwarfs: Sequence
    giants: Sequence
    metallicity: Metallicity
    distance: Float
    m_h: Float
    local: Float


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """Stars: component code[n], whether a giant[n], distance[n] pc, M_H[n] mag (Vega)."""

    component: Int
    giant: npt.NDArray[np.bool_]
    distance: Float
    m_h: Float


def milky_way() -> MilkyWay:
    """The Milky Way of the embedded universe: numbers read, tables made (a few ms)."""
    sampling = parameters.section(_FILE, "sampling")
    thin, thick = (Disc(**parameters.section(_FILE, name)) for name in ("thin", "thick"))
    halo = Halo(**parameters.section(_FILE, "halo"))
    dwarfs, giants = dwarf_sequence(), giant_sequence()
    start = min(dwarfs.m_h[0], giants.m_h[0])
    stop = max(dwarfs.m_h[-1], giants.m_h[-1])
    m_h = start + sampling["bin_mag"] * np.arange(np.ceil((stop - start) / sampling["bin_mag"]) + 1)
    shares = np.array([thin.share, thick.share, halo.share])
    functions = luminosity(m_h, dwarfs, shares / shares.sum())
    distance = np.geomspace(sampling["nearest"], sampling["farthest"], sampling["shells"] + 1)
    metallicity = Metallicity(**parameters.section(_FILE, "metallicity"))
    sun = Sun(**parameters.section(_FILE, "sun"))
    return MilkyWay(sun, thin, thick, halo, dwarfs, giants, metallicity, distance, m_h, functions)


def density(galaxy: MilkyWay, component: int, radius: npt.ArrayLike, height: npt.ArrayLike) -> Float:
    """Density of a component (THIN, THICK, HALO) relative to its own at the Sun.

    radius, height : Galactocentric cylindrical R, z, pc
    Ref: Juric et al. 2008
    """
    r, z = np.asarray(radius, float), np.asarray(height, float)
    if component == HALO:
        return (_halo_distance2(galaxy.halo, r, z) / _halo_distance2(galaxy.halo, *_sun(galaxy))) ** (
            0.5 * galaxy.halo.slope
        )
    disc = galaxy.thin if component == THIN else galaxy.thick
    sun_r, sun_z = _sun(galaxy)
    return np.asarray(np.exp(-(r - sun_r) / disc.length - (np.abs(z) - np.abs(sun_z)) / disc.height))


def _sun(galaxy: MilkyWay) -> tuple[Float, Float]:
    return np.asarray(galaxy.sun.radius), np.asarray(galaxy.sun.height)


def _halo_distance2(halo: Halo, r: Float, z: Float) -> Float:
    return np.asarray(r**2 + (z / halo.flattening) ** 2 + halo.core**2)


def cylindrical(galaxy: MilkyWay, lon: npt.ArrayLike, lat: npt.ArrayLike, distance: Float) -> tuple[Float, Float]:
    """Galactocentric R, z pc at heliocentric distances along Galactic (l, b) deg, all of them broadcast."""
    l_rad, b_rad = np.radians(lon), np.radians(lat)
    across = distance * np.cos(b_rad)
    r = np.hypot(galaxy.sun.radius - across * np.cos(l_rad), across * np.sin(l_rad))
    return r, galaxy.sun.height + distance * np.sin(b_rad)


def numbers(galaxy: MilkyWay, lon: Float, lat: Float, area: float, h_limit: Float) -> Float:
    """Stars[n] of cells before their dust: the sum of `expected` of each.

    lon, lat : [n] Galactic, of the cells' centres, deg; area : of one of them, deg2; h_limit : [n]
    """
    total = np.zeros(lon.size)
    for limit in np.unique(h_limit):
        chosen = np.flatnonzero(h_limit == limit)
        per_shell = _seen(galaxy, float(limit)) @ galaxy.local.T * _volumes(galaxy, area)[:, None]
        per_component = per_shell.reshape(per_shell.shape[0], -1, COMPONENTS).sum(1)
        for some in np.array_split(chosen, -(-chosen.size // _CELLS_AT_A_TIME)):
            r, z = cylindrical(galaxy, lon[some, None], lat[some, None], _middles(galaxy))
            for component in range(COMPONENTS):
                total[some] += density(galaxy, component, r, z) @ per_component[:, component]
    return total


def expected(galaxy: MilkyWay, lon: float, lat: float, area: float, h_limit: float) -> Float:
    """Stars of a cell in every (population, shell, bin), [6, s, b]; 0 where all are fainter than h_limit.

    lon, lat : Galactic, of the cell's centre, deg; area : deg2
    """
    r, z = cylindrical(galaxy, lon, lat, _middles(galaxy))
    relative = np.stack([density(galaxy, component, r, z) for component in (THIN, THICK, HALO)])
    per_shell = np.concatenate([relative, relative]) * _volumes(galaxy, area)
    return np.where(_seen(galaxy, h_limit), per_shell[:, :, None] * galaxy.local[:, None, :], 0.0)


def _middles(galaxy: MilkyWay) -> Float:
    """Where in a shell its density is taken, [s] pc."""
    return np.asarray(np.sqrt(galaxy.distance[:-1] * galaxy.distance[1:]))


def _volumes(galaxy: MilkyWay, area: float) -> Float:
    """Of the shells within an area, deg2, [s] pc^3."""
    near, far = galaxy.distance[:-1], galaxy.distance[1:]
    return np.asarray(area * _SR_PER_DEG2 * (far - near) * (far**2 + far * near + near**2) / 3.0)


def _seen(galaxy: MilkyWay, h_limit: float) -> npt.NDArray[np.bool_]:
    """[s, b] whether a star of the bin may be brighter than the limit in the shell."""
    return np.asarray(galaxy.m_h[None, :-1] + 5.0 * np.log10(galaxy.distance[:-1, None]) - 5.0 < h_limit)


def draw(galaxy: MilkyWay, mean: Float, rng: np.random.Generator) -> Sample:
    """Poisson sample of `expected` numbers; uniform in volume within a shell and in M_H within a bin."""
    boxes = np.flatnonzero(mean)
    cumulative = np.cumsum(mean.ravel()[boxes])
    total = float(cumulative[-1]) if boxes.size else 0.0
    n = int(rng.poisson(total))
    # The product may round up to the total itself.
    drawn = np.minimum(np.searchsorted(cumulative, rng.random(n) * total, side="right"), max(boxes.size - 1, 0))
    population, shell, m_bin = np.unravel_index(boxes[drawn], mean.shape)
    near3, far3 = galaxy.distance[shell] ** 3, galaxy.distance[shell + 1] ** 3
    distance = np.cbrt(near3 + (far3 - near3) * rng.random(n))
    m_h = galaxy.m_h[m_bin] + (galaxy.m_h[m_bin + 1] - galaxy.m_h[m_bin]) * rng.random(n)
    return Sample(population % COMPONENTS, population >= COMPONENTS, distance, m_h)


def metallicity(galaxy: MilkyWay, component: Int, rng: np.random.Generator) -> Float:
    """[M/H][n], dex."""
    law = galaxy.metallicity
    mean, scatter = np.array(law.mean)[component], np.array(law.scatter)[component]
    return np.clip(mean + scatter * rng.standard_normal(component.size), *law.limits)


def teff(galaxy: MilkyWay, stars: Sample, metals: Float) -> Float:
    """Effective temperature[n], K; metal-poor stars are hotter at their luminosity."""
    return _of_sequence(galaxy, stars, "teff") + np.where(
        metals < galaxy.metallicity.poor, galaxy.metallicity.hotter, 0.0
    )


def log_g(galaxy: MilkyWay, stars: Sample) -> Float:
    """log10 surface gravity[n], cm s-2."""
    return _of_sequence(galaxy, stars, "log_g")


def _of_sequence(galaxy: MilkyWay, stars: Sample, name: str) -> Float:
    dwarf = np.interp(stars.m_h, galaxy.dwarfs.m_h, getattr(galaxy.dwarfs, name))
    giant = np.interp(stars.m_h, galaxy.giants.m_h, getattr(galaxy.giants, name))
    return np.asarray(np.where(stars.giant, giant, dwarf))
