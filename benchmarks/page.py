"""How fast the page over a lake answers: python -m benchmarks.page [--quick] [--json FILE].

Charts are counted over made columns, as the page keeps them; the server is asked over HTTP, over a made lake of 1 M
rows and an image; a browser moves brushes over it, where one is installed (extra `browser`, and chromium).
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
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any
from urllib.parse import quote

import duckdb
import numpy as np
import psutil
import pyarrow as pa

from benchmarks import _browser, report
from benchmarks.lake import plan, work
from jobs.explore.counting import Chart, counted
from jobs.page.charts import PART
from lake_schema.fits import images
from lake_schema.store import publish
from lake_schema.store.plan import Output, Part, Plan
from lake_schema.tables.products import PRODUCTS

ROWS, MANY_ROWS, MOST_ROWS, DOWNLOADED = 1_000_000, 50_000_000, 100_000_000, 10_000_000
QUICK_ROWS, QUICK_MANY, QUICK_MOST, QUICK_DOWNLOADED = 100_000, 500_000, 1_000_000, 200_000
CELLS, SIDE, QUICK_SIDE = 2, 4096, 1024
FORMS = ("csv", "parquet", "vot")
TOKEN = "a-token-of-the-benchmark"

SPAN = (-3.0, 3.0)
CHARTS = [*(Chart((k,), (SPAN,), (120,)) for k in range(4)), Chart((0, 1), (SPAN, SPAN), (96, 96))]
LIMITS = {0: (-1.0, 1.0), 1: (-0.5, 2.0), 2: (-2.0, 0.5)}
CUBE = [Chart((0, k), (SPAN, SPAN), (256, 120), frozenset({0, k})) for k in range(1, 4)]

NOTES = {
    "count_1m_ms": "four histograms and a map of 1 M rows, each under the others' brushes, median",
    "count_vs_duckdb": "times less CPU than DuckDB's, one query a chart, of 1 M rows in memory",
    "brush_50m_cpu_ms": "the same of 50 M rows, of the processor",
    "first_100m_ms": "the same of one row in 64 of 100 M, which is shown first, one thread, median",
    "whole_100m_cpu_s": "the same of all 100 M rows, of the processor",
    "whole_1e9_cpu_s_extrapolated": "ten times that: of 1e9 rows, NOT measured",
    "first_1e9_ms_extrapolated": "ten times first_100m_ms: one row in 64 of 1e9, NOT measured",
    "cube_ms": "a move of a held brush over 1 M rows, in the browser, to the numbers it shows, median",
    "cube_server_ms": "counts of three charts for each of 256 places of a held brush, 1 M rows, one thread",
    "brush_1m_ms": "a move of a brush that is counted anew over 1 M rows, in the browser, to its frame, median",
    "brush_1m_95_ms": "the same, of 95 % of the moves",
    "first_sky_s": "from the command to densities in the files' cells, over HTTP",
    "first_sky_browser_s": "the same to its first frame, in a browser that is started beside",
    "select_1_ms": "SELECT 1 over HTTP, median",
    "sky_ms": "densities in the files' cells, median",
    "tile_ms": "a tile of 512 x 512 pixels of a kept image, median over its tiles",
    "first_tile_ms": "the first tile of a 4096 x 4096 image, whose tiles are then kept",
    "server_gb": "memory of the server, without its processes of queries",
    "download_mb": "what server and processes took more at most while 10 M rows went out, of CSV, Parquet, VOTable",
    **{f"download_{form}_mb_per_s": f"10 M rows as {form}" for form in FORMS},
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


def counting(rows: int, many: int, most: int, repeats: int) -> dict[str, float]:
    """Charts over kept columns."""
    few = columns_of(rows)
    counted(few, CHARTS, LIMITS)
    ours = report.best(lambda: counted(few, CHARTS, LIMITS), repeats, time.process_time)
    theirs = report.best(lambda: by_duckdb(few), repeats, time.process_time)
    figures = {
        "count_1m_ms": 1e3 * typical(lambda: counted(few, CHARTS, LIMITS), 5 * repeats),
        "count_vs_duckdb": theirs / ours,
        "cube_server_ms": 1e3 * report.best(lambda: counted(few, CUBE, {1: LIMITS[1]}), repeats),
    }
    threads = os.cpu_count() or 1
    lots = columns_of(most)
    half = [column[:many] for column in lots]
    whole = report.best(lambda: counted(half, CHARTS, LIMITS, threads), repeats, time.process_time)
    figures["brush_50m_cpu_ms"] = 1e3 * whole
    # Rows that are shown first are kept as columns of their own.
    some = [column[::PART].copy() for column in lots]
    figures["first_100m_ms"] = 1e3 * typical(lambda: counted(some, CHARTS, LIMITS), 5 * repeats)
    figures["whole_100m_cpu_s"] = report.best(
        lambda: counted(lots, CHARTS, LIMITS, threads), repeats, time.process_time
    )
    figures["first_1e9_ms_extrapolated"] = 1e9 / most * figures["first_100m_ms"]
    figures["whole_1e9_cpu_s_extrapolated"] = 1e9 / most * figures["whole_100m_cpu_s"]
    return figures


def typical(ask: Callable[[], Any], times: int) -> float:
    """Median time, s."""
    seconds = []
    for _ in range(times):
        started = time.perf_counter()
        ask()
        seconds.append(time.perf_counter() - started)
    return median(seconds)


class Asker:
    """A connection to the page."""

    def __init__(self, port: int) -> None:
        self.connection, self.cookie = http.client.HTTPConnection("127.0.0.1", port), f"truesky-{port}={TOKEN}"

    def ask(self, method: str, path: str, body: str | None = None) -> http.client.HTTPResponse:
        self.connection.request(method, path, body, {"Cookie": self.cookie})
        return self.connection.getresponse()

    def milliseconds(self, times: int, method: str, path: str, body: str | None = None) -> float:
        return 1e3 * typical(lambda: self.ask(method, path, body).read(), times)


def made_lake(lake: Path, rows: int, side: int) -> None:
    """A catalogue of two cells, and an image."""
    lake.mkdir()
    publish.make(lake, plan(CELLS, rows // CELLS), work)
    pixels = np.random.default_rng(2).normal(100.0, 5.0, (side, side)).astype(np.float32)
    header = [
        ("CTYPE1", "RA---TAN", ""), ("CTYPE2", "DEC--TAN", ""), ("CRVAL1", 53.1, ""), ("CRVAL2", -27.8, ""),
        ("CRPIX1", side / 2, ""), ("CRPIX2", side / 2, ""), ("CD1_1", -0.1 / 3600, ""), ("CD1_2", 0.0, ""),
        ("CD2_1", 0.0, ""), ("CD2_2", 0.1 / 3600, ""), ("CUNIT1", "deg", ""), ("CUNIT2", "deg", ""),
        ("RADESYS", "ICRS", ""), ("BUNIT", "electron", ""),
    ]  # fmt: skip
    row = PRODUCTS.build({
        "path": ["images/one.fits"], "content": ["science"], "exposure_id": [1], "detector": ["1"], "channel": ["VIS"],
        "band": ["euclid_vis"], "ra": [53.1], "dec": [-27.8], "mission": ["m"], "sources": [0],
        "s_region": ["POLYGON ICRS 53.2 -27.9 53.0 -27.9 53.0 -27.7 53.2 -27.7"],
    })  # fmt: skip
    files = {"images/one.fits": lambda to: images.write_images(to, [images.Image(pixels, tuple(header))])}
    publish.make(lake, Plan(PRODUCTS, {}, (Part("1.parquet", {}),)), lambda root, facts: Output(row, files))


def serving(lake: Path, rows: int, downloaded: int, side: int, repeats: int) -> dict[str, float]:
    """A server over a made lake: asked over HTTP, and in a browser."""
    made_lake(lake, rows, side)
    started = time.perf_counter()
    command = [sys.executable, "-m", "jobs.page", str(lake), "--no-open", "--token", TOKEN]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            address = server.stdout.readline().split()[-1]
            port = int(address.rpartition("/?")[0].rpartition(":")[2])
            asker = Asker(port)
            key = json.loads(asker.ask("GET", "/api/lake").read())["key"]
            asker.ask("GET", f"/api/{key}/sky/trial/parts").read()
            figures = {"first_sky_s": time.perf_counter() - started}
            figures |= asked(asker, f"/api/{key}", side, 20 * repeats)
            figures["server_gb"] = psutil.Process(server.pid).memory_info().rss / 1e9
            if why := _browser.missing():
                print(f"page: no figures of the browser: {why}")
            else:
                figures |= _browser.brushes(address, 20 * repeats)
            # A connection that was idle meanwhile has been closed.
            figures |= downloads(Asker(port), f"/api/{key}", server.pid, downloaded)
        finally:
            server.terminate()
    if not _browser.missing():
        figures["first_sky_browser_s"] = _browser.first_sky(command)
    return figures


def asked(asker: Asker, lake: str, side: int, times: int) -> dict[str, float]:
    """What the page asks all the time."""
    asker.ask("POST", f"{lake}/sql", '{"sql": "SELECT 1"}').read()
    clock = time.perf_counter()
    asker.ask("GET", f"{lake}/tile/0/0/0/0").read()
    first = time.perf_counter() - clock
    tiles = [f"{lake}/tile/0/0/{row}/{column}" for row in range(side // 512) for column in range(side // 512)]
    return {
        "select_1_ms": asker.milliseconds(times, "POST", f"{lake}/sql", '{"sql": "SELECT 1"}'),
        "sky_ms": asker.milliseconds(times, "GET", f"{lake}/sky/trial/parts"),
        "tile_ms": median(asker.milliseconds(1, "GET", tile) for tile in tiles),
        "first_tile_ms": 1e3 * first,
    }


def downloads(asker: Asker, lake: str, server: int, rows: int) -> dict[str, float]:
    """Large results, read as they come; memory of the server and of its processes."""
    sql = quote(f"SELECT range AS id, range * 1.5 AS x, (range % 1000)::FLOAT AS y FROM range({rows})")
    figures, more = {}, 0.0
    for form in FORMS:
        went, most, before, clock = 0, 0, memory(server), time.perf_counter()
        answer = asker.ask("GET", f"{lake}/export?format={form}&sql={sql}")
        while piece := answer.read(1 << 22):
            went, most = went + len(piece), max(most, memory(server))
        figures[f"download_{form}_mb_per_s"] = went / 1e6 / (time.perf_counter() - clock)
        more = max(more, (most - before) / 1e6)
    return {"download_mb": more, **figures}


def memory(pid: int) -> int:
    """Bytes of a process and those that it started."""
    process = psutil.Process(pid)
    return sum(one.memory_info().rss for one in (process, *process.children(recursive=True)))


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status 0."""
    options = report.options("page", __doc__ or "", argv)
    rows, many, most = (QUICK_ROWS, QUICK_MANY, QUICK_MOST) if options.quick else (ROWS, MANY_ROWS, MOST_ROWS)
    downloaded, side = (QUICK_DOWNLOADED, QUICK_SIDE) if options.quick else (DOWNLOADED, SIDE)
    repeats = 1 if options.quick else 3
    figures = counting(rows, many, most, repeats)
    with tempfile.TemporaryDirectory() as folder:
        # Nothing that is kept is found.
        os.environ["TRUESKY_CACHE"] = f"{folder}/cache"
        figures |= serving(Path(folder) / "lake", rows, downloaded, side, repeats)
    report.finish("page", repeats, figures, NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
