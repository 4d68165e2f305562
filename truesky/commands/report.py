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
from lake_schema.store import layout, read, request_links
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.store.provenance import canonical
from truesky.render.forecasting import catalogue_forecast, speed
from truesky.render.planning.exposure_chunks import rows_of_exposures
from truesky.render.products import run_log

_DESCRIPTION = (
    "seconds are of the clock, CPU s of all cores; failed are parts that could not be made and runs that ended badly, "
    "stopped are runs that say of no end; the forecast is of what the lake holds now, of all its requests, made once"
)


@dataclass(slots=True)
class JobTotals:
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


def job_totals(root: Folder) -> list[JobTotals]:
    """By job, in the order of their first runs; the last line is of all.

    Errors : BadInput where nothing has run;  Damaged names a log's line that no run writes
    """
    totals_by_job: dict[str, JobTotals] = {}
    # Of each process the tables that it has made so far: a job writes a log a table.
    tables_by_process: dict[tuple[str, str], set[str]] = {}
    for path in run_log.logs_of_lake(root):
        if lines := run_log.lines(path):
            job, table = (str(lines[0].get(name, path.stem)) for name in ("job", "table"))
            line, tables_in_run = (
                totals_by_job.setdefault(job, JobTotals(job)),
                tables_by_process.setdefault((job, path.stem.split("-")[-1]), set()),
            )
            if not tables_in_run or table in tables_in_run:
                line.runs += 1
                tables_in_run.clear()
            tables_in_run.add(table)
            _add_log(line, lines)
    if not totals_by_job:
        raise BadInput(f"lake {root}: no run has left a log there")
    forecasts = _forecast(root, speed.estimate_speed(root).factor)
    job_lines = [
        replace(line, forecast_s=forecasts[job][0], forecast_gb=forecasts[job][1]) if job in forecasts else line
        for job, line in totals_by_job.items()
    ]
    return [*job_lines, _sum_jobs(job_lines)]


def _forecast(root: Folder, factor: float) -> dict[str, tuple[float, float]]:
    """CPU seconds and GB of what the lake holds, made once, by the job that makes it."""
    jobs = {line.job: (line.seconds, line.gb) for line in catalogue_forecast.for_lake(root, factor)}
    # By what shapes their bytes: what two requests share is rendered once.
    tasks_by_facts: dict[bytes, dict[str, Any]] = {}
    try:
        requests: list[str | None] = [*request_links.request_names(root)]
        for name in requests or [None]:
            products = (
                read.latest_version(root, "products") if name is None else read.input_version(root, "products", name)
            )
            product_facts = [part["facts"] for part in products.manifest["parts"]]
            tasks = read.version(root, "tasks", products.manifest["facts"]["inputs"]["tasks"])
            columns, numbers = (
                ("exposure_id", "detector", "seconds", "bytes"),
                {facts["exposure_id"] for facts in product_facts},
            )
            task_rows = rows_of_exposures(tasks, numbers, columns).to_pylist()
            planned = {(task["exposure_id"], task["detector"]): task for task in task_rows}
            for facts in product_facts:
                tasks_by_facts.setdefault(canonical(facts), planned[facts["exposure_id"], facts["detector"]])
    except (LakeError, KeyError):
        return jobs
    seconds, size = (sum(task[name] for task in tasks_by_facts.values()) for name in ("seconds", "bytes"))
    return {**jobs, "render_exposures": (factor * seconds, size / 1e9)}


def _add_log(line: JobTotals, lines: Sequence[run_log.Json]) -> None:
    first_entry, last_entry = lines[0], lines[-1]
    task_entries = [entry for entry in lines if "part" in entry]
    done_tasks = [entry for entry in task_entries if "error" not in entry]
    line.stopped += "status" not in last_entry
    line.failed_runs += last_entry.get("status") == "failed"
    line.parts += len(done_tasks)
    line.failed += len(task_entries) - len(done_tasks)
    line.rows += sum(entry.get("rows", 0) for entry in done_tasks)
    line.seconds += first_entry.get("prepare_s", 0.0) + (last_entry["seconds"] if "status" in last_entry else 0.0)
    line.cpu_s += first_entry.get("prepare_cpu_s", 0.0) + sum(entry.get("cpu_s", 0.0) for entry in task_entries)
    line.gb += sum(entry.get("bytes", math.nan) for entry in done_tasks) / 1e9
    line.peak_gb = max([line.peak_gb, *(entry.get("peak_gb", 0.0) for entry in task_entries)])


def _sum_jobs(lines: Sequence[JobTotals]) -> JobTotals:
    total = JobTotals("all", peak_gb=max(line.peak_gb for line in lines))
    for name in ("runs", "failed_runs", "stopped", "parts", "failed", "rows", "seconds", "cpu_s", "gb"):
        setattr(total, name, sum(getattr(line, name) for line in lines))
    for name in ("forecast_s", "forecast_gb"):
        values = [value for line in lines if math.isfinite(value := getattr(line, name))]
        setattr(total, name, sum(values) if values else math.nan)
    return total


def text(totals: Sequence[JobTotals]) -> Iterator[str]:
    """The report as lines of a table."""
    yield (
        f"{'job':20} {'runs':>5} {'failed':>7} {'stopped':>8} {'parts':>8} {'failed':>7} {'rows':>13} {'seconds':>10} "
        f"{'CPU s':>10} {'forecast':>10} {'GB':>9} {'forecast':>9} {'peak GB':>8}"
    )
    for line in totals:
        yield (
            f"{line.job:20} {line.runs:5,} {line.failed_runs:7,} {line.stopped:8,} {line.parts:8,} {line.failed:7,} "
            f"{line.rows:13,} {line.seconds:10,.1f} {line.cpu_s:10,.1f} {_format_number(line.forecast_s, 10, 1)} "
            f"{_format_number(line.gb, 9, 3)} {_format_number(line.forecast_gb, 9, 3)} {line.peak_gb:8.2f}"
        )


def _format_number(value: float, width: int, digits: int) -> str:
    return f"{value:{width},.{digits}f}" if math.isfinite(value) else f"{'-':>{width}}"


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0, 1 a log is damaged, 2 there is no log."""
    parser = argparse.ArgumentParser(prog="truesky report", description=_DESCRIPTION, epilog=f"truesky {__version__}")
    parser.add_argument("lake", help="folder of the lake")
    parser.add_argument("--json", action="store_true", help="one JSON object a line, null where a number is not known")
    options = parser.parse_args(argv)

    def print_report() -> int:
        lines = job_totals(layout.resolve_lake(options.lake))
        for line in map(_json, lines) if options.json else text(lines):
            print(line)
        return 0

    return command.run("report", print_report)


def _json(line: JobTotals) -> str:
    values = asdict(line).items()
    return json.dumps({k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values})


if __name__ == "__main__":
    command.exit_with_status(main)
