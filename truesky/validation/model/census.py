"""Simulate galaxies and halos in many small blocks of the sky, and measure counts, colours, sizes, H alpha and halos.

Measured values are returned by name. Standard errors are under name + "_error"; most are computed from the scatter
between blocks.
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
from truesky.cosmology import FIDUCIAL, Cosmology
from truesky.fluxes.libraries import templates
from truesky.validation.model import observed

# Number of arcmin^2 in a deg^2.
ARCMIN2 = 3600.0
# Area of a generation cell (HEALPix cell in which galaxies are simulated as a whole), deg^2.
AREA = sky.cell_area(GENERATION_ORDER)
# Bands in which magnitudes are computed.
BANDS = ("euclid_vis", "euclid_y", "euclid_j", "euclid_h", "lsst_g", "lsst_r", "lsst_i", "lsst_z")
# Columns of the simulated table `galaxies` that a Census keeps.
COLUMNS = (
    *observed.COLUMNS, "ra", "dec", "z_obs", "bulge_half_light_radius", "disk_half_light_radius", "bulge_fraction",
    "bulge_sersic_index", "bulge_axis_ratio",
)  # fmt: skip
# Columns of the simulated table `halos` that a Census keeps.
HALO_COLUMNS = ("z_true", "log_mass")
# Smallest H alpha fluxes of counted emitters, erg/s/cm^2.
HALPHA_LIMITS = (5e-17, 1e-16, 2e-16, 3e-16)
# Redshift ranges in which H alpha emitters are counted.
HALPHA_SHELLS = ((0.9, 1.8), (0.4, 1.8), (0.7, 2.0))
# Ranges of I_E (AB mag) in which the median size is measured.
SIZE_BINS = ((19, 20), (21, 22), (22, 23), (23, 24), (24, 24.5), (25, 26))
# Redshifts at which the sizes of galaxies with 10^10.75 Msun are measured, half width of the bins in redshift and log10
# of mass, and the smallest number of galaxies.
SIZE_SHELLS, SIZE_HALF, SIZE_NUMBER = (0.75, 1.25, 1.75, 2.25, 2.75), 0.25, 20
# Smallest bulge fraction of galaxies whose ellipticity is compared with that of early types.
EARLY_BULGE = 0.6
# Redshift shells for the luminosity function: centre, half width, and the largest I_E - M_r - DM of any galaxy in the
# shell. The last number gives the faintest M_r to which a sample limited in I_E is complete.
SHELLS = ((0.1, 0.05, 0.2), (0.5, 0.1, 0.4), (1.0, 0.15, 1.5), (2.0, 0.15, 4.0))
# Lowest masses of counted halos, log10 of Msun/h.
HALO_MASSES = (11.0, 12.0, 13.0)
# Redshift shells in which halos are counted: centre and half width.
HALO_SHELLS = ((0.5, 0.1), (1.0, 0.1), (2.0, 0.1))
# Smallest number of galaxies whose sizes are computed in a magnitude range, unless it has fewer galaxies. The largest
# number is twice as high.
_SIZED = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class Census:
    """Simulated galaxies and halos in several separate blocks of the sky.

    Attributes
    ----------
    blocks : int
        Number of blocks.
    area : float
        Area of all blocks together, deg2.
    limit : float
        Magnitude limit in I_E of the galaxies, AB mag.
    rows : mapping of str to array, shape (n,)
        Columns of the table `galaxies` by name, for central and satellite galaxies.
    block : int array, shape (n,)
        Number of the block of each galaxy, from 0.
    mags : mapping of str to array, shape (n,)
        AB magnitudes of the galaxies by band.
    halos : mapping of str to array, shape (m,)
        Columns of the table `halos` by name.
    halo_block : int array, shape (m,)
        Number of the block of each halo, from 0.
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
        """Return the number per deg2, in each block, of the galaxies for which the mask `selected` is True."""
        return np.asarray(np.bincount(self.block[selected], minlength=self.blocks) * (self.blocks / self.area))


def blocks(count: int, side_order: int) -> list[list[int]]:
    """Select `count` blocks that are evenly distributed over the sky; return the numbers of the cells in each block.

    A block consists of 4^`side_order` adjacent generation cells (nested HEALPix cells of order 8).
    """
    n_blocks, inside = 12 << 2 * (GENERATION_ORDER - side_order), 1 << 2 * side_order
    first = ((np.arange(count) + 0.31) * n_blocks / count).astype(int)
    return [[int(block) * inside + i for i in range(inside)] for block in first]


def draw(universe: GalaxyModel, dust: Float32, places: Sequence[Sequence[int]]) -> Census:
    """Simulate the galaxies and halos of several blocks, exactly as the catalogue would contain them.

    Parameters
    ----------
    universe : GalaxyModel
        Model of the galaxies and halos.
    dust : float32 array, shape (pixels,)
        HEALPix map of the Milky Way's extinction A(V), mag.
    places : sequence of sequences of int
        Numbers of the generation cells (nested HEALPix cells of order 8) of each block; at least one block.

    Returns
    -------
    Census
        Central and satellite galaxies, and halos, with the number of their block.
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
    """Return AB magnitudes by band, without lensing magnification and without extinction by the Milky Way.

    Parameters
    ----------
    rows : mapping of str to array, shape (n,)
        Columns of the table `galaxies` that describe the spectra: redshift, absolute magnitude, templates and dust.
    library : Library
        Templates of galaxy spectra.
    z_max : float
        Largest redshift of the cached tables of flux ratios between bands; at least that of all galaxies.

    Returns
    -------
    mapping of str to float32 array, shape (n,)
        Magnitudes in each of BANDS.
    """
    names = ("sed_1", "frac_1", "sed_2", "frac_2", "ext_law_1", "ebv_1")
    sed = band_ratios.Sed(*(rows[name] for name in names))
    z = rows["z_true"].astype(float)
    plain = rows["abs_mag_r01"] + FIDUCIAL.distance_modulus(z)
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
    """Measure the number of galaxies with I_E < 26 per arcmin2, and two other statistics of counts.

    These are the mean slope d log10(N) / d mag from I_E = 20 to 23, and the fraction of satellites at I_E < 24.5.
    """
    vis = census.mags["euclid_vis"]
    per_block = {"vis_26": census.per_deg2(vis < 26.0) / ARCMIN2}
    bright = vis < 24.5
    number = [np.sum(np.abs(vis - at) < 0.5) for at in (20, 21, 22, 23)]
    return _with_errors(per_block) | {
        "vis_slope_20_23": float(np.mean(np.diff(np.log10(number)))),
        "satellites_24.5": float(np.mean(census.rows["kind"][bright])),
    }


def colours(census: Census) -> dict[str, float]:
    """Return the median colours g - r, r - i, I_E - H and J - H (AB mag) of galaxies with I_E < 24.5, by name."""
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
    """Return the half-light radii (arcsec) of bulge and disc together for the galaxies with indices `part`.

    `rows` has the columns of the table `galaxies`.
    """
    names = ("bulge_half_light_radius", "disk_half_light_radius", "bulge_fraction", "bulge_sersic_index")
    bulge, disc, fraction, sersic = (rows[name][part].astype(float) for name in names)
    return half_light_radius(bulge, disc, fraction, sersic)


def half_light_radius(bulge: Float, disc: Float, fraction: Float, sersic: Float) -> Float:
    """Return the half-light radius of galaxies that consist of a Sersic bulge and an exponential disc, by bisection.

    Parameters
    ----------
    bulge, disc : float array, shape (n,)
        Half-light radii of bulge and disc, arcsec.
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
    """Measure sizes: median half-light radius (arcsec) in ranges of I_E, smallest and largest Sersic index of bulges.

    The result also has a test with random galaxies. The model divides a half-light radius into radii of bulge and disc,
    from which the half-light radius is computed again. The largest relative difference of the two is returned.
    """
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


def sizes_by_mass(census: Census, cosmology: Cosmology) -> dict[str, float]:
    """Measure the 16th and 50th percentiles of log10 of half-light radii (kpc) of galaxies with 10^10.75 Msun.

    Redshifts with fewer than SIZE_NUMBER galaxies are left out. The sample should be complete to I_E = 26.
    """
    z, mass = census.rows["z_true"].astype(float), census.rows["log_stellar_mass"]
    figures: dict[str, float] = {}
    for at in SIZE_SHELLS:
        row = np.flatnonzero((np.abs(z - at) < SIZE_HALF) & (np.abs(mass - 10.75) < SIZE_HALF))
        if row.size >= SIZE_NUMBER:
            kpc = half_light_of_rows(census.rows, row) * cosmology.kpc_per_arcsec(z[row])
            low, median = np.percentile(np.log10(kpc), (16, 50)).tolist()
            figures |= {f"log_size_p16_z{at}": low, f"log_size_median_z{at}": median}
    return figures


def ellipticities(census: Census) -> dict[str, float]:
    """Return the quartiles of (1 - q^2) / (1 + q^2) of the bulges of galaxies that are mostly bulge, by name."""
    q = census.rows["bulge_axis_ratio"][census.rows["bulge_fraction"] > EARLY_BULGE].astype(float)
    quartiles = np.percentile((1.0 - q**2) / (1.0 + q**2), (25, 50, 75))
    return {f"early_ellipticity_p{at}": float(value) for at, value in zip((25, 50, 75), quartiles, strict=True)}


def halpha(census: Census) -> dict[str, float]:
    """Return the number of H alpha emitters divided by the number that a published luminosity function predicts.

    This is model 3 of Pozzetti et al. (2016). The ratios are given for each redshift range and flux limit by name, with
    Poisson errors.
    """
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
    """Return the number of luminous galaxies divided by the number that the luminosity function predicts.

    In each redshift shell, galaxies are counted down to the luminosity to which the sample is complete.

    Parameters
    ----------
    census : Census
        Simulated galaxies.
    law : Schechter
        Luminosity function.
    z_min, z_max : float
        Only shells of SHELLS whose central redshift is between these limits are used.

    Returns
    -------
    dict of str to float
        Ratios by shell, with standard errors from the scatter between blocks.
    """
    z, m = census.rows["z_true"], census.rows["abs_mag_r01"]
    ratios = {}
    for at, half, reddest in SHELLS:
        if not z_min < at < z_max:
            continue
        faintest = min(census.limit - float(FIDUCIAL.distance_modulus(at + half)) - reddest, -16.0)
        number = per_deg2(lambda shell, m=faintest: luminosity_function.number_density(law, m, shell), at, half)  # type: ignore[misc]
        ratios[f"luminosity_function_z{at}"] = census.per_deg2((np.abs(z - at) < half) & (m < faintest)) / number
    return _with_errors(ratios)


def per_deg2(density: Callable[[Float], Float], at: float, half: float) -> float:
    """Integrate a comoving number density over a redshift shell.

    Parameters
    ----------
    density : callable
        Function of an array of redshifts that returns comoving number densities in (Mpc/h)^-3.
    at, half : float
        Central redshift and half width of the shell.

    Returns
    -------
    float
        Number of objects per deg2 in the shell.
    """
    grid = np.linspace(at - half, at + half, 41)
    value = density(grid)
    shells = FIDUCIAL.comoving_volume(grid[:-1], grid[1:]) * np.radians(1.0) ** 2
    return float(np.sum(0.5 * (value[1:] + value[:-1]) * shells))


def halos(census: Census, published: Callable[[float, float], float]) -> dict[str, float]:
    """Return the number of halos above several masses, in thin redshift shells, divided by the expected number.

    `published(log_mass, z)` is the expected number density in (Mpc/h)^-3 of halos above a mass (log10 of Msun/h).
    Ratios are returned by name, with standard errors from the scatter between blocks.
    """
    z, mass = census.halos["z_true"], census.halos["log_mass"]
    ratios = {}
    for at, half in HALO_SHELLS:
        volume = float(FIDUCIAL.comoving_volume(at - half, at + half)) * np.radians(1.0) ** 2
        for min_log_mass in HALO_MASSES:
            selected = (np.abs(z - at) < half) & (mass > min_log_mass)
            each = np.bincount(census.halo_block[selected], minlength=census.blocks) * (census.blocks / census.area)
            ratios[f"halos_{min_log_mass:g}_z{at}"] = each / (volume * published(min_log_mass, at))
    return _with_errors(ratios)


def redshifts(census: Census) -> tuple[Float, Float]:
    """Return the redshift distribution of galaxies with I_E < 24.5: bin edges from 0 to 2.4, and fraction in each bin.

    Fractions are relative to the galaxies within the bins.
    """
    edges = np.arange(0.0, 2.41, 0.2)
    number = np.histogram(census.rows["z_true"][census.mags["euclid_vis"] < 24.5], edges)[0]
    return edges, number / number.sum()
