"""Compare halos and galaxies drawn over hundreds of square degrees, to a bright limit, with the model behind them.

The mass function of halos, the luminosity function of galaxies, and the angular correlation w(theta) of halos and of
volume-limited galaxies are measured. The area consists of HEALPix cells of order 4 (blocks) spread over the sky; in
smaller areas the large-scale structure dominates the statistics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.special import j0

from lake_schema import sky
from lake_schema.arrays import Bool, Float, Int
from truesky.catalogue.galaxies import galaxies
from truesky.catalogue.halos import halos, luminosity_function, population
from truesky.catalogue.halos.population import Population
from truesky.catalogue.matter import density_box
from truesky.cosmology import FIDUCIAL
from truesky.request.schema import Universe

BLOCK_ORDER, PIXEL_ORDER = 4, 9
LIMIT = 22.0
MIN_REDSHIFT, MAX_REDSHIFT = 0.4, 0.8
MIN_LOG_MASS = 12.0
EDGES = np.array([0.12, 0.2, 0.3, 0.42, 0.6, 0.8, 1.1, 1.5])
_MAX_MULTIPOLE = 8000


@dataclass(frozen=True, slots=True, eq=False)
class SkySample:
    """Halos and galaxies drawn in several blocks (HEALPix cells of order 4) of the sky.

    Attributes
    ----------
    blocks : list of int
        Nested indices of the blocks.
    halos : tuple of array, shape (n,)
        Redshift, log10 mass (Msun/h) and order-29 nested HEALPix index of each halo.
    galaxies : tuple of array, shape (m,)
        Redshift, absolute magnitude M_r, log10 mass (Msun/h) of the host halo, and order-29 nested HEALPix index of
        each galaxy.
    """

    blocks: list[int]
    halos: tuple[Float, Float, Int]
    galaxies: tuple[Float, Float, Float, Int]

    @property
    def area(self) -> float:
        """Total area of the blocks in deg2."""
        return len(self.blocks) * sky.cell_area(BLOCK_ORDER)


def draw_sky(universe: Population, count: int) -> SkySample:
    """Draw the halos and galaxies of `count` blocks (HEALPix cells of order 4), which are spread over the sky.

    Galaxies are kept if 0.4 < z < 0.8, z < 0.2, or M_r < -20.
    """
    num_blocks = 12 << 2 * BLOCK_ORDER
    blocks = np.linspace(0.04 * num_blocks, 0.97 * num_blocks, count).astype(int).tolist()
    columns: list[list[npt.NDArray[np.generic]]] = [[] for _ in range(7)]
    shift = 2 * (8 - BLOCK_ORDER)
    for block in blocks:
        drawn = population.CellCache(universe)
        for cell in range(block << shift, (block + 1) << shift):
            cell_members = population.members(drawn, cell)
            bright = universe.halos.matching.magnitude(cell_members.z, cell_members.proxy)
            selected = (
                (cell_members.z > MIN_REDSHIFT) & (cell_members.z < MAX_REDSHIFT)
                | (bright < -20.0)
                | (cell_members.z < 0.2)
            )
            hosts = (
                universe.halos.distances.redshift(cell_members.halos.chi),
                cell_members.halos.log_mass,
                cell_members.halos.index,
            )
            members = (
                cell_members.z[selected],
                bright[selected],
                cell_members.host_mass[selected],
                cell_members.index[selected],
            )
            for column, values in zip(columns, (*hosts, *members), strict=True):
                column.append(values)
    arrays = [np.concatenate(column) for column in columns]
    return SkySample(blocks, tuple(arrays[:3]), tuple(arrays[3:]))  # type: ignore[arg-type]


def mass_function(universe: Population, sky_sample: SkySample) -> dict[str, float]:
    """Return the ratio of the number of drawn halos to the number that the model predicts.

    There is one ratio per range of redshift and lowest log10 mass; the sample is complete above these masses. The names
    are `halos_<log mass>_z<lowest redshift>`.
    """
    model, figures = universe.halos, {}
    z, mass, _ = sky_sample.halos
    for z_min, z_max, min_log_mass in (
        (0.2, 0.5, 12.0),
        (0.5, 0.8, 12.0),
        (0.5, 0.8, 13.0),
        (0.8, 1.2, 13.0),
        (0.8, 1.2, 13.5),
    ):
        steps, bins = _select_bins(model, z_min, z_max, min_log_mass)
        mean = np.sum(model.number[np.ix_(steps, bins)].sum(1) * model.steps.volume[steps])
        num_halos = np.sum((z > z_min) & (z < z_max) & (mass > min_log_mass))
        figures[f"halos_{min_log_mass:g}_z{z_min}"] = float(num_halos / (mean * sky_sample.area * np.radians(1.0) ** 2))
    return figures


def luminosity_ratios(universe: Population, sky_sample: SkySample) -> dict[str, float]:
    """Return the ratio of the number of drawn galaxies to the integral of the luminosity function, at four redshifts.

    Galaxies are counted to the faintest M_r at which the sample is complete; this magnitude is returned, too.
    """
    law, figures = luminosity_function.schechter(), {}
    z, m, _, _ = sky_sample.galaxies
    for z_centre, half_width in ((0.1, 0.07), (0.5, 0.1), (0.8, 0.15), (1.0, 0.2)):
        faintest = _faintest_magnitude(universe, z_centre - half_width, z_centre + half_width)
        grid = np.linspace(z_centre - half_width, z_centre + half_width, 81)
        density = luminosity_function.number_density(law, faintest, grid)
        shells = FIDUCIAL.comoving_volume(grid[:-1], grid[1:]) * np.radians(1.0) ** 2 * sky_sample.area
        expected = float(np.sum(0.5 * (density[1:] + density[:-1]) * shells))
        figures[f"luminosity_function_z{z_centre}"] = float(
            np.sum((np.abs(z - z_centre) < half_width) & (m < faintest)) / expected
        )
        figures[f"luminosity_function_z{z_centre}_faintest"] = faintest
    return figures


def correlation(universe: Population, sky_sample: SkySample) -> dict[str, float]:
    """Compare w(theta) of halos and of galaxies at 0.4 < z < 0.8 with the theory.

    The theory is Limber's equation with linear power and the linear bias of halos. For each bin of angle the result
    contains w, its ratio to the theory, and the error of this ratio. Overdensities are relative to the mean density of
    the model and not of the observed area, so no correction by an integral constraint is necessary.
    """
    model, figures = universe.halos, {}
    z, mass, index = sky_sample.halos
    selected = (z > MIN_REDSHIFT) & (z < MAX_REDSHIFT) & (mass > MIN_LOG_MASS)
    steps, bins = _select_bins(model, MIN_REDSHIFT, MAX_REDSHIFT, MIN_LOG_MASS)
    number = model.number[np.ix_(steps, bins)]
    bias_growth = np.sum(number * model.x[np.ix_(steps, bins)], 1) / number.sum(1)
    mean = float(np.sum(number.sum(1) * model.steps.volume[steps])) * np.radians(1.0) ** 2 * sky_sample.area
    figures |= _compare_to_limber(
        "halos", sky_sample, index[selected], mean, model.steps.middle[steps], number.sum(1), bias_growth
    )

    faintest = _faintest_magnitude(universe, MIN_REDSHIFT, MAX_REDSHIFT)
    z, m, host, index = sky_sample.galaxies
    selected = (z > MIN_REDSHIFT) & (z < MAX_REDSHIFT) & (m < faintest)
    law = luminosity_function.schechter()
    density = luminosity_function.number_density(law, np.full(steps.size, faintest), model.steps.z[steps])
    mean = float(np.sum(density * model.steps.volume[steps])) * np.radians(1.0) ** 2 * sky_sample.area
    column = np.clip(np.searchsorted(model.log_mass, host[selected]) - 1, 0, model.x.shape[1] - 1)
    step = np.clip(np.searchsorted(model.steps.z, z[selected]), 0, model.steps.z.size - 1)
    # Fit the bias of the galaxies' halos as a linear function of z, because the mean bias varies smoothly with z.
    slope, level = np.polyfit(z[selected], model.x[step, column], 1)
    bias_growth = level + slope * model.steps.z[steps]
    return figures | _compare_to_limber(
        "galaxies", sky_sample, index[selected], mean, model.steps.middle[steps], density, bias_growth
    )


def _compare_to_limber(
    name: str, sky_sample: SkySample, index: Int, mean: float, chi: Float, density: Float, bias_growth: Float
) -> dict[str, float]:
    measured, error = _angular_correlation(sky_sample.blocks, index, mean)
    expected = _limber_correlation(chi, density, bias_growth)
    figures = {f"w_{name}_number": float(index.size), f"w_{name}_bias_growth": float(np.mean(bias_growth))}
    for low, high, value, sigma, limber_value in zip(EDGES[:-1], EDGES[1:], measured, error, expected, strict=True):
        figures[f"w_{name}_{low:.2f}_{high:.2f}_deg"] = float(value)
        figures[f"w_{name}_{low:.2f}_{high:.2f}_deg_to_limber"] = float(value / limber_value)
        figures[f"w_{name}_{low:.2f}_{high:.2f}_deg_error"] = float(sigma / limber_value)
    return figures


def _angular_correlation(blocks: Sequence[int], index: Int, mean: float) -> tuple[Float, Float]:
    """Measure w(theta) in the bins of EDGES (deg) and its standard error, from counts in HEALPix pixels of order 9.

    `index` contains the order-29 nested index of each object, and `mean` the number of objects that the model predicts
    in all blocks together. The error follows from the scatter between the blocks.
    """
    pixels = 4 ** (PIXEL_ORDER - BLOCK_ORDER)
    pixel = index >> 2 * (sky.MAX_ORDER - PIXEL_ORDER)
    each = np.empty((2, len(blocks), EDGES.size - 1))
    for number, block in enumerate(blocks):
        block_pixels = np.arange(pixels) + block * pixels
        count = np.bincount(pixel[pixel // pixels == block] - block_pixels[0], minlength=pixels)
        delta = count / (mean / (len(blocks) * pixels)) - 1.0
        middle = (
            block_pixels.astype(np.int64) << 2 * (sky.MAX_ORDER - PIXEL_ORDER)
            | 1 << 2 * (sky.MAX_ORDER - PIXEL_ORDER) - 1
        )
        ra, dec = sky.positions_of_indices(middle)
        place = np.digitize(sky.separation(ra[:, None], dec[:, None], ra, dec), EDGES).ravel()
        each[0, number] = np.bincount(place, np.outer(delta, delta).ravel(), EDGES.size + 1)[1:-1]
        each[1, number] = np.bincount(place, minlength=EDGES.size + 1)[1:-1]
    return each[0].sum(0) / each[1].sum(0), np.std(each[0] / each[1], axis=0) / np.sqrt(len(blocks))


def _limber_correlation(chi: Float, density: Float, bias_growth: Float) -> Float:
    """Return w(theta) of counts in HEALPix pixels of order 9 from Limber's equation, averaged over each bin of EDGES.

    `chi` contains comoving distances, `density` the comoving number density, and `bias_growth` the linear bias times
    the growth factor at these distances.
    """
    weight = density * chi**2
    weight = weight / np.trapezoid(weight, chi)
    ell = np.geomspace(1.0, _MAX_MULTIPOLE, 500)
    k = (ell[:, None] + 0.5) / chi
    power = density_box.linear_power(FIDUCIAL, k.ravel()).reshape(k.shape)
    c_l = np.trapezoid((weight * bias_growth / chi) ** 2 * power, chi, axis=1)
    fine = np.arange(1, _MAX_MULTIPOLE + 1)
    side = np.radians(np.sqrt(sky.cell_area(PIXEL_ORDER)))
    c_fine = np.interp(np.log(fine), np.log(ell), c_l) * np.exp(-fine * (fine + 1.0) * side**2 / 12.0)
    means = []
    for low, high in pairwise(EDGES):
        theta = np.linspace(low, high, 9)
        w = [np.sum((2 * fine + 1) / (4 * np.pi) * c_fine * j0((fine + 0.5) * np.radians(t))) for t in theta]
        means.append(np.average(w, weights=theta))
    return np.array(means)


def _select_bins(model: halos.HaloModel, z_min: float, z_max: float, min_log_mass: float) -> tuple[Int, Bool]:
    steps = np.flatnonzero((model.steps.z > z_min) & (model.steps.z < z_max))
    return steps, np.round(model.log_mass[:-1], 3) >= min_log_mass - 1e-3


def _faintest_magnitude(universe: Population, z_min: float, z_max: float) -> float:
    """Return the absolute magnitude M_r to which galaxies between two redshifts are complete.

    It follows from the lowest halo mass that is drawn, and is rounded to 0.1 mag towards bright magnitudes.
    """
    model = universe.halos
    steps = (model.steps.z > z_min) & (model.steps.z < z_max)
    limits = model.matching.magnitude(model.steps.z[steps], model.limit[steps])
    return float(np.floor(10.0 * (limits.min() - 0.02)) / 10.0)


def drawn_from(seed: int, box_cells: int) -> Population:
    """Return the model from which halos and galaxies are drawn, to magnitude 22.

    `seed` is the seed of the simulated universe, and `box_cells` the number of grid cells along a side of the box with
    the density field.
    """
    return galaxies.halos_and_galaxies(seed, Universe(galaxy_limit=LIMIT, box_cells=box_cells))
