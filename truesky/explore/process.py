"""Run SQL queries in a separate process (the worker) with strict limits of memory and time.

The module `truesky.explore.worker` is the program of that process.
"""

from __future__ import annotations

import io
import itertools
import json
import os
import selectors
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import pyarrow as pa

from lake_schema import arguments
from lake_schema.arrays import as_python
from lake_schema.errors import BadInput, Damaged, LakeError
from lake_schema.store.object_storage.s3 import Folder

_ROOT = Path(__file__).resolve().parents[2]
# Default memory limit of a query in bytes.
MEMORY = 4e9
# Default time limit of a query in seconds.
TIMEOUT = 300.0
# Smallest and largest memory limit that a caller may set, bytes.
_MEMORY_LO, _MEMORY_HI = 1e7, 1e15
# Largest time limit that a caller may set, s.
TIMEOUT_HI = 1e6
# Fraction of the memory limit that the result of `Process.ask` may fill.
_RESULT_SHARE = 0.5
_BUFFER = 1 << 20
_ERRORS = {"BadInput": BadInput, "Damaged": Damaged}
_CLOSED = "SQL: stopped, because the lake was closed before the query was answered"
_INTERRUPTED = "SQL: another query began before all rows of this one were read"


@dataclass(slots=True)
class _Worker:
    """Process that runs queries.

    `is_stopped` is True if `Process.stop` has killed the process, perhaps while a thread waited for an answer.
    """

    process: subprocess.Popen[bytes]
    is_stopped: bool = False

    @property
    def is_alive(self) -> bool:
        return not self.is_stopped and self.process.poll() is None


class Process:
    """Separate process that answers SQL queries of tables of a lake.

    The first query starts the process. `close` ends it, and the next query starts a new one. Several threads may use an
    object of this class. `ask` waits until the `ask` calls of other threads have returned. `batches` yields a result
    batch by batch. Such a query is abandoned if another query begins before its last batch was read.

    Parameters
    ----------
    root : Folder
        Folder of the lake.
    tables : sequence of str
        Tables that queries can use: NAME=KEY or REQUEST.NAME=KEY with the key (hash) of a version of a table of the
        lake, NAME=@FILE for an Arrow file, or NAME=?REQUEST for a table that could not be opened, so that a query of it
        raises the reason.
    memory : float, optional
        Memory limit of a query and its result together, 1e7 to 1e15 bytes. OutOfRange is raised for other values.
    """

    def __init__(self, root: Folder, tables: Sequence[str], memory: float = MEMORY) -> None:
        arguments.check_number("memory", memory, _MEMORY_LO, _MEMORY_HI)
        self.max_bytes = int(memory * _RESULT_SHARE)
        self.command = [sys.executable, "-m", "truesky.explore.worker", str(root), str(int(memory)), *tables]
        self._worker: _Worker | None = None
        self._is_discarded = False
        # Answer whose batches are being read, None between two answers.
        self._answer: _Answer | None = None
        self._numbers = itertools.count(1)
        # The lock protects the pipes to and from the process: `ask` holds it until it has the whole answer, `batches`
        # while it reads one batch.
        self._lock = threading.RLock()

    def close(self) -> None:
        """End the process and the query that it is answering, which raises BadInput; a later query starts a new one."""
        self.stop()
        with self._lock:
            self._end()

    def _end(self) -> None:
        # Garbage collection of a generator from `batches` may call `_end` again before this call returns, so the
        # attributes are cleared first.
        worker, self._worker, self._answer = self._worker, None, None
        if worker is not None:
            worker.process.kill()
            worker.process.communicate()

    def stop(self) -> None:
        """Kill the process, so that a query for which another thread waits raises BadInput in that thread.

        The method returns at once. A later query starts a new process.
        """
        # Read `self._worker` only once, since another thread may set it to None at any time.
        if (worker := self._worker) is not None:
            worker.is_stopped = True
            worker.process.kill()

    def discard(self) -> None:
        """Kill the process as `stop` does, but let no query start a new one: further queries raise BadInput."""
        # The order matters if another thread is just starting the process: see `_ensure_worker`.
        self._is_discarded = True
        self.stop()

    def ask(self, text: str, parameters: Mapping[str, object], timeout: float = TIMEOUT) -> pa.Table:
        """Return the result of a SELECT.

        Parameters
        ----------
        text : str
            SQL of the query; $name is a parameter.
        parameters : mapping of str to object
            Values of the parameters by name: numbers, texts, booleans or lists of them.
        timeout : float, optional
            Time in seconds after which the query is stopped, 0 to 1e6.

        Returns
        -------
        pyarrow.Table
            Rows of the result.

        Notes
        -----
        BadInput is raised if the text is not an allowed SELECT, the query exceeds its time or memory, the result has
        more bytes than half of the memory limit, or `stop`, `discard` or `close` ends the query. Damaged is raised if
        the content of a file does not agree with its checksum.
        """
        with self._lock:
            return pa.Table.from_batches(list(self.batches(text, parameters, timeout, max_bytes=self.max_bytes)))

    def batches(
        self,
        text: str,
        parameters: Mapping[str, object] | None = None,
        timeout: float = TIMEOUT,
        max_rows: int | None = None,
        max_bytes: int | None = None,
        expressions: Sequence[str] = (),
    ) -> Iterator[pa.RecordBatch]:
        """Yield the result of a SELECT in batches of rows; closing the generator stops the query.

        At least one batch is yielded; it is empty if the result has no rows.

        Parameters
        ----------
        text : str
            SQL of the query; $name is a parameter.
        parameters : mapping of str to object, optional
            Values of the parameters by name: numbers, texts, booleans or lists of them.
        timeout : float, optional
            Time limit in seconds, 0 to 1e6, from the beginning of the query to the last batch.
        max_rows : int, optional
            Largest number of rows; further rows are not returned. By default all rows are returned.
        max_bytes : int, optional
            Size above which a result is refused. By default any size is allowed, but a single row must not exceed
            64 MiB.
        expressions : sequence of str, optional
            Parts of `text` that a user wrote. Each must be exactly one SQL expression, so that it cannot change the
            rest of the query.

        Yields
        ------
        pyarrow.RecordBatch
            Rows of the result, at most 8 MiB unless a single row is larger.

        Notes
        -----
        BadInput is raised if the text is not an allowed SELECT, an item of `expressions` is not one expression, the
        query exceeds its limits, or `stop`, `discard`, `close` or the beginning of another query ends it. Damaged is
        raised if the content of a file does not agree with its checksum. Both can be raised after some batches have
        been yielded.
        """
        arguments.check_number("timeout", timeout, 0.0, TIMEOUT_HI)
        question = {"sql": text, "parameters": dict(parameters or {}), "rows": max_rows, "bytes": max_bytes}
        answer = self._send(question | {"expressions": [*expressions]}, timeout)
        try:
            while (batch := self._next(answer)) is not None:
                yield batch
        finally:
            self._give_up(answer)

    def _send(self, question: dict[str, Any], timeout: float) -> _Answer:
        """Send a query to the process, and return the object from which its answer can be read.

        If an earlier answer has not been read completely, the process is ended and a new one is started. BadInput is
        raised if a parameter cannot be sent, or if the process has ended.
        """
        number = next(self._numbers)
        line = _line_of(question | {"id": number})
        with self._lock:
            if self._answer is not None:
                self._end()
            worker = self._ensure_worker()
            pipe = worker.process.stdin
            assert pipe is not None
            try:
                pipe.write(line)
                pipe.flush()
            except BrokenPipeError:
                self._end()
                message = _CLOSED if worker.is_stopped else "SQL: the process that answers queries has ended; ask again"
                raise BadInput(message) from None
            self._answer = _Answer(worker, number, timeout)
            return self._answer

    def _next(self, answer: _Answer) -> pa.RecordBatch | None:
        """Return the next batch of rows of an answer, or None after the last one.

        BadInput is raised if the time is over, the process has ended, or another query has begun. Errors that the
        process reports are raised after its last batch.
        """
        with self._lock:
            if self._answer is not answer:
                raise BadInput(_CLOSED if answer.worker.is_stopped else _INTERRUPTED)
            try:
                batch = answer.read()
            except TimeoutError:
                message = f"SQL: stopped after {answer.timeout:g} s"
            except (pa.ArrowException, OSError, EOFError):
                crashed = "SQL: the query needs more memory than its limit, or brought its process down"
                message = _CLOSED if answer.worker.is_stopped else crashed
            else:
                if batch is not None:
                    return batch
                self._answer = None
                if answer.error is not None:
                    raise answer.error
                return None
            self._end()
            raise BadInput(message)

    def _give_up(self, answer: _Answer) -> None:
        """End the process if it is still sending `answer`; do nothing if the answer is complete or abandoned."""
        # Garbage collection can call this in any thread, which must not wait until another thread has its answer. If
        # another thread holds the lock, that thread has ended `answer`, or will end it with its next query.
        if self._answer is answer and self._lock.acquire(blocking=False):
            try:
                if self._answer is answer:
                    self._end()
            finally:
                self._lock.release()

    def _ensure_worker(self) -> _Worker:
        if self._worker is None or not self._worker.is_alive:
            self._end()
            if self._is_discarded:
                raise BadInput(_CLOSED)
            pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
            # Arrow's other memory pools reserve a gigabyte at the start, which would count towards the memory limit.
            environment = {**os.environ, "ARROW_DEFAULT_MEMORY_POOL": "system"}
            worker = self._worker = _Worker(subprocess.Popen(self.command, cwd=_ROOT, env=environment, **pipes))
            # If `discard` was called while the process started, it found nothing to kill.
            if self._is_discarded:
                self.stop()
            return worker
        return self._worker


class _Answer:
    """Answer to one query, read batch by batch from the process that runs queries.

    Attributes
    ----------
    worker : _Worker
        The process.
    number : int
        Number of the query, which the answer repeats.
    timeout : float
        Time in seconds from the creation of this object until the last batch must have been read.
    error : LakeError, optional
        Error that the process reported before or after the rows; None until an error is reported.
    """

    def __init__(self, worker: _Worker, number: int, timeout: float) -> None:
        assert worker.process.stdout is not None
        self.worker, self.number, self.timeout = worker, number, timeout
        self.error: LakeError | None = None
        self._pipe = io.BufferedReader(_TimedPipe(worker.process.stdout, time.monotonic() + timeout), _BUFFER)
        self._stream: pa.RecordBatchStreamReader | None = None

    def read(self) -> pa.RecordBatch | None:
        """Return the next batch of rows, or None after the last one or if the query failed; `error` is then set.

        TimeoutError is raised after the timeout. OSError, EOFError or an error of Arrow is raised if the process has
        ended.
        """
        if self._stream is None:
            if not self._read_status():
                return None
            self._stream = pa.ipc.open_stream(self._pipe)
        try:
            return self._stream.read_next_batch()
        except StopIteration:
            self._read_status()
            return None

    def _read_status(self) -> bool:
        """Read the line of JSON before or after the rows, which may contain an error; return True if it has none.

        An error is stored in `error`. EOFError is raised if the process has ended, and LakeError if the line belongs to
        the answer to another query.
        """
        line = self._pipe.readline()
        if not line.endswith(b"\n"):
            raise EOFError
        status = json.loads(line)
        if status["id"] != self.number:
            raise LakeError(f"SQL: question {self.number} got the answer to question {status['id']}")
        if "error" in status:
            self.error = _ERRORS.get(status["kind"], LakeError)(status["error"])
        return self.error is None


class _TimedPipe(io.RawIOBase):
    """Pipe that can be read until a deadline (a time of `time.monotonic`, s); later reads raise TimeoutError."""

    def __init__(self, pipe: IO[bytes], deadline: float) -> None:
        # Keep the file object and not the number of its descriptor: after the pipe is closed, a new file may get the
        # same number.
        self.pipe, self.deadline = pipe, deadline

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        with selectors.DefaultSelector() as selector:
            selector.register(self.pipe, selectors.EVENT_READ)
            if not selector.select(max(self.deadline - time.monotonic(), 0.0)):
                raise TimeoutError
        return os.readv(self.pipe.fileno(), [buffer])


def _line_of(question: dict[str, Any]) -> bytes:
    """Encode a query as a line of JSON for the process that runs queries.

    BadInput is raised if the SQL is not text, or a parameter is not a finite number, text, boolean or list of them.
    """
    if not isinstance(question["sql"], str):
        raise BadInput(f"SQL: the query must be text, not {type(question['sql']).__name__}")
    try:
        return json.dumps(question, allow_nan=False, default=as_python).encode() + b"\n"
    except (TypeError, ValueError) as error:
        raise BadInput(f"SQL: a parameter must be a number, text, boolean or list of them: {error}") from None
