"""A lake as it is shown: its tables as they were when it was opened, and the processes that answer questions of them.

Whatever is kept of it goes by its key. A lake that is published anew is said to be changed, and shown as it was until
it is opened again; nothing of the one is mixed with the other.
"""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import AsyncIterator, Callable, Collection, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.errors import BadInput, LakeError
from lake_schema.store import read
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.store.provenance import digest
from truesky.explore.explorer import Explorer
from truesky.explore.process import MEMORY, TIMEOUT, Process

if TYPE_CHECKING:
    # Compiled, and slow to load.
    from truesky.explore.counting import ChartColumns

# Questions that wait for a process; those beyond are refused.
MAX_WAITING = 8
# Threads that answer from files and tables: of tiles and sources, which are asked for by the dozen and come soon, and
# of the rest, which may take s; and how many questions may wait for each.
PIXEL_THREADS, TABLE_THREADS, MAX_QUEUED = 4, 2, 64
_KEY_LENGTH = 16
# What is planned and rendered: rows of it go by the number of an exposure, which every request counts for itself.
_EXPOSURE_TABLES = ("exposures", "tasks", "products")
Item = TypeVar("Item")
Arguments = ParamSpec("Arguments")


class Busy(LakeError):
    """Too many questions wait already."""


class Closed(Busy):
    """The lake has been opened anew while a question waited."""


class ProcessPool:
    """Processes that answer questions, each one at a time.

    make : a process;  number : how many
    """

    def __init__(self, start_process: Callable[[], Process], number: int) -> None:
        self._start_process, self._num_waiting, self._is_closed = start_process, 0, False
        self._processes = {start_process() for _ in range(number)}
        self._free: asyncio.Queue[Process] = asyncio.Queue()
        for process in self._processes:
            self._free.put_nowait(process)

    @asynccontextmanager
    async def process(self, is_patient: bool = False) -> AsyncIterator[Process]:
        """A process that is free; where its user is cancelled another takes its place.

        is_patient : waits however many wait, and is none of those who wait
        Errors     : Busy where too many wait; Closed
        """
        self._refuse_closed()
        if self._free.empty() and self._num_waiting >= MAX_WAITING and not is_patient:
            raise Busy(f"{MAX_WAITING} questions are waiting: ask again later")
        self._num_waiting += not is_patient
        try:
            process = await self._free.get()
        finally:
            self._num_waiting -= not is_patient
        try:
            self._refuse_closed()
            yield process
        except LakeError:
            raise
        except BaseException:
            # Its user went away in the midst of an answer: whoever asks next must meet nothing of that.
            process.stop()
            self._processes.discard(process)
            process = self._start_process()
            self._processes.add(process)
            raise
        finally:
            if self._is_closed:
                process.stop()
            self._free.put_nowait(process)

    def _refuse_closed(self) -> None:
        if self._is_closed:
            raise Closed("the lake has been opened anew")

    async def warm(self) -> None:
        """Start them all."""
        async with AsyncExitStack() as stack:
            processes = [await stack.enter_async_context(self.process()) for _ in range(len(self._processes))]
            await asyncio.gather(*(asyncio.to_thread(process.ask, "SELECT 1", {}) for process in processes))

    def close(self) -> None:
        """End them, those that are in use when their users are done; nobody else is given one."""
        self._is_closed = True
        for _ in range(self._free.qsize()):
            process = self._free.get_nowait()
            process.stop()
            self._free.put_nowait(process)


class ThreadPool:
    """Threads that answer questions, and a bound of how many wait for one.

    threads : that answer at a time;  most : questions that may wait beside
    """

    def __init__(self, threads: int, max_queued: int = MAX_QUEUED) -> None:
        self._threads, self._max_queued = ThreadPoolExecutor(threads), max_queued
        self._slots = threading.BoundedSemaphore(threads + max_queued)

    async def run(
        self, function: Callable[Arguments, Item], *arguments: Arguments.args, **keywords: Arguments.kwargs
    ) -> Item:
        """What a function returns, without holding up anything else; one who goes away leaves the line.

        Errors : Busy where too many wait; Closed; those of the function
        """
        if not self._slots.acquire(blocking=False):
            raise Busy(f"{self._max_queued} questions are waiting: ask again later")
        try:
            future = self._threads.submit(function, *arguments, **keywords)
        except RuntimeError:
            self._slots.release()
            raise Closed("the lake has been opened anew") from None
        # Also where nobody waits any more: the thread is in use until it is done.
        future.add_done_callback(lambda _: self._slots.release())
        return await asyncio.wrap_future(future)

    def close(self) -> None:
        """Take no other question; those that wait are answered."""
        self._threads.shutdown(wait=False)


@dataclass(frozen=True, slots=True)
class RequestTables:
    """The tables of one request, and those that no request has to itself.

    request  : its name, None where the lake has no other; of several that share these tables the first
    names    : of all of them, none in a lake without names;  versions : by table
    """

    request: str | None
    names: tuple[str, ...]
    versions: Mapping[str, read.Version]

    def rows(
        self, table: str, columns: Sequence[str] | None = None, exposures: Collection[int] | None = None
    ) -> list[dict[str, Any]]:
        """Rows of a table, none where it is not there.

        columns : names, None = all;  exposures : only those of these, by number, None = all
        """
        version = self.versions.get(table)
        numbers = None if exposures is None else pa.array([*exposures], pa.int64())
        where = None if numbers is None else pc.field("exposure_id").isin(numbers)
        return [] if version is None else version.rows(columns, where=where).to_pylist()

    def iterate_rows(self, table: str, columns: Sequence[str]) -> Iterator[pa.Table]:
        """The same, a part after the other: a plan may be larger than memory."""
        version = self.versions.get(table)
        return iter(()) if version is None else (version.rows(columns, [part]) for part in version.partitions)


class LakeSession:
    """One opened lake.

    root    : of the lake;  request : whose tables, where the lake has those of several
    memory  : bytes that each process may take;  timeout : s that a question may take
    key     : of the versions of its tables
    """

    def __init__(
        self, root: Folder, request: str | None = None, memory: float = MEMORY, timeout: float = TIMEOUT
    ) -> None:
        self.explorer = Explorer(root, memory, timeout, request)
        self.root, self.request, self.timeout = self.explorer.root, request, timeout
        self.key = digest({name: version.key for name, version in self.explorer.versions.items()})[:_KEY_LENGTH]
        # What a user asks may take minutes: it holds up neither the other nor what the page itself asks.
        self.user_queries = ProcessPool(self.explorer.process, 2)
        self.page_queries = ProcessPool(self.explorer.process, 1)
        self.pixel_pool, self.table_pool = ThreadPool(PIXEL_THREADS), ThreadPool(TABLE_THREADS)
        self.threads = min(os.cpu_count() or 1, 8)
        # Kept columns that are mapped, by selection and expressions.
        self.cached_columns: dict[tuple[Hashable, ...], ChartColumns] = {}

    @property
    def versions(self) -> Mapping[str, read.Version]:
        return self.explorer.versions

    @property
    def listed_versions(self) -> Mapping[str, read.Version]:
        """Every table once: by its own name where that is clear."""
        return {name: version for name, version in sorted(self.versions.items()) if self.explorer.is_listed(name)}

    def find_version(self, table: str) -> read.Version:
        """A table of the lake.  Errors: BadInput where there is none."""
        if table not in self.versions:
            raise BadInput(f"the lake has no table {table}")
        return self.versions[table]

    def request_tables(self, *tables: str) -> list[RequestTables]:
        """Each request that has one of these tables; those that have the same versions of all of them count once."""
        request_versions: dict[str, dict[str, read.Version]] = {}
        for name, version in sorted(self.versions.items()):
            request, _, table = name.rpartition(".")
            request_versions.setdefault(request, {})[table] = version
        shared = request_versions.pop("", {})
        owned_tables = {table for versions in request_versions.values() for table in versions}
        common_versions = {table: version for table, version in shared.items() if table not in owned_tables}
        requests_by_keys: dict[tuple[str, ...], list[str]] = {}
        for request, versions in (request_versions or {"": shared}).items():
            versions |= {table: version for table, version in common_versions.items() if table not in versions}
            if keys := tuple(versions[table].key for table in tables if table in versions):
                requests_by_keys.setdefault(keys, []).append(request)
        if not request_versions:
            return [RequestTables(None, (), shared) for _ in requests_by_keys]
        return [
            RequestTables(
                names[0] if len(requests_by_keys) > 1 else None,
                tuple(names),
                {table: version for name in reversed(names) for table, version in request_versions[name].items()},
            )
            for names in requests_by_keys.values()
        ]

    @cached_property
    def observed_requests(self) -> list[RequestTables]:
        """Requests that have planned or rendered something; what goes by the number of an exposure is of one."""
        return self.request_tables(*_EXPOSURE_TABLES)

    def is_changed(self) -> bool:
        """Whether a table has been published since it was opened, or has come or gone."""
        try:
            return _table_keys(Explorer(self.root, request=self.request)) != _table_keys(self.explorer)
        except LakeError:
            return True

    async def run_query(self, text: str, parameters: Mapping[str, object] | None = None) -> pa.Table:
        """The answer to a question of the page's own."""
        async with self.page_queries.process() as process:
            return await asyncio.to_thread(process.ask, text, dict(parameters or {}), self.timeout)

    async def warm(self) -> None:
        """Start the processes, those first that the page itself asks: the first question of each would wait for it."""
        for pool in (self.page_queries, self.user_queries):
            await pool.warm()

    def close(self) -> None:
        """End its processes; what is being answered is answered to its end, of the lake as it was."""
        self.user_queries.close()
        self.page_queries.close()
        self.pixel_pool.close()
        self.table_pool.close()
        self.explorer.close()


def _table_keys(explorer: Explorer) -> tuple[dict[str, str], set[str]]:
    """The keys of its tables, and the names of those that cannot be opened."""
    return {name: version.key for name, version in explorer.versions.items()}, {*explorer.damaged}


async def iterate_in_thread(batches: Iterator[Item]) -> AsyncIterator[Item]:
    """What an iterator that waits gives, without holding up anything else."""
    sentinel = object()
    while (piece := await asyncio.to_thread(next, batches, sentinel)) is not sentinel:
        yield piece  # type: ignore[misc]
