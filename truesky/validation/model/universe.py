"""The universe: counts, sizes, clustering, lensing and stars.

Galaxies of cells spread over the sky, drawn at the settings that a request has by default, are counted and measured;
halos and the galaxies of massive ones over hundreds of deg2 are correlated; the lensing maps are compared with linear
theory in several boxes, the stars with published counts.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Float
from truesky.catalogue import dust_map
from truesky.catalogue.galaxies import band_ratios, galaxies, lensing
from truesky.catalogue.halos import luminosity_function, matching
from truesky.catalogue.matter import density_box
from truesky.catalogue.stars import gaia
from truesky.catalogue.stars import stars as milky_way_stars
from truesky.fluxes import cosmology
from truesky.fluxes.libraries import rest_grid, templates
from truesky.numerics import cache
from truesky.request.schema import Universe
from truesky.validation.model import census, clustering, observed, pictures, shear, small_scales, star_counts
from truesky.validation.theory import Shells

SEED = 7
POWER_EDGES = np.array([0.02, 0.05, 0.10, 0.15, 0.20])
BIASES, BIAS_EDGES = (0.7, 1.0, 1.4, 2.0, 2.9), np.array([0.03, 0.10])
# Of the sample whose clustering is measured: redshifts, and log10 of the least halo and proxy mass.
NEAR, FAR, LOG_MASS = 0.4, 0.8, 12.0
WIDE_EDGES, NARROW_EDGES = np.array([0.3, 0.5, 0.7, 1.0, 1.5]), np.array([0.03, 0.05, 0.08, 0.13, 0.2, 0.3])
TRACERS = ("halos", "galaxies")
BANDS = (30, 64, 128, 256, 384, 512)
PLANES = ((7, 1.0), (12, 2.4))
# Redshifts of sources, and steps along the line of sight, Mpc/h, of which one cell in five is seen.
SIGHTS, SKIPPING = (1.0, 2.3), 20.0
# K-corrections and I_E - M_r - DM at z = 0.1, 0.5, 1, 2 of three templates.
K_REDSHIFTS = (0.1, 0.5, 1.0, 2.0)
K_CORRECTIONS = {
    "sdss_r01": {0: (0.16, 1.60, 3.29, 5.06), 13: (0.005, 0.54, 1.17, 1.12), 25: (-0.14, -0.42, -0.75, -1.31)},
    "euclid_vis": {0: (-0.43, 0.07, 1.15, 3.63), 13: (-0.27, -0.17, 0.29, 0.91), 25: (-0.15, -0.46, -0.73, -1.25)},
}


@dataclass(frozen=True, slots=True)
class Size:
    """How much is drawn.

    settings : of the universe;  blocks : of 4^side_order generation cells;  deep : blocks of one cell to I_E < 28
    wide : blocks of 54 deg2 a box whose clustering is measured;  near : of 215 deg2, for satellites at z = 0.1
    pixels : order-5 cells whose halos are counted; four times as many for clustering at the size of halos
    boxes : seeds of further boxes whose power, clustering and lensing are measured;  stars : cells a latitude
    """

    settings: Universe
    blocks: int
    side_order: int
    deep: int
    wide: int
    near: int
    pixels: int
    boxes: tuple[int, ...]
    stars: int


FULL = Size(Universe(), 160, 0, 8, 20, 3, 16, (8, 9), 12)
QUICK = Size(Universe(box_cells=192, lensing_nside=64), 4, 0, 0, 2, 0, 0, (), 0)


# ------------------------------------------------------------------------------------------------ figures


def theory() -> dict[str, float]:
    """sigma_8, distance, K-corrections."""
    k = np.geomspace(1e-4, 50.0, 20_000)
    x = 8.0 * k
    window = 3.0 * (np.sin(x) - x * np.cos(x)) / x**3
    variance = np.trapezoid(density_box.linear_power(k) * window**2 * k**3 / (2 * np.pi**2), np.log(k))
    figures = {"sigma_8": float(np.sqrt(variance)), "chi_2.3": float(cosmology.comoving_distance(2.3))}
    wavelength, kinds = rest_grid.rest_grid(), list(K_CORRECTIONS["sdss_r01"])
    # The numbers are of the observed spectra with their weak lines, which the library bridges.
    flux = templates.galaxies(wavelength, bridged=-1.0)[kinds].astype(np.float32)
    library = templates.Library(wavelength, flux, tuple(map(str, kinds)))
    z, none = np.array(K_REDSHIFTS), np.zeros(len(K_REDSHIFTS), int)
    for band, published in K_CORRECTIONS.items():
        table = band_ratios.build(library, band, 2.3, 0.5)
        for row, (kind, expected) in enumerate(published.items()):
            found = -2.5 / np.log(10.0) * band_ratios.ln_ratio(table, z, none + row, none, np.zeros(z.size))
            off = found - np.array(expected)
            figures[f"k_{band}_t{kind}_off"] = float(off[np.abs(off).argmax()])
    return figures


def matter(size: Size) -> dict[str, float]:
    """Power and bias of the box, velocities."""
    cells = size.settings.box_cells
    box = density_box.load(SEED, cells)
    boxes = [box, *(shear.gaussian_box(seed, cells) for seed in size.boxes)]
    figures = {}
    if size.boxes:
        power = np.array([clustering.box_power(box, POWER_EDGES) for box in boxes])
        figures = _named("box_power_k{:.2f}", POWER_EDGES, power.mean(0), power.std(0, ddof=1) / np.sqrt(len(boxes)))
    bias = clustering.halo_bias(box, BIASES, BIAS_EDGES)[:, 0]
    figures |= {f"halo_bias_x{x}": float(value) for x, value in zip(BIASES, bias, strict=True)}
    masses = matching.masses()
    of_12 = float(masses.at(masses.bias, np.zeros(1), np.full(1, 12.0))[0])
    return figures | {"velocity_rms": clustering.velocities(box, of_12)}


def _named(pattern: str, edges: Sequence[float] | Float, values: Float, errors: Float) -> dict[str, float]:
    names = [pattern.format(edge) for edge in edges[:-1]]
    figures = {name: float(value) for name, value in zip(names, values, strict=True)}
    return figures | {f"{name}_error": float(value) for name, value in zip(names, errors, strict=True)}


def published_halos() -> Callable[[float, float], float]:
    """Halos above a mass at z, (Mpc/h)^-3: the mass function itself, without what the draw makes of it."""
    masses = matching.masses()

    def number(least: float, z: float) -> float:
        log_mass = np.linspace(least, 16.0, 501)
        ln_density = masses.interpolate(masses.ln_density, np.array([z]), log_mass)[0]
        return float(np.trapezoid(np.exp(ln_density), log_mass))

    return number


def counted(size: Size) -> tuple[dict[str, float], census.Census]:
    """Everything that the galaxies of small blocks tell."""
    universe = galaxies.model(SEED, size.settings)
    dust, law = dust_map.load(SEED), luminosity_function.schechter()
    seen = census.draw(universe, dust, census.blocks(size.blocks, size.side_order))
    figures = {"galaxies": float(seen.block.size), "galaxies_deg2": seen.area}
    figures |= census.counts(seen) | census.colours(seen) | census.sizes(seen) | census.halpha(seen)
    figures |= observed.figures(observed.of_columns(seen.rows, seen.area))
    figures |= census.halos(seen, published_halos()) | census.luminosities(seen, law, 0.0, 1.5)
    if size.deep:
        deep = galaxies.model(SEED, replace(size.settings, galaxy_limit=28.0))
        far = census.draw(deep, dust, census.blocks(size.deep, 0))
        figures |= census.luminosities(far, law, 1.5, 2.3)
    return figures, seen


def compared(
    found: clustering.Correlation, of: Shells, power: Callable[[Float], Float]
) -> tuple[Float, Float, Float, Float]:
    """theta, w, its error, and Limber's: the mean of a block takes as much from what is found as from that."""
    expected, left = clustering.limber(of, found, power)
    return found.theta, found.w + expected - left, found.error, expected


def clustered(size: Size) -> tuple[dict[str, float], dict[str, Any], clustering.Tracers]:
    """w(theta) of halos and of galaxies over Limber's, all boxes together; the curves; the halos of the first box."""
    many, seeds = 12 << 2 * clustering.BLOCK_ORDER, (SEED, *size.boxes)
    cells = ((np.arange(size.wide) + 0.37) * many / size.wide).astype(int).tolist()
    whole, pieces, curves = [], [], {}
    figures: dict[str, float] = {}
    for seed in seeds:
        # The boxes of other seeds are not kept.
        with nullcontext() if seed == SEED else cache.temporary():
            universe = clustering.population_above(seed, size.settings.box_cells, NEAR, FAR, LOG_MASS)
            for cell in cells:
                one = clustering.tracers(universe, clustering.BLOCK_ORDER, cell)
                kinds = (one.part(~one.satellite & (one.log_mass > LOG_MASS)), one.part(one.proxy > LOG_MASS))
                whole.append((cell, kinds))
                pieces.append((cell << 2 * (clustering.PIECE_ORDER - clustering.BLOCK_ORDER), kinds))
    seen = [clustering.shells(clustering.joined([kinds[i] for _, kinds in whole]), NEAR, FAR) for i in range(2)]
    for given, order, edges in (
        (whole, clustering.BLOCK_ORDER, WIDE_EDGES),
        (pieces, clustering.PIECE_ORDER, NARROW_EDGES),
    ):
        for name, of, found in zip(TRACERS, seen, clustering.correlation(given, order, edges), strict=True):
            theta, w, error, expected = compared(found, of, density_box.linear_power)
            curves[f"{name}_{'wide' if edges is WIDE_EDGES else 'narrow'}"] = (theta, w, error, expected)
            figures |= _named(f"w_{name}_{{:g}}", edges, w / expected, error / expected)
    maps = []
    for seed in seeds:
        box = shear.gaussian_box(seed, size.settings.box_cells)
        maps += [(cell, (clustering.structure(box, clustering.BLOCK_ORDER, cell, seen[0]),)) for cell in cells]
    (found,) = clustering.correlation(maps, clustering.BLOCK_ORDER, WIDE_EDGES)
    _, w, error, expected = compared(found, seen[0], clustering.gaussian_power)
    figures |= _named("w_structure_{:g}", WIDE_EDGES, w / expected, error / expected)
    for name in TRACERS:
        for edge in WIDE_EDGES[:-1]:
            alone = figures[f"w_structure_{edge:g}"]
            figures[f"w_{name}_{edge:g}_to_structure"] = figures[f"w_{name}_{edge:g}"] / alone
    figures["clustering_deg2"] = len(whole) * sky.cell_area(clustering.BLOCK_ORDER)
    return figures, curves, clustering.joined([kinds[0] for _, kinds in whole[: size.wide]])


def abundances(size: Size) -> dict[str, float]:
    """Halos above a mass / the mass function, in thin shells of order-5 cells; the error from their scatter."""
    number, cells = published_halos(), ((np.arange(size.pixels) + 0.43) * (12 << 10) / size.pixels).astype(int).tolist()
    figures, area = {}, sky.cell_area(5) * np.radians(1.0) ** 2
    for at, half in census.HALO_SHELLS:
        universe = clustering.population_above(
            SEED, size.settings.box_cells, at - half, at + half, census.HALO_MASSES[0]
        )
        found = [clustering.tracers(universe, 5, cell) for cell in cells]
        volume = float(cosmology.comoving_volume(at - half, at + half)) * area
        for least in census.HALO_MASSES:
            each = [np.sum(~one.satellite & (one.log_mass > least)) / volume / number(least, at) for one in found]
            name = f"halos_{least:g}_z{at}"
            figures[name], figures[f"{name}_error"] = (
                float(np.mean(each)),
                float(np.std(each, ddof=1) / len(each) ** 0.5),
            )
    return figures


def nearby(size: Size) -> dict[str, float]:
    """Satellites of M_r < -20 at z = 0.1, SDSS's limit of volume."""
    universe = clustering.population_above(SEED, size.settings.box_cells, 0.05, 0.15, 11.8)
    cells = ((np.arange(size.near) + 0.4) * 192 / size.near).astype(int).tolist()
    found = clustering.joined([clustering.tracers(universe, 2, cell) for cell in cells])
    z = universe.halos.distances.redshift(found.chi)
    bright = universe.halos.matching.magnitude(z, found.proxy) < -20.0
    share = float(np.mean(found.satellite[bright]))
    return {"satellites_m20_z0.1": share, "satellites_m20_z0.1_number": float(bright.sum())}


def lensed(size: Size, halos: clustering.Tracers) -> tuple[dict[str, float], Float]:
    """Maps, their power in several boxes, shear about halos; C_l over theory [plane, band]."""
    cells, nside = size.settings.box_cells, size.settings.lensing_nside
    box = density_box.load(SEED, cells)
    planes = lensing.load(box, nside, far=True)
    figures: dict[str, float] = {}
    for number, z in PLANES:
        figures |= shear.maps(planes, number, f"z{z}")
    heavy = halos.part(halos.log_mass > 13.5)
    mean, error = shear.tangential(planes, heavy, float(cosmology.comoving_distance(1.2)))
    for radius, value, wrong in zip(shear.RINGS, mean, error, strict=True):
        figures[f"gamma_t_{radius}deg"], figures[f"gamma_t_{radius}deg_in_errors"] = float(value), float(value / wrong)
    if not size.boxes:
        return figures, np.ones((0, 0))
    for z, (rms, linear) in zip(SIGHTS, shear.sight_rms(box, SIGHTS), strict=True):
        figures |= {f"kappa_sight_rms_z{z}": rms, f"kappa_sight_rms_z{z}_to_theory": rms / linear}
        figures[f"kappa_skipping_rms_z{z}"] = shear.skipping_rms(box, z, SKIPPING)
    found = np.stack(
        [shear.power_of(planes, [number for number, _ in PLANES], BANDS)]
        + [shear.power_of_box(seed, cells, nside, [z for _, z in PLANES], BANDS) for seed in size.boxes]
    )
    for plane, (_, z) in enumerate(PLANES):
        error = found[:, plane].std(0, ddof=1) / np.sqrt(len(found))
        figures |= _named(f"c_l_z{z}_{{}}", BANDS, found[:, plane].mean(0), error)
    return figures, found.mean(0)


def milky_way(size: Size) -> dict[str, float]:
    """Stars and dwarfs against other code, the errors of Gaia."""
    universe, dust, figures = milky_way_stars.model(), dust_map.load(SEED), {}
    for b, published in star_counts.COUNTS.items():
        off = star_counts.counts(b, size.stars, universe, dust) / np.array(published) - 1.0
        figures[f"stars_b{b}_off"] = float(off[np.abs(off).argmax()])
    for b, counted_there in star_counts.DWARFS.items():
        off = star_counts.dwarf_counts(b, 1000.0) / np.array(counted_there) - 1.0
        figures[f"dwarfs_b{b}_off"] = float(off[np.abs(off).argmax()])
    return figures | {f"gaia_parallax_g{g:g}": float(gaia.astrometric_errors(g)[2]) for g in star_counts.PARALLAX}


def run(size: Size, folder: Path | None = None) -> dict[str, float]:
    """All figures; their pictures into a folder."""
    started = time.process_time()
    figures, seen = counted(size)
    found, curves, halos = clustered(size)
    figures |= theory() | matter(size) | found
    found, power = lensed(size, halos)
    figures |= found
    if size.near:
        figures |= nearby(size)
    if size.pixels:
        figures |= abundances(size)
        bright = small_scales.universe_of(SEED, size.settings.box_cells)
        figures |= small_scales.figures(bright, 4 * size.pixels)
    if size.stars:
        figures |= milky_way(size)
    if folder is not None:
        pictures.draw(folder, seen, curves, power, BANDS, figures)
    return figures | {"cpu_s": time.process_time() - started}
