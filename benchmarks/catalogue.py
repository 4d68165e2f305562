"""How fast the universe is drawn: python -m benchmarks.catalogue [--quick] [--json FILE].

One order-5 cell (3.4 deg2) to I_E < 26, halos and galaxies, as the job makes it: drawn and written as Parquet. CPU
seconds of one core; the box and its lensing are in the cache.  The peer is SkyPy's draw of a Schechter function to the
same magnitude limit (redshifts and luminosities only), beside ours of halos, satellites, redshifts and luminosities.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from jobs.catalogue import build_galaxies, galaxies, population
from lake_schema import parquet, sky
from lake_schema.provenance import git_commit
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.halos import HALOS

FACTS = {
    "seed": 20240401,
    "galaxy_limit": 26.0,
    "galaxy_band": "euclid_vis",
    "z_max": 2.3,
    "box_cells": 192,
    "lensing_nside": 256,
    "high_redshift_boost": 1.0,
    "quasar_boost": 1.0,
}
CELL = 9000
# Serrano et al. 2024: galaxies of the simulated survey.
SURVEY_GALAXIES = 922e6


def make(cell: int, count: int) -> dict[str, float]:
    """Both tables of the first `count` generation cells of an order-5 cell, as a task makes them; runs anywhere."""
    facts = {**FACTS, "generation_cells": list(range(cell << 6, (cell << 6) + count))}
    build_galaxies._universe(facts)
    started, began = time.process_time(), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        halos = build_galaxies.halo_work(Path(folder), facts).rows
        parquet.write(Path(folder) / "halos.parquet", halos, HALOS)
        halo_s = time.process_time() - started
        rows = build_galaxies.work(Path(folder), facts).rows
        parquet.write(Path(folder) / "galaxies.parquet", rows, GALAXIES)
        size = (Path(folder) / "galaxies.parquet").stat().st_size
    return {
        "rows": rows.num_rows,
        "halos": halos.num_rows,
        "halo_s": halo_s,
        "seconds": time.process_time() - started,
        "wall": time.perf_counter() - began,
        "bytes": size,
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
    }


def two_cores(count: int) -> float:
    """Wall time of two tasks one after another / at once."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        list(pool.map(make, (CELL + 5, CELL + 9), (1, 1)))
        began = time.perf_counter()
        pool.submit(make, CELL + 1, count).result()
        pool.submit(make, CELL + 2, count).result()
        alone = time.perf_counter() - began
        began = time.perf_counter()
        list(pool.map(make, (CELL + 1, CELL + 2), (count, count)))
        return alone / (time.perf_counter() - began)


def peer(area: float) -> float | None:
    """SkyPy: galaxies a second whose redshift and luminosity are drawn, to the limit where they are bright enough."""
    try:
        from astropy.cosmology import FlatLambdaCDM
        from astropy.units import Quantity
        from skypy.galaxies import schechter_lf
    except ImportError:
        return None
    z = np.linspace(0.002, 2.3, 200)
    law = galaxies.luminosity_function.schechter()
    m_star, phi_star, alpha = law.at(z)
    started = time.process_time()
    redshift, _ = schechter_lf(
        z, m_star, phi_star, float(alpha.mean()), 26.0, Quantity(area, "deg2"), FlatLambdaCDM(100.0, 0.319)
    )
    return float(redshift.size / (time.process_time() - started))


def luminosities(count: int) -> float:
    """Ours, the same sub-task: candidates a second with halo, position, velocity, redshift and proxy mass."""
    people = galaxies.people(*(FACTS[name] for name in ("seed", "galaxy_limit", "z_max", "box_cells")))
    drawn = population.Cells(people)
    started = time.process_time()
    found = [population.members(drawn, cell) for cell in range(CELL << 6, (CELL << 6) + count)]
    for one in found:
        people.halos.matching.magnitude(one.z, one.proxy)
    return float(sum(one.id.size for one in found) / (time.process_time() - started))


def run(quick: bool) -> dict[str, Any]:
    """All figures."""
    count = 4 if quick else 64
    whole = make(CELL, count)
    own, other = luminosities(min(count, 16)), peer(sky.cell_area(8) * count)
    return {
        "generation_cells": count,
        "cell_rows": whole["rows"],
        "cell_halos": whole["halos"],
        "cell_s": whole["seconds"],
        "cell_halo_s": whole["halo_s"],
        "cell_peak_gb": whole["peak_gb"],
        "bytes_per_row": whole["bytes"] / whole["rows"],
        "speedup_2_cores": two_cores(2 if quick else 16),
        "galaxies_per_s_core": whole["rows"] / whole["seconds"],
        "draw_per_s_core": own,
        "peer_draw_per_s_core": other,
        "vs_peer": None if other is None else own / other,
        "projected_core_hours_922m": SURVEY_GALAXIES / whole["rows"] * whole["seconds"] / 3600.0,
    }


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="benchmarks.catalogue", description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="four generation cells, for tests")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(argv)
    figures = run(options.quick)
    for name, value in figures.items():
        print(f"{name:28} {'not installed' if value is None else f'{value:,.4g}'}")
    if options.json:
        about = {"name": "catalogue", "commit": git_commit(), "machine": platform.processor() or platform.machine()}
        options.json.write_text(json.dumps({**about, "repeats": 1, **figures}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
