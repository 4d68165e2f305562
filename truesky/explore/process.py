"""Run queries in a separate process with strict limits of memory and time; worker.py is the program of that process."""

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
# Default memory (bytes) and time (s) of a query, and limits of both.
MEMORY, TIMEOUT = 4e9, 300.0
_MEMORY_LO, _MEMORY_HI = 1e7, 1e15
TIMEOUT_HI = 1e6
# Fraction of the memory that a result in one piece may fill.
_RESULT_SHARE = 0.5
_BUFFER = 1 << 20
_ERRORS = {"BadInput": BadInput, "Damaged": Damaged}
_CLOSED = "SQL: stopped, because the lake was closed before the query was answered"
_INTERRUPTED = "SQL: another query began before all rows of this one were read"


@dataclass(slots=True)
class _Worker:
    """The other process; `is_stopped` is True if a thread stopped it while another may have waited for an answer."""

    process: subprocess.Popen[bytes]
    is_stopped: bool = False

    @property
    def is_alive(self) -> bool:
        return not self.is_stopped and self.process.poll() is None


class Process:
    """Process that answers queries of some tables. The first query starts it; `close` ends it until the next query.

    Several threads may use it. `ask` waits until the queries of other threads are answered. A query whose rows are read
    piece by piece, with `batches`, ends if another query begins before its last piece was read.

    Parameters
    ----------
    root : Folder
        Folder of the lake.
    tables : sequence of str
        NAME=KEY or REQUEST.NAME=KEY for tables of the lake, NAME=@FILE for an Arrow file.
    memory : float
        Memory limit of a query and its result together, bytes.
    """

    def __init__(self, root: Folder, tables: Sequence[str], memory: float = MEMORY) -> None:
        arguments.check_number("memory", memory, _MEMORY_LO, _MEMORY_HI)
        self.max_bytes = int(memory * _RESULT_SHARE)
        self.command = [sys.executable, "-m", "truesky.explore.worker", str(root), str(int(memory)), *tables]
        self._worker: _Worker | None = None
        # Answer that is currently read, None between two answers.
        self._answer: _Answer | None = None
        self._numbers = itertools.count(1)
        # This lock protects the pipes: `ask` holds it for the whole answer, `batches` for each piece.
        self._lock = threading.RLock()

    def close(self) -> None:
        """End the process and its current query; a later query starts a new process."""
        self.stop()
        with self._lock:
            self._end()

    def _end(self) -> None:
        # Garbage collection of another generator may call this again before it returns.
        worker, self._worker, self._answer = self._worker, None, None
        if worker is not None:
            worker.process.kill()
            worker.process.communicate()

    def stop(self) -> None:
        """Stop the query for which another thread waits, without waiting for it; later queries are answered."""
        # The attribute is read once, since another thread may change it meanwhile.
        if (worker := self._worker) is not None:
            worker.is_stopped = True
            worker.process.kill()

    def ask(self, text: str, parameters: Mapping[str, object], timeout: float = TIMEOUT) -> pa.Table:
        """Return the result of a SELECT.

        Parameters
        ----------
        text : str
            SQL of the query.
        parameters : mapping of str to object
            Values of its parameters.
        timeout : float
            Time after which the query is stopped, s.

        Returns
        -------
        Table
            Rows of the result.

        Notes
        -----
        BadInput and Damaged are raised as by `Explorer.sql`.
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
        """Yield the result of a SELECT piece by piece, at least one piece; closing the generator stops the query.

        Parameters
        ----------
        text : str
            SQL of the query.
        parameters : mapping of str to object, optional
            Values of its parameters.
        timeout : float
            Time until the last piece, s.
        max_rows : int, optional
            Largest number of rows; by default all.
        max_bytes : int, optional
            Size above which a result is refused. By default any size is allowed, but a single row must not exceed
            64 MiB.
        expressions : sequence of str
            Parts of the text that a user wrote; each must be exactly one expression.

        Yields
        ------
        RecordBatch
            Piece of the result.

        Notes
        -----
        Errors are those of `ask`; they can also be raised after some pieces. BadInput is raised if another query began
        before the last piece.
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
        """Send a question; an answer that is not completely read is abandoned."""
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
        """Next piece, None after the last one."""
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
        """End the process if it still answers this question."""
        # A thread that collects a generator must not wait for the answer to another thread's question. If another
        # thread holds the lock, it has ended this answer, or will end it with its next question.
        if self._answer is answer and self._lock.acquire(blocking=False):
            try:
                if self._answer is answer:
                    self._end()
            finally:
                self._lock.release()

    def _ensure_worker(self) -> _Worker:
        if self._worker is None or not self._worker.is_alive:
            self._end()
            pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
            # Arrow's other allocators reserve a gigabyte at the start, which would count towards the limit.
            environment = {**os.environ, "ARROW_DEFAULT_MEMORY_POOL": "system"}
            self._worker = _Worker(subprocess.Popen(self.command, cwd=_ROOT, env=environment, **pipes))
        return self._worker


class _Answer:
    """Answer of a worker to one question.

    Attributes
    ----------
    worker : _Worker
        The worker.
    number : int
        Number of the question, which the answer repeats.
    timeout : float
        Time from now until the last piece, s.
    error : LakeError, optional
        Error from the worker, known after the last piece.
    """

    def __init__(self, worker: _Worker, number: int, timeout: float) -> None:
        assert worker.process.stdout is not None
        self.worker, self.number, self.timeout = worker, number, timeout
        self.error: LakeError | None = None
        self._pipe = io.BufferedReader(_TimedPipe(worker.process.stdout, time.monotonic() + timeout), _BUFFER)
        self._stream: pa.RecordBatchStreamReader | None = None

    def read(self) -> pa.RecordBatch | None:
        """Return the next piece, None after the last one.

        TimeoutError is raised after the timeout; OSError, EOFError or an error of Arrow if the worker has ended.
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
        """Read the status line before or after the pieces; True if there is no error."""
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
    """Pipe that can be read until a deadline of the monotonic clock; TimeoutError is raised after it."""

    def __init__(self, pipe: IO[bytes], deadline: float) -> None:
        # The file object is kept, not its descriptor, which a new file might reuse.
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
    """Encode a question as a line of JSON for the worker."""
    if not isinstance(question["sql"], str):
        raise BadInput(f"SQL: the query must be text, not {type(question['sql']).__name__}")
    try:
        return json.dumps(question, allow_nan=False, default=as_python).encode() + b"\n"
    except (TypeError, ValueError) as error:
        raise BadInput(f"SQL: a parameter must be a number, text, boolean or list of them: {error}") from None
