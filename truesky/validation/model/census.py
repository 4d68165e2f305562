"""Count the galaxies of many small blocks of the sky: counts, colours, sizes, H alpha, luminosities and halos.

Figures are returned by name. The error of a count is under name + "_error"; it is the scatter between the blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from lake_schema import sky
from lake_schema.arrays import Array, Bool, Float, Float32, Int
from lake_schema.ids import GENERATION_ORDER
from truesky.catalogue.galaxies import band_ratios, emission_lines, galaxies, morphology
from truesky.catalogue.galaxies.galaxies import GalaxyModel
from truesky.catalogue.halos import luminosity_function, matching, population
from truesky.fluxes import cosmology
from truesky.fluxes.libraries import templates
from truesky.validation.model import observed

ARCMIN2 = 3600.0
AREA = sky.cell_area(GENERATION_ORDER)
BANDS = ("euclid_vis", "euclid_y", "euclid_j", "euclid_h", "lsst_g", "lsst_r", "lsst_i", "lsst_z")
COLUMNS = (
    *observed.COLUMNS, "ra", "dec", "z_obs", "bulge_half_light_radius", "disk_half_light_radius", "bulge_fraction",
    "bulge_sersic_index",
)  # fmt: skip
HALO_COLUMNS = ("z_true", "log_mass")
HALPHA_LIMITS, HALPHA_SHELLS = (5e-17, 1e-16, 2e-16, 3e-16), ((0.9, 1.8), (0.4, 1.8), (0.7, 2.0))
SIZE_BINS = ((19, 20), (21, 22), (22, 23), (23, 24), (24, 24.5), (25, 26))
# Redshift, half width, and the largest I_E - M_r - DM of any spectrum there, which sets the limit of M_r.
SHELLS = ((0.1, 0.05, 0.2), (0.5, 0.1, 0.4), (1.0, 0.15, 1.5), (2.0, 0.15, 4.0))
HALO_MASSES, HALO_SHELLS = (11.0, 12.0, 13.0), ((0.5, 0.1), (1.0, 0.1), (2.0, 0.1))
_SIZED = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class Census:
    """Galaxies of the light cone and halos in blocks of the sky.

    Attributes
    ----------
    blocks : int
        Number of blocks.
    area : float
        Area of all blocks, deg2.
    limit : float
        Magnitude limit of the galaxies.
    rows : mapping of str to array, shape (n,)
        Columns of the galaxies by name.
    block : int array, shape (n,)
        Block of each galaxy.
    mags : mapping of str to array, shape (n,)
        Magnitudes of the galaxies by band, AB.
    halos : mapping of str to array, shape (m,)
        Columns of the halos by name.
    halo_block : int array, shape (m,)
        Block of each halo.
    """

    blocks: int
    area: float
    limit: float
    rows: Mapping[str, Array]
    block: Int
    mags: Mapping[str, Array]
    halos: Mapping[str, Array]
    halo_block: Int

    def per_deg2(self, selected: Bool) -> Float:
        """Return the number of selected galaxies per deg2 in each block."""
        return np.asarray(np.bincount(self.block[selected], minlength=self.blocks) * (self.blocks / self.area))


def blocks(count: int, side_order: int) -> list[list[int]]:
    """Return `count` nested blocks of 4^side_order generation cells each, distributed over the sky."""
    n_blocks, inside = 12 << 2 * (GENERATION_ORDER - side_order), 1 << 2 * side_order
    first = ((np.arange(count) + 0.31) * n_blocks / count).astype(int)
    return [[int(block) * inside + i for i in range(inside)] for block in first]


def draw(universe: GalaxyModel, dust: Float32, places: Sequence[Sequence[int]]) -> Census:
    """Draw the galaxies and halos of blocks as the catalogue contains them.

    Parameters
    ----------
    universe : GalaxyModel
        Model of the galaxies.
    dust : float32 array, shape (pixels,)
        Map of A(V), mag.
    places : sequence of sequences of int
        Generation cells of each block.

    Returns
    -------
    Census
        Galaxies and halos with their blocks.
    """
    halo_cells, library = population.CellCache(universe.population), templates.galaxy_library()
    rows, hosts, mags = [], [], []
    for place in places:
        galaxy_table = pa.concat_tables(
            [galaxies.draw(cell, universe, halo_cells, dust).select(COLUMNS) for cell in place]
        )
        galaxy_table = galaxy_table.filter(pa.array(galaxy_table["kind"].to_numpy() < 2))
        rows.append({name: galaxy_table[name].to_numpy() for name in COLUMNS})
        mags.append(magnitudes(rows[-1], library, matching.Z_LAST))
        table = pa.concat_tables([galaxies.halo_table(cell, universe.population, halo_cells) for cell in place])
        hosts.append({name: table[name].to_numpy() for name in HALO_COLUMNS})

    def concatenate(parts: Sequence[Mapping[str, Array]]) -> Mapping[str, Array]:
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def block_numbers(parts: Sequence[Mapping[str, Array]]) -> Int:
        return np.repeat(np.arange(len(parts)), [part["z_true"].size for part in parts])

    area = sum(len(place) for place in places) * AREA
    return Census(
        len(places),
        area,
        universe.limit,
        concatenate(rows),
        block_numbers(rows),
        concatenate(mags),
        concatenate(hosts),
        block_numbers(hosts),
    )


def magnitudes(rows: Mapping[str, Array], library: templates.Library, z_max: float) -> Mapping[str, Array]:
    """Return AB magnitudes by band, before lensing magnification and the dust of the Milky Way.

    Parameters
    ----------
    rows : mapping of str to array, shape (n,)
        Columns of table `galaxies`.
    library : Library
        Galaxy spectra.
    z_max : float
        Redshift that the tables of band ratios reach.

    Returns
    -------
    mapping of str to float32 array, shape (n,)
        Magnitudes by band.
    """
    names = ("sed_1", "frac_1", "sed_2", "frac_2", "ext_law_1", "ebv_1")
    sed = band_ratios.Sed(*(rows[name] for name in names))
    z = rows["z_true"].astype(float)
    plain = rows["abs_mag_r01"] + cosmology.distance_modulus(z)
    return {
        band: (plain + band_ratios.offset(band_ratios.load(library, band, z_max, 0.5), z, sed)).astype(np.float32)
        for band in BANDS
    }


def _mean(values: Float) -> tuple[float, float]:
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(values.size))


def _with_errors(per_block: dict[str, Float]) -> dict[str, float]:
    figures: dict[str, float] = {}
    for name, values in per_block.items():
        figures[name], figures[f"{name}_error"] = _mean(values)
    return figures


def counts(census: Census) -> dict[str, float]:
    """Galaxies per arcmin2 with I_E < 26, slope of the counts, and fraction of satellites with I_E < 24.5."""
    vis = census.mags["euclid_vis"]
    per_block = {"vis_26": census.per_deg2(vis < 26.0) / ARCMIN2}
    bright = vis < 24.5
    number = [np.sum(np.abs(vis - at) < 0.5) for at in (20, 21, 22, 23)]
    return _with_errors(per_block) | {
        "vis_slope_20_23": float(np.mean(np.diff(np.log10(number)))),
        "satellites_24.5": float(np.mean(census.rows["kind"][bright])),
    }


def colours(census: Census) -> dict[str, float]:
    """Median colours of galaxies with I_E < 24.5."""
    mags = census.mags
    bright = mags["euclid_vis"] < 24.5
    pairs = {
        "g_r": ("lsst_g", "lsst_r"), "r_i": ("lsst_r", "lsst_i"), "vis_h": ("euclid_vis", "euclid_h"),
        "j_h": ("euclid_j", "euclid_h"),
    }  # fmt: skip
    return {
        f"median_{name}": float(np.median(mags[blue][bright] - mags[red][bright]))
        for name, (blue, red) in pairs.items()
    }


def half_light_of_rows(rows: Mapping[str, Array], part: Int) -> Float:
    """Return the half-light radii (arcsec) of bulge and disc together for rows `part` of table `galaxies`."""
    names = ("bulge_half_light_radius", "disk_half_light_radius", "bulge_fraction", "bulge_sersic_index")
    bulge, disc, fraction, sersic = (rows[name][part].astype(float) for name in names)
    return half_light_radius(bulge, disc, fraction, sersic)


def half_light_radius(bulge: Float, disc: Float, fraction: Float, sersic: Float) -> Float:
    """Return the half-light radius of a bulge and an exponential disc together, by bisection.

    Parameters
    ----------
    bulge, disc : float array, shape (n,)
        Half-light radii of the components, arcsec.
    fraction : float array, shape (n,)
        Bulge-to-total ratio, 0 to 1.
    sersic : float array, shape (n,)
        Sersic index of the bulge.

    Returns
    -------
    float array, shape (n,)
        Half-light radius, arcsec.
    """
    low, high = np.minimum(bulge, disc), np.maximum(bulge, disc)
    for _ in range(30):
        middle = np.sqrt(low * high)
        light = fraction * morphology.light_within(middle, bulge, sersic)
        light += (1 - fraction) * morphology.light_within(middle, disc, 1.0)
        low, high = np.where(light < 0.5, middle, low), np.where(light < 0.5, high, middle)
    return np.asarray(np.sqrt(low * high))


def sizes(census: Census) -> dict[str, float]:
    """Median radii by magnitude, range of the Sersic index, and largest relative error of two-component radii."""
    vis, figures = census.mags["euclid_vis"], {}
    for bright, faint in SIZE_BINS:
        inside = np.flatnonzero((vis >= bright) & (vis < faint))
        sample = inside[:: max(inside.size // _SIZED, 1)]
        figures[f"size_{bright}_{faint}"] = float(np.median(half_light_of_rows(census.rows, sample)))
    sersic = census.rows["bulge_sersic_index"]
    figures |= {"sersic_least": float(sersic.min()), "sersic_most": float(sersic.max())}
    rng, n, shapes = np.random.default_rng(3), _SIZED, morphology.shapes()
    bulge = shapes.bulge
    fraction, radius = rng.random(n), np.exp(rng.uniform(np.log(0.01), np.log(10.0), n))
    red = rng.random(n) < 0.3
    index, ratio = morphology.sersic_index(bulge, red, rng), morphology.radius_ratio(bulge, red, rng)
    radii = morphology.component_radii(shapes, radius, fraction, ratio, index)
    figures["half_light_worst"] = float(np.abs(half_light_radius(*radii, fraction, index) / radius - 1.0).max())
    return figures


def halpha(census: Census) -> dict[str, float]:
    """Ratio of the number of H alpha emitters to the published number, with its Poisson error."""
    z, flux = census.rows["z_true"], census.rows["flux_halpha"]
    figures = {}
    for z_min, z_max in HALPHA_SHELLS:
        for limit in HALPHA_LIMITS:
            expected = float(emission_lines.expected_counts(np.array([limit]), z_min, z_max)[0]) * census.area
            n_emitters = float(np.sum((z > z_min) & (z < z_max) & (flux > limit)))
            name = f"halpha_{limit:g}_{z_min}_{z_max}"
            figures[name], figures[f"{name}_error"] = n_emitters / expected, np.sqrt(n_emitters) / expected
    return figures


def luminosities(census: Census, law: luminosity_function.Schechter, z_min: float, z_max: float) -> dict[str, float]:
    """Return the ratio of the number of galaxies to the luminosity function in complete samples.

    Parameters
    ----------
    census : Census
        Galaxies that were drawn.
    law : Schechter
        Luminosity function.
    z_min, z_max : float
        Redshift range of the shells.

    Returns
    -------
    dict of str to float
        Ratios by shell, with errors.
    """
    z, m = census.rows["z_true"], census.rows["abs_mag_r01"]
    ratios = {}
    for at, half, reddest in SHELLS:
        if not z_min < at < z_max:
            continue
        faintest = min(census.limit - float(cosmology.distance_modulus(at + half)) - reddest, -16.0)
        number = per_deg2(lambda shell, m=faintest: luminosity_function.number_density(law, m, shell), at, half)  # type: ignore[misc]
        ratios[f"luminosity_function_z{at}"] = census.per_deg2((np.abs(z - at) < half) & (m < faintest)) / number
    return _with_errors(ratios)


def per_deg2(density: Callable[[Float], Float], at: float, half: float) -> float:
    """Integrate a comoving density over a shell of redshift.

    Parameters
    ----------
    density : callable
        Density in (Mpc/h)^-3 of redshifts.
    at, half : float
        Middle and half width of the shell.

    Returns
    -------
    float
        Number per deg2.
    """
    grid = np.linspace(at - half, at + half, 41)
    value = density(grid)
    shells = cosmology.comoving_volume(grid[:-1], grid[1:]) * np.radians(1.0) ** 2
    return float(np.sum(0.5 * (value[1:] + value[:-1]) * shells))


def halos(census: Census, published: Callable[[float, float], float]) -> dict[str, float]:
    """Ratio of the number of halos above a mass to the number density `published(log_mass, z)` in thin shells."""
    z, mass = census.halos["z_true"], census.halos["log_mass"]
    ratios = {}
    for at, half in HALO_SHELLS:
        volume = float(cosmology.comoving_volume(at - half, at + half)) * np.radians(1.0) ** 2
        for min_log_mass in HALO_MASSES:
            selected = (np.abs(z - at) < half) & (mass > min_log_mass)
            each = np.bincount(census.halo_block[selected], minlength=census.blocks) * (census.blocks / census.area)
            ratios[f"halos_{min_log_mass:g}_z{at}"] = each / (volume * published(min_log_mass, at))
    return _with_errors(ratios)


def redshifts(census: Census) -> tuple[Float, Float]:
    """Redshift distribution of galaxies with I_E < 24.5: edges of bins of width 0.2, and fraction in each bin."""
    edges = np.arange(0.0, 2.41, 0.2)
    number = np.histogram(census.rows["z_true"][census.mags["euclid_vis"] < 24.5], edges)[0]
    return edges, number / number.sum()
