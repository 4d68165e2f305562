"""Lines that describe a run. The display on a terminal is tested with test_supervise.py."""

import io
import os

from truesky.numerics import activity
from truesky.numerics.activity import Activity
from truesky.running import display, progress
from truesky.running.progress import RunState, TableState

JOBS = (("build_galaxies", 60.0), ("build_stars", 4000.0))


def test_one_line_describes_a_run():
    assert display.describe_state(RunState(), 0.0, 5.4) == "progress: checking the request; 0:05 elapsed"
    lensing = Activity("lensing map", 20.0, 4, 16, 17)
    state = RunState(JOBS, 2, (), 10.0, activities=(lensing,))
    assert display.describe_state(state, 0.0, 30.0) == (
        "progress: build_galaxies (1 of 2), lensing map 5 of 16; 0:30 elapsed, about 1:07:20 left"
    )
    table = TableState("stars", "part", 1, 0, 0)
    state = RunState(JOBS, 2, (70.0,), 80.0, table=table, activities=(Activity("isochrones", 20.0, 0, 0, 17),))
    assert "build_stars (2 of 2), stars 0 of 1 part, isochrones; " in display.describe_state(state, 0.0, 90.0)
    state = RunState(JOBS, 2, (70.0, 60.0), 150.0)
    assert display.describe_state(state, 0.0, 151.0) == "progress: finishing; 2:31 elapsed"


def test_each_process_has_one_activity():
    """The newest, which is a part of the others of its process."""
    activities = (Activity("a", 1.0, 0, 0, 1), Activity("b", 2.0, 0, 0, 2), Activity("c", 3.0, 0, 0, 1))
    line = display.describe_state(RunState(JOBS, 2, (), 0.0, activities=activities), 0.0, 4.0)
    assert "(1 of 2), c, b; " in line


def test_lines_appear_at_the_start_of_a_job_and_after_a_while(tmp_path, monkeypatch):
    monkeypatch.setenv(activity.SETTING, str(tmp_path))
    monkeypatch.setattr(display, "_READ_INTERVAL", 0.0)
    monkeypatch.setattr(display, "_READ_SHARE", 1e9)
    stream = io.StringIO()

    def new_lines():
        shown.update()
        text = stream.getvalue()
        stream.truncate(0)
        stream.seek(0)
        return text.splitlines()

    with display.show_run(tmp_path, stream, 0.0) as shown:
        assert new_lines() == []
        progress.announce_run(JOBS, 2)
        progress.announce_job([])
        (line,) = new_lines()
        assert "build_galaxies (1 of 2)" in line
        assert new_lines() == []
        shown.next_line -= display.LINE_INTERVAL
        assert len(new_lines()) == 1
        assert new_lines() == []
        shown.write("a table\n", stream)
        assert new_lines() == ["a table"]
        assert os.listdir(tmp_path)
