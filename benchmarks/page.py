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
from benchmarks.lake import plan, work
from lake_schema.fits import images
from lake_schema.store import publish
from lake_schema.store.plan import Output, Part, Plan
from lake_schema.tables.products import PRODUCTS
from truesky.explore.counting import Chart, Held, counted, held
from truesky.page.charts import PART, answered

ROWS, MANY_ROWS, MOST_ROWS, DOWNLOADED, LARGE = 1_000_000, 50_000_000, 100_000_000, 10_000_000, 10_000_000
QUICK_ROWS, QUICK_MANY, QUICK_MOST, QUICK_DOWNLOADED, QUICK_LARGE = 100_000, 500_000, 1_000_000, 200_000, 200_000
CELLS, SIDE, QUICK_SIDE = 2, 4096, 1024
FORMS = ("csv", "parquet", "vot", "fits")
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
    figures["held_50m_cpu_s"] = report.best(lambda: held(half), 1, time.process_time)

    def answer(kept: Held, part: int = 1) -> Callable[[], bytes]:
        return lambda: answered(kept, QUESTION, part, threads)

    figures["brush_50m_cpu_ms"] = 1e3 * report.best(answer(held(half)), repeats, time.process_time)
    # Rows that are shown first are kept as columns of their own.
    some = held([column[::PART].copy() for column in lots])
    figures["first_100m_ms"] = 1e3 * typical(answer(some, PART), 5 * repeats)
    figures["whole_100m_cpu_s"] = report.best(answer(held(lots)), repeats, time.process_time)
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
    """A catalogue of cells of at most 1 M rows, and an image."""
    lake.mkdir()
    cells = max(CELLS, rows // ROWS)
    publish.make(lake, plan(cells, rows // cells), work)
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
    command = [sys.executable, "-m", "truesky.page", str(lake), "--no-open", "--token", TOKEN]
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
            figures["fill_1m_s"] = filled(asker, f"/api/{key}", 1)
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


def filled(asker: Asker, lake: str, part: int) -> float:
    """s of the first answer of four columns of a lake of which nothing is kept."""
    question = {**QUESTION, "source": "trial", "axes": ["ra", "dec", "x_0", "x_1"], "limits": [], "part": part}
    question["charts"] = [{**chart, "spans": None} for chart in QUESTION["charts"]]
    started = time.perf_counter()
    answer = asker.ask("POST", f"{lake}/charts", json.dumps(question))
    answer.read()
    assert answer.status == 200
    return time.perf_counter() - started


def large(lake: Path, rows: int, repeats: int) -> dict[str, float]:
    """A lake of many rows: the first answer of a sample, and a cone among them."""
    made_lake(lake, rows, QUICK_SIDE)
    command = [sys.executable, "-m", "truesky.page", str(lake), "--no-open", "--token", TOKEN]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            server.stdout.readline()
            service = server.stdout.readline().split()[-1]
            asker = Asker(int(service.partition("/tap/")[0].rpartition(":")[2]))
            about = json.loads(asker.ask("GET", "/api/lake").read())
            asker.ask("POST", f"/api/{about['key']}/sql", '{"sql": "SELECT count(*) FROM trial"}').read()
            sample = filled(asker, f"/api/{about['key']}", PART)
            question = '{"sql": "SELECT ra, dec FROM trial LIMIT 1 OFFSET 1000"}'
            ((ra, dec),) = json.loads(asker.ask("POST", f"/api/{about['key']}/sql", question).read())["rows"]
            times = []
            for condition in (
                f"CONTAINS(POINT(ra, dec), CIRCLE({ra}, {dec}, 0.01)) = 1", f"separation(ra, dec, {ra}, {dec}) <= 0.01"
            ):  # fmt: skip
                query = quote(f"SELECT id FROM trial WHERE {condition}")
                path = f"/tap/{service.partition('/tap/')[2]}/sync?LANG=ADQL&QUERY={query}"
                asker.ask("GET", path).read()
                times.append(asker.milliseconds(3 * repeats, "GET", path))
        finally:
            server.terminate()
    return {
        "fill_sample_10m_s": sample, "fill_sample_1e8_s_extrapolated": 1e8 / rows * sample,
        "cone_10m_ms": times[0], "cone_scan_10m_ms": times[1],
    }  # fmt: skip


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
        figures |= large(Path(folder) / "large", QUICK_LARGE if options.quick else LARGE, repeats)
    report.finish("page", repeats, figures, NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
