"""The report of the runs of a lake: sums, unknown values, errors."""

import json

import pytest

from lake_schema.errors import BadInput, Damaged, TasksFailed
from lake_schema.store import layout, publish
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.products import PRODUCTS
from lake_schema.tables.tasks import TASKS
from tests import requests
from tests.universe import plain_plan, plain_work, rows_of
from truesky.commands import report
from truesky.render.forecasting import request_cost, speed
from truesky.request.from_toml import parse
from truesky.running.submitted_job import Job, Step
from truesky.running.submitted_job import run as run_job


def log(root, name, *lines):
    (folder := layout.runs_folder(root)).mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def part(name, **about):
    return {"job": "draw", "part": name, "seconds": 2.0, "cpu_s": 1.5, "peak_gb": 0.5, **about}


def test_runs_add_up(lake):
    first = {"job": "draw", "table": "x", "prepare_s": 3.0, "prepare_cpu_s": 2.0}
    log(
        lake,
        "1-x-1",
        first,
        part("a", rows=10, bytes=2 * 10**9),
        part("b", error="no"),
        {"seconds": 5.0, "status": "failed"},
    )
    log(lake, "2-x-1", first, part("b", rows=5, bytes=10**9, peak_gb=0.75), {"seconds": 4.0, "status": "done"})
    log(lake, "3-y-1", {"job": "other"}, part("c", rows=1))
    one, other, total = report.job_totals(lake)
    assert (one.job, one.runs, one.failed_runs, one.stopped, one.parts, one.failed) == ("draw", 2, 1, 0, 2, 1)
    assert (one.rows, one.seconds, one.cpu_s, one.gb, one.peak_gb) == (15, 15.0, 8.5, 3.0, 0.75)
    assert (other.job, other.stopped, other.parts, other.seconds) == ("other", 1, 1, 0.0)
    assert (total.job, total.runs, total.parts, total.rows, total.peak_gb) == ("all", 3, 3, 16, 0.75)


def test_a_run_makes_several_tables(lake):
    """Each table has a log, whose name ends in the number of the process. This number may repeat."""
    for name in ("1-x-7", "2-y-7", "3-x-8", "4-x-7"):
        log(lake, name, {"job": "draw", "table": name[2]}, part("a", rows=1), {"seconds": 1.0, "status": "done"})
    assert (report.job_totals(lake)[0].runs, report.job_totals(lake)[0].parts) == (3, 4)


def test_unknown_values_are_marked(lake, capsys):
    log(lake, "1-x-1", {"job": "draw"}, part("a", rows=10), {"seconds": 5.0, "status": "done"})
    assert report.main([str(lake)]) == 0
    head, line, total, *notes = capsys.readouterr().out.splitlines()
    assert len({len(head), len(line), len(total)}) == 1
    assert all(";" in note for note in notes)
    assert line.split()[-4:] == ["-", "-", "-", "0.50"]
    assert report.main([str(lake), "--json"]) == 0
    first, _ = json.loads(capsys.readouterr().out)
    assert (first["job"], first["rows"], first["gb"], first["forecast_s"]) == ("draw", 10, None, None)


def test_the_log_of_a_job_is_read(tmp_path):
    """The log of a real job has every task, its size, and the time before the first task."""
    root, request = tmp_path / "lake", requests.written(tmp_path)
    plan = plain_plan(1, parts=3)
    job = Job("toy", "", lambda lake, request: [Step(plan, plain_work, on_driver=True)])
    run_job(job, root, parse(request))
    line, _ = report.job_totals(root)
    version = layout.version_folder(root, plan.table.name, plan.key)
    size = sum(path.stat().st_size for path in (version / "dataset").iterdir())
    assert (line.job, line.runs, line.parts, line.failed) == ("toy", 1, 3, 0)
    assert line.gb * 1e9 == pytest.approx(size)
    assert line.seconds > 0.0

    def fails(lake, facts):
        raise BadInput("no")

    other = Job("toy", "", lambda lake, request: [Step(plain_plan(2, parts=3), fails, on_driver=True)])
    with pytest.raises(TasksFailed):
        run_job(other, root, parse(request))
    line, _ = report.job_totals(root)
    assert (line.runs, line.failed_runs, line.parts, line.failed) == (2, 1, 3, 3)


def rendered(lake, name, detectors):
    """Publish products and tasks for some detectors of exposure 0, each with (name, digest of its facts)."""
    n = len(detectors)
    columns = {key: rows_of(TASKS, n)[key] for key in TASKS.names}
    columns |= {"exposure_id": [0] * n, "detector": [detector for detector, _ in detectors]}
    tasks = TASKS.build({**columns, "seconds": [10.0] * n, "bytes": [10**9] * n})
    planned = Plan(TASKS, {"of": name}, (Task("all.parquet", {}),))
    publish.make_version(lake, planned, lambda root, facts: Output(tasks), name=name)
    parts = (Task(f"{d}.parquet", {"exposure_id": 0, "detector": d, "product": shape}) for d, shape in detectors)
    plan = Plan(PRODUCTS, {"inputs": {"tasks": planned.key}}, tuple(parts))
    publish.make_version(lake, plan, lambda root, facts: Output(PRODUCTS.empty()), name=name)


def test_the_forecast_is_of_all_requests(lake):
    """A detector that two requests share is rendered once."""
    log(lake, "1-products-1", {"job": "render_exposures"}, part("a", rows=1), {"seconds": 5.0, "status": "done"})
    rendered(lake, "a", [("3-4", "x"), ("3-5", "y")])
    factor = speed.estimate_speed(lake).factor

    def expected(detectors):
        cost = request_cost.render_job(detectors, 10.0 * detectors, 1e9 * detectors, factor)
        return pytest.approx((cost.cpu_s, cost.bytes / 1e9))

    line, _ = report.job_totals(lake)
    assert (line.forecast_s, line.forecast_gb) == expected(2)
    rendered(lake, "b", [("3-4", "x"), ("3-5", "z")])
    line, total = report.job_totals(lake)
    assert (line.forecast_s, line.forecast_gb) == expected(3)
    assert (total.forecast_s, total.forecast_gb) == expected(3)


def test_a_lake_without_logs_and_a_damaged_log_are_refused(lake, capsys):
    assert report.main([str(lake)]) == 2
    assert "is not a lake, because it has no tables" in capsys.readouterr().err
    assert report.main([str(lake / "none")]) == 2
    assert "none does not exist; make it with truesky run" in capsys.readouterr().err
    log(lake, "1-x-1", {"job": "draw"}, part("a", rows="ten"), {"status": "done"})
    with pytest.raises(Damaged, match="line 2 is not a valid log line"):
        report.job_totals(lake)
