"""How fast the page over a lake answers: python -m benchmarks.page [--quick] [--json FILE].

Charts are counted over made columns, as the page keeps them; the server is asked over HTTP, with a small made lake.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import http.client
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from urllib.parse import quote

import duckdb
import numpy as np
import psutil
import pyarrow as pa

from benchmarks import report
from benchmarks.lake import plan, work
from jobs.explore.counting import Chart, counted
from lake_schema.store import publish

ROWS, MANY_ROWS, DOWNLOADED = 1_000_000, 50_000_000, 10_000_000
QUICK_ROWS, QUICK_MANY, QUICK_DOWNLOADED = 100_000, 500_000, 200_000
CELLS, ROWS_A_CELL = 2, 20_000
TOKEN = "a-token-of-the-benchmark"

SPAN = (-3.0, 3.0)
CHARTS = [*(Chart((k,), (SPAN,), (120,)) for k in range(4)), Chart((0, 1), (SPAN, SPAN), (96, 96))]
LIMITS = {0: (-1.0, 1.0), 1: (-0.5, 2.0), 2: (-2.0, 0.5)}
CUBE = [Chart((0, k), (SPAN, SPAN), (256, 120), frozenset({0, k})) for k in range(1, 4)]

NOTES = {
    "brush_1m_ms": "four histograms and a map of 1 M rows, each under the others' brushes, median",
    "brush_50m_cpu_ms": "the same of 50 M rows, of the processor",
    "brush_vs_duckdb": "times less CPU than DuckDB's, one query a chart, of 1 M rows in memory",
    "cube_ms": "counts of three charts for each of 256 places of a held brush, 1 M rows, one thread",
    "start_s": "from the command to the first answer",
    "select_1_ms": "SELECT 1 over HTTP, median",
    "first_sky_ms": "densities in the files' cells, median",
    "server_gb": "memory of the server, without its processes of queries",
    "download_mb": "what the server took more at most while 10 M rows went out as CSV",
    "download_mb_per_s": "of CSV",
}


def columns_of(rows: int) -> list[np.ndarray]:
    """Made columns, normal."""
    rng = np.random.default_rng(1)
    return [rng.standard_normal(rows, np.float32) for _ in range(4)]


def by_duckdb(columns: Sequence[np.ndarray]) -> None:
    """The same counts, a query a chart."""
    with duckdb.connect() as session:
        session.register("t", pa.table({f"c{k}": column for k, column in enumerate(columns)}))
        lo, hi = SPAN
        for chart in CHARTS:
            bins = [
                f"least(floor((c{k} - {lo}) / {hi - lo} * {n}), {n - 1})"
                for k, n in zip(chart.columns, chart.bins, strict=True)
            ]
            where = [f"c{k} BETWEEN {a} AND {b}" for k, (a, b) in LIMITS.items() if k not in chart.columns]
            where += [f"c{k} BETWEEN {lo} AND {hi}" for k in chart.columns]
            session.sql(
                f"SELECT {', '.join(bins)}, count(*) FROM t WHERE {' AND '.join(where)} GROUP BY ALL"
            ).fetchall()


def counting(rows: int, many: int, repeats: int) -> dict[str, float]:
    """Charts over kept columns."""
    few = columns_of(rows)
    counted(few, CHARTS, LIMITS)
    seconds = []
    for _ in range(5 * repeats):
        started = time.perf_counter()
        counted(few, CHARTS, LIMITS)
        seconds.append(time.perf_counter() - started)
    ours = report.best(lambda: counted(few, CHARTS, LIMITS), repeats, time.process_time)
    theirs = report.best(lambda: by_duckdb(few), repeats, time.process_time)
    cube = report.best(lambda: counted(few, CUBE, {1: LIMITS[1]}), repeats)
    lots = columns_of(many)
    whole = report.best(lambda: counted(lots, CHARTS, LIMITS, os.cpu_count() or 1), repeats, time.process_time)
    return {
        "brush_1m_ms": 1e3 * median(seconds),
        "brush_50m_cpu_ms": 1e3 * whole,
        "brush_vs_duckdb": theirs / ours,
        "cube_ms": 1e3 * cube,
    }


class Asker:
    """A connection to the page."""

    def __init__(self, port: int) -> None:
        self.connection, self.cookie = http.client.HTTPConnection("127.0.0.1", port), f"truesky-{port}={TOKEN}"

    def ask(self, method: str, path: str, body: str | None = None) -> http.client.HTTPResponse:
        self.connection.request(method, path, body, {"Cookie": self.cookie})
        return self.connection.getresponse()

    def milliseconds(self, times: int, method: str, path: str, body: str | None = None) -> float:
        seconds = []
        for _ in range(times):
            started = time.perf_counter()
            self.ask(method, path, body).read()
            seconds.append(time.perf_counter() - started)
        return 1e3 * median(seconds)


def serving(folder: Path, rows: int) -> dict[str, float]:
    """A server over a small lake, and a large download from it."""
    lake = folder / "lake"
    lake.mkdir()
    publish.make(lake, plan(CELLS, ROWS_A_CELL), work)
    started = time.perf_counter()
    command = [sys.executable, "-m", "jobs.page", str(lake), "--no-open", "--token", TOKEN]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            port = int(server.stdout.readline().rpartition("/?")[0].rpartition(":")[2])
            asker = Asker(port)
            key = json.loads(asker.ask("GET", "/api/lake").read())["key"]
            start = time.perf_counter() - started
            asker.ask("POST", f"/api/{key}/sql", '{"sql": "SELECT 1"}').read()
            select = asker.milliseconds(50, "POST", f"/api/{key}/sql", '{"sql": "SELECT 1"}')
            first = asker.milliseconds(20, "GET", f"/api/{key}/sky/trial/parts")
            process = psutil.Process(server.pid)
            before = process.memory_info().rss
            sql = quote(f"SELECT range AS id, range * 1.5 AS x, (range % 1000)::FLOAT AS y FROM range({rows})")
            went, most, clock = 0, before, time.perf_counter()
            answer = asker.ask("GET", f"/api/{key}/export?format=csv&sql={sql}")
            while piece := answer.read(1 << 22):
                went, most = went + len(piece), max(most, process.memory_info().rss)
            seconds = time.perf_counter() - clock
        finally:
            server.terminate()
    return {
        "start_s": start,
        "select_1_ms": select,
        "first_sky_ms": first,
        "server_gb": before / 1e9,
        "download_mb": (most - before) / 1e6,
        "download_mb_per_s": went / 1e6 / seconds,
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status 0."""
    options = report.options("page", __doc__ or "", argv)
    sizes = (QUICK_ROWS, QUICK_MANY, QUICK_DOWNLOADED) if options.quick else (ROWS, MANY_ROWS, DOWNLOADED)
    repeats = 1 if options.quick else 3
    with tempfile.TemporaryDirectory() as folder:
        figures = {**counting(sizes[0], sizes[1], repeats), **serving(Path(folder), sizes[2])}
    report.finish("page", repeats, figures, NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
