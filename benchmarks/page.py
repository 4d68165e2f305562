"""How fast the page over a lake answers: python -m benchmarks.page [--quick] [--json FILE].

Charts are answered as the page answers them, over made columns that it keeps; the server is asked over HTTP, over a
made lake of 1 M rows and an image, and over one of 10 M rows of which nothing is kept; a browser moves brushes over the
first, where one is installed (extra `test`, and chromium).
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
from benchmarks.lake import catalogue_plan, make_cell
from lake_schema.fits import images
from lake_schema.store import publish
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.products import PRODUCTS
from truesky.explore.counting import Chart, ChartColumns, count_rows, inspect_columns
from truesky.page.charts import SUBSAMPLING, pack_counts

ROWS, MANY_ROWS, MAX_ROWS, DOWNLOADED_ROWS, LARGE_LAKE_ROWS = 1_000_000, 50_000_000, 100_000_000, 10_000_000, 10_000_000
QUICK_ROWS, QUICK_MANY_ROWS, QUICK_MAX_ROWS, QUICK_DOWNLOADED_ROWS, QUICK_LARGE_LAKE_ROWS = (
    100_000,
    500_000,
    1_000_000,
    200_000,
    200_000,
)
CELLS, SIDE, QUICK_SIDE = 2, 4096, 1024
FORMATS = ("csv", "parquet", "vot", "fits")
TOKEN = "a-token-of-the-benchmark"

SPAN = (-3.0, 3.0)
CHARTS = [*(Chart((k,), (SPAN,), (120,)) for k in range(4)), Chart((0, 1), (SPAN, SPAN), (96, 96))]
LIMITS = {0: (-1.0, 1.0), 1: (-0.5, 2.0), 2: (-2.0, 0.5)}
# The same as the page asks for them.
QUESTION: dict[str, Any] = {
    "charts": [{"axes": c.columns, "bins": c.bins, "spans": c.spans} for c in CHARTS],
    "limits": [[axis, *limit] for axis, limit in LIMITS.items()],
}
CUBE = [Chart((0, k), (SPAN, SPAN), (256, 120), frozenset({0, k})) for k in range(1, 4)]

NOTES = {
    "count_1m_ms": "four histograms and a map of 1 M rows, each under the others' brushes, median",
    "count_vs_duckdb": "times less CPU than DuckDB's, one query a chart, of 1 M rows in memory",
    "brush_50m_cpu_ms": "the answer to a move of a brush: four histograms and a map of 50 M kept rows, CPU",
    "held_50m_cpu_s": "what is looked for once in these columns, spans and missing values, CPU",
    "first_100m_ms": "the answer of one row in 64 of 100 M, once they are kept, which is shown at a move, median",
    "whole_100m_cpu_s": "the answer of all 100 M kept rows, CPU",
    "whole_1e9_cpu_s_extrapolated": "ten times that: of 1e9 rows, NOT measured",
    "first_1e9_ms_extrapolated": "ten times first_100m_ms: one row in 64 of 1e9, NOT measured",
    "fill_1m_s": "the first answer of four columns of 1 M rows of a lake, of which nothing is kept",
    "fill_sample_10m_s": "the first answer of one row in 64 of 10 M, of which nothing is kept",
    "fill_sample_1e8_s_extrapolated": "ten times that: of 1e8 rows, NOT measured",
    "cone_10m_ms": "36 arcsec by ADQL's CONTAINS among 10 M rows, over TAP, median",
    "cone_scan_10m_ms": "the same by separation(), which reads all of them, median",
    "cube_ms": "a move of a held brush over 1 M rows, in the browser, to the numbers it shows, median",
    "cube_server_ms": "counts of three charts for each of 256 places of a held brush, 1 M rows, one thread",
    "brush_1m_ms": "a move of a brush that is counted anew over 1 M rows, in the browser, to its frame, median",
    "brush_1m_95_ms": "the same, of 95 % of the moves",
    "first_sky_s": "from the command to densities in the files' cells",
    "first_sky_browser_s": "the same to its first frame, in a browser that is started beside",
    "select_1_ms": "SELECT 1 over HTTP, median",
    "sky_ms": "densities in the files' cells, median",
    "tile_ms": "a tile of 512 x 512 pixels of a kept image, median over its tiles",
    "first_tile_ms": "the first tile of a 4096 x 4096 image, whose tiles are then kept",
    "server_gb": "memory of the server, without its processes of queries",
    "download_mb": "what server and processes took more at most while 10 M rows went out, of any kind of file",
    **{f"download_{form}_mb_per_s": f"10 M rows as {form}" for form in FORMATS},
}


def random_columns(rows: int) -> list[np.ndarray]:
    """Made columns, normal."""
    rng = np.random.default_rng(1)
    return [rng.standard_normal(rows, np.float32) for _ in range(4)]


def count_with_duckdb(columns: Sequence[np.ndarray]) -> None:
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


def time_counting(rows: int, many_rows: int, max_rows: int, repeats: int) -> dict[str, float]:
    """Charts over kept columns."""
    few_columns = random_columns(rows)
    count_rows(few_columns, CHARTS, LIMITS)
    ours = report.best_time(lambda: count_rows(few_columns, CHARTS, LIMITS), repeats, time.process_time)
    theirs = report.best_time(lambda: count_with_duckdb(few_columns), repeats, time.process_time)
    figures = {
        "count_1m_ms": 1e3 * median_seconds(lambda: count_rows(few_columns, CHARTS, LIMITS), 5 * repeats),
        "count_vs_duckdb": theirs / ours,
        "cube_server_ms": 1e3 * report.best_time(lambda: count_rows(few_columns, CUBE, {1: LIMITS[1]}), repeats),
    }
    threads = os.cpu_count() or 1
    all_columns = random_columns(max_rows)
    many_columns = [column[:many_rows] for column in all_columns]
    figures["held_50m_cpu_s"] = report.best_time(lambda: inspect_columns(many_columns), 1, time.process_time)

    def make_answer(cached_columns: ChartColumns, part: int = 1) -> Callable[[], bytes]:
        return lambda: pack_counts(cached_columns, QUESTION, part, threads)

    figures["brush_50m_cpu_ms"] = 1e3 * report.best_time(
        make_answer(inspect_columns(many_columns)), repeats, time.process_time
    )
    # Rows that are shown first are kept as columns of their own.
    sample = inspect_columns([column[::SUBSAMPLING].copy() for column in all_columns])
    figures["first_100m_ms"] = 1e3 * median_seconds(make_answer(sample, SUBSAMPLING), 5 * repeats)
    figures["whole_100m_cpu_s"] = report.best_time(
        make_answer(inspect_columns(all_columns)), repeats, time.process_time
    )
    figures["first_1e9_ms_extrapolated"] = 1e9 / max_rows * figures["first_100m_ms"]
    figures["whole_1e9_cpu_s_extrapolated"] = 1e9 / max_rows * figures["whole_100m_cpu_s"]
    return figures


def median_seconds(ask: Callable[[], Any], times: int) -> float:
    """Median time, s."""
    seconds = []
    for _ in range(times):
        started = time.perf_counter()
        ask()
        seconds.append(time.perf_counter() - started)
    return median(seconds)


class PageClient:
    """A connection to the page."""

    def __init__(self, port: int) -> None:
        self.connection, self.cookie = http.client.HTTPConnection("127.0.0.1", port), f"truesky-{port}={TOKEN}"

    def send(self, method: str, path: str, body: str | None = None) -> http.client.HTTPResponse:
        self.connection.request(method, path, body, {"Cookie": self.cookie})
        return self.connection.getresponse()

    def milliseconds(self, times: int, method: str, path: str, body: str | None = None) -> float:
        return 1e3 * median_seconds(lambda: self.send(method, path, body).read(), times)


def make_lake(lake: Path, rows: int, side: int) -> None:
    """A catalogue of cells of at most 1 M rows, and an image."""
    lake.mkdir()
    cells = max(CELLS, rows // ROWS)
    publish.make_version(lake, catalogue_plan(cells, rows // cells), make_cell)
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
    publish.make_version(lake, Plan(PRODUCTS, {}, (Task("1.parquet", {}),)), lambda root, facts: Output(row, files))


def measure_server(lake: Path, rows: int, downloaded: int, side: int, repeats: int) -> dict[str, float]:
    """A server over a made lake: asked over HTTP, and in a browser."""
    make_lake(lake, rows, side)
    started = time.perf_counter()
    command = [sys.executable, "-m", "truesky.page", str(lake), "--no-open", "--token", TOKEN]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            address = server.stdout.readline().split()[-1]
            port = int(address.rpartition("/?")[0].rpartition(":")[2])
            client = PageClient(port)
            key = json.loads(client.send("GET", "/api/lake").read())["key"]
            client.send("GET", f"/api/{key}/sky/trial/parts").read()
            figures = {"first_sky_s": time.perf_counter() - started}
            figures |= time_requests(client, f"/api/{key}", side, 20 * repeats)
            figures["fill_1m_s"] = first_answer_seconds(client, f"/api/{key}", 1)
            figures["server_gb"] = psutil.Process(server.pid).memory_info().rss / 1e9
            if missing := _browser.missing_requirement():
                print(f"page: no figures of the browser: {missing}")
            else:
                figures |= _browser.time_brushes(address, 20 * repeats)
            # A connection that was idle meanwhile has been closed.
            figures |= measure_downloads(PageClient(port), f"/api/{key}", server.pid, downloaded)
        finally:
            server.terminate()
    if not _browser.missing_requirement():
        figures["first_sky_browser_s"] = _browser.time_first_sky(command)
    return figures


def first_answer_seconds(client: PageClient, lake: str, part: int) -> float:
    """s of the first answer of four columns of a lake of which nothing is kept."""
    question = {**QUESTION, "source": "trial", "axes": ["ra", "dec", "x_0", "x_1"], "limits": [], "part": part}
    question["charts"] = [{**chart, "spans": None} for chart in QUESTION["charts"]]
    started = time.perf_counter()
    answer = client.send("POST", f"{lake}/charts", json.dumps(question))
    answer.read()
    assert answer.status == 200
    return time.perf_counter() - started


def measure_large_lake(lake: Path, rows: int, repeats: int) -> dict[str, float]:
    """A lake of many rows: the first answer of a sample, and a cone among them."""
    make_lake(lake, rows, QUICK_SIDE)
    command = [sys.executable, "-m", "truesky.page", str(lake), "--no-open", "--token", TOKEN]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            server.stdout.readline()
            service = server.stdout.readline().split()[-1]
            client = PageClient(int(service.partition("/tap/")[0].rpartition(":")[2]))
            lake_info = json.loads(client.send("GET", "/api/lake").read())
            client.send("POST", f"/api/{lake_info['key']}/sql", '{"sql": "SELECT count(*) FROM trial"}').read()
            sample = first_answer_seconds(client, f"/api/{lake_info['key']}", SUBSAMPLING)
            question = '{"sql": "SELECT ra, dec FROM trial LIMIT 1 OFFSET 1000"}'
            ((ra, dec),) = json.loads(client.send("POST", f"/api/{lake_info['key']}/sql", question).read())["rows"]
            times = []
            for condition in (
                f"CONTAINS(POINT(ra, dec), CIRCLE({ra}, {dec}, 0.01)) = 1", f"separation(ra, dec, {ra}, {dec}) <= 0.01"
            ):  # fmt: skip
                query = quote(f"SELECT id FROM trial WHERE {condition}")
                path = f"/tap/{service.partition('/tap/')[2]}/sync?LANG=ADQL&QUERY={query}"
                client.send("GET", path).read()
                times.append(client.milliseconds(3 * repeats, "GET", path))
        finally:
            server.terminate()
    return {
        "fill_sample_10m_s": sample, "fill_sample_1e8_s_extrapolated": 1e8 / rows * sample,
        "cone_10m_ms": times[0], "cone_scan_10m_ms": times[1],
    }  # fmt: skip


def time_requests(client: PageClient, lake: str, side: int, times: int) -> dict[str, float]:
    """What the page asks all the time."""
    client.send("POST", f"{lake}/sql", '{"sql": "SELECT 1"}').read()
    clock = time.perf_counter()
    client.send("GET", f"{lake}/tile/0/0/0/0").read()
    first = time.perf_counter() - clock
    tiles = [f"{lake}/tile/0/0/{row}/{column}" for row in range(side // 512) for column in range(side // 512)]
    return {
        "select_1_ms": client.milliseconds(times, "POST", f"{lake}/sql", '{"sql": "SELECT 1"}'),
        "sky_ms": client.milliseconds(times, "GET", f"{lake}/sky/trial/parts"),
        "tile_ms": median(client.milliseconds(1, "GET", tile) for tile in tiles),
        "first_tile_ms": 1e3 * first,
    }


def measure_downloads(client: PageClient, lake: str, server: int, rows: int) -> dict[str, float]:
    """Large results, read as they come; memory of the server and of its processes."""
    sql = quote(f"SELECT range AS id, range * 1.5 AS x, (range % 1000)::FLOAT AS y FROM range({rows})")
    figures, added_mb = {}, 0.0
    for form in FORMATS:
        num_bytes, peak, initial, clock = 0, 0, process_memory(server), time.perf_counter()
        answer = client.send("GET", f"{lake}/export?format={form}&sql={sql}")
        while piece := answer.read(1 << 22):
            num_bytes, peak = num_bytes + len(piece), max(peak, process_memory(server))
        figures[f"download_{form}_mb_per_s"] = num_bytes / 1e6 / (time.perf_counter() - clock)
        added_mb = max(added_mb, (peak - initial) / 1e6)
    return {"download_mb": added_mb, **figures}


def process_memory(pid: int) -> int:
    """Bytes of a process and those that it started."""
    process = psutil.Process(pid)
    return sum(family_member.memory_info().rss for family_member in (process, *process.children(recursive=True)))


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status 0."""
    options = report.options("page", __doc__ or "", argv)
    rows, many_rows, max_rows = (
        (QUICK_ROWS, QUICK_MANY_ROWS, QUICK_MAX_ROWS) if options.quick else (ROWS, MANY_ROWS, MAX_ROWS)
    )
    downloaded, side = (QUICK_DOWNLOADED_ROWS, QUICK_SIDE) if options.quick else (DOWNLOADED_ROWS, SIDE)
    repeats = 1 if options.quick else 3
    figures = time_counting(rows, many_rows, max_rows, repeats)
    with tempfile.TemporaryDirectory() as folder:
        # Nothing that is kept is found.
        os.environ["TRUESKY_CACHE"] = f"{folder}/cache"
        figures |= measure_server(Path(folder) / "lake", rows, downloaded, side, repeats)
        figures |= measure_large_lake(
            Path(folder) / "large", QUICK_LARGE_LAKE_ROWS if options.quick else LARGE_LAKE_ROWS, repeats
        )
    report.print_and_write("page", repeats, figures, NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
