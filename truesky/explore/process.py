"""A process that answers queries, with bounds of memory and time that hold; worker.py is its other end."""

from __future__ import annotations

import io
import json
import os
import selectors
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import pyarrow as pa

from lake_schema.errors import BadInput, Damaged, LakeError, OutOfRange
from lake_schema.store.object_storage.s3 import Folder

_ROOT = Path(__file__).resolve().parents[2]
# Bytes that a query may take, and s, where nobody says otherwise; and between which bounds anybody may.
MEMORY, TIMEOUT = 4e9, 300.0
_MEMORY_LO, _MEMORY_HI = 1e7, 1e15
TIMEOUT_HI = 1e6
# Of the memory the part that a result may fill that is wanted in one piece.
_RESULT = 0.5
_BUFFER = 1 << 20
_ERRORS = {"BadInput": BadInput, "Damaged": Damaged}


class Process:
    """Answers queries of some tables; starts with the first, ends with `close`, and then starts again.

    tables  : NAME=KEY or REQUEST.NAME=KEY of tables of the lake `root`, NAME=@FILE of an Arrow file
    memory  : bytes that a query and its result may take together
    """

    def __init__(self, root: Folder, tables: Sequence[str], memory: float = MEMORY) -> None:
        check("memory", memory, _MEMORY_LO, _MEMORY_HI)
        self.most_bytes = int(memory * _RESULT)
        self.command = [sys.executable, "-m", "truesky.explore.worker", str(root), str(int(memory)), *tables]
        self._worker: subprocess.Popen[bytes] | None = None
        # Of the question that is being answered, None between two.
        self._answering: object | None = None
        # A question that was given up may be ended by whichever thread collects its generator.
        self._changing = threading.RLock()

    def close(self) -> None:
        """End the process; a later query starts another."""
        with self._changing:
            self._end()

    def _end(self) -> None:
        if self._worker is not None:
            self._worker.kill()
            self._worker.communicate()
            self._worker = None

    def stop(self) -> None:
        """End what it is doing, from another thread than the one that waits for it; a later query starts another."""
        # Looked up once: another thread may end it meanwhile.
        if (worker := self._worker) is not None:
            worker.kill()

    def ask(self, text: str, parameters: dict[str, object], timeout: float = TIMEOUT) -> pa.Table:
        """The result of a SELECT, which is stopped after `timeout` s.  Errors: BadInput, Damaged, as of Explorer.sql"""
        batches = list(self.batches(text, parameters, timeout, most_bytes=self.most_bytes))
        return pa.Table.from_batches(batches)

    def batches(
        self,
        text: str,
        parameters: Mapping[str, object] | None = None,
        timeout: float = TIMEOUT,
        rows: int | None = None,
        most_bytes: int | None = None,
        expressions: Sequence[str] = (),
    ) -> Iterator[pa.RecordBatch]:
        """The same piece by piece, at least one; whoever reads no further stops the query.

        text, parameters : as of `ask`;  timeout : s until the last piece
        rows             : at most so many, None = all;  most_bytes : refuse a larger result, None = any size
        expressions      : parts of the text that must each be one expression, whoever wrote them
        Errors           : as of `ask`, also after some pieces have come
        """
        check("timeout", timeout, 0.0, TIMEOUT_HI)
        question: dict[str, Any] = {
            "sql": text,
            "parameters": dict(parameters or {}),
            "rows": rows,
            "bytes": most_bytes,
        }
        question["expressions"] = [*expressions]
        try:
            line = json.dumps(question, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise BadInput(f"SQL: a parameter is not a number, text, boolean or list of them: {error}") from None
        stopped = BadInput(f"SQL: stopped after {timeout:g} s")
        own, worker = self._begun()
        assert worker.stdin is not None
        assert worker.stdout is not None
        whole = False
        try:
            worker.stdin.write(line.encode() + b"\n")
            worker.stdin.flush()
            out = io.BufferedReader(_Timed(worker.stdout.fileno(), time.monotonic() + timeout), _BUFFER)
            answer = _line(out)
            if not answer:
                with pa.ipc.open_stream(out) as stream:
                    yield from stream
                answer = _line(out)
            whole = True
        except TimeoutError:
            raise stopped from None
        except BrokenPipeError:
            raise BadInput("SQL: the process that answers queries has ended; ask again") from None
        except (pa.ArrowException, OSError, EOFError):
            raise BadInput("SQL: the query needs more memory than it may have, or brought its process down") from None
        finally:
            self._ended(own, whole)
        if answer:
            raise _ERRORS.get(answer["kind"], LakeError)(answer["error"])

    def _begun(self) -> tuple[object, subprocess.Popen[bytes]]:
        """A question that is now being answered, and who answers it."""
        with self._changing:
            if self._answering is not None:
                # Whoever asked before reads no further, though that is found out only when the generator is collected.
                self._end()
            self._answering = object()
            return self._answering, self._running()

    def _ended(self, question: object, whole: bool) -> None:
        """A question that has been answered, or is given up; that may be found out when another is being answered."""
        with self._changing:
            if self._answering is question:
                self._answering = None
                if not whole:
                    self._end()

    def _running(self) -> subprocess.Popen[bytes]:
        if self._worker is None or self._worker.poll() is not None:
            pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
            # Arrow's other allocators reserve a gigabyte at the start, which would count against the limit.
            environment = {**os.environ, "ARROW_DEFAULT_MEMORY_POOL": "system"}
            self._worker = subprocess.Popen(self.command, cwd=_ROOT, env=environment, **pipes)
        return self._worker


class _Timed(io.RawIOBase):
    """What a pipe says until a moment of the monotonic clock; later TimeoutError."""

    def __init__(self, pipe: int, deadline: float) -> None:
        self.pipe, self.deadline = pipe, deadline

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        with selectors.DefaultSelector() as selector:
            selector.register(self.pipe, selectors.EVENT_READ)
            if not selector.select(max(self.deadline - time.monotonic(), 0.0)):
                raise TimeoutError
        return os.readv(self.pipe, [buffer])


def _line(out: IO[bytes]) -> dict[str, str]:
    if not (line := out.readline()):
        raise EOFError
    said: dict[str, str] = json.loads(line)
    return said


def check(name: str, value: float, lo: float, hi: float) -> None:
    """Refuse a number outside its bounds.

    name : in the refusal;  value : what was given;  lo, hi : both still allowed
    """
    if not lo <= value <= hi:
        raise OutOfRange(name, value, lo, hi)
