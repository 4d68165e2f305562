"""Is the universe what it should be: python -m benchmarks.validate_universe [--quick] [--json FILE] [--figures FOLDER].

Blocks of generation cells spread over the sky are drawn and counted: against the mass and luminosity functions,
the published counts, H alpha, and the angular correlation of Limber's approximation; the lensing maps are measured.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from scipy.special import j0

from jobs.catalogue import band_ratios, density_box, dust_map, emission_lines, galaxies, lensing, population
from jobs.fluxes import cosmology, templates
from lake_schema import sky
from lake_schema.provenance import git_commit

Float = npt.NDArray[np.float64]

SEED, BOX_CELLS, NSIDE = 7, 192, 256
ARCMIN2 = 3600.0
# Observed i-band counts, per arcmin2: GAMA, zCOSMOS, VVDS, LSST Science Book.
OBSERVED_I = {20: 0.57, 21: 1.45, 22: 3.7, 23: 9.0, 24: 21.0, 25: 44.5}
COLUMNS = (
    "id", "ra", "dec", "kind", "z_true", "z_obs", "abs_mag_r01", "color_gr_01", "sed_1", "frac_1", "sed_2", "frac_2",
    "ext_law_1", "ebv_1", "flux_halpha", "kappa", "gamma1", "gamma2", "log_halo_mass",
)  # fmt: skip


def blocks(count: int, side_order: int) -> list[list[int]]:
    """Nested blocks of generation cells, spread over the sky."""
    many, inside = 12 << 2 * (8 - side_order), 1 << 2 * side_order
    first = np.linspace(0.31 * many / count, many * (1 - 0.5 / count), count).astype(int)
    return [[int(block) * inside + i for i in range(inside)] for block in first]


def counts(rows: dict[str, Float], area: float) -> dict[str, float]:
    """Galaxies per arcmin2, n(z), satellites, H alpha, per deg2."""
    z, m = rows["z_true"].astype(float), rows["abs_mag_r01"].astype(float)
    names = ("sed_1", "frac_1", "sed_2", "frac_2", "ext_law_1", "ebv_1")
    sed, library = band_ratios.Sed(*(rows[name] for name in names)), templates.galaxy_library()

    def mag(band: str) -> Float:
        table = band_ratios.load(library, band, 2.3, 0.5)
        return m + cosmology.distance_modulus(z) + band_ratios.offset(table, z, sed)

    vis, i_band, g, r = mag("euclid_vis"), mag("lsst_i"), mag("lsst_g"), mag("lsst_r")
    bright = vis < 24.5
    figures = {
        "vis_26_arcmin2": np.sum(vis < 26) / area / ARCMIN2,
        "vis_245_arcmin2": np.sum(bright) / area / ARCMIN2,
        "median_z_245": np.median(z[bright]),
        "median_g_r_245": np.median((g - r)[bright]),
        "median_r_i_245": np.median((r - i_band)[bright]),
        "satellites_245": np.mean(rows["kind"][bright]),
        "satellites_m20_near": np.mean(rows["kind"][(m < -20) & (z < 0.2)]),
        "red_245": np.mean(rows["color_gr_01"][bright] > 0.75),
        "vis_slope_20_23": np.mean(np.diff(np.log10(np.histogram(vis, np.arange(19.5, 24.0, 1.0))[0]))),
    }
    figures |= {f"i_{limit}_arcmin2": np.sum(i_band < limit) / area / ARCMIN2 for limit in OBSERVED_I}
    figures |= {f"i_{limit}_to_observed": figures[f"i_{limit}_arcmin2"] / seen for limit, seen in OBSERVED_I.items()}
    flux = rows["flux_halpha"].astype(float)
    for near, far in ((0.9, 1.8), (0.4, 1.8), (0.7, 2.0)):
        for limit in (5e-17, 1e-16, 2e-16, 3e-16):
            expected = float(emission_lines.expected_counts(np.array([limit]), near, far)[0])
            found = np.sum((z > near) & (z < far) & (flux > limit)) / area
            figures[f"halpha_{limit:g}_{near}_{far}_to_published"] = found / expected
    velocity = 299792.458 * (rows["z_obs"] - z) / (1 + z)
    figures["velocity_rms_near_km_s"] = np.std(velocity[(rows["kind"] == 0) & (z < 0.3)])
    return {name: float(value) for name, value in figures.items()}


def luminosity_function(universe: galaxies.GalaxyModel, rows: dict[str, Float], area: float) -> dict[str, float]:
    """Found / expected galaxies where every spectrum beats the limit."""
    law, figures = universe.luminosities, {}
    z, m = rows["z_true"].astype(float), rows["abs_mag_r01"].astype(float)
    for at, half, reddest in ((0.1, 0.05, 0.2), (0.5, 0.1, 0.4), (1.0, 0.15, 1.5)):
        grid = np.linspace(at - half, at + half, 41)
        faintest = min(26.0 - float(cosmology.distance_modulus(at + half)) - reddest, -16.0)
        density = galaxies.luminosity_function.number_density(law, faintest, grid)
        shells = cosmology.comoving_volume(grid[:-1], grid[1:]) * np.radians(1.0) ** 2 * area
        expected = float(np.sum(0.5 * (density[1:] + density[:-1]) * shells))
        figures[f"luminosity_function_z{at}"] = float(np.sum((np.abs(z - at) < half) & (m < faintest)) / expected)
    return figures


def mass_function(universe: galaxies.GalaxyModel, halos: pa.Table, area: float) -> dict[str, float]:
    """Found / expected halos above a mass."""
    model, figures = universe.population.halos, {}
    z, mass = (halos[name].to_numpy() for name in ("z_true", "log_mass"))
    for near, far in ((0.3, 0.8), (0.8, 1.5), (1.5, 2.3)):
        steps = (model.line.z > near) & (model.line.z < far)
        for least in (11.0, 12.0, 13.0):
            bins = np.round(model.log_mass[:-1], 3) >= least - 1e-3
            mean = np.sum(model.number[np.ix_(steps, bins)].sum(1) * model.line.volume[steps]) * area
            found = np.sum((z > near) & (z < far) & (mass > least))
            figures[f"halos_{least:g}_z{near}"] = float(found / (mean * np.radians(1.0) ** 2))
    return figures


def correlation(universe: galaxies.GalaxyModel, groups: list[pa.Table], cells: list[list[int]]) -> dict[str, float]:
    """w(theta) of centrals with M > 10^12 at 0.4 < z < 0.8, all blocks together, beside Limber with the halos' bias."""
    edges = np.geomspace(0.03, 1.2, 9)
    pairs = np.zeros((3, edges.size - 1))
    rng = np.random.default_rng(5)
    total, area = 0, 0.0
    points = []
    for rows, block in zip(groups, cells, strict=True):
        mass, z = rows["log_mass"].to_numpy(), rows["z_true"].to_numpy()
        keep = (mass > 12.0) & (z > 0.4) & (z < 0.8)
        points.append((rows["ra"].to_numpy()[keep], rows["dec"].to_numpy()[keep], block))
        total, area = total + int(keep.sum()), area + len(block) * sky.cell_area(8)
    for ra, dec, block in points:
        spread = [sky.random_in_cell(8, cell, 2 * total // sum(len(b) for b in cells), rng)[1:] for cell in block]
        random = [np.concatenate(part) for part in zip(*spread, strict=True)]
        weight = total / area * len(block) * sky.cell_area(8) / random[0].size
        for k, (one, two) in enumerate((((ra, dec), (ra, dec)), ((ra, dec), random), (random, random))):
            pairs[k] += _pairs(one, two, edges) * weight**k
    found = (pairs[0] - 2 * pairs[1] + pairs[2]) / pairs[2]
    theta = np.sqrt(edges[1:] * edges[:-1])
    expected = _limber(universe, theta)
    figures = {}
    for at, one, other in zip(theta, found, expected, strict=True):
        figures[f"w_{at:.2f}_deg"] = float(one)
        figures[f"w_{at:.2f}_deg_to_limber"] = float(one / other)
    return figures


def _pairs(one: Any, two: Any, edges: Float) -> Float:
    number = np.zeros(edges.size - 1)
    for ra, dec in zip(*one, strict=True):
        number += np.histogram(sky.separation(ra, dec, two[0], two[1]), edges)[0]
    return number


def _limber(universe: galaxies.GalaxyModel, theta: Float) -> Float:
    model = universe.population.halos
    steps = np.flatnonzero((model.line.z > 0.4) & (model.line.z < 0.8))
    bins = np.round(model.log_mass[:-1], 3) >= 12.0 - 1e-3
    number = model.number[np.ix_(steps, bins)]
    growing = np.sum(number * model.x[np.ix_(steps, bins)], 1) / number.sum(1)
    chi = model.line.middle[steps]
    weight = number.sum(1) * chi**2
    weight /= np.trapezoid(weight, chi)
    ell = np.geomspace(2.0, 6000.0, 400)
    k = (ell[:, None] + 0.5) / chi
    power = density_box.linear_power(k.ravel()).reshape(k.shape) * (k < np.pi / 4.0)
    c_l = np.trapezoid((weight * growing / chi) ** 2 * power, chi, axis=1)
    fine = np.arange(2, 6001)
    c_fine = np.interp(np.log(fine), np.log(ell), c_l)
    return np.array([np.sum((2 * fine + 1) / (4 * np.pi) * c_fine * j0((fine + 0.5) * np.radians(t))) for t in theta])


def lensing_figures(universe: galaxies.GalaxyModel) -> dict[str, float]:
    """rms of the maps."""
    figures = {}
    for number, name in ((7, "z1"), (12, "z24")):
        fields = universe.planes.maps[number]
        figures[f"kappa_rms_{name}"] = float(fields[:, lensing.KAPPA].std(dtype=float))
        figures[f"kappa_mean_{name}"] = float(fields[:, lensing.KAPPA].mean(dtype=float))
        figures[f"gamma_rms_{name}"] = float(fields[:, lensing.GAMMA_1].std(dtype=float))
        bend = np.hypot(fields[:, lensing.EAST], fields[:, lensing.NORTH]).astype(float)
        figures[f"deflection_rms_arcmin_{name}"] = float(60 * np.degrees(np.sqrt(np.mean(bend**2))))
        figures[f"deflection_max_arcmin_{name}"] = float(60 * np.degrees(bend.max()))
    return figures


def run(count: int, order: int) -> tuple[dict[str, Any], dict[str, Float]]:
    """All figures, and the galaxies that they were counted from."""
    universe, dust = galaxies.model(SEED, 26.0, 2.3, BOX_CELLS, NSIDE), dust_map.load(SEED)
    drawn, started = population.Cells(universe.population), time.process_time()
    places, tables, groups = blocks(count, order), [], []
    for block in places:
        tables += [galaxies.draw(cell, universe, drawn, dust).select(COLUMNS) for cell in block]
        groups.append(pa.concat_tables([galaxies.halo_table(cell, universe.population, drawn) for cell in block]))
    seconds = time.process_time() - started
    rows = pa.concat_tables(tables)
    rows = rows.filter(pa.array(rows["kind"].to_numpy() < 2))
    columns = {name: rows[name].to_numpy() for name in COLUMNS}
    area = sum(len(block) for block in places) * sky.cell_area(8)
    halos = pa.concat_tables(groups)
    figures: dict[str, Any] = {"area_deg2": area, "galaxies": rows.num_rows, "halos": halos.num_rows, "cpu_s": seconds}
    figures |= counts(columns, area) | luminosity_function(universe, columns, area)
    figures |= mass_function(universe, halos, area) | correlation(universe, groups, places)
    return figures | lensing_figures(universe), columns


def draw_figures(folder: Path, columns: dict[str, Float]) -> None:
    """A slice of the light-cone and n(z)."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    folder.mkdir(parents=True, exist_ok=True)
    figure, axes = pyplot.subplots(2, 1, figsize=(11, 7))
    first = np.abs(columns["ra"] - np.median(columns["ra"][:1000])) < 5
    for kind, colour in ((0, "0.2"), (1, "tab:red")):
        part = first & (columns["kind"] == kind) & (columns["z_true"] < 0.8)
        axes[0].plot(columns["z_obs"][part], columns["ra"][part], ",", color=colour)
    axes[0].set(xlabel="z_obs", ylabel="ra [deg]")
    axes[1].hist(columns["z_true"], np.arange(0, 2.35, 0.02), histtype="step")
    axes[1].set(xlabel="z_true", ylabel="galaxies")
    figure.savefig(folder / "universe.png", dpi=110)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="benchmarks.validate_universe", description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="two small blocks, for tests")
    parser.add_argument("--blocks", type=int, default=24, help="blocks of 16 generation cells (0.84 deg2 each)")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--figures", type=Path, metavar="FOLDER")
    options = parser.parse_args(argv)
    figures, columns = run(2, 1) if options.quick else run(options.blocks, 2)
    for name, value in figures.items():
        print(f"{name:42} {value:,.4g}")
    if options.figures:
        draw_figures(options.figures, columns)
    if options.json:
        about = {"name": "validate_universe", "commit": git_commit(), "machine": platform.machine(), "repeats": 1}
        options.json.write_text(json.dumps({**about, **figures}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
