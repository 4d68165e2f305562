"""Measure the CPU time in which the emulator observes the sources of a lake, and scale it to 1,000 deg2.

    python -m scripts.emulator_cost LAKE MODEL [MODEL ..] [--profile]

The lake has catalogues, fluxes, and the table `depth` in the bands of the models. Each partition is observed, and its
rows are written to a temporary file, as by `truesky emulate`, in one process. The time of its start is not included.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import tempfile
import time
from pathlib import Path

import numpy as np

from lake_schema import sky
from lake_schema.store import layout, parquet, read
from lake_schema.tables.survey.observed import observed_sources
from truesky.emulator import build_observed, model

# HEALPix order of the cells in which catalogues are made: a catalogue covers whole cells.
_CELLS = 8


def observe(lake, files, folder):
    """Observe all partitions, and return the numbers of sources and of rows, the area (deg2), and the CPU times (s).

    The two times are for observing and for writing. Temporary files are written to `folder`.
    """
    models = [model.read_model(Path(name)) for name in files]
    versions = {name: read.version(lake, name) for name in ("galaxies", "galaxy_fluxes", "stars", "star_fluxes")}
    facts = {name: version.key for name, version in versions.items()}
    facts |= {"seed": 1, "depth": read.version(lake, "depth").key, "models": [fitted.sha256 for fitted in models]}
    table, times, rows, sources, cells = observed_sources([fitted.band for fitted in models]), np.zeros(2), 0, 0, 0
    # The first call in a process compiles and loads functions.
    build_observed.observe_partition(files, lake, {**facts, "part": versions["galaxies"].partitions[0]})
    for part in versions["galaxies"].partitions:
        index = versions["galaxies"].rows(["_healpix_29"], [part])["_healpix_29"].to_numpy()
        cells += len(np.unique(sky.parent(index, sky.MAX_ORDER, _CELLS)))
        started = time.process_time()
        output = build_observed.observe_partition(files, lake, {**facts, "part": part})
        observed = time.process_time()
        parquet.write(folder / "rows.parquet", output.rows, table)
        times += observed - started, time.process_time() - observed
        rows, sources = rows + output.rows.num_rows, sources + len(index)
    sources += versions["stars"].rows(["id"]).num_rows
    return sources, rows, cells * sky.cell_area(_CELLS), times


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lake")
    parser.add_argument("models", nargs="+")
    parser.add_argument("--profile", action="store_true", help="print the functions that take most of the time")
    options = parser.parse_args()
    profile = cProfile.Profile()
    with tempfile.TemporaryDirectory() as folder:
        if options.profile:
            profile.enable()
        sources, rows, area, times = observe(layout.resolve_lake(options.lake), options.models, Path(folder))
        profile.disable()
    # Exposures may cover a part of the catalogue only, but in a survey each source has a row.
    per_source = times[0] / sources + times[1] / max(rows, 1)
    per_area = per_source * sources / area
    print(
        f"{len(options.models)} models, {sources} sources in {area:.3f} deg2, {rows} rows: {times[0]:.2f} s to observe "
        f"and {times[1]:.2f} s to write. With a row for each source: {1.0 / per_source:.3g} sources per s and core, "
        f"{per_area:.2f} core-s per deg2, {per_area / 3.6:.2f} core-hours per 1,000 deg2"
    )
    if options.profile:
        pstats.Stats(profile).sort_stats("tottime").print_stats(25)


if __name__ == "__main__":
    main()
