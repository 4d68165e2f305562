"""Measure the response times of the web page of a lake: python -m benchmarks.page [--quick] [--json FILE].

Histograms (charts) are counted over random columns. HTTP requests go to a server of a lake (folder of tables) with a
table of 1 million random rows and an image, and to one with 10 million rows and an empty cache. If a browser is
installed (extra `test`, and chromium), it moves a brush over the charts of the first lake. A brush is a range on the
axis of a chart that selects rows in all other charts.
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
# Body of the HTTP request with which the page asks for the charts CHARTS, for rows within LIMITS.
QUESTION: dict[str, Any] = {
    "charts": [{"axes": c.columns, "bins": c.bins, "spans": c.spans} for c in CHARTS],
    "limits": [[axis, *limit] for axis, limit in LIMITS.items()],
}
CUBE = [Chart((0, k), (SPAN, SPAN), (256, 120), frozenset({0, k})) for k in range(1, 4)]

NOTES = {
    "count_1m_ms": "four histograms and a map of 1 M rows, each filtered by the brushes of the others, median",
    "count_vs_duckdb": "CPU time of DuckDB (one query per chart, 1 M rows in memory) / ours",
    "brush_50m_cpu_ms": "move of a brush: four histograms and a map of 50 M cached rows, CPU",
    "held_50m_cpu_s": "ranges and missing values of these columns, which are determined once, CPU",
    "first_100m_ms": "first result of a move: one row in 64 of 100 M, cached, median",
    "whole_100m_cpu_s": "all 100 M cached rows, CPU",
    "whole_1e9_cpu_s_extrapolated": "1e9 rows: ten times whole_100m_cpu_s, NOT measured",
    "first_1e9_ms_extrapolated": "one row in 64 of 1e9: ten times first_100m_ms, NOT measured",
    "fill_1m_s": "first request for four columns of 1 M rows of a lake, empty cache",
    "fill_sample_10m_s": "first request for one row in 64 of 10 M, empty cache",
    "fill_sample_1e8_s_extrapolated": "1e8 rows: ten times fill_sample_10m_s, NOT measured",
    "cone_10m_ms": "circle of 36 arcsec by ADQL CONTAINS in 10 M rows, over TAP, median",
    "cone_scan_10m_ms": "the same by separation(), which reads all rows, median",
    "cube_ms": "move of a held brush over 1 M rows in the browser until other numbers are shown, median",
    "cube_server_ms": "counts of three charts for each of 256 positions of a held brush, 1 M rows, one thread",
    "brush_1m_ms": "move of a brush over 1 M rows with a request to the server, in the browser until drawn, median",
    "brush_1m_95_ms": "the same, 95 % quantile",
    "first_sky_s": "from the start of the command to densities in the cells of the files",
    "first_sky_browser_s": "the same until the map is drawn in a browser that runs already",
    "select_1_ms": "SELECT 1 over HTTP, median",
    "sky_ms": "densities in the cells of the files, median",
    "tile_ms": "tile of 512 x 512 pixels of a cached image, median over its tiles",
    "first_tile_ms": "first tile of a 4096 x 4096 image, which caches all tiles",
    "server_gb": "memory of the server without its query processes",
    "download_mb": "additional peak memory of server and processes during a download of 10 M rows in any format",
    **{f"download_{form}_mb_per_s": f"10 M rows as {form}" for form in FORMATS},
}


def random_columns(rows: int) -> list[np.ndarray]:
    """Return four float32 columns of normally distributed random numbers with this number of rows."""
    rng = np.random.default_rng(1)
    return [rng.standard_normal(rows, np.float32) for _ in range(4)]


def count_with_duckdb(columns: Sequence[np.ndarray]) -> None:
    """Count the rows in the bins of CHARTS with DuckDB, one query per chart, for comparison."""
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
    """Measure how long it takes to count rows in the bins of charts, for columns in memory.

    Parameters
    ----------
    rows, many_rows, max_rows : int
        Numbers of rows of the small, the large and the largest table; `many_rows` must not exceed `max_rows`.
    repeats : int
        Number of repeats of each measurement.

    Returns
    -------
    dict of str to float
        Measured values by name; a name ends with the unit of the value, such as `_s` or `_gb`.
    """
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
    # In a large table the page first counts a sample of the rows, which it keeps as separate, contiguous columns.
    sample = inspect_columns([column[::SUBSAMPLING].copy() for column in all_columns])
    figures["first_100m_ms"] = 1e3 * median_seconds(make_answer(sample, SUBSAMPLING), 5 * repeats)
    figures["whole_100m_cpu_s"] = report.best_time(
        make_answer(inspect_columns(all_columns)), repeats, time.process_time
    )
    figures["first_1e9_ms_extrapolated"] = 1e9 / max_rows * figures["first_100m_ms"]
    figures["whole_1e9_cpu_s_extrapolated"] = 1e9 / max_rows * figures["whole_100m_cpu_s"]
    return figures


def median_seconds(ask: Callable[[], Any], times: int) -> float:
    """Return the median wall time (s) of `times` calls of the function `ask`."""
    seconds = []
    for _ in range(times):
        started = time.perf_counter()
        ask()
        seconds.append(time.perf_counter() - started)
    return median(seconds)


class PageClient:
    """HTTP connection to the server of the page on a port of this machine, with the cookie that gives access."""

    def __init__(self, port: int) -> None:
        self.connection, self.cookie = http.client.HTTPConnection("127.0.0.1", port), f"truesky-{port}={TOKEN}"

    def send(self, method: str, path: str, body: str | None = None) -> http.client.HTTPResponse:
        """Send an HTTP request, and return the response, whose body must be read before the next request.

        Parameters
        ----------
        method, path : str
            Method (such as GET) and path of the request.
        body : str, optional
            Body of the request; by default it is empty.

        Returns
        -------
        http.client.HTTPResponse
            The response.
        """
        self.connection.request(method, path, body, {"Cookie": self.cookie})
        return self.connection.getresponse()

    def milliseconds(self, times: int, method: str, path: str, body: str | None = None) -> float:
        """Return the median wall time of several equal HTTP requests, until the response has been read.

        Parameters
        ----------
        times : int
            Number of requests.
        method, path : str
            Method (such as GET) and path of the request.
        body : str, optional
            Body of the request; by default it is empty.

        Returns
        -------
        float
            Median time in milliseconds.
        """
        return 1e3 * median_seconds(lambda: self.send(method, path, body).read(), times)


def make_lake(lake: Path, rows: int, side: int) -> None:
    """Make a lake with a catalogue of random values (table `trial`) and an image of noise.

    Parameters
    ----------
    lake : Path
        Folder of the lake, which must not exist.
    rows : int
        Approximate number of rows of the catalogue. They are divided among at least two HEALPix cells of order 5, with
        about a million rows each in large catalogues.
    side : int
        Width and height of the image in pixels.
    """
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
    """Measure the response times of a server of the page over HTTP and, if one is installed, in a browser.

    Parameters
    ----------
    lake : Path
        Folder of the lake to make, which must not exist.
    rows, downloaded : int
        Number of rows of the catalogue, and number of rows to download.
    side : int
        Width and height of the image in pixels.
    repeats : int
        Factor of the numbers of repeats: most HTTP requests are sent 20 times as often.

    Returns
    -------
    dict of str to float
        Measured values by name; a name ends with the unit of the value, such as `_s` or `_gb`.
    """
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
                print(f"page: the browser is not measured: {missing}")
            else:
                figures |= _browser.time_brushes(address, 20 * repeats)
            # Use a new connection: the server has closed the first one, because it was idle during the measurements
            # in the browser.
            figures |= measure_downloads(PageClient(port), f"/api/{key}", server.pid, downloaded)
        finally:
            server.terminate()
    if not _browser.missing_requirement():
        figures["first_sky_browser_s"] = _browser.time_first_sky(command)
    return figures


def first_answer_seconds(client: PageClient, lake: str, part: int) -> float:
    """Return the wall time of a request for charts of four columns that the server must first read from the table.

    Parameters
    ----------
    client : PageClient
        Connection to the server.
    lake : str
        Beginning of the HTTP paths of the lake, "/api/<key>".
    part : int
        1 to count all rows, or 64 (SUBSAMPLING) to count one row in 64.

    Returns
    -------
    float
        Time in seconds.
    """
    question = {**QUESTION, "source": "trial", "axes": ["ra", "dec", "x_0", "x_1"], "limits": [], "part": part}
    question["charts"] = [{**chart, "spans": None} for chart in QUESTION["charts"]]
    started = time.perf_counter()
    answer = client.send("POST", f"{lake}/charts", json.dumps(question))
    answer.read()
    assert answer.status == 200
    return time.perf_counter() - started


def measure_large_lake(lake: Path, rows: int, repeats: int) -> dict[str, float]:
    """Measure response times for a large table: the first charts of a sample, and searches in a circle on the sky.

    Parameters
    ----------
    lake : Path
        Folder of the lake to make, which must not exist.
    rows : int
        Number of rows of the table.
    repeats : int
        A third of the number of searches.

    Returns
    -------
    dict of str to float
        Measured values by name; a name ends with the unit of the value, such as `_s` or `_gb`.
    """
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
    """Time the frequent HTTP requests of the page: a small SQL query, the first sky map, and tiles of an image.

    Parameters
    ----------
    client : PageClient
        Connection to the server.
    lake : str
        Beginning of the HTTP paths of the lake, "/api/<key>".
    side : int
        Width and height of the image in pixels, at least 512.
    times : int
        Number of requests for the query and for the map. Each tile is requested once.

    Returns
    -------
    dict of str to float
        Median times in milliseconds, and the time of the first tile.
    """
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
    """Measure the speed of large downloads, and the additional memory of the server and its query processes.

    Parameters
    ----------
    client : PageClient
        Connection to the server.
    lake : str
        Beginning of the HTTP paths of the lake, "/api/<key>".
    server : int
        Process identifier of the server.
    rows : int
        Number of rows to download.

    Returns
    -------
    dict of str to float
        Speed in MB/s for each file format, and `download_mb`, the largest additional memory in MB.
    """
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
    """Return the resident memory (bytes) of a process and all its descendants together."""
    process = psutil.Process(pid)
    return sum(family_member.memory_info().rss for family_member in (process, *process.children(recursive=True)))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    options = report.options("page", __doc__ or "", argv)
    rows, many_rows, max_rows = (
        (QUICK_ROWS, QUICK_MANY_ROWS, QUICK_MAX_ROWS) if options.quick else (ROWS, MANY_ROWS, MAX_ROWS)
    )
    downloaded, side = (QUICK_DOWNLOADED_ROWS, QUICK_SIDE) if options.quick else (DOWNLOADED_ROWS, SIDE)
    repeats = 1 if options.quick else 3
    figures = time_counting(rows, many_rows, max_rows, repeats)
    with tempfile.TemporaryDirectory() as folder:
        # Use an empty cache folder of truesky, so that first requests are not answered from it.
        os.environ["TRUESKY_CACHE"] = f"{folder}/cache"
        figures |= measure_server(Path(folder) / "lake", rows, downloaded, side, repeats)
        figures |= measure_large_lake(
            Path(folder) / "large", QUICK_LARGE_LAKE_ROWS if options.quick else LARGE_LAKE_ROWS, repeats
        )
    report.print_and_write("page", repeats, figures, NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
