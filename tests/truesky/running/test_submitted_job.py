"""The shell of a job, without Spark: statuses, lines, the log of a run."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from py4j.protocol import Py4JNetworkError

from lake_schema import __version__, instruction_set
from lake_schema.store import layout, locks, publish, read, request_links, stage
from lake_schema.store.plan import Plan, Task
from tests import requests
from tests.universe import PLAIN, plain_plan, plain_work
from truesky.running import submitted_job, task_chains
from truesky.running.submitted_job import Job, Step

ROOT = Path(__file__).resolve().parents[3]


def job_of(work, on_driver=True):
    return Job("toy_job", "Toy rows.", lambda lake, request: [Step(plain_plan(request.seed), work, on_driver)])


@pytest.fixture
def request_file(tmp_path):
    return requests.written(tmp_path, name="small", seed=2)


@pytest.fixture
def run(lake, request_file):
    def run_job(work, *options):
        return submitted_job.main(job_of(work), ["--lake", str(lake), "--request", str(request_file), *options])

    return run_job


def logs(lake):
    return [
        [json.loads(line) for line in path.read_text().splitlines()]
        for path in sorted(layout.runs_folder(lake).glob("*.jsonl"))
    ]


def test_a_run_is_logged(run, lake):
    assert run(plain_work) == 0
    ((first, *parts, last),) = logs(lake)
    assert first["truesky"] == __version__
    assert (first["job"], first["table"], first["request"], first["parts"]) == ("toy_job", "plain", "small", 3)
    assert first["key"] == read.version(lake, "plain").key
    assert {len(first["commit"]), len("unknown")} & {40, 7}
    assert [line["part"] for line in parts] == ["0.parquet", "1.parquet", "2.parquet"]
    for line in parts:
        assert line["rows"] == 20
        assert 0 <= line["seconds"] < 60
        assert 0.01 < line["peak_gb"] < 100
    assert last["seconds"] >= sum(line["seconds"] for line in parts)


def test_the_summary_says_what_was_made(run, capsys):
    assert run(plain_work) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert line.split()[:2] == ["plain", "60"]
    assert "3 of 3 parts made" in line
    assert run(None) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert "already there, 0 of 3 parts made" in line


def test_a_table_of_several_kinds_of_machine_is_named(run, lake, monkeypatch, capsys):
    def elsewhere(root, facts):
        monkeypatch.setattr(stage, "machine", lambda: f"kind {facts['part']}")
        return plain_work(root, facts)

    assert run(elsewhere) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert "table plain" in line
    assert "kind 0; kind 1; kind 2" in line


def raising(root, facts):
    if facts["part"] == 1:
        raise ValueError("row 17")
    return plain_work(root, facts)


def test_a_failure_is_one_line_and_its_traceback_is_in_the_log(run, lake, capsys):
    assert run(raising) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err == "toy_job: table plain: 1 of 3 tasks failed: 1.parquet: ValueError: row 17\n"
    (log,) = logs(lake)
    (failed,) = [line for line in log if "error" in line and "part" in line]
    assert failed["part"] == "1.parquet"
    assert 'raise ValueError("row 17")' in failed["traceback"]
    assert log[-1]["ended"]
    assert log[-1]["status"] == "failed"
    assert log[-1]["error"].startswith("TasksFailed: table plain: 1 of 3 tasks failed")
    assert "in make" in log[-1]["traceback"]
    assert run(plain_work) == 0
    assert [line["part"] for line in logs(lake)[1] if "part" in line] == ["1.parquet"]
    assert logs(lake)[1][-1]["status"] == "done"
    assert "error" not in logs(lake)[1][-1]


def test_verbose_shows_the_traceback(run, capsys):
    assert run(raising, "-v") == 1
    assert 'raise ValueError("row 17")' in capsys.readouterr().err


def test_help_tells_what_the_job_does_and_the_version(capsys):
    with pytest.raises(SystemExit, match="0"):
        submitted_job.main(job_of(plain_work), ["--help"])
    out = capsys.readouterr().out
    assert "Toy rows." in out
    assert f"truesky {__version__}" in out


@pytest.mark.parametrize(
    ("options", "words"),
    [(["--request", "none.toml"], "no such file"), (["--lake", "s3://bucket"], "POSIX")],
)
def test_the_exit_status_of_wrong_arguments_is_2(lake, request_file, capsys, options, words):
    arguments = ["--lake", str(lake), "--request", str(request_file), *options]
    assert submitted_job.main(job_of(plain_work), arguments) == 2
    assert words in capsys.readouterr().err


def test_another_run_of_the_same_plan_is_refused(run, lake, request_file, capsys, monkeypatch):
    monkeypatch.setattr(locks, "SHORT_TIMEOUT", 0.1)

    def work(root, facts):
        assert run(plain_work) == 1
        return plain_work(root, facts)

    assert run(work) == 0
    assert (
        capsys.readouterr().err.splitlines()
        == [f"toy_job: table plain: another run is making version {plain_plan(2).key}"] * 3
    )


def test_a_run_that_breaks_off_says_so_in_its_log(run, lake, capsys, monkeypatch):
    def full(root, plan, base, name):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(publish, "_publish", full)
    assert run(plain_work) == 1
    assert capsys.readouterr().err == "toy_job: [Errno 28] No space left on device\n"
    assert (logs(lake)[0][-1]["status"], logs(lake)[0][-1]["error"][:7]) == ("failed", "OSError")


def test_what_is_already_there_needs_no_log(run, lake, capsys):
    assert run(plain_work) == 0
    shutil.rmtree(layout.runs_folder(lake))
    layout.runs_folder(lake).touch()
    assert run(plain_work) == 0
    out, err = capsys.readouterr()
    assert "already there" in out
    assert "no log of this run" in err


@pytest.fixture(params=[errno.EROFS, errno.EACCES])
def make_read_only(request, monkeypatch):
    """Return a function after whose call nothing can be written, as on a read-only disc."""

    def refuse(path, *args, **options):
        raise OSError(request.param, os.strerror(request.param), os.fspath(path))

    def open_for_reading(path, mode="r", *args, **options):
        return refuse(path) if set(mode) & set("wax+") else open(path, mode, *args, **options)

    def refuse_all():
        for name in ("mkdir", "unlink", "rename", "replace", "symlink"):
            monkeypatch.setattr(os, name, refuse)
        monkeypatch.setattr(Path, "open", open_for_reading)

    return refuse_all


def test_a_lake_that_is_not_writable_is_one_line_and_status_2(run, lake, capsys, make_read_only):
    make_read_only()
    assert run(plain_work) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"toy_job: lake {lake} cannot be written: {lake}/plain: ")
    assert err.count("\n") == 1


def test_an_area_that_cannot_be_written_is_one_line_and_status_2(run, lake, capsys, make_read_only):
    assert run(plain_work) == 0
    (lake / "names" / "small" / "area.json").unlink()
    make_read_only()
    assert run(plain_work) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"toy_job: lake {lake} cannot be written: {lake}/names/small/")
    assert err.count("\n") == 1


def test_a_complete_lake_that_is_not_writable_needs_no_message(run, lake, capsys, make_read_only):
    assert run(plain_work) == 0
    make_read_only()
    assert run(plain_work) == 0
    out, err = capsys.readouterr()
    assert "already there" in out
    assert err == ""


def test_the_error_is_one_line_if_java_ends_during_its_start(lake, request_file, capsys, monkeypatch):
    def dead(name):
        raise Py4JNetworkError("Answer from Java side is empty\nTraceback ...")

    monkeypatch.setattr("truesky.running.session.get_session", dead)
    arguments = ["--lake", str(lake), "--request", str(request_file)]
    assert submitted_job.main(job_of(plain_work, on_driver=False), arguments) == 1
    err = capsys.readouterr().err
    assert err.startswith("toy_job: Spark did not start: ")
    assert len(err.splitlines()) == 1


def test_a_part_that_kills_its_worker_is_found_in_few_runs(monkeypatch):
    """One of a thousand tasks kills its worker; all others are made, in runs of many tasks each."""
    runs = []

    def link_of(part):
        return task_chains.Link("chain", (float(part.name), 0), 1.0)

    def collect(spark, function, parts, given):
        assert given is link_of
        runs.append(len(parts))
        if any(part.name == "700" for part in parts):
            raise Py4JNetworkError("the worker is gone")
        return [{"part": part.name} for part in parts]

    monkeypatch.setattr("truesky.running.session.get_session", lambda name: None)
    monkeypatch.setattr("truesky.running.session.is_alive", lambda spark: True)
    monkeypatch.setattr(submitted_job, "_collect", collect)
    parts = [Task(f"{i:03}", {}) for i in range(1000)]
    results = submitted_job._spark_map(dict, parts, "toy", True, link_of)
    assert [result["part"] for result in results] == [part.name for part in parts]
    assert [result for result in results if "error" in result] == [
        {"part": "700", "error": "its worker ended unexpectedly"}
    ]
    assert len(runs) <= 2 * 10 + 1


def fake_spark(made):
    """Return a session that runs tasks at once, and adds the lists of task names that it got to `made`."""

    def parallelize(lists, number):
        assert number == len(lists)
        made.extend([part.name for part in parts] for parts in lists)
        return SimpleNamespace(
            mapPartitions=lambda run: SimpleNamespace(collect=lambda: [one for p in lists for one in run([p])])
        )

    context = SimpleNamespace(master="local[2]", defaultParallelism=1, parallelize=parallelize)
    return SimpleNamespace(sparkContext=context)


def test_tasks_of_a_chain_run_one_after_the_other():
    """In order of the chain, in one list if it is short compared with all tasks."""
    chains = {"a2": ("a", 2.0), "b1": ("b", 1.0), "a1": ("a", 1.0), **{f"c{n}": (f"c{n}", 0.0) for n in range(20)}}
    parts, made = [Task(name, {}) for name in chains], []

    def link_of(part):
        chain, order = chains[part.name]
        return task_chains.Link(chain, (order, 0), 1.0)

    found = submitted_job._collect(fake_spark(made), lambda part: {"part": part.name}, parts, link_of)
    assert sorted(one["part"] for one in found) == sorted(chains)
    assert made[0] == ["a1", "a2"]
    assert [len(names) for names in made] == [2] + [1] * 21
    made.clear()
    submitted_job._collect(fake_spark(made), lambda part: {"part": part.name}, parts)
    assert made == [[name] for name in chains]


def test_a_worker_s_modules_are_left_out_of_its_collections_once(monkeypatch):
    """After its first task."""
    done = []
    monkeypatch.setattr(submitted_job.gc, "freeze", lambda: done.append("frozen"))
    submitted_job._freeze_garbage.cache_clear()
    parts = [Task(name, {}) for name in "abc"]
    found = submitted_job._collect(fake_spark([]), lambda part: done.append(part.name) or {"part": part.name}, parts)
    submitted_job._freeze_garbage.cache_clear()
    assert [one["part"] for one in found] == ["a", "b", "c"]
    assert done == ["a", "frozen", "b", "c"]


def test_the_bar_counts_receipts(run, monkeypatch, capsys):
    monkeypatch.setenv("TRUESKY_PROGRESS", "1")
    assert run(plain_work) == 0
    assert "plain" in capsys.readouterr().err


def test_two_steps_and_an_empty_table(lake, request_file):
    def steps(root, request):
        return [Step(Plan(PLAIN, {}, ()), plain_work, True), Step(plain_plan(3), plain_work, True)]

    assert submitted_job.main(Job("two", "Two.", steps), ["--lake", str(lake), "--request", str(request_file)]) == 0
    assert read.version(lake, "plain").num_rows == 60
    assert len(logs(lake)) == 2


_STOPPED = """
import sys, time
from truesky.running.submitted_job import Job, Step, main
from tests.universe import plain_plan, plain_work
def work(root, facts):
    if facts["part"] == 1:
        print("started", flush=True)
        time.sleep(600)
    return plain_work(root, facts)
sys.exit(main(Job("slow", "Slow.", lambda lake, request: [Step(plain_plan(2), work, True)])))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_run_says_so_and_the_next_continues(run, lake, request_file, number):
    command = [sys.executable, "-c", _STOPPED, "--lake", str(lake), "--request", str(request_file)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=ROOT, env=dict(os.environ), **pipes) as driver:
        assert driver.stdout.readline() == "started\n"
        driver.send_signal(number)
        assert driver.wait(120) == 128 + number
        assert driver.stderr.read() == "slow: stopped; a second run continues where this one ended\n"
    assert run(plain_work) == 0
    assert [line["part"] for line in logs(lake)[-1] if "part" in line] == ["1.parquet", "2.parquet"]


def test_what_a_job_makes_belongs_to_its_request(run, lake, tmp_path):
    assert run(plain_work) == 0
    other = tmp_path / "other"
    other.mkdir()
    file = requests.written(other, name="other", seed=3)
    assert submitted_job.main(job_of(plain_work), ["--lake", str(lake), "--request", str(file)]) == 0
    assert request_links.keys_by_request(lake, "plain") == {"other": plain_plan(3).key, "small": plain_plan(2).key}


# ------------------------------------------------------------------------------------------------ kinds of machines


def test_a_process_that_breaks_the_promise_makes_nothing(run, lake, monkeypatch, capsys):
    """As a notebook's that imported numpy first, on a CPU with AVX-512."""
    monkeypatch.setattr(instruction_set, "_has_level", lambda: True)
    monkeypatch.setattr(instruction_set, "_numpy_in_use", lambda: ("X86_V3", "X86_V4"))
    monkeypatch.delenv("TRUESKY_CPU", raising=False)
    assert run(plain_work) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("toy_job: numpy uses X86_V4, so results would differ between machines")
    assert list(lake.iterdir()) == []


def test_a_choice_of_the_user_is_reported_once(run, monkeypatch, capsys):
    monkeypatch.setattr(instruction_set, "check", lambda: "last bits may differ between machines")
    assert run(plain_work) == 0
    assert capsys.readouterr().err == "toy_job: last bits may differ between machines\n"


@pytest.mark.parametrize("kinds", [["here"], ["there"], ["here", "there"]])
def test_a_worker_of_another_kind_is_reported(run, monkeypatch, capsys, kinds):
    """One kind that is not the driver's is as much another as two are."""
    told = iter(kinds * 3)
    monkeypatch.setattr(submitted_job, "machine", lambda: "here")
    monkeypatch.setattr(stage, "machine", lambda: next(told))
    assert run(plain_work) == 0
    about = "toy_job: table plain: made on machines of other kinds than this one, so last bits may differ: here here, "
    expected = "" if kinds == ["here"] else f"{about}made on {'; '.join(kinds)}\n"
    assert capsys.readouterr().err == expected


# ---------------------------------------------------------------------------------------------- functions in workers


def square(number):
    return number * number


def test_a_function_runs_here_without_a_session(monkeypatch):
    monkeypatch.setattr(submitted_job, "has_session", lambda: False)
    assert submitted_job.map_in_workers(square, [3, 4]) == [9, 16]


def test_a_function_runs_here_if_a_worker_fails(monkeypatch):
    def lost(name):
        raise Py4JNetworkError("the worker is gone")

    monkeypatch.setattr(submitted_job, "has_session", lambda: True)
    monkeypatch.setattr("truesky.running.session.get_session", lost)
    assert submitted_job.map_in_workers(square, [3, 4]) == [9, 16]
    assert submitted_job.map_in_workers(square, []) == []


def test_a_function_runs_in_workers_in_order(monkeypatch):
    def parallelize(items, count):
        assert count == len(items)
        return SimpleNamespace(
            map=lambda function: SimpleNamespace(collect=lambda: [-function(item) for item in items])
        )

    session = SimpleNamespace(sparkContext=SimpleNamespace(parallelize=parallelize))
    monkeypatch.setattr(submitted_job, "has_session", lambda: True)
    monkeypatch.setattr("truesky.running.session.get_session", lambda name: session)
    assert submitted_job.map_in_workers(square, [3, 4]) == [-9, -16]
