"""Questions of other tools that wait for their answer: jobs of UWS, with a result that is kept for a day.

Ref: IVOA Recommendation UWS 1.1
"""

from __future__ import annotations

import asyncio
import secrets
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

from lake_schema.errors import BadInput, LakeError

MAX_JOBS, PARALLEL_JOBS = 64, 2
# Of the result of a job, and of those of all jobs together.
MAX_RESULT_BYTES, MAX_TOTAL_BYTES = 4 << 30, 16 << 30
RETENTION = timedelta(days=1)
_END_PHASES = ("COMPLETED", "ERROR", "ABORTED")
# (parameters, s that it may take) -> content type and pieces of the answer
RunQuery = Callable[[dict[str, str], float], AbstractAsyncContextManager[tuple[str, AsyncIterator[bytes]]]]


@dataclass(slots=True)
class Job:
    """A question, and what becomes of it; `size` are the bytes of its result."""

    parameters: dict[str, str]
    max_seconds: float
    name: str = field(default_factory=lambda: secrets.token_hex(8))
    phase: str = "PENDING"
    creation_time: datetime = field(default_factory=lambda: datetime.now(UTC))
    start_time: datetime | None = None
    end_time: datetime | None = None
    destruction_time: datetime = field(default_factory=lambda: datetime.now(UTC) + RETENTION)
    error: str = ""
    content_type: str = ""
    result_bytes: int = 0
    task: asyncio.Task[None] | None = None
    phase_changed: asyncio.Event = field(default_factory=asyncio.Event)

    def set_phase(self, phase: str) -> None:
        """And tell whoever waits for it."""
        self.phase = phase
        self.phase_changed.set()
        self.phase_changed = asyncio.Event()

    @property
    def has_ended(self) -> bool:
        return self.phase in _END_PHASES


class Jobs:
    """All of them; results lie in a folder that goes with the service.

    run : answers a question
    """

    def __init__(self, run_query: RunQuery) -> None:
        self._run_query = run_query
        self._folder = tempfile.TemporaryDirectory(prefix="truesky-")
        self._jobs: dict[str, Job] = {}
        self._slots = asyncio.Semaphore(PARALLEL_JOBS)

    def all(self) -> list[Job]:
        """Those that are not past their day, oldest first."""
        now = datetime.now(UTC)
        for name in [name for name, job in self._jobs.items() if job.destruction_time <= now]:
            self.remove(name)
        return list(self._jobs.values())

    def add(self, parameters: dict[str, str], max_seconds: float) -> Job:
        """A new one, which waits to be started.  Errors: BadInput where there are too many"""
        if len(self.all()) >= MAX_JOBS:
            raise BadInput(f"{MAX_JOBS} jobs are kept: delete some")
        job = Job(parameters, max_seconds)
        self._jobs[job.name] = job
        return job

    def get(self, name: str) -> Job | None:
        """The job of a name, None where there is none."""
        self.all()
        return self._jobs.get(name)

    def file(self, job: Job) -> Path:
        """Where its result is."""
        return Path(self._folder.name) / job.name

    def start(self, job: Job) -> None:
        """Run it, unless it has been."""
        if job.phase == "PENDING":
            job.set_phase("QUEUED")
            job.task = asyncio.create_task(self._run_job(job))

    def abort(self, job: Job) -> None:
        """End it, unless it has ended."""
        if not job.has_ended:
            if job.task is not None:
                job.task.cancel()
            job.end_time = datetime.now(UTC)
            job.set_phase("ABORTED")

    def remove(self, name: str) -> None:
        """End and forget it."""
        if (job := self._jobs.pop(name, None)) is not None:
            self.abort(job)
            self.file(job).unlink(missing_ok=True)

    async def close(self) -> None:
        """Forget all."""
        tasks = [job.task for job in self._jobs.values() if job.task is not None]
        for name in list(self._jobs):
            self.remove(name)
        await asyncio.gather(*tasks, return_exceptions=True)
        self._folder.cleanup()

    async def _run_job(self, job: Job) -> None:
        try:
            # Queued until there is a place, and a process that answers.
            async with self._slots, self._run_query(job.parameters, job.max_seconds) as (content_type, pieces):
                job.start_time = datetime.now(UTC)
                job.set_phase("EXECUTING")
                await self._write_result(job, pieces)
                job.content_type = content_type
        except asyncio.CancelledError:
            # What has been written of an answer that nobody will have counts against the others no more.
            self._remove_result(job)
            raise
        except (LakeError, OSError) as error:
            job.error = str(error) or type(error).__name__
        except Exception as error:
            # Whatever it is: a job that has ended must not be waited for.
            job.error = f"{type(error).__name__}: {error}"
        if job.error:
            self._remove_result(job)
        job.end_time = datetime.now(UTC)
        job.set_phase("ERROR" if job.error else "COMPLETED")

    def _remove_result(self, job: Job) -> None:
        """What has been written of its result."""
        self.file(job).unlink(missing_ok=True)
        job.result_bytes = 0

    async def _write_result(self, job: Job, pieces: AsyncIterator[bytes]) -> None:
        """Write the result of a job into its file.  Errors: BadInput where it is too large"""
        with self.file(job).open("wb") as file:
            async for piece in pieces:
                # A piece may be as large as the whole result: others are answered while it is written.
                await asyncio.to_thread(file.write, piece)
                job.result_bytes += len(piece)
                if job.result_bytes > MAX_RESULT_BYTES:
                    raise BadInput(f"the result has more than {MAX_RESULT_BYTES / 1e9:.3g} GB: ask for less")
                if sum(stored_job.result_bytes for stored_job in self._jobs.values()) > MAX_TOTAL_BYTES:
                    raise BadInput(f"results of jobs have more than {MAX_TOTAL_BYTES / 1e9:.3g} GB: delete some")
