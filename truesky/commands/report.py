"""What the runs of a lake took: python -m truesky.commands.report LAKE [--json], or truesky report LAKE.

rows    a line a job and one of all: runs, parts, failures, rows, seconds, GB, beside the forecast
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from lake_schema import __version__, command
from lake_schema.errors import BadInput, LakeError
from lake_schema.store import layout, names, read
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.store.provenance import canonical
from truesky.render.forecasting import catalogue_forecast, speed
from truesky.render.planning.parts import of_exposures
from truesky.render.products import run_log

_ABOUT = (
    "seconds are of the clock, CPU s of all cores; failed are parts that could not be made and runs that ended badly, "
    "stopped are runs that say of no end; the forecast is of what the lake holds now, of all its requests, made once"
)


@dataclass(slots=True)
class Line:
    """One job of a lake, all its runs together.

    failed, failed_runs : parts that could not be made;  runs that ended for whatever else
    stopped             : runs whose log has no end: killed, or still at work
    seconds, cpu_s      : of the runs' clocks;  of the processors, for the parts and for what came before them
    gb                  : written; nan = a run did not say
    peak_gb             : largest memory of a part
    forecast_s, forecast_gb : CPU s and GB of what the lake holds, nan = no forecast
    """

    job: str
    runs: int = 0
    failed_runs: int = 0
    stopped: int = 0
    parts: int = 0
    failed: int = 0
    rows: int = 0
    seconds: float = 0.0
    cpu_s: float = 0.0
    forecast_s: float = math.nan
    gb: float = 0.0
    forecast_gb: float = math.nan
    peak_gb: float = 0.0


def rows(root: Folder) -> list[Line]:
    """By job, in the order of their first runs; the last line is of all.

    Errors : BadInput where nothing has run;  Damaged names a log's line that no run writes
    """
    found: dict[str, Line] = {}
    # Of each process the tables that it has made so far: a job writes a log a table.
    tables: dict[tuple[str, str], set[str]] = {}
    for path in run_log.of_lake(root):
        if lines := run_log.lines(path):
            job, table = (str(lines[0].get(name, path.stem)) for name in ("job", "table"))
            line, before = found.setdefault(job, Line(job)), tables.setdefault((job, path.stem.split("-")[-1]), set())
            if not before or table in before:
                line.runs += 1
                before.clear()
            before.add(table)
            _add(line, lines)
    if not found:
        raise BadInput(f"lake {root}: no run has left a log there")
    foreseen = _forecast(root, speed.of_machine(root).factor)
    made = [
        replace(line, forecast_s=foreseen[job][0], forecast_gb=foreseen[job][1]) if job in foreseen else line
        for job, line in found.items()
    ]
    return [*made, _all(made)]


def _forecast(root: Folder, factor: float) -> dict[str, tuple[float, float]]:
    """CPU seconds and GB of what the lake holds, made once, by the job that makes it."""
    jobs = {line.job: (line.seconds, line.gb) for line in catalogue_forecast.of_lake(root, factor)}
    # By what shapes their bytes: what two requests share is rendered once.
    own: dict[bytes, dict[str, Any]] = {}
    try:
        requests: list[str | None] = [*names.names(root)]
        for name in requests or [None]:
            products = (
                read.published_last(root, "products") if name is None else read.for_request(root, "products", name)
            )
            made = [part["facts"] for part in products.manifest["parts"]]
            tasks = read.version(root, "tasks", products.manifest["facts"]["inputs"]["tasks"])
            columns, numbers = ("exposure_id", "detector", "seconds", "bytes"), {facts["exposure_id"] for facts in made}
            some = of_exposures(tasks, numbers, columns).to_pylist()
            planned = {(task["exposure_id"], task["detector"]): task for task in some}
            for facts in made:
                own.setdefault(canonical(facts), planned[facts["exposure_id"], facts["detector"]])
    except (LakeError, KeyError):
        return jobs
    seconds, size = (sum(task[name] for task in own.values()) for name in ("seconds", "bytes"))
    return {**jobs, "render_exposures": (factor * seconds, size / 1e9)}


def _add(line: Line, lines: Sequence[run_log.Json]) -> None:
    first, last = lines[0], lines[-1]
    parts = [one for one in lines if "part" in one]
    made = [one for one in parts if "error" not in one]
    line.stopped += "status" not in last
    line.failed_runs += last.get("status") == "failed"
    line.parts += len(made)
    line.failed += len(parts) - len(made)
    line.rows += sum(one.get("rows", 0) for one in made)
    line.seconds += first.get("prepare_s", 0.0) + (last["seconds"] if "status" in last else 0.0)
    line.cpu_s += first.get("prepare_cpu_s", 0.0) + sum(one.get("cpu_s", 0.0) for one in parts)
    line.gb += sum(one.get("bytes", math.nan) for one in made) / 1e9
    line.peak_gb = max([line.peak_gb, *(one.get("peak_gb", 0.0) for one in parts)])


def _all(lines: Sequence[Line]) -> Line:
    total = Line("all", peak_gb=max(line.peak_gb for line in lines))
    for name in ("runs", "failed_runs", "stopped", "parts", "failed", "rows", "seconds", "cpu_s", "gb"):
        setattr(total, name, sum(getattr(line, name) for line in lines))
    for name in ("forecast_s", "forecast_gb"):
        known = [value for line in lines if math.isfinite(value := getattr(line, name))]
        setattr(total, name, sum(known) if known else math.nan)
    return total


def text(lines: Sequence[Line]) -> Iterator[str]:
    """The report as lines of a table."""
    yield (
        f"{'job':20} {'runs':>5} {'failed':>7} {'stopped':>8} {'parts':>8} {'failed':>7} {'rows':>13} {'seconds':>10} "
        f"{'CPU s':>10} {'forecast':>10} {'GB':>9} {'forecast':>9} {'peak GB':>8}"
    )
    for one in lines:
        yield (
            f"{one.job:20} {one.runs:5,} {one.failed_runs:7,} {one.stopped:8,} {one.parts:8,} {one.failed:7,} "
            f"{one.rows:13,} {one.seconds:10,.1f} {one.cpu_s:10,.1f} {_known(one.forecast_s, 10, 1)} "
            f"{_known(one.gb, 9, 3)} {_known(one.forecast_gb, 9, 3)} {one.peak_gb:8.2f}"
        )


def _known(value: float, width: int, digits: int) -> str:
    return f"{value:{width},.{digits}f}" if math.isfinite(value) else f"{'-':>{width}}"


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0, 1 a log is damaged, 2 there is no log."""
    parser = argparse.ArgumentParser(prog="truesky report", description=_ABOUT, epilog=f"truesky {__version__}")
    parser.add_argument("lake", help="folder of the lake")
    parser.add_argument("--json", action="store_true", help="one JSON object a line, null where a number is not known")
    options = parser.parse_args(argv)

    def reported() -> int:
        lines = rows(layout.lake(options.lake))
        for line in map(_json, lines) if options.json else text(lines):
            print(line)
        return 0

    return command.status("report", reported)


def _json(line: Line) -> str:
    values = asdict(line).items()
    return json.dumps({k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values})


if __name__ == "__main__":
    command.leave(main)
