"""The state of a run: what its process announces, and the time that is left."""

import pytest

from truesky.numerics import activity
from truesky.running import progress
from truesky.running.progress import RunState, TableState

JOBS = (("build", 20.0), ("draw", 100.0), ("plan", 0.0))


def test_nothing_is_written_without_a_run(tmp_path, monkeypatch):
    monkeypatch.delenv(activity.SETTING, raising=False)
    monkeypatch.chdir(tmp_path)
    progress.announce_run(JOBS, 2)
    progress.announce_job([])
    with progress.table_in_work("images", "detector", tmp_path, 3, 0):
        pass
    assert list(tmp_path.iterdir()) == []


def test_what_is_announced_is_read(tmp_path, monkeypatch):
    (receipts := tmp_path / "receipts").mkdir()
    (folder := tmp_path / "state").mkdir()
    monkeypatch.setenv(activity.SETTING, str(folder))
    assert progress.read_state(folder) == RunState()
    progress.announce_run(JOBS, 2)
    progress.announce_job([30.0])
    state = progress.read_state(folder)
    assert (state.jobs, state.workers, state.finished, state.job, state.table) == (JOBS, 2, (30.0,), "draw", None)
    progress.announce_tables(5)
    for name in ("0.json", "1.json", ".2.json.new"):
        (receipts / name).touch()
    with progress.table_in_work("images", "detector", receipts, 3, 2):
        state = progress.read_state(folder)
        assert state.table == TableState("images", "detector", 3, 2, 2)
        assert state.parts_of_job == 5
        assert state.tables_started >= state.job_started > 0.0
    # The receipts of a published table are removed.
    assert progress.read_state(folder).table.done == 3
    progress.announce_job([30.0, 40.0, 0.1])
    state = progress.read_state(folder)
    assert (state.job, state.table, state.parts_of_job) == (None, None, 0)
    assert progress.time_left(state, 1e9) is None


@pytest.mark.parametrize(
    "text",
    [
        "[1]", "3", '"x"', "[" * 100_000, "{", '{"jobs": 3, "finished": 3, "name": 3, "receipts": 3, "parts": "x"}',
        '{"jobs": [["a"], 3, "ab"], "workers": -1, "finished": ["x", null], "job_started": "x", "done": 1e400}',
        '{"jobs": [["a", 1' + "0" * 400 + ']], "workers": NaN, "parts_of_job": 2.5, "receipts": "\\u0000"}',
        '{"text": 3, "started": "x", "done": 1, "total": 2, "process": 1' + "0" * 30 + "}",
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", ["run.json", "job.json", "tables.json", "table.json", "activity-1-1.json"])
def test_a_damaged_file_is_left_out(tmp_path, name, text):
    (tmp_path / "run.json").write_text('{"jobs": [["build", 3.0]]}')
    (tmp_path / name).write_text(text)
    state = progress.read_state(tmp_path)
    assert state.workers == 1
    assert state.activities == ()
    assert all(seconds == 0.0 for seconds in state.finished)
    left = progress.time_left(state, 1e9)
    assert left is None or left >= 0.0


def test_the_time_left_is_that_of_the_forecast_at_first():
    state = RunState(JOBS, 2, (), 1000.0)
    assert progress.time_left(RunState(), 1000.0) is None
    assert progress.time_left(state, 1005.0) == pytest.approx(115.0)
    # The forecast time of the job is over.
    assert progress.time_left(state, 1030.0) == pytest.approx(100.0)
    # The first job took twice its forecast time, so the second is expected to do so, too.
    assert progress.time_left(RunState(JOBS, 2, (40.0,), 1000.0), 1010.0) == pytest.approx(190.0)


def test_the_time_left_follows_from_the_parts_that_are_finished():
    """Nothing of the forecast counts for the present job then; two more parts are half done on average."""
    table = TableState("images", "detector", 10, 4, 0)
    state = RunState(JOBS, 2, (20.0,), 1000.0, 1010.0, 10, table)
    assert progress.time_left(state, 1060.0) == pytest.approx(50.0 * 5.0 / 5.0)
    # Six parts of an earlier table of the job are finished.
    state = RunState(JOBS, 2, (20.0,), 1000.0, 1010.0, 20, TableState("images", "detector", 10, 4, 10))
    assert progress.time_left(state, 1060.0) == pytest.approx(50.0 * 5.0 / 15.0)


def test_a_measured_pace_holds_for_later_jobs():
    """Half of the first job took 30 s instead of 10 s."""
    state = RunState(JOBS, 1, (), 1000.0, 1000.0, 4, TableState("halos", "part", 4, 2, 0))
    share = 2.5 / 4.0
    assert progress.time_left(state, 1030.0) == pytest.approx(
        30.0 * (1.0 - share) / share + 100.0 * 30.0 / (20.0 * share)
    )
