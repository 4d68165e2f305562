"""Report time, memory and size of all runs of a lake (the folder of a simulation), compared with the forecast.

Usage: truesky report LAKE [--json].

The report is a table with one line per job (such as "build_stars") and a last line with the totals.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from lake_schema import command
from lake_schema.errors import BadInput, LakeError
from lake_schema.store import layout, read, request_links
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.store.provenance import canonical
from lake_schema.texts import text_tables
from truesky.command_line import commands
from truesky.render.forecasting import catalogue_forecast, request_cost, speed
from truesky.render.planning.exposure_chunks import rows_of_exposures
from truesky.render.products import run_log

_HEADINGS = (
    "job", "runs", "failed runs", "stopped runs", "parts", "failed parts", "rows", "seconds", "CPU s", "forecast CPU s",
    "GB", "forecast GB", "peak GB",
)  # fmt: skip
_NOTES = (
    "stopped runs: their log has no end, because they were killed or are still running; parts: tasks, each makes one "
    "file;\nseconds: wall time; forecast: to make the present content of the lake once, for all its requests, with a "
    "warm cache"
)


@dataclass(slots=True)
class JobTotals:
    """Totals of all runs of one job in a lake. A job makes tables; each of its tasks makes one file of a table.

    Attributes
    ----------
    job : str
        Name of the job, or "all" for the sum of all jobs.
    runs : int
        Number of runs. A run of a job that makes several tables counts once.
    failed_runs : int
        Number of runs that ended with an error.
    stopped : int
        Number of runs whose log has no end: they were killed or are still running.
    parts : int
        Number of tasks that succeeded.
    failed : int
        Number of tasks that failed, added over all runs. Failed attempts that Spark repeated within a run are not
        included.
    rows : int
        Number of rows written.
    seconds : float
        Wall time of the runs, in seconds. If the log of a run has no end, only the time of preparation is included.
    cpu_s : float
        CPU time of the tasks and of the preparation of the runs, in seconds.
    forecast_s : float
        Forecast of the CPU time for the present content of the lake, in seconds; nan if there is no forecast.
    gb : float
        Size of the files written, in GB; nan if a log does not contain it.
    forecast_gb : float
        Forecast of the size of the present content of the lake, in GB; nan if there is no forecast.
    peak_gb : float
        Largest peak memory of a task, in GB.
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
    """Return the totals of each job, in the order of their first runs, and then the sum of all jobs.

    Parameters
    ----------
    root : Folder
        Folder of the lake.

    Returns
    -------
    list of JobTotals
        One entry per job; the last one is the sum.

    Raises
    ------
    BadInput
        If the lake has no log of a run.
    Damaged
        If a line of a log is invalid. The message names the line.
    """
    totals_by_job: dict[str, JobTotals] = {}
    # Tables of the current run, by job and process number. A job writes one log per table. If a process writes another
    # log for the same table, a new run has begun.
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
        if not read.table_names(root):
            raise layout.missing_table(root)
        raise BadInput(f"lake {root} has no log of a run, because no job has run in this folder")
    forecasts = _forecast(root, speed.estimate_speed(root).factor)
    job_lines = [
        replace(line, forecast_s=forecasts[job][0], forecast_gb=forecasts[job][1]) if job in forecasts else line
        for job, line in totals_by_job.items()
    ]
    return [*job_lines, _sum_jobs(job_lines)]


def _forecast(root: Folder, factor: float) -> dict[str, tuple[float, float]]:
    """Return the forecast CPU time (s) and size (GB) of making the present content of the lake once, by job.

    `factor` is the CPU time of this machine relative to the machine on which the costs were measured. The images are
    left out if their plans are missing or unreadable.
    """
    jobs = {line.job: (line.seconds, line.gb) for line in catalogue_forecast.for_lake(root, factor)}
    # Count an image that several requests share only once. Two requests share an image if all facts (JSON values) that
    # determine its bytes are equal.
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
    rendering = request_cost.render_job(len(tasks_by_facts), seconds, size, factor)
    return {**jobs, rendering.job: (rendering.cpu_s, rendering.bytes / 1e9)}


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


def text(totals: Sequence[JobTotals]) -> list[str]:
    """Return the lines of the report as text: a header, then one line per entry; "-" means that a value is unknown."""
    rows = [
        (
            line.job, f"{line.runs:,}", f"{line.failed_runs:,}", f"{line.stopped:,}", f"{line.parts:,}",
            f"{line.failed:,}", f"{line.rows:,}", f"{line.seconds:,.1f}", f"{line.cpu_s:,.1f}",
            _format_number(line.forecast_s, 1), _format_number(line.gb, 3), _format_number(line.forecast_gb, 3),
            f"{line.peak_gb:.2f}",
        )
        for line in totals
    ]  # fmt: skip
    return text_tables.format_table(_HEADINGS, rows, _HEADINGS[1:])


def _format_number(value: float, digits: int) -> str:
    return f"{value:,.{digits}f}" if math.isfinite(value) else "-"


def main(argv: Sequence[str] | None = None) -> int:
    """Print the report of the lake in the arguments (by default sys.argv), and return the exit status.

    It is 0, 1 if a log is damaged, or 2 if there is no log or no such lake. Wrong options end the process with
    status 2.
    """
    return commands.run("report", run_command, argv)


def run_command(options: argparse.Namespace) -> int:
    """Print the report of the lake in the parsed arguments of `truesky report`, and return 0.

    BadInput is raised if there is no log or no such lake, and Damaged if a log is damaged.
    """
    totals = job_totals(layout.resolve_lake(options.lake))
    if options.json:
        text_tables.print_json([asdict(line) for line in totals])
    else:
        for line in text(totals):
            print(line)
        print(_NOTES)
    return 0


if __name__ == "__main__":
    command.exit_with_status(main)
