"""A run in a child process: its display on a pseudo-terminal and without one, its output, its end."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pexpect
import psutil
import pytest

ROOT = Path(__file__).resolve().parents[3]
# A run that makes the second of its two tables, and writes the numbers of its processes to a file.
_RUN = """
import os, subprocess, sys, time
from pathlib import Path
from truesky.numerics import activity
from truesky.running import progress, supervise
supervise.end_with_parent()
folder = Path(sys.argv[1])
worker = subprocess.Popen([sys.executable, "-c", sys.argv[2]], start_new_session=True)
while not list(Path(os.environ[activity.SETTING]).glob("group-*")):
    time.sleep(0.01)
print("forecast: 2 toys", flush=True)
print("\\x1b[1mcareful\\x1b[0m [bold]", file=sys.stderr, flush=True)
progress.announce_run([("build_toys", 5.0), ("draw_toys", 65.0)], 2)
progress.announce_job([4.0])
progress.announce_tables(6)
(folder / "0.json").touch()
with progress.table_in_work("images", "toy", folder, 4, 2), activity.report("lensing map", 16) as update:
    time.sleep(0.3)
    update(4)
    (folder / "processes").write_text(f"{os.getpid()} {worker.pid}")
    time.sleep(600)
"""
_WORKER = """
import signal, time
from truesky.running import supervise
signal.signal(signal.SIGTERM, signal.SIG_IGN)
supervise.register_process_group()
time.sleep(600)
"""
_PARENT = """
import sys
from truesky.running import display, supervise
display.LINE_INTERVAL = 0.5
sys.exit(supervise.supervise("truesky", sys.argv[1:], "truesky run toys.toml"))
"""
_STOPPED = "truesky: stopped; to continue, run: truesky run toys.toml"


def words(*arguments):
    return [sys.executable, "-c", _PARENT, "-c", *map(str, arguments)]


def environment(**variables):
    # Another test may have left $COLUMNS, which replaces the width of the terminal.
    inherited = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
    return {**inherited, "PYTHONPATH": str(ROOT), **variables}


def processes(folder):
    deadline = time.monotonic() + 60
    while not (folder / "processes").exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return [psutil.Process(int(number)) for number in (folder / "processes").read_text().split()]


def wait_until_gone(run_processes, limit):
    _, alive = psutil.wait_procs(run_processes, limit)
    for process in alive:
        process.kill()
    assert not [process for process in alive if process.status() != psutil.STATUS_ZOMBIE]


def finished(program, *arguments):
    """Run a child process with the program, supervised without a terminal."""
    return subprocess.run(words(program, *arguments), env=environment(), capture_output=True, text=True, timeout=60)


def test_the_display_on_a_terminal_and_ctrl_c(tmp_path):
    first, *rest = words(_RUN, tmp_path, _WORKER)
    terminal = pexpect.spawn(
        first, rest, env=environment(TERM="xterm"), dimensions=(24, 80), encoding="utf-8", timeout=60
    )
    terminal.expect_exact("forecast: 2 toys")
    terminal.expect_exact("careful")
    terminal.expect_exact(" [bold]")
    terminal.expect_exact("draw_toys (2 of 2)")
    terminal.expect_exact("images: 1 of 4 toys")
    terminal.expect(r"0:\d\d elapsed, about \d:\d\d left")
    terminal.expect_exact("lensing map 5 of 16")
    run_processes, start = processes(tmp_path), time.monotonic()
    terminal.sendintr()
    terminal.expect_exact(_STOPPED)
    terminal.expect(pexpect.EOF)
    terminal.wait()
    assert time.monotonic() - start < 2.0
    assert terminal.exitstatus == 130
    wait_until_gone(run_processes, 2.0)


# test_the_display_on_a_terminal_and_ctrl_c has a short version.
@pytest.mark.nightly
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_lines_without_a_terminal_and_the_end_by_a_signal(tmp_path, number):
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(words(_RUN, tmp_path, _WORKER), env=environment(), **pipes) as parent:
        assert parent.stdout.readline() == "forecast: 2 toys\n"
        lines = iter(parent.stderr.readline, "")
        line = next(line for line in lines if "lensing map" in line)
        assert line.startswith("progress: draw_toys (2 of 2), images 1 of 4 toys, lensing map ")
        run_processes = processes(tmp_path)
        parent.send_signal(number)
        assert parent.wait(60) == 128 + number
        assert parent.stderr.read().splitlines()[-1] == _STOPPED
    wait_until_gone(run_processes, 2.0)


def test_a_run_ends_with_the_process_that_supervises_it(tmp_path):
    # The folder of the state is left behind, because nothing can remove it.
    variables = environment(TMPDIR=str(tmp_path))
    with subprocess.Popen(words(_RUN, tmp_path, _WORKER), env=variables, stderr=subprocess.DEVNULL) as parent:
        run, worker = processes(tmp_path)
        parent.kill()
    # Spark's workers end with Java; this one does not.
    worker.kill()
    wait_until_gone([run], 10.0)


def test_the_output_and_the_status_of_a_run_are_passed_on():
    done = finished("import sys; print('a\\nb', end=''); print('é', file=sys.stderr); sys.exit(7)")
    assert (done.returncode, done.stdout, done.stderr) == (7, "a\nb", "é\n")


def test_a_run_imports_nothing_from_the_current_folder(tmp_path, monkeypatch):
    """Users may call truesky in a folder that they have downloaded."""
    (tmp_path / "strange.py").touch()
    monkeypatch.chdir(tmp_path)
    done = finished("import importlib.util, truesky; print(importlib.util.find_spec('strange'))")
    assert (done.returncode, done.stdout) == (0, "None\n")


def test_a_run_that_is_killed_says_so():
    done = finished("import os, signal; os.kill(os.getpid(), signal.SIGKILL)")
    assert done.returncode == 1
    assert done.stderr == (
        "truesky: the process of the run was ended by SIGKILL; to continue, run: truesky run toys.toml\n"
    )


def test_a_reader_of_the_output_may_close_it():
    """As `truesky run ... | head`. The run ends then, too."""
    reader, writer = os.pipe()
    os.close(reader)
    program = "import time; print('a', flush=True); time.sleep(600)"
    done = subprocess.run(words(program), env=environment(), stdout=writer, stderr=subprocess.PIPE, timeout=60)
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, b"")
