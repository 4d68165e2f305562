"""Run a command in a child process, show its progress, print its output, and end all its processes on Ctrl-C.

The process that computes cannot control the terminal itself: compiled code may run for many seconds before Python can
refresh a display or handle a signal.
"""

from __future__ import annotations

import os
import selectors
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import IO

from lake_schema import command
from truesky.numerics import activity
from truesky.running import display
from truesky.running.display import Display

_ROOT = Path(__file__).resolve().parents[2]
_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# Time between two updates of the display, s.
_INTERVAL = 0.25
# Time between two looks for processes that have not ended, s.
_POLL = 0.02
# Time that processes have to end after SIGTERM, before they are killed, s.
_GRACE = 1.2
# Prefix of the names of files that name further process groups of the run.
_GROUP = "group-"
# Size of the pieces in which the output of the child process is read, bytes.
_PIECE = 1 << 16


def supervise(name: str, words: Sequence[str], resume: str) -> int:
    """Run a Python program in a child process, with a display of its progress, and return its exit status.

    Parameters
    ----------
    name : str
        Name of the command, for messages.
    words : sequence of str
        Arguments of Python: the program and its arguments. The program must call `end_with_parent`.
    resume : str
        Command with which the user continues a run that was stopped.

    Returns
    -------
    int
        Exit status of the child process; 1 with a message if it was killed, and without one if the reader of the output
        has closed it; 130, 143 or 129 after Ctrl-C, SIGTERM or SIGHUP. All processes of the run have ended then.
    """
    return command.run(name, lambda: _supervise(name, words, resume))


def _supervise(name: str, words: Sequence[str], resume: str) -> int:
    received: list[int] = []
    with (
        _collect_signals(received),
        tempfile.TemporaryDirectory(prefix="truesky-", ignore_cleanup_errors=True) as folder,
    ):
        started = time.time()
        columns = str(shutil.get_terminal_size().columns)
        # As in spark-env.sh, numerical libraries use one thread per process, because Spark starts one worker per core.
        defaults = {"COLUMNS": columns, "OMP_NUM_THREADS": "1"}
        # The child process must not import modules from the folder in which the user is: others may have made it.
        search_path = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), str(_ROOT)]))
        safe = {"PYTHONSAFEPATH": "1", "PYTHONPATH": search_path}
        environment = {**defaults, **os.environ, **safe, activity.SETTING: folder}
        # A separate process group lets this process end all processes of the run, and keeps Ctrl-C from them.
        with subprocess.Popen(
            [sys.executable, *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
            process_group=0,
        ) as child:
            try:
                with display.show_run(Path(folder), sys.stderr, started) as run_display:
                    _relay(child, run_display, received)
            finally:
                _end_groups(child, Path(folder))
    if received:
        return command.print_error(name, f"stopped; to continue, run: {resume}", 128 + received[0])
    if child.returncode < 0:
        reason = signal.Signals(-child.returncode).name
        return command.print_error(name, f"the process of the run was ended by {reason}; to continue, run: {resume}", 1)
    return child.returncode


def register_process_group() -> None:
    """Let the parent process of a run end the process group of this process, if a process supervises the run."""
    if folder := os.environ.get(activity.SETTING):
        activity.write_json(Path(folder) / f"{_GROUP}{os.getpgid(0)}", {})


def end_with_parent() -> None:
    """End this process when its parent has ended, of which the end of stdin is the sign.

    Call this function in the child process of `supervise`, so that no run continues if its parent is killed.
    """

    def wait() -> None:
        with suppress(OSError):
            while os.read(0, 1):
                pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextmanager
def _collect_signals(received: list[int]) -> Iterator[None]:
    """Append the numbers of signals that should stop the run to a list inside the `with` block."""

    def receive(number: int, frame: FrameType | None) -> None:
        received.append(number)

    previous_handlers = {number: signal.signal(number, receive) for number in _STOP_SIGNALS}
    try:
        yield
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)


def _relay(child: subprocess.Popen[bytes], run_display: Display, received: Sequence[int]) -> None:
    """Print the output of the child process and update the display, until the child ends or a signal arrives."""
    assert child.stdout is not None
    assert child.stderr is not None
    outputs: dict[int, tuple[IO[str], bytearray]] = {
        child.stdout.fileno(): (sys.stdout, bytearray()),
        child.stderr.fileno(): (sys.stderr, bytearray()),
    }
    with selectors.DefaultSelector() as selector:
        for number in outputs:
            selector.register(number, selectors.EVENT_READ)
        while selector.get_map() and not received:
            for key, _ in selector.select(_INTERVAL):
                stream, rest = outputs[key.fd]
                piece = os.read(key.fd, _PIECE)
                rest += piece
                if not piece:
                    selector.unregister(key.fd)
                end = len(rest) if not piece else rest.rfind(b"\n") + 1
                if end:
                    run_display.write(rest[:end].decode(errors="backslashreplace"), stream)
                    del rest[:end]
            # Processes of the run that outlive the child may keep its output open.
            if child.poll() is not None and not selector.select(0):
                return
            run_display.update()


def _end_groups(child: subprocess.Popen[bytes], folder: Path) -> None:
    """End all processes of a run: the workers at once, the child and Java politely at first, then by force.

    Workers need no time, because a file that is not complete is not used. Java removes its temporary files.
    """
    for path in folder.glob(f"{_GROUP}*"):
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(int(path.name.removeprefix(_GROUP)), signal.SIGKILL)
    deadline = time.monotonic() + _GRACE
    with suppress(ProcessLookupError, PermissionError):
        while time.monotonic() < deadline:
            child.poll()
            os.killpg(child.pid, signal.SIGTERM)
            time.sleep(_POLL)
        os.killpg(child.pid, signal.SIGKILL)
