"""The Milky Way's stars: how many there are along a line of sight, and draws of them.

milky_way       the components, by one of the models MODELS, and the luminosity functions
numbers         stars of many cells
expected        stars of a cell in every (population, shell of distance, bin of M_H)
draw            Poisson sample of it
teff, log_g, metallicity   labels of the sample

A population is a component's dwarfs, giants or white dwarfs.  The numbers and their sources are in milky_way.toml.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from jobs import sums
from jobs.catalogue import parameters
from jobs.catalogue.stars.density_laws import (
    Aged,
    CoredPowerLaw,
    Exponential,
    Law,
    Parabolic,
    PowerLaw,
    Sun,
    Young,
    density,
)
from jobs.catalogue.stars.stellar_populations import (
    Sequence,
    dwarf_sequence,
    giant_sequence,
    luminosity,
    white_dwarf_sequence,
)
from lake_schema.arrays import Bool, Float, Int

MODELS = ("juric", "besancon")
THIN, THICK, HALO = 0, 1, 2
DWARF, GIANT, WHITE_DWARF = 0, 1, 2
_STAGES = 3
_FILE = "milky_way.toml"
_SR_PER_DEG2 = np.radians(1.0) ** 2
# So that the shells of all of them take 20 MB.
_CELLS_AT_A_TIME = 1024


@dataclass(frozen=True, slots=True)
class Component:
    """A law of density, its share in the density of stars at the Sun, and THIN, THICK or HALO."""

    law: Law
    share: float
    code: int


@dataclass(frozen=True, slots=True)
class Metallicity:
    """Normal distributions of [M/H] of the three components, and what it does (milky_way.toml, [metallicity])."""

    mean: tuple[float, ...]
    scatter: tuple[float, ...]
    limits: tuple[float, float]
    hotter: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class MilkyWay:
    """Everything that stars are drawn from, made once by `milky_way`.

    sequences : of DWARF, GIANT, WHITE_DWARF
    distance  : [s + 1] pc, edges of the shells; m_h : [b + 1] mag, edges of the bins
    local     : [p, b] pc^-3 at the Sun: dwarfs of every component, then their giants, then their white dwarfs
    """

    sun: Sun
    components: tuple[Component, ...]
    sequences: tuple[Sequence, Sequence, Sequence]
    metallicity: Metallicity
    distance: Float
    m_h: Float
    local: Float


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """Stars: component THIN, THICK, HALO [n], stage DWARF, .. [n], distance[n] pc, M_H[n] mag (Vega)."""

    component: Int
    stage: Int
    distance: Float
    m_h: Float


def milky_way(model: str = "juric") -> MilkyWay:
    """The Milky Way of the embedded universe: numbers read, tables made (a few ms)."""
    sampling = parameters.section(_FILE, "sampling")
    sun, components = _juric() if model == "juric" else _besancon()
    sequences = dwarf_sequence(), giant_sequence(), white_dwarf_sequence()
    start = min(sequence.m_h[0] for sequence in sequences)
    stop = max(sequence.m_h[-1] for sequence in sequences)
    m_h = start + sampling["bin_mag"] * np.arange(np.ceil((stop - start) / sampling["bin_mag"]) + 1)
    share = np.array([component.share for component in components])
    functions = luminosity(m_h, sequences[DWARF], share / share.sum(), np.array([c.code for c in components]))
    distance = np.geomspace(sampling["nearest"], sampling["farthest"], sampling["shells"] + 1)
    metallicity = Metallicity(**parameters.section(_FILE, "metallicity"))
    return MilkyWay(sun, components, sequences, metallicity, distance, m_h, functions)


def _juric() -> tuple[Sun, tuple[Component, ...]]:
    """Ref: Juric et al. 2008"""
    number: dict[str, Any] = parameters.section(_FILE, "juric")
    thin = Exponential(number["thin_length"], number["thin_height"])
    thick = Exponential(number["thick_length"], number["thick_height"])
    halo = PowerLaw(number["halo_flattening"], number["halo_slope"], number["halo_core"])
    components = (
        Component(thin, 1.0, THIN),
        Component(thick, number["thick_share"], THICK),
        Component(halo, number["halo_share"], HALO),
    )
    return Sun(number["sun_radius"], number["sun_height"]), components


def _besancon() -> tuple[Sun, tuple[Component, ...]]:
    """Ref: Robin et al. 2003"""
    number: dict[str, Any] = parameters.section(_FILE, "besancon")
    flattening = number["thin_flattening"]
    thin: list[Law] = [Aged(value, number["outer"], number["inner"]) for value in flattening]
    thin[0] = Young(flattening[0], number["young_outer"], number["young_inner"])
    thick = Parabolic(number["thick_length"], number["thick_height"], number["thick_joint"])
    halo = CoredPowerLaw(number["halo_flattening"], number["halo_slope"], number["halo_core"])
    components = [Component(law, local, THIN) for law, local in zip(thin, number["thin_local"], strict=True)]
    components += [Component(thick, number["thick_local"], THICK), Component(halo, number["halo_local"], HALO)]
    return Sun(number["sun_radius"], number["sun_height"]), tuple(components)


def cylindrical(galaxy: MilkyWay, lon: npt.ArrayLike, lat: npt.ArrayLike, distance: Float) -> tuple[Float, Float]:
    """Galactocentric R, z pc at heliocentric distances along Galactic (l, b) deg, all of them broadcast.

    lon, lat : float[...] deg;  distance : float[...] pc
    galaxy   : where the Sun is in it
    """
    l_rad, b_rad = np.radians(lon), np.radians(lat)
    across = distance * np.cos(b_rad)
    r = np.hypot(galaxy.sun.radius - across * np.cos(l_rad), across * np.sin(l_rad))
    return r, galaxy.sun.height + distance * np.sin(b_rad)


def numbers(galaxy: MilkyWay, lon: Float, lat: Float, area: float, h_limit: Float) -> Float:
    """Stars[n] of cells before their dust: the sum of `expected` of each.

    lon, lat : [n] Galactic, of the cells' centres, deg; area : of one of them, deg2; h_limit : [n]
    galaxy   : components, their populations and laws
    """
    total = np.zeros(lon.size)
    for limit in np.unique(h_limit):
        chosen = np.flatnonzero(h_limit == limit)
        per_shell = sums.product(_seen(galaxy, float(limit)), galaxy.local.T) * volumes(galaxy, area)[:, None]
        weight = per_shell.reshape(per_shell.shape[0], _STAGES, -1).sum(1)
        for some in np.array_split(chosen, -(-chosen.size // _CELLS_AT_A_TIME)):
            r, z = cylindrical(galaxy, lon[some, None], lat[some, None], middles(galaxy))
            for component, weights in zip(galaxy.components, weight.T, strict=True):
                total[some] += sums.product(density(component.law, galaxy.sun, r, z), weights)
    return total


def expected(galaxy: MilkyWay, lon: float, lat: float, area: float, h_limit: float) -> Float:
    """Stars of a cell in every (population, shell, bin), [p, s, b]; 0 where all are fainter than h_limit.

    lon, lat : Galactic, of the cell's centre, deg; area : deg2
    galaxy   : components, their populations and laws;  h_limit : mag, Vega
    """
    r, z = cylindrical(galaxy, lon, lat, middles(galaxy))
    relative = np.stack([density(component.law, galaxy.sun, r, z) for component in galaxy.components])
    per_shell = np.tile(relative * volumes(galaxy, area), (_STAGES, 1))
    return np.where(_seen(galaxy, h_limit), per_shell[:, :, None] * galaxy.local[:, None, :], 0.0)


def middles(galaxy: MilkyWay) -> Float:
    """Where in a shell its density is taken, [s] pc."""
    return np.asarray(np.sqrt(galaxy.distance[:-1] * galaxy.distance[1:]))


def volumes(galaxy: MilkyWay, area: float) -> Float:
    """Of the shells within an area, deg2, [s] pc^3."""
    near, far = galaxy.distance[:-1], galaxy.distance[1:]
    return np.asarray(area * _SR_PER_DEG2 * (far - near) * (far**2 + far * near + near**2) / 3.0)


def _seen(galaxy: MilkyWay, h_limit: float) -> Bool:
    """[s, b] whether a star of the bin may be brighter than the limit in the shell."""
    return np.asarray(galaxy.m_h[None, :-1] + 5.0 * np.log10(galaxy.distance[:-1, None]) - 5.0 < h_limit)


def draw(galaxy: MilkyWay, mean: Float, rng: np.random.Generator) -> Sample:
    """Poisson sample of `expected` numbers; uniform in volume within a shell and in M_H within a bin.

    mean : float[p, s, b]
    """
    drawn = _boxes(mean, rng)
    population, shell, m_bin = np.unravel_index(drawn, mean.shape)
    distance = _distance(galaxy, shell, rng)
    m_h = galaxy.m_h[m_bin] + (galaxy.m_h[m_bin + 1] - galaxy.m_h[m_bin]) * rng.random(drawn.size)
    stage, component = np.divmod(population, len(galaxy.components))
    codes = np.array([component.code for component in galaxy.components])
    return Sample(codes[component], stage, distance, m_h)


def in_shells(galaxy: MilkyWay, mean: Float, rng: np.random.Generator) -> tuple[Int, Float]:
    """Poisson sample of expected numbers [k, s] of k kinds: kind[n], distance[n] pc, uniform in volume in a shell.

    mean : float[k, s]
    """
    kind, shell = np.unravel_index(_boxes(mean, rng), mean.shape)
    return np.asarray(kind), _distance(galaxy, shell, rng)


def _boxes(mean: Float, rng: np.random.Generator) -> Int:
    """Flat index[n] of the box that each of a Poisson number of draws falls into."""
    boxes = np.flatnonzero(mean)
    cumulative = np.cumsum(mean.ravel()[boxes])
    total = float(cumulative[-1]) if boxes.size else 0.0
    n = int(rng.poisson(total))
    # The product may round up to the total itself.
    return boxes[np.minimum(np.searchsorted(cumulative, rng.random(n) * total, side="right"), max(boxes.size - 1, 0))]


def _distance(galaxy: MilkyWay, shell: Int, rng: np.random.Generator) -> Float:
    near3, far3 = galaxy.distance[shell] ** 3, galaxy.distance[shell + 1] ** 3
    return np.asarray(np.cbrt(near3 + (far3 - near3) * rng.random(shell.size)))


def metallicity(galaxy: MilkyWay, component: Int, rng: np.random.Generator) -> Float:
    """[M/H][n], dex.

    component : int[n]
    """
    law = galaxy.metallicity
    mean, scatter = np.array(law.mean)[component], np.array(law.scatter)[component]
    return np.clip(mean + scatter * rng.standard_normal(component.size), *law.limits)


def teff(galaxy: MilkyWay, stars: Sample) -> Float:
    """Effective temperature[n], K; the metal-poor components' stars are hotter at their luminosity."""
    hotter = np.array(galaxy.metallicity.hotter)[stars.component]
    return _of_sequence(galaxy, stars, "teff") + np.where(stars.stage == WHITE_DWARF, 0.0, hotter)


def log_g(galaxy: MilkyWay, stars: Sample) -> Float:
    """log10 surface gravity[n], cm s-2."""
    return _of_sequence(galaxy, stars, "log_g")


def _of_sequence(galaxy: MilkyWay, stars: Sample, name: str) -> Float:
    values = [np.interp(stars.m_h, sequence.m_h, getattr(sequence, name)) for sequence in galaxy.sequences]
    return np.choose(stars.stage, values)
