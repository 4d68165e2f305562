"""What all benchmarks share: options, a clock, the table that a person reads and the JSON that a machine does."""

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
    """The options of a benchmark: quick, json; picture : whether it can draw one;  lake : what it does with one."""
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{name}", description=doc.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="little work and one repeat, for tests")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to this file")
    if picture:
        parser.add_argument("--picture", type=Path, metavar="FILE", help="draw them into this PNG")
    if lake:
        parser.add_argument("--lake", type=Path, metavar="LAKE", help=lake)
    return parser.parse_args(argv)


def best_time(work: Callable[[], Any], repeats: int, clock: Callable[[], float] = time.perf_counter) -> float:
    """Shortest time of several, s."""
    seconds = []
    for _ in range(repeats):
        started = clock()
        work()
        seconds.append(clock() - started)
    return min(seconds)


def machine() -> str:
    """Processor and number of cores."""
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
    """Print the figures, each with its note; write them as one flat JSON object where a file is given."""
    header = {"name": name, "commit": git_commit(), "machine": machine(), "repeats": repeats}
    load = round(os.getloadavg()[0], 2)
    print(f"{name}: {header['machine']}, commit {header['commit'][:10]}, best of {repeats}, load average {load}")
    for key, value in figures.items():
        print(f"  {key:28} {value:14,.4g}   {notes.get(key, '')}")
    if file is not None:
        file.write_text(json.dumps({**header, "load_average": load, **figures}, indent=1) + "\n")
