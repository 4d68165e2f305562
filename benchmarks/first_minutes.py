"""Measure what a new user waits for: the first picture, the first catalogue and the answers of short commands.

All times are wall times of commands in separate processes, so they are comparable only on an idle machine. Each run
is compared with the forecast that `truesky check` made directly before it.
"""

from __future__ import annotations

import contextlib
import json
import os
import pty
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks import report

ROOT = Path(__file__).resolve().parents[1]
# A catalogue of 1 deg2 with five bands, whose targets are 90 s with an empty cache and 40 s with a full one.
_ONE_DEGREE = """\
name = "one_degree"
seed = 5
area = { cone = { ra = 150.1, dec = 2.2, radius = 0.5642 } }
universe = { galaxy_limit = 25.0 }
fluxes = { bands = ["euclid_vis", "euclid_y", "euclid_j", "euclid_h", "lsst_r"] }
"""
# A request for tests, without images.
_SMALL = """\
name = "small"
seed = 5
area = { cone = { ra = 150.1, dec = 2.2, radius = 0.02 } }
universe = { galaxy_limit = 20.0, star_limit = 18.0, box_cells = 192, lensing_nside = 64 }
fluxes = { bands = ["euclid_vis"] }
"""
# Shipped requests that run in minutes.
_REQUESTS = ("demo", "field", "nisp_calibration", "nisp_spectra", "slitless", "vis_calibration")
_REPEATS = 3
_NOTES = {
    "help_s": "truesky --help (target 0.3)",
    "check_s": "truesky check requests/demo.toml, with its cost (target 1.5)",
    "count_s": "truesky sql, number of galaxies (target 1)",
    "demo_warm_s": "requests/demo.toml in a new lake with a full cache (target 40)",
    "one_degree_cold_s": "catalogue of 1 deg2 to 25 mag with five bands, empty cache (target 90)",
    "one_degree_warm_s": "the same with a full cache (target 40)",
    "longest_silence_s": "longest time without output on a terminal, of all runs (target 10)",
    "worst_time": "largest of |time / forecast - 1| (target 0.3)",
    "worst_bytes": "largest of |bytes / forecast - 1| of lakes and caches (target 0.2)",
}


@dataclass(frozen=True, slots=True)
class Run:
    """A run of a request, and its forecast.

    Attributes
    ----------
    wall_s, forecast_s : float
        Wall time in s.
    lake_bytes, forecast_lake : float
        Size of the lake without pictures.
    cache_bytes, forecast_cache : float
        Size of the entries that the run added to the cache.
    silence_s : float
        Longest time in s without output on a terminal.
    """

    wall_s: float
    forecast_s: float
    lake_bytes: float
    forecast_lake: float
    cache_bytes: float
    forecast_cache: float
    silence_s: float


def measure_run(request: Path, lake: Path, cache: Path) -> Run:
    """Forecast and run a request in a new lake, with a cache folder that the run fills."""
    environment = _environment(cache)
    command = [sys.executable, "-m", "truesky.commands"]
    checked = subprocess.run(
        [*command, "check", str(request), "--json"], env=environment, capture_output=True, text=True
    )
    if checked.returncode:
        raise SystemExit(checked.stderr)
    cost = json.loads(checked.stdout)["cost"]
    cached = _folder_bytes(cache)
    started = time.perf_counter()
    silence = max(_silences([*command, "run", str(request), str(lake)], environment))
    wall = time.perf_counter() - started
    lake_bytes = _folder_bytes(lake) - _folder_bytes(lake / "pictures")
    return Run(
        wall,
        cost["wall_s"],
        lake_bytes,
        cost["lake_bytes"],
        _folder_bytes(cache) - cached,
        cost["cache_bytes"],
        silence,
    )


def _silences(command: Sequence[str], environment: dict[str, str]) -> Iterator[float]:
    """Run a command on a pseudo-terminal, and yield the times in s between pieces of output."""
    terminal, end = pty.openpty()
    output, last = bytearray(), time.perf_counter()
    with subprocess.Popen(command, env=environment, stdin=end, stdout=end, stderr=end) as process:
        os.close(end)
        # Reading from a pseudo-terminal whose other end is closed is an error on Linux.
        with contextlib.suppress(OSError):
            while piece := os.read(terminal, 65536):
                output += piece
                now = time.perf_counter()
                yield now - last
                last = now
    os.close(terminal)
    if process.returncode:
        raise SystemExit(output.decode(errors="replace"))
    yield time.perf_counter() - last


def _folder_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _command_s(words: Sequence[str], cache: Path, repeats: int) -> float:
    """Return the shortest wall time in s of several calls of a truesky command with a cache folder."""
    command, environment = [sys.executable, "-m", "truesky.commands", *words], _environment(cache)
    return report.best_time(lambda: subprocess.run(command, env=environment, check=True, capture_output=True), repeats)


def _environment(cache: Path) -> dict[str, str]:
    return {**os.environ, "TRUESKY_CACHE": str(cache)}


def measure(requests: Sequence[Path], folder: Path, repeats: int) -> dict[str, float]:
    """Run requests with an empty and a full cache, and return wall times and the errors of forecasts.

    Parameters
    ----------
    requests : sequence of Path
        Requests; each gets an empty cache.
    folder : Path
        Folder for lakes and caches.
    repeats : int
        Number of repeats of short commands. Each request runs once per state of the cache.

    Returns
    -------
    dict of str to float
        For each request and state of the cache (cold, warm) the wall time in s, and the times and sizes relative to
        their forecasts; the largest errors of forecasts; and the times of short commands.
    """
    figures: dict[str, float] = {}
    time_errors, byte_errors, silences = [], [], []
    for request in requests:
        cache = folder / f"cache_{request.stem}"
        cache.mkdir()
        for state in ("cold", "warm"):
            lake = folder / f"{request.stem}_{state}"
            run = measure_run(request, lake, cache)
            name = f"{request.stem}_{state}"
            figures[f"{name}_s"] = run.wall_s
            figures[f"{name}_time_ratio"] = run.wall_s / run.forecast_s
            figures[f"{name}_lake_ratio"] = run.lake_bytes / run.forecast_lake
            if run.forecast_cache > 0.0:
                figures[f"{name}_cache_ratio"] = run.cache_bytes / run.forecast_cache
            silences.append(run.silence_s)
            time_errors.append(abs(run.wall_s / run.forecast_s - 1.0))
            byte_errors.append(abs((run.lake_bytes + run.cache_bytes) / (run.forecast_lake + run.forecast_cache) - 1.0))
            print(name, run, file=sys.stderr, flush=True)
            if request is not requests[-1] or state == "cold":
                shutil.rmtree(lake)
        if request is not requests[-1]:
            shutil.rmtree(cache)
    figures["longest_silence_s"] = max(silences)
    figures["worst_time"], figures["worst_bytes"] = max(time_errors), max(byte_errors)
    commands = {
        "help": ("--help",),
        "check": ("check", str(ROOT / "requests" / "demo.toml")),
        "count": ("sql", str(lake), "SELECT count(*) FROM galaxies"),
    }
    for name, words in commands.items():
        # Without this call, the first repeat would fill the cache.
        _command_s(words, cache, 1)
        figures[f"{name}_s"] = _command_s(words, cache, repeats)
    return figures


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    options = report.options("first_minutes", __doc__ or "", argv)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        catalogue = folder / ("small.toml" if options.quick else "one_degree.toml")
        catalogue.write_text(_SMALL if options.quick else _ONE_DEGREE, encoding="utf-8")
        requests = [] if options.quick else [ROOT / "requests" / f"{name}.toml" for name in _REQUESTS]
        repeats = 1 if options.quick else _REPEATS
        figures = measure([*requests, catalogue], folder, repeats)
    report.print_and_write("first_minutes", repeats, figures, _NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
