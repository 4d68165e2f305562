"""Functions that all benchmarks use: command-line options, measurement of times, and a report as table and as JSON."""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lake_schema.store.provenance import git_commit


def options(
    name: str, doc: str, argv: Sequence[str] | None = None, picture: bool = False, lake: str = ""
) -> argparse.Namespace:
    """Parse the command-line options of a benchmark.

    Parameters
    ----------
    name : str
        Name of the benchmark's module in the package `benchmarks`.
    doc : str
        Docstring of this module; its first line is the description of the command. It must not be empty.
    argv : sequence of str, optional
        Arguments. The default is the command line.
    picture : bool, optional
        If True, add the option --picture.
    lake : str, optional
        Help text of the option --lake. By default there is no such option.

    Returns
    -------
    argparse.Namespace
        `quick` (bool), `json` (Path or None) and, if these options exist, `picture` and `lake` (Path or None).

    Notes
    -----
    SystemExit is raised if an option is wrong, and for --help.
    """
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{name}", description=doc.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="do little work and one repeat, for tests")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to this file")
    if picture:
        parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the figures into this PNG file")
    if lake:
        parser.add_argument("--lake", type=Path, metavar="LAKE", help=lake)
    return parser.parse_args(argv)


def round_up(error: float) -> float:
    """Return a positive error with two digits, rounded up, because tables and headers state it as the largest error."""
    step = 10.0 ** (math.floor(math.log10(error)) - 1)
    return float(f"{math.ceil(error / step) * step:.2g}")


def best_time(work: Callable[[], Any], repeats: int, clock: Callable[[], float] = time.perf_counter) -> float:
    """Return the shortest time of several calls of a function.

    Parameters
    ----------
    work : callable
        Function without arguments.
    repeats : int
        Number of calls, at least 1.
    clock : callable, optional
        Function that returns a time in seconds. The default measures wall time; `time.process_time` measures CPU time.

    Returns
    -------
    float
        Shortest time in seconds.
    """
    seconds = []
    for _ in range(repeats):
        started = clock()
        work()
        seconds.append(clock() - started)
    return min(seconds)


def machine() -> str:
    """Return the model of the processor and the number of cores as text, such as "Intel Xeon ..., 2 cores"."""
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return f"{model}, {os.cpu_count()} cores"


def print_and_write(
    name: str, repeats: int, figures: Mapping[str, float], notes: Mapping[str, str], file: Path | None
) -> None:
    """Print the results of a benchmark as a table, and write them to a JSON file if one is given.

    Parameters
    ----------
    name : str
        Name of the benchmark.
    repeats : int
        Number of repeats of each measurement, for the heading.
    figures : mapping of str to float
        Measured values by name; a name ends with the unit of the value, such as `_s` or `_gb`.
    notes : mapping of str to str
        Descriptions of some of the values, by name.
    file : Path or None
        JSON file to write, one object with the commit, the machine and the values; None to write nothing.
    """
    header = {"name": name, "commit": git_commit(), "machine": machine(), "repeats": repeats}
    load = round(os.getloadavg()[0], 2)
    print(f"{name}: {header['machine']}, commit {header['commit'][:10]}, best of {repeats}, load average {load}")
    for key, value in figures.items():
        print(f"  {key:28} {value:14,.4g}   {notes.get(key, '')}")
    if file is not None:
        file.write_text(json.dumps({**header, "load_average": load, **figures}, indent=1) + "\n")
