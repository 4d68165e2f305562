"""Show the progress of a run: a live display on a terminal, else one line every half minute."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Protocol

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from truesky.numerics.activity import Activity
from truesky.running import progress
from truesky.running.progress import RunState

# Time between two lines if there is no terminal, s.
LINE_INTERVAL = 30.0
# Smallest time between two readings of the state of the run, s. It is longer if a reading takes long, because counting
# 100,000 files loads the file system.
_READ_INTERVAL, _READ_SHARE = 0.25, 0.05
# Width of the bar of a table, characters.
_BAR_WIDTH = 20
# Largest number of activities in the display.
_MAX_ACTIVITIES = 6


class Display(Protocol):
    """Something that shows the progress of a run and prints the output of its process."""

    def update(self) -> None:
        """Show the present state of the run, if it is time."""

    def write(self, text: str, stream: IO[str]) -> None:
        """Print lines of the run's process to one of the streams of this process."""


@contextmanager
def show_run(folder: Path, stream: IO[str], started: float) -> Iterator[Display]:
    """Show the progress of a run inside the `with` block.

    Parameters
    ----------
    folder : Path
        Folder with the state of the run, see `progress`.
    stream : text stream
        Stream for the display, such as sys.stderr. If it is a terminal that can move its cursor, the display is live.
    started : float
        Start of the run, s since 1970.

    Yields
    ------
    Display
        Object that shows the progress when its method `update` is called.
    """
    console = Console(file=stream)
    if not console.is_terminal or console.is_dumb_terminal:
        yield _LineDisplay(_StateReader(folder), stream, started)
        return
    with Live(console=console, auto_refresh=False, transient=True) as live:
        yield _LiveDisplay(_StateReader(folder), live, started)


class _StateReader:
    """Reader of the state of a run that spends at most a twentieth of the time on reading."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.state, self.next_reading = folder, RunState(), 0.0

    def read(self) -> RunState:
        """Return the state of the run; it is read again if the last reading is older than the interval."""
        start = time.monotonic()
        if start >= self.next_reading:
            self.state = progress.read_state(self.folder)
            end = time.monotonic()
            self.next_reading = end + max(_READ_INTERVAL, (end - start) / _READ_SHARE)
        return self.state


class _LineDisplay:
    """Display without a terminal: one line every half minute, and at the start of each job."""

    def __init__(self, reader: _StateReader, stream: IO[str], started: float) -> None:
        self.reader, self.stream, self.started = reader, stream, started
        self.job: str | None = None
        self.next_line = time.monotonic() + LINE_INTERVAL

    def update(self) -> None:
        state = self.reader.read()
        if state.job == self.job and time.monotonic() < self.next_line:
            return
        if state.job is not None or time.monotonic() >= self.next_line:
            print(describe_state(state, self.started, time.time()), file=self.stream, flush=True)
            self.next_line = time.monotonic() + LINE_INTERVAL
        self.job = state.job

    def write(self, text: str, stream: IO[str]) -> None:
        stream.write(text)
        stream.flush()


class _LiveDisplay:
    """Display on a terminal: the present job with a bar, and one line per activity."""

    def __init__(self, reader: _StateReader, live: Live, started: float) -> None:
        self.reader, self.live, self.started = reader, live, started

    def update(self) -> None:
        self.live.update(_layout(self.reader.read(), self.started, time.time()), refresh=True)

    def write(self, text: str, stream: IO[str]) -> None:
        if stream.isatty():
            # Print above the live lines. The console must not change the text.
            for line in text.splitlines():
                self.live.console.print(Text.from_ansi(line), soft_wrap=True, highlight=False)
        else:
            stream.write(text)
            stream.flush()


def describe_state(state: RunState, started: float, now: float) -> str:
    """Return one line that describes the progress of a run.

    Parameters
    ----------
    state : RunState
        State of the run.
    started, now : float
        Start of the run and present time, s since 1970.

    Returns
    -------
    str
        For example "progress: build_galaxies (1 of 5), galaxies 3 of 8 parts, lensing map 5 of 16; 1:20 elapsed, about
        2:10 left".
    """
    words = [_describe_job(state)]
    if state.table is not None:
        words.append(f"{state.table.name} {_describe_parts(state)}")
    words += [_describe_activity(entry) for entry in _shown_activities(state)]
    return f"progress: {', '.join(words)}; {_describe_time(state, started, now)}"


def _layout(state: RunState, started: float, now: float) -> Group:
    # Two lines, because one would be too long for a terminal of 80 columns.
    job = Text(_describe_job(state), style="bold", no_wrap=True)
    job.append(f"  {_describe_time(state, started, now)}", style="not bold")
    head = Table.grid(padding=(0, 2))
    if table := state.table:
        bar = ProgressBar(total=max(table.parts, 1), completed=table.done, width=_BAR_WIDTH)
        head.add_row(Text(""), bar, Text(f"{table.name}: {_describe_parts(state)}", no_wrap=True))
    lines = [
        Text(f"  {_describe_activity(entry)}  {_format_time(now - entry.started)}", style="dim", no_wrap=True)
        for entry in _shown_activities(state)
    ]
    return Group(job, head, *lines)


def _shown_activities(state: RunState) -> tuple[Activity, ...]:
    """Return the newest activity of each process, because the older ones contain it."""
    return tuple({entry.process: entry for entry in state.activities}.values())[:_MAX_ACTIVITIES]


def _describe_job(state: RunState) -> str:
    if state.job is None:
        return "finishing" if state.finished else "checking the request"
    return f"{state.job} ({len(state.finished) + 1} of {len(state.jobs)})"


def _describe_parts(state: RunState) -> str:
    table = state.table
    return "" if table is None else f"{table.done:,} of {table.parts:,} {table.unit}{'' if table.parts == 1 else 's'}"


def _describe_activity(entry: Activity) -> str:
    return f"{entry.text} {min(entry.done + 1, entry.total)} of {entry.total}" if entry.total else entry.text


def _describe_time(state: RunState, started: float, now: float) -> str:
    remaining = progress.time_left(state, now)
    elapsed = f"{_format_time(now - started)} elapsed"
    return elapsed if remaining is None else f"{elapsed}, about {_format_time(remaining)} left"


def _format_time(seconds: float) -> str:
    minutes, rest = divmod(max(round(seconds), 0), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
