"""Functions for all benchmarks: command-line options, a clock, and a report as table and as JSON."""

from __future__ import annotations

import argparse
import json
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
    """Parse the options of a benchmark.

    Parameters
    ----------
    name : str
        Name of the benchmark.
    doc : str
        Its module docstring; the first line is the description.
    argv : sequence of str, optional
        Arguments. The default is the command line.
    picture : bool, optional
        Add the option --picture.
    lake : str, optional
        Help text of the option --lake; without it there is no such option.

    Returns
    -------
    argparse.Namespace
        `quick`, `json`, and `picture` and `lake` if these options exist.
    """
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{name}", description=doc.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="do little work and one repeat, for tests")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to this file")
    if picture:
        parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the figures into this PNG file")
    if lake:
        parser.add_argument("--lake", type=Path, metavar="LAKE", help=lake)
    return parser.parse_args(argv)


def best_time(work: Callable[[], Any], repeats: int, clock: Callable[[], float] = time.perf_counter) -> float:
    """Return the shortest time of several calls of a function.

    Parameters
    ----------
    work : callable
        The function.
    repeats : int
        Number of calls.
    clock : callable, optional
        Clock in seconds. The default measures wall time.

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
    """Return the model of the processor and the number of cores."""
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
    """Print the figures with notes, and write them as a flat JSON object if a file is given.

    Parameters
    ----------
    name : str
        Name of the benchmark.
    repeats : int
        Number of repeats of each measurement.
    figures : mapping of str to float
        The figures.
    notes : mapping of str to str
        Descriptions of figures.
    file : Path or None
        JSON file to write.
    """
    header = {"name": name, "commit": git_commit(), "machine": machine(), "repeats": repeats}
    load = round(os.getloadavg()[0], 2)
    print(f"{name}: {header['machine']}, commit {header['commit'][:10]}, best of {repeats}, load average {load}")
    for key, value in figures.items():
        print(f"  {key:28} {value:14,.4g}   {notes.get(key, '')}")
    if file is not None:
        file.write_text(json.dumps({**header, "load_average": load, **figures}, indent=1) + "\n")
