"""Measure the speed of the galaxy catalogue: python -m benchmarks.catalogue [--quick] [--json FILE].

The halos and galaxies of one HEALPix cell of order 5 (3.4 deg2) to I_E < 26 are drawn with default settings and written
as Parquet, as in the Spark job. Times are CPU seconds of one core, with the box of the density field and its lensing
maps in the cache. The job itself is timed with Spark on one and two cores, for a circle where four cells meet.

Both truesky and SkyPy draw positions and magnitudes in three passbands of galaxies to magnitude 26. SkyPy draws a
Schechter function at random positions, and truesky central and satellite galaxies in halos of the box. Without SkyPy
the benchmark ends with an error.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from truesky.request.schema import Universe

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks import _peers, report
from lake_schema import sky
from lake_schema.store import layout, parquet
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.halos import HALOS
from truesky.catalogue import build_galaxies
from truesky.catalogue.galaxies import band_ratios, galaxies
from truesky.catalogue.halos import matching, population
from truesky.cosmology import FIDUCIAL
from truesky.fluxes.libraries import templates
from truesky.running.task_metrics import peak_memory_gb, reset_peak_memory

ROOT = Path(__file__).resolve().parents[1]
SEED = 7
CELL = 9000
# Number of galaxies in the simulated survey of Serrano et al. 2024.
SURVEY_GALAXIES = 922e6
# Position (RA, Dec in deg) where four HEALPix cells of order 5 meet, so that a circle around it has a quarter in each.
CENTRE = (53.4375, -27.279613)
# Radius (deg) of the circle in which the Spark job draws galaxies, and its radius with --quick.
RADIUS, QUICK_RADIUS = 0.75, 0.05
NOTES = {
    "cell_rows": "galaxies of an order-5 cell to I_E < 26",
    "cell_s": "CPU, both tables, drawn and written (target 45)",
    "cell_halo_s": "part of cell_s for halos",
    "cell_peak_gb": "peak resident memory (target 1.5)",
    "speedup_2_cores": "wall time of the job, local[1] / local[2] (target 1.8; only valid on an idle machine)",
    "serial_share": "share of local[1] outside tasks, without the start of Java",
    "speedup_from_shares": "speed-up by two free cores that follows from this share",
    "photometry_per_s_core": "galaxies to I_E < 26 with positions and magnitudes in I_E, Y and H per CPU second",
    "skypy_photometry_per_s_core": "the same for SkyPy: Schechter function, templates of k-correct, random positions",
    "photometry_vs_skypy": "ours / SkyPy for the same area; SkyPy integrates bands at 1000 redshifts once",
    "projected_core_hours_922m": "core-hours of the simulated survey with 922 million galaxies (target 12)",
}


def universe_settings(quick: bool) -> dict[str, object]:
    """Return the default settings of the simulated universe by name, with a seed.

    If `quick` is True, the box of the density field and the lensing maps are smaller.
    """
    small = {"box_cells": 192, "lensing_nside": 64} if quick else {}
    return {"seed": SEED, **asdict(Universe()), **small}


def make_cell(cell: int, count: int, settings: dict[str, object]) -> dict[str, float]:
    """Draw the halos and galaxies of a HEALPix cell and write them to temporary files, as a task of the job does.

    Parameters
    ----------
    cell : int
        Nested index of the cell of order 5.
    count : int
        Number of cells of order 8 in it that are drawn, 1 to 64.
    settings : dict
        Settings of the simulated universe, from `universe_settings`.

    Returns
    -------
    dict of str to float
        Measured values by name; a name ends with the unit of the value, such as `_s` or `_gb`.
    """
    task_facts = {**settings, "generation_cells": list(range(cell << 6, (cell << 6) + count))}
    build_galaxies._universe(task_facts, None)
    reset_peak_memory()
    started, wall_start = time.process_time(), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        halos = build_galaxies.draw_halos(Path(folder), task_facts).rows
        parquet.write(Path(folder) / "halos.parquet", halos, HALOS)
        halo_s = time.process_time() - started
        rows = build_galaxies.draw_galaxies(Path(folder), task_facts).rows
        parquet.write(Path(folder) / "galaxies.parquet", rows, GALAXIES)
        size = (Path(folder) / "galaxies.parquet").stat().st_size
    return {
        "cell_rows": rows.num_rows,
        "cell_halos": halos.num_rows,
        "cell_s": time.process_time() - started,
        "cell_wall_s": time.perf_counter() - wall_start,
        "cell_halo_s": halo_s,
        "cell_peak_gb": peak_memory_gb(),
        "bytes_per_row": size / rows.num_rows,
    }


def time_job(cores: int, quick: bool) -> tuple[float, float]:
    """Run the job that makes the table `galaxies` with Spark on this number of cores.

    Return the wall time (s) without the start of Java and of the worker processes, and the sum of the wall times of all
    tasks (s). CalledProcessError is raised if the job fails.
    """
    ra, dec = CENTRE
    settings = universe_settings(quick)
    with tempfile.TemporaryDirectory() as folder:
        request = Path(folder) / "request.toml"
        request.write_text(
            f'name = "meeting"\nseed = {SEED}\n[area]\n'
            f"cone = {{ ra = {ra}, dec = {dec}, radius = {QUICK_RADIUS if quick else RADIUS} }}\n[universe]\n"
            f"box_cells = {settings['box_cells']}\nlensing_nside = {settings['lensing_nside']}\n"
        )
        spark = shutil.which("spark-submit", path=str(Path(sys.executable).parent)) or "spark-submit"
        job = ROOT / "jobs" / "catalogue" / "build_galaxies.py"
        lake = Path(folder) / "lake"
        command = [spark, "--master", f"local[{cores}]", job, "--lake", lake, "--request", request]
        subprocess.run([str(word) for word in command], check=True, capture_output=True, text=True)
        # Only the log of the table `galaxies` is read. The same worker processes have made the halos before, so their
        # start and the compilation of functions are not part of the time.
        (log,) = layout.runs_folder(layout.resolve_lake(lake)).glob("*-galaxies-*.jsonl")
        lines = [json.loads(line) for line in log.read_text().splitlines()]
    tasks = sum(line["seconds"] for line in lines if "part" in line)
    return next(line["seconds"] for line in lines if "ended" in line), tasks


def two_core_speedup(quick: bool, repeats: int) -> dict[str, float]:
    """Compare the wall times of the job that makes galaxies on one and on two cores.

    Each time is the shortest of `repeats` runs, which alternate. The result contains the measured speed-up, the
    fraction of the one-core time that is spent outside tasks, and the speed-up that follows from this fraction.
    """
    turns = [(time_job(1, quick), time_job(2, quick)) for _ in range(repeats)]
    single_core_s, tasks = min(single_core for single_core, _ in turns)
    double_core_s = min(double_core for _, double_core in turns)[0]
    serial = 1.0 - tasks / single_core_s
    return {
        "speedup_2_cores": single_core_s / double_core_s,
        "serial_share": serial,
        "speedup_from_shares": 1.0 / (serial + 0.5 * (1.0 - serial)),
    }


def photometry(count: int, settings: dict[str, object]) -> float:
    """Return the galaxies per CPU second that truesky draws, with positions and magnitudes in three passbands.

    Halos, velocities, redshifts and spectra are drawn, too, because the magnitudes depend on them. `count` is the
    number of HEALPix cells of order 8, and `settings` are from `universe_settings`.
    """
    universe = build_galaxies._universe(settings, None)
    drawn = population.CellCache(universe.population)
    library, dustiest = templates.galaxy_library(), float(universe.selection.ebv[-1])
    bands = [band_ratios.load(library, band, matching.Z_LAST, dustiest) for band in ("euclid_y", "euclid_h")]
    started, number = time.process_time(), 0
    for cell in range(CELL << 6, (CELL << 6) + count):
        members = population.members(drawn, cell)
        selected = galaxies.select(universe, *galaxies._draw_candidates(SEED, universe, members))
        reference_magnitude = selected.m_r + FIDUCIAL.distance_modulus(selected.z)
        band_magnitudes = [reference_magnitude + band_ratios.offset(band, selected.z, selected.sed) for band in bands]
        number += np.stack(
            [members.ra[selected.row], members.dec[selected.row], selected.magnitude, *band_magnitudes]
        ).shape[1]
    return number / (time.process_time() - started)


def run(quick: bool, repeats: int) -> dict[str, float]:
    """Measure the speed of the galaxy catalogue, and return all results by name; `quick` draws a small area."""
    settings, count = universe_settings(quick), 4 if quick else 64
    turns = [make_cell(CELL, count, settings) for _ in range(repeats)]
    figures = {"generation_cells": count, **min(turns, key=lambda turn: turn["cell_s"])}
    figures["galaxies_per_s_core"] = figures["cell_rows"] / figures["cell_s"]
    figures["projected_core_hours_922m"] = SURVEY_GALAXIES / figures["galaxies_per_s_core"] / 3600.0
    area = sky.cell_area(8) * count
    our_rate, skypy_rate = photometry(count, settings), _peers.skypy_photometry(area, SEED)
    figures |= {
        "photometry_per_s_core": our_rate,
        "skypy_photometry_per_s_core": skypy_rate,
        "photometry_vs_skypy": our_rate / skypy_rate,
    }
    return figures | two_core_speedup(quick, repeats)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    options = report.options("catalogue", __doc__ or "", argv)
    report.print_and_write("catalogue", 1, run(options.quick, 1), NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
