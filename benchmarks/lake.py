"""Measure the speed of the lake (the folder of tables): python -m benchmarks.lake [--quick] [--json FILE].

Writing, searching and reading are measured with a catalogue of 50 columns of random values, in 20 HEALPix cells of
250,000 rows. They are compared with the Parquet writers of Spark and pyarrow, with cone searches by lsdb, with a full
scan, and with queries that do not verify the checksums of files.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from benchmarks import report
from lake_schema import sky
from lake_schema.columns import Column, Table
from lake_schema.store import layout, parquet, publish, read
from lake_schema.store.plan import Json, Output, Plan, Task
from lake_schema.store.stage import write_partition
from lake_schema.tables.common import DEC, HEALPIX_29, ID, RA
from truesky.explore.explorer import Explorer

# First of the consecutive nested HEALPix cells of order 5, around the Chandra Deep Field South.
FIRST_CELL = 8976
# Number of HEALPix cells of the catalogue, and number of rows in each cell.
CELLS, ROWS = 20, 250_000
# Number of HEALPix cells, and number of rows in each, with the option --quick.
QUICK_CELLS, QUICK_ROWS = 3, 20_000
CONE_ARCSEC, CONE_COLUMNS = 60.0, ("id", "ra", "dec", "x_0", "x_1")

KIND_CODES = tuple((code, f"kind {code}") for code in range(5))
TRIAL = Table(
    "trial",
    1,
    (
        ID,
        RA,
        DEC,
        HEALPIX_29,
        Column("halo_id", "int64", doc="identifier", lo=0),
        *(Column(f"{name}_true", "float64", "deg", doc="a place nearby", lo=-90.0, hi=360.0) for name in ("ra", "dec")),
        *(Column(f"kind_{i}", "int32", codes=KIND_CODES, doc="random code", lo=0, hi=4) for i in range(3)),
        *(Column(f"x_{i}", "float32", doc="random number", lo=0.0, hi=1.0) for i in range(40)),
    ),
    "50 columns of random values, 228 bytes per row before compression, which compress worse than real data.",
    order=5,
)

NOTES = {
    "write_rows_per_s_core": "rows validated, written, hashed, synced, with the receipt",
    "write_parquet_rows_per_s": "the Parquet file alone",
    "write_vs_spark_writer": "speed / speed of Spark's writer, one core, from memory",
    "write_vs_pyarrow_defaults": "speed / speed of pyarrow with default settings",
    "bytes_per_row": "in the file",
    "bytes_per_row_defaults": "in a file of pyarrow with default settings",
    "finish_s": "metadata, margin, skymap, manifest and rename of the whole catalogue",
    "cone_ms": '60" cone, 5 columns, by lake_schema.store.read, warm',
    "cone_cold_ms": "the same, a version just opened",
    "cone_vs_lsdb": "time of lsdb's cone_search / ours",
    "cone_vs_scan": "time of a scan of all positions / ours",
    "heatmap_s": "100 x 100 bins of two columns of all rows, by the explorer",
    "heatmap_vs_unverified": "time / time of DuckDB's read_parquet, which verifies nothing",
    "verify_mb_per_s": "sha256 of every file, order of rows in every cell",
    "read_mb_per_s": "all columns of a cell into memory, checksums verified (bytes of the file)",
    "read_vs_unverified": "time / time of pyarrow without checksums",
    "session_start_s": "a Spark session in a new process",
}


def random_rows(cell: int, n: int) -> pa.Table:
    """Return `n` rows of random values for the table TRIAL, with positions in a nested HEALPix cell of order 5."""
    rng = np.random.default_rng([1, cell])
    index, ra, dec = sky.random_in_cell(5, cell, n, rng)
    ids = np.int64(cell) << 46 | np.arange(n)
    columns = {"id": ids, "ra": ra, "dec": dec, "_healpix_29": index, "halo_id": ids & ~np.int64(1023)}
    columns |= {"ra_true": ra + rng.normal(0, 1e-3, n), "dec_true": dec + rng.normal(0, 1e-3, n)}
    for column in TRIAL.columns[7:]:
        columns[column.name] = rng.integers(0, 5, n) if column.codes else rng.random(n)
    return TRIAL.build(columns)


def make_cell(root: Path, facts: Json) -> Output:
    """Make the rows of one HEALPix cell of the catalogue.

    `facts` contains `cell` (nested index of order 5) and `rows` (number of rows). `root` is not used, but the functions
    that compute a file of a table must have it.
    """
    return Output(random_rows(facts["cell"], facts["rows"]))


def catalogue_plan(cells: int, rows: int) -> Plan:
    """Return the list of tasks that make the catalogue, one per HEALPix cell.

    `cells` is the number of cells, and `rows` the number of rows in each.
    """
    numbers = range(FIRST_CELL, FIRST_CELL + cells)
    return Plan(
        TRIAL, {}, tuple(Task(layout.cell_file(5, cell), {"cell": cell, "rows": rows}, rows) for cell in numbers)
    )


def time_writing(folder: Path, rows: pa.Table, repeats: int) -> dict[str, float]:
    """Measure the speed of writing the rows of one cell by truesky, pyarrow and Spark, each on one core.

    Parameters
    ----------
    folder : Path
        Existing folder in which the files are written.
    rows : pyarrow.Table
        Rows of one cell.
    repeats : int
        Number of repeats; the shortest time counts.

    Returns
    -------
    dict of str to float
        Measured values by name; a name ends with the unit of the value, such as `_s` or `_gb`.
    """
    part = Task(layout.cell_file(5, FIRST_CELL), {})
    ours, plain = folder / "ours.parquet", folder / "plain.parquet"
    pa.set_cpu_count(1)
    partition_s = report.best_time(lambda: write_partition(folder / ".stage-x", TRIAL, part, Output(rows)), repeats)
    parquet_s = report.best_time(lambda: parquet.write(ours, rows, TRIAL), repeats)
    default_s = report.best_time(lambda: pq.write_table(rows, plain), repeats)
    spark_s = _time_spark_writer(folder, ours, repeats)
    n = rows.num_rows
    return {
        "write_rows_per_s_core": n / partition_s,
        "write_parquet_rows_per_s": n / parquet_s,
        "write_vs_spark_writer": spark_s / parquet_s,
        "write_vs_pyarrow_defaults": default_s / parquet_s,
        "bytes_per_row": ours.stat().st_size / n,
        "bytes_per_row_defaults": plain.stat().st_size / n,
    }


def _time_spark_writer(folder: Path, file: Path, repeats: int) -> float:
    """Return the wall time (s) in which Spark writes the rows of a Parquet file, read before, in one task."""
    from truesky.running.session import get_session

    frame = get_session("benchmarks.lake").read.parquet(str(file)).coalesce(1).cache()
    frame.count()
    return report.best_time(lambda: frame.write.mode("overwrite").parquet(str(folder / "spark")), repeats + 1)


def time_cones(version: read.Version, repeats: int) -> dict[str, float]:
    """Time searches in circles of 60 arcsec by truesky, by lsdb, and by a scan of all rows.

    `version` is the catalogue, and `repeats` the number of random positions. SystemExit is raised if the three methods
    do not find the same number of rows.
    """
    import lsdb

    centres = np.random.default_rng(2).permutation(version.rows(["ra", "dec"], version.partitions[:2]).to_pandas())[
        :repeats
    ]
    radius, columns = CONE_ARCSEC / 3600, list(CONE_COLUMNS)
    started = time.perf_counter()
    opened = read.version(version.folder.parents[1], TRIAL.name)
    opened.cone(*centres[0], radius, columns)
    cold = time.perf_counter() - started
    catalogue = lsdb.open_catalog(str(version.folder), columns=columns)
    ours_s, theirs_s, scan_s = [], [], []
    for ra, dec in centres:
        our_rows = _time_call(ours_s, lambda ra=ra, dec=dec: opened.cone(ra, dec, radius, columns))
        lsdb_rows = _time_call(theirs_s, lambda ra=ra, dec=dec: catalogue.cone_search(ra, dec, CONE_ARCSEC).compute())
        scan_rows = _time_call(scan_s, lambda ra=ra, dec=dec: _scan_cone(version, ra, dec, radius, columns))
        if not our_rows.num_rows == len(lsdb_rows) == scan_rows.num_rows:
            raise SystemExit(f"cones differ: {our_rows.num_rows}, {len(lsdb_rows)}, {scan_rows.num_rows} rows")
    best = min(ours_s)
    return {
        "cone_ms": 1e3 * best,
        "cone_cold_ms": 1e3 * cold,
        "cone_vs_lsdb": min(theirs_s) / best,
        "cone_vs_scan": min(scan_s) / best,
    }


def _time_call(seconds: list[float], work):  # type: ignore[no-untyped-def]
    started = time.perf_counter()
    result = work()
    seconds.append(time.perf_counter() - started)
    return result


def _scan_cone(version: read.Version, ra: float, dec: float, radius: float, columns: list[str]) -> pa.Table:
    rows = version.rows(columns)
    return rows.filter(pa.array(sky.separation(rows["ra"].to_numpy(), rows["dec"].to_numpy(), ra, dec) <= radius))


def time_heatmap(version: read.Version, repeats: int) -> dict[str, float]:
    """Measure the wall time of a two-dimensional histogram of all rows of a catalogue.

    The result contains the time in s, and its ratio to the time of DuckDB for files whose checksums are not verified.
    """
    import duckdb

    files = [str(version.partition_path(part)) for part in version.partitions]
    text = """SELECT floor(x_0 * 100)::INT AS i, floor(x_1 * 100)::INT AS j, count(*) AS n
        FROM read_parquet($files) WHERE x_0 BETWEEN 0 AND 1 AND x_1 BETWEEN 0 AND 1 GROUP BY i, j"""
    with Explorer(version.folder.parents[1]) as lake, duckdb.connect(":memory:") as plain:

        def count_bins() -> None:
            lake.heatmap("trial", "x_0", "x_1", span=((0.0, 1.0), (0.0, 1.0)))

        count_bins()
        seconds = report.best_time(count_bins, repeats)
        unverified = report.best_time(lambda: plain.execute(text, {"files": files}).fetchall(), repeats + 1)
    return {"heatmap_s": seconds, "heatmap_vs_unverified": seconds / unverified}


def time_verification(version: read.Version, repeats: int) -> dict[str, float]:
    """Measure the speed (MB/s) of verifying all files of a table, and of reading one file with verified checksums.

    The reading is also compared with pyarrow, which verifies no checksums.
    """
    size = sum(entry["bytes"] for entry in version.manifest["files"]) / 1e6
    deep = report.best_time(lambda: read.find_faults(version, deep=True), repeats)
    part = version.partitions[0]
    checked = report.best_time(lambda: version.rows(partitions=[part]), repeats)
    plain = report.best_time(lambda: ds.dataset(str(version.partition_path(part))).to_table(), repeats)
    return {
        "verify_mb_per_s": size / deep,
        "read_mb_per_s": version.partition_path(part).stat().st_size / 1e6 / checked,
        "read_vs_unverified": checked / plain,
    }


_SESSION = (
    "import time; t = time.time(); from truesky.running.session import get_session; get_session('x'); "
    "print(time.time() - t)"
)


def time_session_start(repeats: int) -> dict[str, float]:
    """Return the shortest wall time (s) of the start of a Spark session in a new process, of at most three starts."""
    command = [sys.executable, "-c", _SESSION]
    done = [subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(min(repeats, 3))]
    return {"session_start_s": min(float(text) for text in done)}


def run(quick: bool, folder: Path) -> tuple[int, dict[str, float]]:
    """Make the catalogue in `folder`, and measure everything; return the number of repeats and all results by name."""
    cells, rows, repeats = (QUICK_CELLS, QUICK_ROWS, 1) if quick else (CELLS, ROWS, 5)
    figures = time_writing(folder, random_rows(FIRST_CELL, rows), repeats)
    pa.set_cpu_count(os.cpu_count() or 1)
    root = folder / "lake"
    root.mkdir()
    ends: list[float] = []

    def mapper(function, parts):  # type: ignore[no-untyped-def]
        yield from map(function, parts)
        ends.append(time.perf_counter())

    publish.make_version(root, catalogue_plan(cells, rows), make_cell, mapper)
    figures["finish_s"] = time.perf_counter() - ends[0]
    version = read.version(root, TRIAL.name)
    figures |= (
        time_cones(version, 3 if quick else 20) | time_heatmap(version, repeats) | time_verification(version, repeats)
    )
    return repeats, figures | time_session_start(repeats)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    chosen = report.options("lake", __doc__ or "", argv)
    folder = Path(tempfile.mkdtemp(prefix="truesky-benchmark-"))
    try:
        repeats, figures = run(chosen.quick, folder)
    finally:
        shutil.rmtree(folder)
    report.print_and_write("lake", repeats, figures, NOTES, chosen.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
