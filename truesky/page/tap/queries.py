"""Asynchronous queries of the TAP service (UWS jobs); a job and its result are kept for at most a day.

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

# Largest number of asynchronous queries (jobs) that are kept, finished ones included.
MAX_JOBS = 64
# Largest number of asynchronous queries (jobs) that run at the same time; others wait.
PARALLEL_JOBS = 2
# Largest size in bytes of the result of one job.
MAX_RESULT_BYTES = 4 << 30
# Largest size in bytes of the results of all jobs together.
MAX_TOTAL_BYTES = 16 << 30
# Jobs and their results are deleted after this time.
RETENTION = timedelta(days=1)
_END_PHASES = ("COMPLETED", "ERROR", "ABORTED")
# Type of a function that runs a query. Its arguments are the parameters of TAP and the time limit in seconds. It
# provides the HTTP content type and an iterator over the bytes of the result.
RunQuery = Callable[[dict[str, str], float], AbstractAsyncContextManager[tuple[str, AsyncIterator[bytes]]]]


@dataclass(slots=True)
class Job:
    """An asynchronous query with its state.

    `parameters` are the parameters of TAP, `max_seconds` is the time limit in seconds, and `name` identifies the job in
    addresses. `phase` is the state that the UWS standard defines, such as "EXECUTING". `result_bytes` is the size of
    the result that has been written. `phase_changed` is set when the phase changes. Times are in UTC.
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
        """Set the phase (state) of the job, and wake all HTTP requests that wait for a change of the phase."""
        self.phase = phase
        self.phase_changed.set()
        self.phase_changed = asyncio.Event()

    @property
    def has_ended(self) -> bool:
        """True if the job has been completed, has failed or was aborted."""
        return self.phase in _END_PHASES


class Jobs:
    """All asynchronous jobs of a TAP service.

    Their results are files in a temporary folder, which is removed when the service ends.

    Parameters
    ----------
    run_query : RunQuery
        Function that runs a query. Its arguments are the parameters of TAP and the time limit in seconds.
    """

    def __init__(self, run_query: RunQuery) -> None:
        self._run_query = run_query
        self._folder = tempfile.TemporaryDirectory(prefix="truesky-")
        self._jobs: dict[str, Job] = {}
        self._slots = asyncio.Semaphore(PARALLEL_JOBS)

    def all(self) -> list[Job]:
        """Delete jobs whose destruction time is over, and return the others, oldest first."""
        now = datetime.now(UTC)
        for name in [name for name, job in self._jobs.items() if job.destruction_time <= now]:
            self.remove(name)
        return list(self._jobs.values())

    def add(self, parameters: dict[str, str], max_seconds: float) -> Job:
        """Add a job with these parameters of TAP and time limit (s), without starting it.

        BadInput is raised if there are already 64 jobs.
        """
        if len(self.all()) >= MAX_JOBS:
            raise BadInput(f"there are {MAX_JOBS} jobs already: delete some")
        job = Job(parameters, max_seconds)
        self._jobs[job.name] = job
        return job

    def get(self, name: str) -> Job | None:
        """Return the job with this identifier, or None if it does not exist or has expired."""
        self.all()
        return self._jobs.get(name)

    def file(self, job: Job) -> Path:
        """Return the path of the file for the result of a job; the file exists only while there is a result."""
        return Path(self._folder.name) / job.name

    def start(self, job: Job) -> None:
        """Start a job in the background; do nothing if it has been started or has ended."""
        if job.phase == "PENDING":
            job.set_phase("QUEUED")
            job.task = asyncio.create_task(self._run_job(job))

    def abort(self, job: Job) -> None:
        """Stop a job and set its phase to ABORTED; do nothing if it has ended."""
        if not job.has_ended:
            if job.task is not None:
                job.task.cancel()
            job.end_time = datetime.now(UTC)
            job.set_phase("ABORTED")

    def remove(self, name: str) -> None:
        """Stop the job with this identifier and delete it with its result; do nothing if it does not exist."""
        if (job := self._jobs.pop(name, None)) is not None:
            self.abort(job)
            self.file(job).unlink(missing_ok=True)

    async def close(self) -> None:
        """Stop and delete all jobs, and remove the folder of the results."""
        tasks = [job.task for job in self._jobs.values() if job.task is not None]
        for name in list(self._jobs):
            self.remove(name)
        await asyncio.gather(*tasks, return_exceptions=True)
        self._folder.cleanup()

    async def _run_job(self, job: Job) -> None:
        try:
            # The job has the phase QUEUED until fewer than PARALLEL_JOBS jobs run and a query process is free.
            async with self._slots, self._run_query(job.parameters, job.max_seconds) as (content_type, pieces):
                job.start_time = datetime.now(UTC)
                job.set_phase("EXECUTING")
                await self._write_result(job, pieces)
                job.content_type = content_type
        except asyncio.CancelledError:
            # The job was aborted. Delete its partial result, so that it does not count towards the limit for the size
            # of all results.
            self._remove_result(job)
            raise
        except (LakeError, OSError) as error:
            job.error = str(error) or type(error).__name__
        except Exception as error:
            # Catch any other error, too: if the job never ended, a client would wait for it forever.
            job.error = f"{type(error).__name__}: {error}"
        if job.error:
            self._remove_result(job)
        job.end_time = datetime.now(UTC)
        job.set_phase("ERROR" if job.error else "COMPLETED")

    def _remove_result(self, job: Job) -> None:
        """Delete the file with the result of a job, complete or not, if it exists."""
        self.file(job).unlink(missing_ok=True)
        job.result_bytes = 0

    async def _write_result(self, job: Job, pieces: AsyncIterator[bytes]) -> None:
        """Write the result of a job into its file.

        BadInput is raised if the result has more than 4 GiB, or the results of all jobs have more than 16 GiB together.
        """
        with self.file(job).open("wb") as file:
            async for piece in pieces:
                # `piece` may be as large as the whole result. It is written in a thread, so that the server can answer
                # other requests meanwhile.
                await asyncio.to_thread(file.write, piece)
                job.result_bytes += len(piece)
                if job.result_bytes > MAX_RESULT_BYTES:
                    raise BadInput(f"the result is larger than {MAX_RESULT_BYTES / 1e9:.3g} GB: select fewer rows")
                if sum(stored_job.result_bytes for stored_job in self._jobs.values()) > MAX_TOTAL_BYTES:
                    raise BadInput(f"all results are larger than {MAX_TOTAL_BYTES / 1e9:.3g} GB: delete some jobs")
