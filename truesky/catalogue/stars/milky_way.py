"""Stars of the Milky Way: expected numbers along lines of sight, and random samples.

The Milky Way has components (thin disc, thick disc, halo and bulge), each with a density law, ages and metallicities.
Stars are on isochrones of these ages and metallicities, which are cut into short stretches at the edges of bins of the
absolute H magnitude M_H, or are white dwarfs. The parameters and their sources are in milky_way.toml.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Bool, Float, Int
from truesky.catalogue import parameters
from truesky.catalogue.stars import companions, stellar_populations
from truesky.catalogue.stars.density_laws import (
    Bar,
    CoredPowerLaw,
    Exponential,
    Law,
    OldDisc,
    Parabolic,
    PowerLaw,
    Sun,
    YoungDisc,
    density,
)
from truesky.catalogue.stars.stellar_populations import MassFunction, Pieces, Population, Tracks
from truesky.numerics import matrices

MODELS = ("juric", "besancon")
THIN, THICK, HALO, BULGE = 0, 1, 2, 5
_FILE = "milky_way.toml"
_SR_PER_DEG2 = np.radians(1.0) ** 2
# Number of sky cells whose expected numbers are computed together; their arrays by shell of distance take 20 MB.
_CELLS_AT_A_TIME = 1024


@dataclass(frozen=True, slots=True)
class Component:
    """Component of the Milky Way, such as the thin disc.

    Attributes
    ----------
    law : Law
        Density law, relative to the density at the Sun (for the bulge, at its centre).
    share : float
        Fraction of the stellar systems below a solar mass near the Sun that belong to the component. For the bulge, the
        density of these systems at its centre in units of the total density near the Sun.
    code : int
        THIN, THICK, HALO or BULGE.
    population : Population
        Ages and metallicities of the stars.
    """

    law: Law
    share: float
    code: int
    population: Population


@dataclass(frozen=True, slots=True, eq=False)
class MilkyWay:
    """Tables from which stars are drawn, made once by `milky_way`.

    Attributes
    ----------
    sun : Sun
        Position of the Sun in the Milky Way.
    components : tuple of Component
        c components, such as the thin disc.
    tracks : Tracks
        k isochrones of all components.
    width : float array, shape (k,)
        Range of [M/H] of the stars on each isochrone.
    limits : tuple of float
        Lowest and highest [M/H] of stars.
    distance : float array, shape (s + 1,)
        Edges of the shells of distance from the Sun, ascending, pc.
    m_h : float array, shape (b + 1,)
        Edges of the bins of the absolute H magnitude (Vega), ascending.
    pieces : Pieces
        n stretches of isochrones and of the white dwarf sequence, sorted by component, then by bin.
    first : int array, shape (c, b + 1)
        Index of the first stretch of each component and bin.
    cumulative : float array, shape (n + 1,)
        Cumulative sum of the number densities of the stretches, pc^-3.
    local : float array, shape (c, b)
        Number density of single stars and primaries where the density law of the component is 1, pc^-3.
    companions : float array, shape (c, b)
        Number density of companions where the density law of the component is 1, pc^-3.
    """

    sun: Sun
    components: tuple[Component, ...]
    tracks: Tracks
    width: Float
    limits: tuple[float, float]
    distance: Float
    m_h: Float
    pieces: Pieces
    first: Int
    cumulative: Float
    local: Float
    companions: Float


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """Random sample of stars in one cell of the sky.

    Attributes
    ----------
    component : int array, shape (n,)
        Component of the Milky Way: THIN, THICK, HALO or BULGE.
    stage : int array, shape (n,)
        Evolutionary stage, a constant of stellar_populations such as DWARF.
    track : int array, shape (n,)
        Index of the isochrone, -1 for white dwarfs.
    distance : float array, shape (n,)
        Distance from the Sun, pc.
    m_h : float array, shape (n,)
        Absolute H magnitude (Vega).
    mass : float array, shape (n,)
        Mass at birth, Msun, NaN for white dwarfs.
    teff : float array, shape (n,)
        Temperature, K.
    log_g : float array, shape (n,)
        log10 of the surface gravity, cm s-2.
    metallicity : float array, shape (n,)
        [M/H].
    age : float array, shape (n,)
        Age, Gyr, NaN for white dwarfs.
    """

    component: Int
    stage: Int
    track: Int
    distance: Float
    m_h: Float
    mass: Float
    teff: Float
    log_g: Float
    metallicity: Float
    age: Float


@cache
def milky_way(model: str = "juric") -> MilkyWay:
    """Return the tables of a Milky Way model, "juric" or "besancon" (any other name also gives the latter).

    The first call in a process makes the tables in 0.2 s; later calls return the same object.
    """
    sampling = parameters.section(_FILE, "sampling")
    sun, components = _juric() if model == "juric" else _besancon()
    masses = MassFunction(**parameters.section(_FILE, "mass_function"))
    population_cells = Population(*(np.concatenate(v) for v in zip(*map(_population_columns, components), strict=True)))
    tracks = stellar_populations.build_tracks(population_cells.age, population_cells.metallicity)
    m_h = sampling["brightest"] + sampling["bin_mag"] * np.arange(sampling["bins"] + 1)
    owner = np.repeat(np.arange(len(components)), [c.population.age.size for c in components])
    pieces = stellar_populations.build_pieces(tracks, population_cells.share, masses, m_h)
    # Scale the numbers of each component to the observed local density of its stellar systems below a solar mass that
    # are not yet white dwarfs.
    piece_owner = owner[pieces.track]
    share = np.array([component.share for component in components])
    living = np.bincount(
        piece_owner, pieces.number * (pieces.log_mass.mean(0) < np.log10(masses.reference)), share.size
    )
    scale = masses.local * share / living
    dwarfs = stellar_populations.white_dwarf_pieces(m_h)
    parts, starts, offset = [], [], 0
    second = np.zeros((share.size, m_h.size - 1))
    for k in range(share.size):
        component_pieces = pieces.take(piece_owner == k)
        component_pieces = component_pieces.take(np.argsort(component_pieces.bin, kind="stable"))
        component_pieces = _scale_number(component_pieces, float(scale[k]))
        second[k] = companions.expected_density(tracks, component_pieces, m_h)
        component_pieces = stellar_populations.concatenate([component_pieces, _scale_number(dwarfs, float(share[k]))])
        component_pieces = component_pieces.take(np.argsort(component_pieces.bin, kind="stable"))
        starts.append(offset + np.searchsorted(component_pieces.bin, np.arange(m_h.size)))
        offset += component_pieces.bin.size
        parts.append(component_pieces)
    all_pieces, first = stellar_populations.concatenate(parts), np.stack(starts)
    cumulative = np.concatenate([[0.0], np.cumsum(all_pieces.number)])
    distance = np.geomspace(sampling["nearest"], sampling["farthest"], sampling["shells"] + 1)
    limits = parameters.section(_FILE, "metallicity")["limits"]
    local = cumulative[first[:, 1:]] - cumulative[first[:, :-1]]
    return MilkyWay(
        sun,
        components,
        tracks,
        population_cells.width,
        limits,
        distance,
        m_h,
        all_pieces,
        first,
        cumulative,
        local,
        second,
    )


def _population_columns(component: Component) -> tuple[Float, Float, Float, Float]:
    population = component.population
    return population.age, population.metallicity, population.width, population.share


def _scale_number(pieces: Pieces, factor: float) -> Pieces:
    return replace(pieces, number=pieces.number * factor)


def _populations(model: str) -> dict[str, Any]:
    return parameters.section(_FILE, f"{model}_populations")


def _thin(numbers: dict[str, Any], bins: slice) -> Population:
    """Return the stellar population of the thin disc in some of its age bins, with a constant birth rate.

    `numbers` are the metallicities by age bin from milky_way.toml.
    """
    law = parameters.section(_FILE, "metallicity")
    edges, parts = np.array(law["thin_age"]), np.array(law["thin_parts"])
    ages, shares, bin_of_age = [], [], []
    for k in range(parts.size)[bins]:
        inner = np.linspace(edges[k], edges[k + 1], parts[k] + 1)
        ages += list(0.5 * (inner[1:] + inner[:-1]))
        shares += list(np.diff(inner))
        bin_of_age += [k] * int(parts[k])
    mean, scatter = (np.array(numbers[name])[bin_of_age] for name in ("thin_metallicity", "thin_scatter"))
    return stellar_populations.build_population(np.array(ages), np.array(shares), mean, scatter, law["thin_cells"])


def _single_age(numbers: dict[str, Any], name: str) -> Population:
    """Return a stellar population of a single age; `name` is the prefix of its keys in `numbers`, such as "thick"."""
    law = parameters.section(_FILE, "metallicity")
    age, mean, scatter = (np.array([numbers[f"{name}_{quantity}"]]) for quantity in ("age", "metallicity", "scatter"))
    return stellar_populations.build_population(age, np.ones(1), mean, scatter, law["old_cells"])


def _bulge() -> Component:
    """Return the bulge component with the bar of Robin et al. 2012 and a single age."""
    number: dict[str, Any] = parameters.section(_FILE, "bulge")
    masses = MassFunction(**parameters.section(_FILE, "mass_function"))
    share = number["central_density"] * number["systems_per_mass"] / masses.local
    law = Bar(*(number[name] for name in ("angle", "length", "width", "height", "parallel", "perpendicular")))
    return Component(law, share, BULGE, _single_age(number, "bulge"))


def _juric() -> tuple[Sun, tuple[Component, ...]]:
    """Return the position of the Sun and the components of the model of Juric et al. 2008, with a bulge."""
    number: dict[str, Any] = parameters.section(_FILE, "juric")
    born = _populations("juric")
    thin = Exponential(number["thin_length"], number["thin_height"])
    thick = Exponential(number["thick_length"], number["thick_height"])
    halo = PowerLaw(number["halo_flattening"], number["halo_slope"], number["halo_core"])
    share = np.array([1.0, number["thick_share"], number["halo_share"]])
    share /= share.sum()
    components = (
        Component(thin, float(share[0]), THIN, _thin(born, slice(None))),
        Component(thick, float(share[1]), THICK, _single_age(born, "thick")),
        Component(halo, float(share[2]), HALO, _single_age(born, "halo")),
        _bulge(),
    )
    return Sun(number["sun_radius"], number["sun_height"]), components


def _besancon() -> tuple[Sun, tuple[Component, ...]]:
    """Return the position of the Sun and the components of the Besancon model (Robin et al. 2003), with a bulge."""
    number: dict[str, Any] = parameters.section(_FILE, "besancon")
    born = _populations("besancon")
    flattening = number["thin_flattening"]
    thin: list[Law] = [OldDisc(value, number["outer"], number["inner"]) for value in flattening]
    thin[0] = YoungDisc(flattening[0], number["young_outer"], number["young_inner"])
    thick = Parabolic(number["thick_length"], number["thick_height"], number["thick_joint"])
    halo = CoredPowerLaw(number["halo_flattening"], number["halo_slope"], number["halo_core"])
    local = np.array([*number["thin_local"], number["thick_local"], number["halo_local"]])
    share = (local / local.sum()).tolist()
    components = [Component(law, share[k], THIN, _thin(born, slice(k, k + 1))) for k, law in enumerate(thin)]
    components += [
        Component(thick, share[-2], THICK, _single_age(born, "thick")),
        Component(halo, share[-1], HALO, _single_age(born, "halo")),
        _bulge(),
    ]
    return Sun(number["sun_radius"], number["sun_height"]), tuple(components)


def cylindrical(
    galaxy: MilkyWay, lon: npt.ArrayLike, lat: npt.ArrayLike, distance: Float
) -> tuple[Float, Float, Float]:
    """Return Galactocentric cylindrical coordinates of positions along lines of sight.

    Parameters
    ----------
    galaxy : MilkyWay
        Model of the Milky Way with the position of the Sun.
    lon, lat : float array, any shape
        Galactic longitude and latitude, deg.
    distance : float array, any shape
        Distance from the Sun, pc; broadcast against `lon` and `lat`.

    Returns
    -------
    radius, height : float array, broadcast shape of the arguments
        Distance from the axis of the Milky Way, and height above its plane, pc.
    azimuth : float array, broadcast shape of the arguments
        Angle from the direction of the Sun, rad, positive towards positive Galactic longitudes.
    """
    l_rad, b_rad = np.radians(lon), np.radians(lat)
    across = distance * np.cos(b_rad)
    x, y = galaxy.sun.radius - across * np.cos(l_rad), across * np.sin(l_rad)
    return np.hypot(x, y), galaxy.sun.height + distance * np.sin(b_rad), np.arctan2(y, x)


def expected_counts(galaxy: MilkyWay, lon: Float, lat: Float, area: float, h_limit: Float) -> Float:
    """Return the expected number of stars and companions in sky cells, without extinction.

    Parameters
    ----------
    galaxy : MilkyWay
        Model of the Milky Way.
    lon, lat : float array, shape (n,)
        Galactic coordinates of the cells' centres, deg.
    area : float
        Area of a cell, deg2.
    h_limit : float array, shape (n,)
        Faintest H magnitude (Vega).

    Returns
    -------
    float array, shape (n,)
        Expected number.
    """
    total = np.zeros(lon.size)
    # Number density of the stars in all bins of M_H below each edge, for each component.
    brighter = np.cumsum(galaxy.local + galaxy.companions, axis=1)
    brighter = np.concatenate([np.zeros((len(brighter), 1)), brighter], axis=1)
    for limit in np.unique(h_limit):
        chosen = np.flatnonzero(h_limit == limit)
        visible_bins = _may_be_visible(galaxy, float(limit)).sum(axis=1)
        per_shell = brighter.T[visible_bins] * shell_volumes(galaxy, area)[:, None]
        for batch in np.array_split(chosen, -(-chosen.size // _CELLS_AT_A_TIME)):
            r, z, azimuth = cylindrical(galaxy, lon[batch, None], lat[batch, None], shell_distances(galaxy))
            for component, weights in zip(galaxy.components, per_shell.T, strict=True):
                total[batch] += matrices.matmul(density(component.law, galaxy.sun, r, z, azimuth), weights)
    return total


def expected_per_bin(galaxy: MilkyWay, lon: float, lat: float, area: float, h_limit: float) -> Float:
    """Return the expected number of single stars and primaries in a sky cell, without extinction.

    Parameters
    ----------
    galaxy : MilkyWay
        Model of the Milky Way.
    lon, lat : float
        Galactic coordinates of the cell's centre, deg.
    area : float
        Area of the cell, deg2.
    h_limit : float
        Faintest H magnitude (Vega).

    Returns
    -------
    float array, shape (c, s, b)
        Expected number by component, shell of distance and bin of the absolute H magnitude. It is 0 if all stars in the
        shell and bin are too faint.
    """
    r, z, azimuth = cylindrical(galaxy, lon, lat, shell_distances(galaxy))
    relative = np.stack([density(component.law, galaxy.sun, r, z, azimuth) for component in galaxy.components])
    per_shell = relative * shell_volumes(galaxy, area)
    return np.where(_may_be_visible(galaxy, h_limit), per_shell[:, :, None] * galaxy.local[:, None, :], 0.0)


def shell_distances(galaxy: MilkyWay) -> Float:
    """Return the distance (pc) at which the density in each shell is computed: the geometric mean of its edges."""
    return np.asarray(np.sqrt(galaxy.distance[:-1] * galaxy.distance[1:]))


def shell_volumes(galaxy: MilkyWay, area: float) -> Float:
    """Return the volume (pc^3) of each shell of distance inside a cone with a solid angle of `area` deg2."""
    inner, outer = galaxy.distance[:-1], galaxy.distance[1:]
    return np.asarray(area * _SR_PER_DEG2 * (outer - inner) * (outer**2 + outer * inner + inner**2) / 3.0)


def _may_be_visible(galaxy: MilkyWay, h_limit: float) -> Bool:
    """Return True for shells of distance and bins of M_H, shape (s, b), in which stars may be brighter than `h_limit`.

    Extinction is not included.
    """
    return np.asarray(galaxy.m_h[None, :-1] + 5.0 * np.log10(galaxy.distance[:-1, None]) - 5.0 < h_limit)


def draw(galaxy: MilkyWay, mean: Float, rng: np.random.Generator, labels: np.random.Generator) -> Sample:
    """Draw a Poisson sample of stars from expected numbers.

    Stars are uniform in volume within each shell of distance, and uniform along each stretch of an isochrone.

    Parameters
    ----------
    galaxy : MilkyWay
        Model of the Milky Way.
    mean : float array, shape (c, s, b)
        Expected numbers by component, shell and bin of the absolute H magnitude, from `expected_per_bin`.
    rng : Generator
        Random numbers of counts, distances and magnitudes.
    labels : Generator
        Random numbers of the metallicities around the values of the isochrones.

    Returns
    -------
    Sample
        The stars.
    """
    drawn = _draw_boxes(mean, rng)
    owner, shell, m_bin = np.unravel_index(drawn, mean.shape)
    distance = _draw_distance(galaxy, shell, rng)
    first, last = galaxy.cumulative[galaxy.first[owner, m_bin]], galaxy.cumulative[galaxy.first[owner, m_bin + 1]]
    piece = np.searchsorted(galaxy.cumulative, first + (last - first) * rng.random(drawn.size), side="right") - 1
    # Limit the index to the stretches of the bin, because rounding may give the next one.
    piece = np.clip(piece, galaxy.first[owner, m_bin], galaxy.first[owner, m_bin + 1] - 1)
    pieces, along = galaxy.pieces, rng.random(drawn.size)

    def interpolate(ends: Float) -> Float:
        low = ends[0, piece]
        return np.asarray(low + (ends[1, piece] - low) * along)

    track = pieces.track[piece]
    cooling = track < 0
    metals = galaxy.tracks.metallicity[track] + galaxy.width[track] * (labels.random(drawn.size) - 0.5)
    codes = np.array([component.code for component in galaxy.components])
    return Sample(
        component=codes[owner],
        stage=pieces.stage[piece],
        track=track,
        distance=distance,
        m_h=interpolate(pieces.m_h),
        mass=np.where(cooling, np.nan, 10.0 ** interpolate(pieces.log_mass)),
        teff=10.0 ** interpolate(pieces.log_teff),
        log_g=interpolate(pieces.log_g),
        metallicity=np.clip(metals, *galaxy.limits),
        age=np.where(cooling, np.nan, galaxy.tracks.age[track]),
    )


def draw_in_shells(galaxy: MilkyWay, mean: Float, rng: np.random.Generator) -> tuple[Int, Float]:
    """Draw a Poisson sample of objects of k kinds, uniform in volume within each shell of distance.

    Parameters
    ----------
    galaxy : MilkyWay
        Model of the Milky Way with the edges of the shells.
    mean : float array, shape (k, s)
        Expected number of objects of each kind in each shell.
    rng : Generator
        Random numbers.

    Returns
    -------
    kind : int array, shape (n,)
        Kind of each object, 0 to k - 1.
    distance : float array, shape (n,)
        Distance from the Sun, pc.
    """
    kind, shell = np.unravel_index(_draw_boxes(mean, rng), mean.shape)
    return np.asarray(kind), _draw_distance(galaxy, shell, rng)


def _draw_boxes(mean: Float, rng: np.random.Generator) -> Int:
    """Draw a Poisson number of objects; return for each the flat index of its element in `mean` (expected numbers)."""
    boxes = np.flatnonzero(mean)
    cumulative = np.cumsum(mean.ravel()[boxes])
    total = float(cumulative[-1]) if boxes.size else 0.0
    n = int(rng.poisson(total))
    # Limit the index, because rounding may give one beyond the end of `boxes`.
    return boxes[np.minimum(np.searchsorted(cumulative, rng.random(n) * total, side="right"), max(boxes.size - 1, 0))]


def _draw_distance(galaxy: MilkyWay, shell: Int, rng: np.random.Generator) -> Float:
    near3, far3 = galaxy.distance[shell] ** 3, galaxy.distance[shell + 1] ** 3
    return np.asarray(np.cbrt(near3 + (far3 - near3) * rng.random(shell.size)))
