"""A process that answers queries, with bounds of memory and time that hold; worker.py is its other end."""

from __future__ import annotations

import json
import os
import selectors
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from lake_schema.errors import BadInput, Damaged, LakeError, OutOfRange

_ROOT = Path(__file__).resolve().parents[2]
# Bytes that a query may take, and s, where nobody says otherwise; and between which bounds anybody may.
MEMORY, TIMEOUT = 4e9, 300.0
_MEMORY_LO, _MEMORY_HI = 1e7, 1e15
TIMEOUT_HI = 1e6
_ERRORS = {"BadInput": BadInput, "Damaged": Damaged}


class Process:
    """Answers queries of some tables; starts with the first, ends with `close`, and then starts again.

    tables  : NAME=KEY or REQUEST.NAME=KEY of tables of the lake `root`, NAME=@FILE of an Arrow file
    memory  : bytes that a query and its result may take together
    """

    def __init__(self, root: Path, tables: Sequence[str], memory: float = MEMORY) -> None:
        check("memory", memory, _MEMORY_LO, _MEMORY_HI)
        self.command = [sys.executable, "-m", "jobs.explore.worker", str(root), str(int(memory)), *tables]
        self._worker: subprocess.Popen[bytes] | None = None

    def close(self) -> None:
        """End the process; a later query starts another."""
        if self._worker is not None:
            self._worker.kill()
            self._worker.communicate()
            self._worker = None

    def ask(self, text: str, parameters: dict[str, object], timeout: float = TIMEOUT) -> pa.Table:
        """The result of a SELECT, which is stopped after `timeout` s.  Errors: BadInput, Damaged, as of Explorer.sql"""
        check("timeout", timeout, 0.0, TIMEOUT_HI)
        try:
            line = json.dumps({"sql": text, "parameters": parameters}, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise BadInput(f"SQL: a parameter is not a number, text, boolean or list of them: {error}") from None
        deadline = time.monotonic() + timeout
        worker = self._running()
        assert worker.stdin is not None
        assert worker.stdout is not None
        whole = False
        try:
            worker.stdin.write(line.encode() + b"\n")
            worker.stdin.flush()
            if not _readable(worker, deadline):
                raise BadInput(f"SQL: stopped after {timeout:g} s")
            head = worker.stdout.readline()
            if not head:
                raise BadInput("SQL: the query needs more memory than it may have, or brought its process down")
            answer = json.loads(head)
            if not answer:
                with pa.ipc.open_stream(worker.stdout) as stream:
                    found = stream.read_all()
            whole = True
        except BrokenPipeError:
            raise BadInput("SQL: the process that answers queries has ended; ask again") from None
        finally:
            if not whole:
                self.close()
        if answer:
            raise _ERRORS.get(answer["kind"], LakeError)(answer["error"])
        return found

    def _running(self) -> subprocess.Popen[bytes]:
        if self._worker is None or self._worker.poll() is not None:
            pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
            # Arrow's other allocators reserve a gigabyte at the start, which would count against the limit.
            environment = {**os.environ, "ARROW_DEFAULT_MEMORY_POOL": "system"}
            self._worker = subprocess.Popen(self.command, cwd=_ROOT, env=environment, **pipes)
        return self._worker


def check(name: str, value: float, lo: float, hi: float) -> None:
    """Refuse a number outside its bounds.

    name : in the refusal;  value : what was given;  lo, hi : both still allowed
    """
    if not lo <= value <= hi:
        raise OutOfRange(name, value, lo, hi)


def _readable(worker: subprocess.Popen[bytes], deadline: float) -> bool:
    """Has the process said anything, or ended, before the deadline?"""
    assert worker.stdout is not None
    with selectors.DefaultSelector() as selector:
        selector.register(worker.stdout, selectors.EVENT_READ)
        return bool(selector.select(max(deadline - time.monotonic(), 0.0)))
