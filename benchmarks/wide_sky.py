"""The universe over hundreds of square degrees, to a bright limit: what a few cells hide in their own structure.

halos and volume-limited galaxies of blocks of order-4 cells -> mass function, luminosity function, w(theta)
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
from truesky.fluxes import cosmology
from truesky.request.schema import Universe

BLOCK_ORDER, PIXEL_ORDER = 4, 9
LIMIT = 22.0
NEAR, FAR = 0.4, 0.8
LEAST_MASS = 12.0
EDGES = np.array([0.12, 0.2, 0.3, 0.42, 0.6, 0.8, 1.1, 1.5])
_L_MOST = 8000


@dataclass(frozen=True, slots=True, eq=False)
class Sky:
    """What was drawn: one entry a halo, one a galaxy.

    halos : z, log_mass, order-29 index;  galaxies : z, M_r, log_mass of the host, order-29 index
    """

    blocks: list[int]
    halos: tuple[Float, Float, Int]
    galaxies: tuple[Float, Float, Float, Int]

    @property
    def area(self) -> float:
        return len(self.blocks) * sky.cell_area(BLOCK_ORDER)


def draw(universe: Population, count: int) -> Sky:
    """`count` blocks spread over the sky."""
    many = 12 << 2 * BLOCK_ORDER
    blocks = np.linspace(0.04 * many, 0.97 * many, count).astype(int).tolist()
    found: list[list[npt.NDArray[np.generic]]] = [[] for _ in range(7)]
    shift = 2 * (8 - BLOCK_ORDER)
    for block in blocks:
        drawn = population.Cells(universe)
        for cell in range(block << shift, (block + 1) << shift):
            one = population.members(drawn, cell)
            bright = universe.halos.matching.magnitude(one.z, one.proxy)
            kept = (one.z > NEAR) & (one.z < FAR) | (bright < -20.0) | (one.z < 0.2)
            hosts = universe.halos.distances.redshift(one.halos.chi), one.halos.log_mass, one.halos.index
            members = one.z[kept], bright[kept], one.host_mass[kept], one.index[kept]
            for column, values in zip(found, (*hosts, *members), strict=True):
                column.append(values)
    together = [np.concatenate(column) for column in found]
    return Sky(blocks, tuple(together[:3]), tuple(together[3:]))  # type: ignore[arg-type]


def mass_function(universe: Population, seen: Sky) -> dict[str, float]:
    """Found / expected halos above a mass that is complete."""
    model, figures = universe.halos, {}
    z, mass, _ = seen.halos
    for near, far, least in ((0.2, 0.5, 12.0), (0.5, 0.8, 12.0), (0.5, 0.8, 13.0), (0.8, 1.2, 13.0), (0.8, 1.2, 13.5)):
        steps, bins = _cut(model, near, far, least)
        mean = np.sum(model.number[np.ix_(steps, bins)].sum(1) * model.line.volume[steps])
        found = np.sum((z > near) & (z < far) & (mass > least))
        figures[f"halos_{least:g}_z{near}"] = float(found / (mean * seen.area * np.radians(1.0) ** 2))
    return figures


def luminosities(universe: Population, seen: Sky) -> dict[str, float]:
    """Found / expected galaxies brighter than what the limit reaches in any colour."""
    law, figures = luminosity_function.schechter(), {}
    z, m, _, _ = seen.galaxies
    for at, half in ((0.1, 0.07), (0.5, 0.1), (0.8, 0.15), (1.0, 0.2)):
        faintest = _faintest(universe, at - half, at + half)
        grid = np.linspace(at - half, at + half, 81)
        density = luminosity_function.number_density(law, faintest, grid)
        shells = cosmology.comoving_volume(grid[:-1], grid[1:]) * np.radians(1.0) ** 2 * seen.area
        expected = float(np.sum(0.5 * (density[1:] + density[:-1]) * shells))
        figures[f"luminosity_function_z{at}"] = float(np.sum((np.abs(z - at) < half) & (m < faintest)) / expected)
        figures[f"luminosity_function_z{at}_faintest"] = faintest
    return figures


def correlation(universe: Population, seen: Sky) -> dict[str, float]:
    """w(theta) of halos and of galaxies at 0.4 < z < 0.8 / Limber's, with the halos' linear bias.

    Densities are measured against the mean of the model, not of the blocks: there is no integral constraint.
    """
    model, figures = universe.halos, {}
    z, mass, index = seen.halos
    kept = (z > NEAR) & (z < FAR) & (mass > LEAST_MASS)
    steps, bins = _cut(model, NEAR, FAR, LEAST_MASS)
    number = model.number[np.ix_(steps, bins)]
    growing = np.sum(number * model.x[np.ix_(steps, bins)], 1) / number.sum(1)
    mean = float(np.sum(number.sum(1) * model.line.volume[steps])) * np.radians(1.0) ** 2 * seen.area
    figures |= _compared("halos", seen, index[kept], mean, model.line.middle[steps], number.sum(1), growing)

    faintest = _faintest(universe, NEAR, FAR)
    z, m, host, index = seen.galaxies
    kept = (z > NEAR) & (z < FAR) & (m < faintest)
    law = luminosity_function.schechter()
    density = luminosity_function.number_density(law, np.full(steps.size, faintest), model.line.z[steps])
    mean = float(np.sum(density * model.line.volume[steps])) * np.radians(1.0) ** 2 * seen.area
    column = np.clip(np.searchsorted(model.log_mass, host[kept]) - 1, 0, model.x.shape[1] - 1)
    step = np.clip(np.searchsorted(model.line.z, z[kept]), 0, model.line.z.size - 1)
    # Smooth in z: a line through the mean bias of the galaxies.
    slope, level = np.polyfit(z[kept], model.x[step, column], 1)
    growing = level + slope * model.line.z[steps]
    return figures | _compared("galaxies", seen, index[kept], mean, model.line.middle[steps], density, growing)


def _compared(
    name: str, seen: Sky, index: Int, mean: float, chi: Float, density: Float, growing: Float
) -> dict[str, float]:
    found, error = _angular(seen.blocks, index, mean)
    expected = _limber(chi, density, growing)
    figures = {f"w_{name}_number": float(index.size), f"w_{name}_bias_growth": float(np.mean(growing))}
    for low, high, one, sigma, other in zip(EDGES[:-1], EDGES[1:], found, error, expected, strict=True):
        figures[f"w_{name}_{low:.2f}_{high:.2f}_deg"] = float(one)
        figures[f"w_{name}_{low:.2f}_{high:.2f}_deg_to_limber"] = float(one / other)
        figures[f"w_{name}_{low:.2f}_{high:.2f}_deg_error"] = float(sigma / other)
    return figures


def _angular(blocks: Sequence[int], index: Int, mean: float) -> tuple[Float, Float]:
    """w in bins of EDGES from pairs of pixels, and its error from the scatter of the blocks."""
    pixels = 4 ** (PIXEL_ORDER - BLOCK_ORDER)
    pixel = index >> 2 * (sky.DEEPEST - PIXEL_ORDER)
    each = np.empty((2, len(blocks), EDGES.size - 1))
    for number, block in enumerate(blocks):
        own = np.arange(pixels) + block * pixels
        count = np.bincount(pixel[pixel // pixels == block] - own[0], minlength=pixels)
        delta = count / (mean / (len(blocks) * pixels)) - 1.0
        middle = own.astype(np.int64) << 2 * (sky.DEEPEST - PIXEL_ORDER) | 1 << 2 * (sky.DEEPEST - PIXEL_ORDER) - 1
        ra, dec = sky.positions(middle)
        place = np.digitize(sky.separation(ra[:, None], dec[:, None], ra, dec), EDGES).ravel()
        each[0, number] = np.bincount(place, np.outer(delta, delta).ravel(), EDGES.size + 1)[1:-1]
        each[1, number] = np.bincount(place, minlength=EDGES.size + 1)[1:-1]
    return each[0].sum(0) / each[1].sum(0), np.std(each[0] / each[1], axis=0) / np.sqrt(len(blocks))


def _limber(chi: Float, density: Float, growing: Float) -> Float:
    """w of the pixels' counts, the mean over each bin.  density : [s] comoving;  growing : [s] bias times growth"""
    weight = density * chi**2
    weight = weight / np.trapezoid(weight, chi)
    ell = np.geomspace(1.0, _L_MOST, 500)
    k = (ell[:, None] + 0.5) / chi
    power = density_box.linear_power(k.ravel()).reshape(k.shape)
    c_l = np.trapezoid((weight * growing / chi) ** 2 * power, chi, axis=1)
    fine = np.arange(1, _L_MOST + 1)
    side = np.radians(np.sqrt(sky.cell_area(PIXEL_ORDER)))
    c_fine = np.interp(np.log(fine), np.log(ell), c_l) * np.exp(-fine * (fine + 1.0) * side**2 / 12.0)
    means = []
    for low, high in pairwise(EDGES):
        theta = np.linspace(low, high, 9)
        w = [np.sum((2 * fine + 1) / (4 * np.pi) * c_fine * j0((fine + 0.5) * np.radians(t))) for t in theta]
        means.append(np.average(w, weights=theta))
    return np.array(means)


def _cut(model: halos.HaloModel, near: float, far: float, least: float) -> tuple[Int, Bool]:
    steps = np.flatnonzero((model.line.z > near) & (model.line.z < far))
    return steps, np.round(model.log_mass[:-1], 3) >= least - 1e-3


def _faintest(universe: Population, near: float, far: float) -> float:
    """M_r to which galaxies between two redshifts are complete: above the mass limit's magnitude, all are drawn."""
    model = universe.halos
    steps = (model.line.z > near) & (model.line.z < far)
    limits = model.matching.magnitude(model.line.z[steps], model.limit[steps])
    return float(np.floor(10.0 * (limits.min() - 0.02)) / 10.0)


def drawn_from(seed: int, box_cells: int) -> Population:
    """The population that is drawn."""
    return galaxies.halos_and_galaxies(seed, Universe(galaxy_limit=LIMIT, box_cells=box_cells))
