"""Measure the simulated universe: counts, sizes, clustering, lensing and stars.

Galaxies are simulated with default settings in cells distributed over the sky, then counted and measured. The
clustering of massive halos and of their galaxies is measured over 3200 deg2 in a full validation. Lensing maps of
universes with several random seeds are compared with linear theory, and the stars with reference counts.
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
from truesky.cosmology import Cosmology
from truesky.fluxes.libraries import rest_grid, templates
from truesky.numerics import cache
from truesky.request.schema import Universe
from truesky.validation.model import census, clustering, observed, pictures, shear, small_scales, star_counts
from truesky.validation.theory import Shells

# Seed of the universe.
SEED = 7
# Edges of the wavenumber bins in which the matter power spectrum is measured, h/Mpc.
POWER_EDGES = np.array([0.02, 0.05, 0.10, 0.15, 0.20])
# Values of bias times growth factor for which the bias of halos is measured.
BIASES = (0.7, 1.0, 1.4, 2.0, 2.9)
# Edges of the wavenumber bin in which the bias is measured, h/Mpc.
BIAS_EDGES = np.array([0.03, 0.10])
# Lowest redshift of the halos and galaxies whose clustering is measured.
Z_MIN = 0.4
# Highest redshift of the halos and galaxies whose clustering is measured.
Z_MAX = 0.8
# Lowest mass (log10 of Msun/h) of the halos whose clustering is measured. It is also the lowest proxy mass of the
# galaxies, which determines their luminosity.
MIN_LOG_MASS = 12.0
# Edges of the separation bins in large blocks of the sky, deg.
WIDE_EDGES = np.array([0.3, 0.5, 0.7, 1.0, 1.5])
# Edges of the separation bins in small cells, deg.
NARROW_EDGES = np.array([0.03, 0.05, 0.08, 0.13, 0.2, 0.3])
# Names of the two samples whose clustering is measured.
TRACERS = ("halos", "galaxies")
# Edges of the bands of multipoles l in which C_l of the convergence is measured.
BANDS = (30, 64, 128, 256, 384, 512)
# Lensing maps that are measured: index, and redshift of the sources.
PLANES = ((7, 1.0), (12, 2.4))
# Redshifts of the sources for which the rms of the convergence along lines of sight is measured.
SIGHTS = (1.0, 2.3)
# Step along the line of sight (Mpc/h) that is too large: it samples only one cell of the box in five.
SKIPPING = 20.0
# Redshifts of the published values in K_CORRECTIONS.
K_REDSHIFTS = (0.1, 0.5, 1.0, 2.0)
# Published values by band and number of the galaxy template: K-corrections for sdss_r01, and I_E - M_r - DM (mag) for
# euclid_vis.
K_CORRECTIONS = {
    "sdss_r01": {0: (0.16, 1.60, 3.29, 5.06), 13: (0.005, 0.54, 1.17, 1.12), 25: (-0.14, -0.42, -0.75, -1.31)},
    "euclid_vis": {0: (-0.43, 0.07, 1.15, 3.63), 13: (-0.27, -0.17, 0.29, 0.91), 25: (-0.15, -0.46, -0.73, -1.25)},
}


@dataclass(frozen=True, slots=True)
class SampleSize:
    """Amount of sky to simulate for each measurement; 0 or () skips a measurement.

    Attributes
    ----------
    settings : Universe
        Settings of the universe, as in a request.
    blocks : int
        Number of blocks in which galaxies are simulated to the default depth, at least 2.
    side_order : int
        A block consists of 4^side_order generation cells (HEALPix cells of order 8).
    deep_blocks : int
        Number of single generation cells (HEALPix cells of order 8) in which galaxies are simulated to I_E = 28.
    wide_blocks : int
        Number of blocks of 54 deg2 for the clustering, for each random seed, at least 2.
    nearby_blocks : int
        Number of blocks of 215 deg2 for satellites at z = 0.1.
    halo_cells : int
        Number of HEALPix cells of order 5 in which halos are counted; the clustering within halos uses four times as
        many.
    box_seeds : tuple of int
        Further random seeds of the box of matter, for power spectrum, clustering and lensing.
    star_cells : int
        Number of generation cells in which stars are simulated at each Galactic latitude.
    """

    settings: Universe
    blocks: int
    side_order: int
    deep_blocks: int
    wide_blocks: int
    nearby_blocks: int
    halo_cells: int
    box_seeds: tuple[int, ...]
    star_cells: int


# Sample for a full validation, which takes a quarter of an hour.
FULL = SampleSize(Universe(), 160, 0, 8, 20, 3, 16, (8, 9), 12)
# Small sample for a quick run (20 s), with too little sky for reliable verdicts.
QUICK = SampleSize(Universe(box_cells=192, lensing_nside=64), 4, 0, 0, 2, 0, 0, (), 0)


def theory(cosmology: Cosmology) -> dict[str, float]:
    """Compute sigma_8, the comoving distance to z = 2.3 (Mpc/h), and offsets from published K-corrections.

    For each band and galaxy template, the offset (mag) with the largest absolute value over all redshifts is returned.
    """
    k = np.geomspace(1e-4, 50.0, 20_000)
    x = 8.0 * k
    window = 3.0 * (np.sin(x) - x * np.cos(x)) / x**3
    variance = np.trapezoid(density_box.linear_power(cosmology, k) * window**2 * k**3 / (2 * np.pi**2), np.log(k))
    figures = {"sigma_8": float(np.sqrt(variance)), "chi_2.3": float(cosmology.comoving_distance(2.3))}
    wavelength, template_numbers = rest_grid.rest_grid(), list(K_CORRECTIONS["sdss_r01"])
    # Do not remove weak emission lines from the templates (as the library usually does): the published numbers include
    # them.
    flux = templates.galaxy_spectra(wavelength, bridge_width=-1.0)[template_numbers].astype(np.float32)
    library = templates.Library(wavelength, flux, tuple(map(str, template_numbers)))
    z, zeros = np.array(K_REDSHIFTS), np.zeros(len(K_REDSHIFTS), int)
    for band, published in K_CORRECTIONS.items():
        table = band_ratios.build(library, band, 2.3, 0.5)
        for row, (kind, expected) in enumerate(published.items()):
            k_correction = -2.5 / np.log(10.0) * band_ratios.ln_ratio(table, z, zeros + row, zeros, np.zeros(z.size))
            offset = k_correction - np.array(expected)
            figures[f"k_{band}_t{kind}_off"] = float(offset[np.abs(offset).argmax()])
    return figures


def matter(size: SampleSize) -> dict[str, float]:
    """Measure the matter in the universe's periodic box: power spectrum, bias of halos, and velocities.

    Power spectrum and bias are relative to theory; the rms velocity of halos of 10^12 Msun/h is in km/s. The power
    spectrum is left out without further random seeds.
    """
    cells, cosmology = size.settings.box_cells, size.settings.cosmology
    box = density_box.load(SEED, cells, cosmology)
    boxes = [box, *(shear.gaussian_box(cosmology, seed, cells) for seed in size.box_seeds)]
    figures = {}
    if size.box_seeds:
        power = np.array([clustering.box_power(box, POWER_EDGES) for box in boxes])
        figures = _figures_by_edge(
            "box_power_k{:.2f}", POWER_EDGES, power.mean(0), power.std(0, ddof=1) / np.sqrt(len(boxes))
        )
    bias = clustering.halo_bias(box, BIASES, BIAS_EDGES)[:, 0]
    figures |= {f"halo_bias_x{x}": float(value) for x, value in zip(BIASES, bias, strict=True)}
    masses = matching.masses(cosmology)
    of_12 = float(masses.interpolate_pairs(masses.bias, np.zeros(1), np.full(1, 12.0))[0])
    return figures | {"velocity_rms": clustering.velocity_rms(box, of_12)}


def _figures_by_edge(pattern: str, edges: Sequence[float] | Float, values: Float, errors: Float) -> dict[str, float]:
    names = [pattern.format(edge) for edge in edges[:-1]]
    figures = {name: float(value) for name, value in zip(names, values, strict=True)}
    return figures | {f"{name}_error": float(value) for name, value in zip(names, errors, strict=True)}


def mass_function(cosmology: Cosmology) -> Callable[[float, float], float]:
    """Return the theoretical cumulative mass function of halos as a function of (log_mass, z).

    The function returns the number density in (Mpc/h)^-3 of halos above a mass, given as log10 of Msun/h, at redshift
    z.
    """
    masses = matching.masses(cosmology)

    def number(min_log_mass: float, z: float) -> float:
        log_mass = np.linspace(min_log_mass, 16.0, 501)
        ln_density = masses.interpolate(masses.ln_density, np.array([z]), log_mass)[0]
        return float(np.trapezoid(np.exp(ln_density), log_mass))

    return number


def count_galaxies(size: SampleSize) -> tuple[dict[str, float], census.Census]:
    """Simulate galaxies in many small blocks of the sky, and measure counts, colours, sizes, lines, masses and halos.

    Returns the measured values by name, and the simulated galaxies.
    """
    universe = galaxies.model(SEED, size.settings)
    dust, law = dust_map.load(SEED), luminosity_function.schechter()
    sample = census.draw(universe, dust, census.blocks(size.blocks, size.side_order))
    figures = {"galaxies": float(sample.block.size), "galaxies_deg2": sample.area}
    figures |= census.counts(sample) | census.colours(sample) | census.sizes(sample) | census.halpha(sample)
    figures |= census.sizes_by_mass(sample, size.settings.cosmology) | census.ellipticities(sample)
    figures |= observed.figures(observed.from_columns(sample.rows, sample.area, size.settings.cosmology))
    figures |= census.halos(sample, mass_function(size.settings.cosmology)) | census.luminosities(sample, law, 0.0, 1.5)
    if size.deep_blocks:
        deep = galaxies.model(SEED, replace(size.settings, galaxy_limit=28.0))
        deep_sample = census.draw(deep, dust, census.blocks(size.deep_blocks, 0))
        figures |= census.luminosities(deep_sample, law, 1.5, 2.3)
    return figures, sample


def compare_with_limber(
    cosmology: Cosmology,
    measured: clustering.Correlation,
    tracer_shells: Shells,
    power: Callable[[Cosmology, Float], Float],
) -> tuple[Float, Float, Float, Float]:
    """Correct a measured w for the finite size of the blocks, and predict w in Limber's approximation.

    w was measured relative to the mean density of each block, which makes it too low. The difference is computed from
    the prediction and added.

    Parameters
    ----------
    cosmology : Cosmology
        Parameters of the universe.
    measured : Correlation
        Measured angular correlation function w, relative to the mean density of each block.
    tracer_shells : Shells
        Distribution of the tracers over distance, weighted with bias times growth factor.
    power : callable
        Function of (cosmology, k) that returns the matter power P(k) at z = 0 in (Mpc/h)^3 for k in h/Mpc.

    Returns
    -------
    theta, w, error, expected : float array, shape (bins,)
        Separation in deg, corrected w and its standard error, and predicted w.
    """
    expected, mean_subtracted = clustering.limber(cosmology, tracer_shells, measured, power)
    return measured.theta, measured.w + expected - mean_subtracted, measured.error, expected


def measure_clustering(size: SampleSize) -> tuple[dict[str, float], dict[str, Any], clustering.Tracers]:
    """Measure w(theta) of halos and galaxies, divided by predictions in Limber's approximation, for all random seeds.

    Returns the measured values by name, the curves (theta, w, error, prediction) by name, such as "halos_wide", and the
    halos that were simulated with the first seed.
    """
    n_blocks, seeds = 12 << 2 * clustering.BLOCK_ORDER, (SEED, *size.box_seeds)
    cells = ((np.arange(size.wide_blocks) + 0.37) * n_blocks / size.wide_blocks).astype(int).tolist()
    wide_samples, narrow_samples, curves = [], [], {}
    figures: dict[str, float] = {}
    cosmology = size.settings.cosmology
    for seed in seeds:
        # Store boxes of other seeds in a temporary folder, so that they do not fill the disc cache.
        with nullcontext() if seed == SEED else cache.use_temporary_dir():
            universe = clustering.population_above(seed, size.settings, Z_MIN, Z_MAX, MIN_LOG_MASS)
            for cell in cells:
                sample = clustering.draw_tracers(universe, clustering.BLOCK_ORDER, cell)
                samples = (
                    sample.select(~sample.satellite & (sample.log_mass > MIN_LOG_MASS)),
                    sample.select(sample.proxy > MIN_LOG_MASS),
                )
                wide_samples.append((cell, samples))
                narrow_samples.append((cell << 2 * (clustering.PIECE_ORDER - clustering.BLOCK_ORDER), samples))
    shells_by_kind = [
        clustering.shells(cosmology, clustering.concatenate([samples[i] for _, samples in wide_samples]), Z_MIN, Z_MAX)
        for i in range(2)
    ]
    for samples_by_cell, order, edges in (
        (wide_samples, clustering.BLOCK_ORDER, WIDE_EDGES),
        (narrow_samples, clustering.PIECE_ORDER, NARROW_EDGES),
    ):
        for name, tracer_shells, measured in zip(
            TRACERS, shells_by_kind, clustering.correlation(samples_by_cell, order, edges), strict=True
        ):
            theta, w, error, expected = compare_with_limber(
                cosmology, measured, tracer_shells, density_box.linear_power
            )
            curves[f"{name}_{'wide' if edges is WIDE_EDGES else 'narrow'}"] = (theta, w, error, expected)
            figures |= _figures_by_edge(f"w_{name}_{{:g}}", edges, w / expected, error / expected)
    maps = []
    for seed in seeds:
        box = shear.gaussian_box(cosmology, seed, size.settings.box_cells)
        maps += [
            (cell, (clustering.projected_field(box, clustering.BLOCK_ORDER, cell, shells_by_kind[0]),))
            for cell in cells
        ]
    (measured,) = clustering.correlation(maps, clustering.BLOCK_ORDER, WIDE_EDGES)
    _, w, error, expected = compare_with_limber(cosmology, measured, shells_by_kind[0], clustering.gaussian_power)
    figures |= _figures_by_edge("w_structure_{:g}", WIDE_EDGES, w / expected, error / expected)
    for name in TRACERS:
        for edge in WIDE_EDGES[:-1]:
            structure_ratio = figures[f"w_structure_{edge:g}"]
            figures[f"w_{name}_{edge:g}_to_structure"] = figures[f"w_{name}_{edge:g}"] / structure_ratio
    figures["clustering_deg2"] = len(wide_samples) * sky.cell_area(clustering.BLOCK_ORDER)
    return figures, curves, clustering.concatenate([samples[0] for _, samples in wide_samples[: size.wide_blocks]])


def abundances(size: SampleSize) -> dict[str, float]:
    """Measure the number of halos above several masses in thin redshift shells, divided by the mass function.

    Halos are simulated in HEALPix cells of order 5; errors are computed from the scatter between these cells.
    """
    number, cells = (
        mass_function(size.settings.cosmology),
        ((np.arange(size.halo_cells) + 0.43) * (12 << 10) / size.halo_cells).astype(int).tolist(),
    )
    figures, area = {}, sky.cell_area(5) * np.radians(1.0) ** 2
    for at, half in census.HALO_SHELLS:
        universe = clustering.population_above(SEED, size.settings, at - half, at + half, census.HALO_MASSES[0])
        samples = [clustering.draw_tracers(universe, 5, cell) for cell in cells]
        volume = float(size.settings.cosmology.comoving_volume(at - half, at + half)) * area
        for min_log_mass in census.HALO_MASSES:
            each = [
                np.sum(~sample.satellite & (sample.log_mass > min_log_mass)) / volume / number(min_log_mass, at)
                for sample in samples
            ]
            name = f"halos_{min_log_mass:g}_z{at}"
            figures[name], figures[f"{name}_error"] = (
                float(np.mean(each)),
                float(np.std(each, ddof=1) / len(each) ** 0.5),
            )
    return figures


def nearby_satellites(size: SampleSize) -> dict[str, float]:
    """Measure the fraction of satellites among galaxies with M_r - 5 log h < -20 at 0.05 < z < 0.15, as in SDSS.

    The result also has the number of these galaxies.
    """
    universe = clustering.population_above(SEED, size.settings, 0.05, 0.15, 11.8)
    cells = ((np.arange(size.nearby_blocks) + 0.4) * 192 / size.nearby_blocks).astype(int).tolist()
    sample = clustering.concatenate([clustering.draw_tracers(universe, 2, cell) for cell in cells])
    z = universe.halos.distances.redshift(sample.chi)
    bright = universe.halos.matching.magnitude(z, sample.proxy) < -20.0
    share = float(np.mean(sample.satellite[bright]))
    return {"satellites_m20_z0.1": share, "satellites_m20_z0.1_number": float(bright.sum())}


def measure_lensing(size: SampleSize, halos: clustering.Tracers) -> tuple[dict[str, float], Float]:
    """Measure lensing maps, their power spectrum for several random seeds, and the shear around massive halos.

    Returns the measured values by name, and C_l of the convergence divided by linear theory, shape (planes, bands).
    Without further random seeds, the power spectrum is not measured and this array is empty.
    """
    cells, nside, cosmology = size.settings.box_cells, size.settings.lensing_nside, size.settings.cosmology
    box = density_box.load(SEED, cells, cosmology)
    planes = lensing.load(box, nside, with_far_planes=True)
    figures: dict[str, float] = {}
    for number, z in PLANES:
        figures |= shear.map_statistics(cosmology, planes, number, f"z{z}")
    heavy = halos.select(halos.log_mass > 13.5)
    mean, error = shear.tangential_shear(planes, heavy, float(cosmology.comoving_distance(1.2)))
    for radius, value, value_error in zip(shear.RINGS, mean, error, strict=True):
        figures[f"gamma_t_{radius}deg"], figures[f"gamma_t_{radius}deg_in_errors"] = (
            float(value),
            float(value / value_error),
        )
    if not size.box_seeds:
        return figures, np.ones((0, 0))
    for z, (rms, linear) in zip(SIGHTS, shear.line_of_sight_rms(box, SIGHTS), strict=True):
        figures |= {f"kappa_sight_rms_z{z}": rms, f"kappa_sight_rms_z{z}_to_theory": rms / linear}
        figures[f"kappa_skipping_rms_z{z}"] = shear.skipping_rms(box, z, SKIPPING)
    ratios = np.stack(
        [shear.power_of_maps(cosmology, planes, [number for number, _ in PLANES], BANDS)]
        + [
            shear.power_of_box(shear.gaussian_box(cosmology, seed, cells), nside, [z for _, z in PLANES], BANDS)
            for seed in size.box_seeds
        ]
    )
    for plane, (_, z) in enumerate(PLANES):
        error = ratios[:, plane].std(0, ddof=1) / np.sqrt(len(ratios))
        figures |= _figures_by_edge(f"c_l_z{z}_{{}}", BANDS, ratios[:, plane].mean(0), error)
    return figures, ratios.mean(0)


def milky_way(size: SampleSize) -> dict[str, float]:
    """Measure relative differences of simulated star and brown dwarf counts from reference counts.

    For each Galactic latitude, the difference with the largest absolute value is returned. The result also has the
    simulated parallax errors of Gaia (mas).
    """
    universe, dust, figures = milky_way_stars.model(), dust_map.load(SEED), {}
    for b, published in star_counts.COUNTS.items():
        offset = star_counts.counts(b, size.star_cells, universe, dust) / np.array(published) - 1.0
        figures[f"stars_b{b}_off"] = float(offset[np.abs(offset).argmax()])
    for b, published_dwarfs in star_counts.DWARFS.items():
        offset = star_counts.dwarf_counts(b, 1000.0) / np.array(published_dwarfs) - 1.0
        figures[f"dwarfs_b{b}_off"] = float(offset[np.abs(offset).argmax()])
    return figures | {f"gaia_parallax_g{g:g}": float(gaia.astrometric_errors(g)[2]) for g in star_counts.PARALLAX}


def run(size: SampleSize, folder: Path | None = None) -> dict[str, float]:
    """Run all measurements of the simulated universe, and return the measured values by name.

    If `folder` is given, plots are written to it. The value "cpu_s" is the CPU time that was used, in seconds.
    """
    started = time.process_time()
    figures, sample = count_galaxies(size)
    new_figures, curves, halos = measure_clustering(size)
    figures |= theory(size.settings.cosmology) | matter(size) | new_figures
    new_figures, power = measure_lensing(size, halos)
    figures |= new_figures
    if size.nearby_blocks:
        figures |= nearby_satellites(size)
    if size.halo_cells:
        figures |= abundances(size)
        bright = small_scales.galaxy_population(SEED, size.settings)
        figures |= small_scales.figures(bright, 4 * size.halo_cells)
    if size.star_cells:
        figures |= milky_way(size)
    if folder is not None:
        pictures.draw(folder, sample, curves, power, BANDS, figures)
    return figures | {"cpu_s": time.process_time() - started}
