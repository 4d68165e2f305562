"""A lake that the page shows: its tables as they were when it was opened, and the processes that answer queries.

The key of the versions of its tables identifies an open lake. If new versions are published, the page reports that the
lake has changed, but shows the old versions until the user opens the lake again.
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
    # This module loads compiled code, which is slow.
    from truesky.explore.counting import ChartColumns

# Largest number of queries that wait for a process; further queries are refused.
MAX_WAITING = 8
# Number of threads for short, frequent requests (tiles, sources), and for requests that may take seconds; largest
# number of requests that wait for each of the two pools.
PIXEL_THREADS, TABLE_THREADS, MAX_QUEUED = 4, 2, 64
_KEY_LENGTH = 16
# Tables of plans and images. Their exposure numbers are unique only within one request.
_EXPOSURE_TABLES = ("exposures", "tasks", "products")
Item = TypeVar("Item")
Arguments = ParamSpec("Arguments")


class Busy(LakeError):
    """Too many requests are waiting."""


class Closed(Busy):
    """The lake was opened again while a request waited."""


class ProcessPool:
    """Pool of processes, each of which answers one query at a time.

    Parameters
    ----------
    start_process : callable
        Function that returns a new process.
    number : int
        Number of processes.
    """

    def __init__(self, start_process: Callable[[], Process], number: int) -> None:
        self._start_process, self._num_waiting, self._is_closed = start_process, 0, False
        self._processes = {start_process() for _ in range(number)}
        self._free: asyncio.Queue[Process] = asyncio.Queue()
        for process in self._processes:
            self._free.put_nowait(process)

    @asynccontextmanager
    async def process(self, is_patient: bool = False) -> AsyncIterator[Process]:
        """Lend a free process. If its user is cancelled, a new process replaces it.

        Parameters
        ----------
        is_patient : bool, optional
            Wait even if MAX_WAITING queries are waiting, and do not count as one of them.

        Yields
        ------
        Process
            The process.

        Raises
        ------
        Busy
            If too many queries are waiting.
        Closed
            If the pool has been closed.
        """
        self._refuse_closed()
        if self._free.empty() and self._num_waiting >= MAX_WAITING and not is_patient:
            raise Busy(f"{MAX_WAITING} queries are waiting: try again later")
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
            # The user left in the middle of an answer. Replace the process: the next user must not get the rest.
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
            raise Closed("the lake has been opened again")

    async def warm(self) -> None:
        """Start all processes."""
        async with AsyncExitStack() as stack:
            processes = [await stack.enter_async_context(self.process()) for _ in range(len(self._processes))]
            await asyncio.gather(*(asyncio.to_thread(process.ask, "SELECT 1", {}) for process in processes))

    def close(self) -> None:
        """Stop idle processes now and busy processes when their queries end. Waiting queries raise Closed."""
        self._is_closed = True
        for _ in range(self._free.qsize()):
            process = self._free.get_nowait()
            process.stop()
            self._free.put_nowait(process)


class ThreadPool:
    """Pool of threads with a limited queue.

    Parameters
    ----------
    threads : int
        Number of threads.
    max_queued : int, optional
        Largest number of requests that wait for a thread.
    """

    def __init__(self, threads: int, max_queued: int = MAX_QUEUED) -> None:
        self._threads, self._max_queued = ThreadPoolExecutor(threads), max_queued
        self._slots = threading.BoundedSemaphore(threads + max_queued)

    async def run(
        self, function: Callable[Arguments, Item], *arguments: Arguments.args, **keywords: Arguments.kwargs
    ) -> Item:
        """Run a function in a thread and return its result. A cancelled caller leaves the queue.

        Parameters
        ----------
        function : callable
            The function.
        *arguments, **keywords
            Its arguments.

        Returns
        -------
        object
            Result of the function.

        Raises
        ------
        Busy
            If too many requests are waiting.
        Closed
            If the pool has been closed.
        """
        if not self._slots.acquire(blocking=False):
            raise Busy(f"{self._max_queued} requests are waiting: try again later")
        try:
            future = self._threads.submit(function, *arguments, **keywords)
        except RuntimeError:
            self._slots.release()
            raise Closed("the lake has been opened again") from None
        # Free the slot only when the thread is done, even if the caller has been cancelled.
        future.add_done_callback(lambda _: self._slots.release())
        return await asyncio.wrap_future(future)

    def close(self) -> None:
        """Accept no further requests; waiting requests are still answered."""
        self._threads.shutdown(wait=False)


@dataclass(frozen=True, slots=True)
class RequestTables:
    """The tables of one request, including the tables that all requests share.

    Attributes
    ----------
    request : str or None
        Name of the request; the first name if several requests share these tables; None if no other request has tables.
    names : tuple of str
        Names of all requests that share these tables; empty in a lake without named requests.
    versions : mapping of str to Version
        Versions by name of the table.
    """

    request: str | None
    names: tuple[str, ...]
    versions: Mapping[str, read.Version]

    def rows(
        self, table: str, columns: Sequence[str] | None = None, exposures: Collection[int] | None = None
    ) -> list[dict[str, Any]]:
        """Read rows of a table.

        Parameters
        ----------
        table : str
            Name of the table.
        columns : sequence of str, optional
            Names of the columns. The default is all columns.
        exposures : collection of int, optional
            Read only rows of exposures with these numbers. The default is all rows.

        Returns
        -------
        list of dict
            One dictionary per row; empty if the request has no such table.
        """
        version = self.versions.get(table)
        numbers = None if exposures is None else pa.array([*exposures], pa.int64())
        where = None if numbers is None else pc.field("exposure_id").isin(numbers)
        return [] if version is None else version.rows(columns, where=where).to_pylist()

    def iterate_rows(self, table: str, columns: Sequence[str]) -> Iterator[pa.Table]:
        """Yield the rows of a table partition by partition, because a table may be larger than the memory."""
        version = self.versions.get(table)
        return iter(()) if version is None else (version.rows(columns, [part]) for part in version.partitions)


class LakeSession:
    """An open lake with its processes and threads.

    Parameters
    ----------
    root : Folder
        Folder of the lake.
    request : str, optional
        Name of the request whose tables are shown. The default is all requests.
    memory : float, optional
        Memory limit of each process, in bytes.
    timeout : float, optional
        Time limit of a query, in seconds.

    Attributes
    ----------
    key : str
        Key of the versions of all tables; it changes if a table changes.
    """

    def __init__(
        self, root: Folder, request: str | None = None, memory: float = MEMORY, timeout: float = TIMEOUT
    ) -> None:
        self.explorer = Explorer(root, memory, timeout, request)
        self.root, self.request, self.timeout = self.explorer.root, request, timeout
        self.key = digest({name: version.key for name, version in self.explorer.versions.items()})[:_KEY_LENGTH]
        # A query of the user may take minutes. Separate processes keep it from delaying the queries of the page.
        self.user_queries = ProcessPool(self.explorer.process, 2)
        self.page_queries = ProcessPool(self.explorer.process, 1)
        self.pixel_pool, self.table_pool = ThreadPool(PIXEL_THREADS), ThreadPool(TABLE_THREADS)
        self.threads = min(os.cpu_count() or 1, 8)
        # Memory-mapped columns of charts, by selection and expressions of the axes.
        self.cached_columns: dict[tuple[Hashable, ...], ChartColumns] = {}

    @property
    def versions(self) -> Mapping[str, read.Version]:
        """Versions of all tables by name, with and without the name of the request."""
        return self.explorer.versions

    @property
    def listed_versions(self) -> Mapping[str, read.Version]:
        """Versions by listed name: the name of the table, and REQUEST.TABLE if the versions of requests differ."""
        return {name: version for name, version in sorted(self.versions.items()) if self.explorer.is_listed(name)}

    def find_version(self, table: str) -> read.Version:
        """Return the version of a table; raise BadInput if the lake has no such table."""
        if table not in self.versions:
            raise BadInput(f"the lake has no table {table}")
        return self.versions[table]

    def request_tables(self, *tables: str) -> list[RequestTables]:
        """Return the tables of each request that has any of these tables. Requests with equal versions count once."""
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
        """Tables of the requests that have a plan or images. Exposure numbers are unique within each of them."""
        return self.request_tables(*_EXPOSURE_TABLES)

    def is_changed(self) -> bool:
        """Return True if a table was added, removed or published again since the lake was opened."""
        try:
            return _table_keys(Explorer(self.root, request=self.request)) != _table_keys(self.explorer)
        except LakeError:
            return True

    async def run_query(self, text: str, parameters: Mapping[str, object] | None = None) -> pa.Table:
        """Run a query of the page and return its result."""
        async with self.page_queries.process() as process:
            return await asyncio.to_thread(process.ask, text, dict(parameters or {}), self.timeout)

    async def warm(self) -> None:
        """Start the processes now, because the first query of each would wait for it; first those of the page."""
        for pool in (self.page_queries, self.user_queries):
            await pool.warm()

    def close(self) -> None:
        """Stop the processes. Running queries finish with the versions of this lake."""
        self.user_queries.close()
        self.page_queries.close()
        self.pixel_pool.close()
        self.table_pool.close()
        self.explorer.close()


def _table_keys(explorer: Explorer) -> tuple[dict[str, str], set[str]]:
    """Return the keys of the tables by name, and the names of the tables that cannot be opened."""
    return {name: version.key for name, version in explorer.versions.items()}, {*explorer.damaged}


async def iterate_in_thread(batches: Iterator[Item]) -> AsyncIterator[Item]:
    """Yield the items of a blocking iterator, computed in a thread so that the event loop is not blocked."""
    sentinel = object()
    while (piece := await asyncio.to_thread(next, batches, sentinel)) is not sentinel:
        yield piece  # type: ignore[misc]
