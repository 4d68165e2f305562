"""Measure speed and accuracy of the star catalogue: python -m benchmarks.stars [--quick] [--json FILE].

The report has these lines:

stars_per_s_core   stars per CPU second of one core, until the table of stars is published in the lake (folder)
with_fluxes_...    stars per CPU second of one core, until stars and their fluxes in ten passbands are published
cell_peak_gb       peak memory of a process that draws the most crowded HEALPix cell outside the plane and the bulge
counts_*           largest relative difference of drawn star counts from counts that independent code expects from the
                   same density laws
against_*          ratio of drawn star counts to published counts of the real sky in the same passband
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lake_schema.arrays import Float32

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks import report
from lake_schema import sky, units
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import layout, publish, read
from truesky.catalogue import build_stars, dust_map
from truesky.catalogue.stars import gaia, stars
from truesky.fluxes import band_fluxes, compute_fluxes, passbands
from truesky.fluxes.libraries import templates
from truesky.fluxes.libraries.vega import vega_magnitude
from truesky.request.from_toml import from_table
from truesky.validation.model import star_counts

BANDS = [f"euclid_{b}" for b in ("vis", "y", "j", "h")] + [f"lsst_{b}" for b in "ugrizy"]
# Published number of stars with H < 26 at |b| > 20 deg from the same density laws as in truesky.
SKY_20 = 2.65e9


def pole_counts(v: float) -> float:
    """Return the published number of stars per deg2 at the Galactic pole that are brighter than magnitude `v` in V.

    Notes
    -----
    The error is 15 % according to the authors. At V = 11 the formula gives only half of the real number.

    References
    ----------
    Bahcall & Soneira 1980, eq. B1
    """
    disc = 925.0 * 10.0 ** (0.035 * (v - 15.75)) / (1.0 + 10.0 ** (-0.132 * (v - 15.75))) ** 3
    spheroid = 1050.0 * 10.0 ** (0.087 * (v - 17.5)) / (1.0 + 10.0 ** (-0.18 * (v - 17.5))) ** 2.5
    return float(disc + spheroid)


def count_far_from_plane(step: int) -> float:
    """Return the number of stars with H < 26 at |b| > 20 deg that the density laws of truesky predict.

    Only every `step`-th HEALPix cell of order 8 is computed, and the sum is multiplied by `step`.
    """
    cells = np.arange(0, 12 << 2 * GENERATION_ORDER, step)
    _, b = sky.galactic(*sky.cell_centres(GENERATION_ORDER, cells))
    universe = stars.model()
    # The published number counts a binary as one star, so companions are switched off.
    single_stars = replace(universe.galaxy, companions=0.0 * universe.galaxy.companions)
    return float(stars.expected_counts(cells[np.abs(b) > 20.0], replace(universe, galaxy=single_stars)).sum() * step)


def brighter_than_11(step: int, dust: Float32) -> float:
    """Return the number of stars with V < 11 on the whole sky that the density laws of truesky predict, with dust.

    `dust` is the map of Galactic dust from `dust_map.load`. Only every `step`-th HEALPix cell of order 4 is computed.
    """
    return star_counts.count_whole_sky(stars.model(), 11.0, dust, step)


def pole_figures(cells: int, dust: Float32) -> dict[str, float]:
    """Count simulated stars at both Galactic poles with V < 20 and with G < 20, and compare with published counts.

    `cells` is the number of positions near the poles whose HEALPix cells are drawn, and `dust` the map of Galactic
    dust. The result contains the stars per deg2 and their ratios to the published counts.
    """
    universe, library = stars.model(24.0), templates.stellar_library()
    zero_points = {"bessell_v": vega_magnitude(passbands.load("bessell_v")), "gaia_g": gaia.ab_minus_vega()[0]}
    drawn = star_counts.cells_at_latitude(90.0, cells, south=True)
    magnitudes = {band: [] for band in zero_points}
    for cell in drawn:
        rows = stars.draw(cell, star_counts.SEED, universe, dust)
        fluxes = band_fluxes.star_fluxes(rows, list(zero_points), library)
        for band, offset in zero_points.items():
            magnitudes[band].append(units.mag_of_f_nu(fluxes[f"f_nu_{band}"].to_numpy().astype(float)) - offset)
    v, g = (np.concatenate(magnitudes[band]) for band in zero_points)
    area = len(drawn) * star_counts.AREA
    # Convert the published counts from V to G: multiply the count in each bin of V by the fraction of simulated stars
    # in this bin that is brighter than G = 20.
    edges = np.arange(8.0, 24.1, 0.5)
    bright_counts, _ = np.histogram(v[g < 20.0], edges)
    all_counts, _ = np.histogram(v, edges)
    published = np.diff([pole_counts(edge) for edge in edges]) @ (bright_counts / np.maximum(all_counts, 1))
    return {
        "pole_v20_per_deg2": np.sum(v < 20.0) / area,
        "against_pole_v20": np.sum(v < 20.0) / area / pole_counts(20.0),
        "pole_g20_per_deg2": np.sum(g < 20.0) / area,
        "against_pole_g20": np.sum(g < 20.0) / area / float(published),
    }


def speed(radius: float) -> dict[str, float]:
    """Measure the speed of drawing stars and of computing their fluxes, in this process without Spark.

    The stars lie in a circle of this radius (deg) at Galactic latitude 30 deg. The result contains the number of rows,
    stars per CPU second without and with fluxes, and the size of a row in bytes.
    """
    ra, dec = (float(x) for x in sky.equatorial(90.0, 30.0))
    table = {"name": "benchmark", "seed": star_counts.SEED, "area": {"cone": {"ra": ra, "dec": dec, "radius": radius}}}
    request = from_table({**table, "fluxes": {"bands": BANDS}})
    # Make the libraries of spectra, the tables of fluxes and compiled code before the clock starts, because they are
    # made only once per machine.
    curves = [passbands.load(band) for band in BANDS]
    libraries = templates.galaxy_library(), templates.stellar_library()
    band_fluxes.prepare(curves, [None] * len(curves), *libraries, request.accuracy)
    dust_map.load(star_counts.SEED)
    with tempfile.TemporaryDirectory() as folder:
        lake = layout.resolve_lake(folder)
        started = time.process_time()
        (step,) = build_stars.steps(lake, request)
        publish.make_version(lake, step.plan, step.run_task)
        drawn = time.process_time()
        step = compute_fluxes.flux_step("star", lake, request)
        publish.make_version(lake, step.plan, step.run_task)
        ended = time.process_time()
        version = read.version(lake, "stars")
        size = sum(path.stat().st_size for path in version.folder.rglob("Npix=*"))
    rows = version.num_rows
    return {
        "rows": rows,
        "stars_per_s_core": rows / (drawn - started),
        "with_fluxes_per_s_core": rows / (ended - started),
        "bytes_per_row": size / rows,
    }


_CROWDED = """
import resource, sys
from pathlib import Path
from benchmarks.stars import draw_crowded_cell
rows = draw_crowded_cell(float(sys.argv[1]))
print(rows, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6)
"""


def draw_crowded_cell(limit: float) -> int:
    """Draw and publish the stars of the most crowded HEALPix cell, and return their number.

    `limit` is the faintest magnitude. Cells in the Galactic plane and in the bulge are not considered, because truesky
    uses brighter limits there.
    """
    cells = np.arange(12 << 2 * GENERATION_ORDER)
    lon, lat = sky.galactic(*sky.cell_centres(GENERATION_ORDER, cells))
    before_bulge = np.abs((lon + 180.0) % 360.0 - 180.0) < stars.BULGE[0]
    min_latitude = np.where(before_bulge, stars.BULGE[1], stars.PLANE)
    edge_cells = cells[(np.abs(lat) >= min_latitude) & (np.abs(lat) < min_latitude + 0.3)]
    (ra,), (dec,) = sky.cell_centres(
        GENERATION_ORDER, edge_cells[[stars.expected_counts(edge_cells, stars.model()).argmax()]]
    )
    area = {"cone": {"ra": float(ra), "dec": float(dec), "radius": 0.0}}
    request = from_table({"name": "x", "seed": star_counts.SEED, "area": area, "universe": {"star_limit": limit}})
    with tempfile.TemporaryDirectory() as folder:
        lake = layout.resolve_lake(folder)
        (step,) = build_stars.steps(lake, request)
        publish.make_version(lake, step.plan, step.run_task)
        return read.version(lake, "stars").num_rows


def crowded_cell_memory(limit: float) -> tuple[float, float]:
    """Return the number of stars and the peak memory (GB) of `draw_crowded_cell` in a new process."""
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run(
        [sys.executable, "-c", _CROWDED, str(limit)], capture_output=True, text=True, check=True, cwd=root
    )
    rows, gigabytes = map(float, done.stdout.split())
    return rows, gigabytes


def run(quick: bool) -> dict[str, float]:
    """Measure speed and accuracy of the star catalogue, and return all results by name; `quick` draws few stars."""
    dust = dust_map.load(star_counts.SEED)
    figures = speed(0.1 if quick else 1.0)
    figures["cell_rows"], figures["cell_peak_gb"] = crowded_cell_memory(16.0 if quick else 26.0)
    cells, universe = (4, stars.model(22.0)) if quick else (24, stars.model())
    for b in (60,) if quick else star_counts.COUNTS:
        ratios = star_counts.counts(b, cells, universe, dust) / np.array(star_counts.COUNTS[b])
        compared = ratios[:-1] if quick else ratios
        figures[f"counts_b{b}_off"] = float(compared[np.abs(compared - 1.0).argmax()] - 1.0)
    for b in (60,) if quick else star_counts.DWARFS:
        ratios = star_counts.dwarf_counts(b, 100.0 if quick else 1000.0) / np.array(star_counts.DWARFS[b])
        figures[f"lt_b{b}_off"] = float(ratios[np.abs(ratios - 1.0).argmax()] - 1.0)
    figures["sky_b20_off"] = count_far_from_plane(4096 if quick else 64) / SKY_20 - 1.0
    figures["sky_v11"] = brighter_than_11(64 if quick else 4, dust)
    figures |= pole_figures(4 if quick else 24, dust)
    for g, published in star_counts.PARALLAX.items():
        figures[f"gaia_parallax_g{g:g}_off"] = float(gaia.astrometric_errors(g)[2] / published - 1.0)
    return figures


NOTES = {
    "stars_per_s_core": "stars drawn and published per CPU second",
    "with_fluxes_per_s_core": "the same with fluxes in ten bands",
    "cell_peak_gb": "peak memory of the most crowded cell outside the plane and the bulge",
    "sky_b20_off": "stars with H < 26 at |b| > 20 deg, relative difference from 2.65e9",
    "sky_v11": "stars with V < 11 on the whole sky; the real number is 1e6",
    "against_pole_v20": "ratio to Bahcall & Soneira 1980, whose error is 15 %",
    "against_pole_g20": "the same in G",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    options = report.options("stars", __doc__ or "", argv)
    report.print_and_write("stars", 1, run(options.quick), NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
