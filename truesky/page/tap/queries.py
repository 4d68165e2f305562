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

MOST_JOBS, AT_ONCE = 64, 2
# Of the result of a job, and of those of all jobs together.
MOST_BYTES, MOST_BYTES_IN_ALL = 4 << 30, 16 << 30
KEPT = timedelta(days=1)
_ENDED = ("COMPLETED", "ERROR", "ABORTED")
# (parameters, s that it may take) -> content type and pieces of the answer
Run = Callable[[dict[str, str], float], AbstractAsyncContextManager[tuple[str, AsyncIterator[bytes]]]]


@dataclass(slots=True)
class Job:
    """A question, and what becomes of it; `size` are the bytes of its result."""

    parameters: dict[str, str]
    most_seconds: float
    name: str = field(default_factory=lambda: secrets.token_hex(8))
    phase: str = "PENDING"
    made: datetime = field(default_factory=lambda: datetime.now(UTC))
    started: datetime | None = None
    ended: datetime | None = None
    destroyed: datetime = field(default_factory=lambda: datetime.now(UTC) + KEPT)
    error: str = ""
    kind: str = ""
    size: int = 0
    task: asyncio.Task[None] | None = None
    changed: asyncio.Event = field(default_factory=asyncio.Event)

    def set_phase(self, phase: str) -> None:
        """And tell whoever waits for it."""
        self.phase = phase
        self.changed.set()
        self.changed = asyncio.Event()

    @property
    def has_ended(self) -> bool:
        return self.phase in _ENDED


class Jobs:
    """All of them; results lie in a folder that goes with the service.

    run : answers a question
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._folder = tempfile.TemporaryDirectory(prefix="truesky-")
        self._jobs: dict[str, Job] = {}
        self._places = asyncio.Semaphore(AT_ONCE)

    def all(self) -> list[Job]:
        """Those that are not past their day, oldest first."""
        now = datetime.now(UTC)
        for name in [name for name, job in self._jobs.items() if job.destroyed <= now]:
            self.remove(name)
        return list(self._jobs.values())

    def add(self, parameters: dict[str, str], most_seconds: float) -> Job:
        """A new one, which waits to be started.  Errors: BadInput where there are too many"""
        if len(self.all()) >= MOST_JOBS:
            raise BadInput(f"{MOST_JOBS} jobs are kept: delete some")
        job = Job(parameters, most_seconds)
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
            job.task = asyncio.create_task(self._work(job))

    def abort(self, job: Job) -> None:
        """End it, unless it has ended."""
        if not job.has_ended:
            if job.task is not None:
                job.task.cancel()
            job.ended = datetime.now(UTC)
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

    async def _work(self, job: Job) -> None:
        try:
            # Queued until there is a place, and a process that answers.
            async with self._places, self._run(job.parameters, job.most_seconds) as (kind, pieces):
                job.started = datetime.now(UTC)
                job.set_phase("EXECUTING")
                await self._keep(job, pieces)
                job.kind = kind
        except asyncio.CancelledError:
            # What has been written of an answer that nobody will have counts against the others no more.
            self._forget(job)
            raise
        except (LakeError, OSError) as error:
            job.error = str(error) or type(error).__name__
        except Exception as error:
            # Whatever it is: a job that has ended must not be waited for.
            job.error = f"{type(error).__name__}: {error}"
        if job.error:
            self._forget(job)
        job.ended = datetime.now(UTC)
        job.set_phase("ERROR" if job.error else "COMPLETED")

    def _forget(self, job: Job) -> None:
        """What has been written of its result."""
        self.file(job).unlink(missing_ok=True)
        job.size = 0

    async def _keep(self, job: Job, pieces: AsyncIterator[bytes]) -> None:
        """Write the result of a job into its file.  Errors: BadInput where it is too large"""
        with self.file(job).open("wb") as file:
            async for piece in pieces:
                # A piece may be as large as the whole result: others are answered while it is written.
                await asyncio.to_thread(file.write, piece)
                job.size += len(piece)
                if job.size > MOST_BYTES:
                    raise BadInput(f"the result has more than {MOST_BYTES / 1e9:.3g} GB: ask for less")
                if sum(one.size for one in self._jobs.values()) > MOST_BYTES_IN_ALL:
                    raise BadInput(f"results of jobs have more than {MOST_BYTES_IN_ALL / 1e9:.3g} GB: delete some")
