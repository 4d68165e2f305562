"""Asynchronous queries: UWS jobs whose results are kept for a day.

References
----------
IVOA Recommendation UWS 1.1
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
# Largest size of the result of one job, and of the results of all jobs.
MAX_RESULT_BYTES, MAX_TOTAL_BYTES = 4 << 30, 16 << 30
RETENTION = timedelta(days=1)
_END_PHASES = ("COMPLETED", "ERROR", "ABORTED")
# Function that runs a query: (parameters, time limit in s) -> content type and pieces of the result.
RunQuery = Callable[[dict[str, str], float], AbstractAsyncContextManager[tuple[str, AsyncIterator[bytes]]]]


@dataclass(slots=True)
class Job:
    """An asynchronous query, its state by UWS, and the size of its result.

    `parameters` are the parameters of TAP, `max_seconds` is the time limit, and `name` is the identifier in addresses.
    """

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
        """Set the phase and wake all requests that wait for a change of it."""
        self.phase = phase
        self.phase_changed.set()
        self.phase_changed = asyncio.Event()

    @property
    def has_ended(self) -> bool:
        """True if the job is completed, failed or aborted."""
        return self.phase in _END_PHASES


class Jobs:
    """All jobs of a service. Results are stored in a temporary folder, which is removed when the service ends.

    Parameters
    ----------
    run_query : RunQuery
        Function that runs a query.
    """

    def __init__(self, run_query: RunQuery) -> None:
        self._run_query = run_query
        self._folder = tempfile.TemporaryDirectory(prefix="truesky-")
        self._jobs: dict[str, Job] = {}
        self._slots = asyncio.Semaphore(PARALLEL_JOBS)

    def all(self) -> list[Job]:
        """Remove expired jobs and return the others, oldest first."""
        now = datetime.now(UTC)
        for name in [name for name, job in self._jobs.items() if job.destruction_time <= now]:
            self.remove(name)
        return list(self._jobs.values())

    def add(self, parameters: dict[str, str], max_seconds: float) -> Job:
        """Add a job, which `start` will run; raise BadInput if there are too many jobs."""
        if len(self.all()) >= MAX_JOBS:
            raise BadInput(f"there are {MAX_JOBS} jobs already: delete some")
        job = Job(parameters, max_seconds)
        self._jobs[job.name] = job
        return job

    def get(self, name: str) -> Job | None:
        """Return the job with this identifier, or None if it does not exist."""
        self.all()
        return self._jobs.get(name)

    def file(self, job: Job) -> Path:
        """Return the path of the result of a job."""
        return Path(self._folder.name) / job.name

    def start(self, job: Job) -> None:
        """Run a job if it has not been started yet."""
        if job.phase == "PENDING":
            job.set_phase("QUEUED")
            job.task = asyncio.create_task(self._run_job(job))

    def abort(self, job: Job) -> None:
        """Stop a job if it has not ended yet."""
        if not job.has_ended:
            if job.task is not None:
                job.task.cancel()
            job.end_time = datetime.now(UTC)
            job.set_phase("ABORTED")

    def remove(self, name: str) -> None:
        """Stop a job and delete it with its result."""
        if (job := self._jobs.pop(name, None)) is not None:
            self.abort(job)
            self.file(job).unlink(missing_ok=True)

    async def close(self) -> None:
        """Stop and delete all jobs."""
        tasks = [job.task for job in self._jobs.values() if job.task is not None]
        for name in list(self._jobs):
            self.remove(name)
        await asyncio.gather(*tasks, return_exceptions=True)
        self._folder.cleanup()

    async def _run_job(self, job: Job) -> None:
        try:
            # The job stays queued until a slot and a process are free.
            async with self._slots, self._run_query(job.parameters, job.max_seconds) as (content_type, pieces):
                job.start_time = datetime.now(UTC)
                job.set_phase("EXECUTING")
                await self._write_result(job, pieces)
                job.content_type = content_type
        except asyncio.CancelledError:
            # Delete the partial result, so that it does not count towards the size of all results.
            self._remove_result(job)
            raise
        except (LakeError, OSError) as error:
            job.error = str(error) or type(error).__name__
        except Exception as error:
            # Catch any error, because a client would wait forever for a job without an end.
            job.error = f"{type(error).__name__}: {error}"
        if job.error:
            self._remove_result(job)
        job.end_time = datetime.now(UTC)
        job.set_phase("ERROR" if job.error else "COMPLETED")

    def _remove_result(self, job: Job) -> None:
        """Delete the result, complete or not."""
        self.file(job).unlink(missing_ok=True)
        job.result_bytes = 0

    async def _write_result(self, job: Job, pieces: AsyncIterator[bytes]) -> None:
        """Write the result of a job into its file; raise BadInput if it is too large."""
        with self.file(job).open("wb") as file:
            async for piece in pieces:
                # A piece may be as large as the whole result, so write it in a thread to keep the server responsive.
                await asyncio.to_thread(file.write, piece)
                job.result_bytes += len(piece)
                if job.result_bytes > MAX_RESULT_BYTES:
                    raise BadInput(f"the result is larger than {MAX_RESULT_BYTES / 1e9:.3g} GB: select fewer rows")
                if sum(stored_job.result_bytes for stored_job in self._jobs.values()) > MAX_TOTAL_BYTES:
                    raise BadInput(f"all results are larger than {MAX_TOTAL_BYTES / 1e9:.3g} GB: delete some jobs")
