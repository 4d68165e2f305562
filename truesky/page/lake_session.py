"""An open lake (folder with tables and images) for the web page, with the processes that answer its SQL queries.

The versions of the tables are fixed when the lake is opened, and a hash of them (`LakeSession.key`) identifies the open
lake. If new versions are published, the page reports that the lake has changed, but it shows the old versions until the
user opens the lake again.
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
    # Import this module for type checks only, because it loads compiled code, which takes long.
    from truesky.explore.counting import ChartColumns

# Largest number of SQL queries that wait for a process; further queries are refused.
MAX_WAITING = 8
# Number of threads for short, frequent HTTP requests, such as tiles of images.
PIXEL_THREADS = 4
# Number of threads for HTTP requests that may take seconds.
TABLE_THREADS = 2
# Largest number of HTTP requests that wait for a thread of a pool.
MAX_QUEUED = 64
_KEY_LENGTH = 16
# Tables with the plans and images of a request. Their exposure numbers are unique only within one request.
_EXPOSURE_TABLES = ("exposures", "tasks", "products")
Item = TypeVar("Item")
Arguments = ParamSpec("Arguments")


class Busy(LakeError):
    """Error: too many queries or HTTP requests are waiting; the client may try again later."""


class Closed(Busy):
    """Error: the lake was opened again while a query or an HTTP request waited, so it is not answered."""


class ProcessPool:
    """Pool of query processes, each of which answers one SQL query at a time.

    Parameters
    ----------
    start_process : callable
        Function without arguments that returns a new `Process`.
    number : int
        Number of processes.

    Attributes
    ----------
    threads : ThreadPool
        One thread per process, in which a caller waits for its answer. Waiting may take minutes, and would keep the
        threads of `asyncio.to_thread` from other work.
    """

    def __init__(self, start_process: Callable[[], Process], number: int) -> None:
        self._start_process, self._num_waiting, self._is_closed = start_process, 0, False
        self.threads = ThreadPool(number)
        self._processes = {start_process() for _ in range(number)}
        self._free: asyncio.Queue[Process] = asyncio.Queue()
        for process in self._processes:
            self._free.put_nowait(process)

    @asynccontextmanager
    async def process(self, is_patient: bool = False) -> AsyncIterator[Process]:
        """Wait for a free process and lend it for the duration of an `async with` block.

        If the block ends with an error other than a LakeError, for example because the client has left, the process is
        stopped and replaced by a new one.

        Parameters
        ----------
        is_patient : bool, optional
            If True, wait even if 8 queries are waiting, and do not count as one of them.

        Yields
        ------
        Process
            Process that no other query uses.

        Raises
        ------
        Busy
            If 8 queries are waiting and `is_patient` is False.
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
            # The client may have left in the middle of an answer. Replace the process, so that the next query cannot
            # get the rest of this answer.
            process.discard()
            self._processes.discard(process)
            process = self._start_process()
            self._processes.add(process)
            raise
        finally:
            if self._is_closed:
                process.discard()
            self._free.put_nowait(process)

    def _refuse_closed(self) -> None:
        if self._is_closed:
            raise Closed("the lake has been opened again")

    async def warm(self) -> None:
        """Start all processes with a trivial query, so that later queries need not wait for a start."""
        async with AsyncExitStack() as stack:
            processes = [await stack.enter_async_context(self.process()) for _ in range(len(self._processes))]
            await asyncio.gather(*(self.threads.run(process.ask, "SELECT 1", {}) for process in processes))

    def close(self) -> None:
        """Stop idle processes now, and busy processes when their queries end. Queries that wait raise Closed."""
        self._is_closed = True
        for _ in range(self._free.qsize()):
            process = self._free.get_nowait()
            process.discard()
            self._free.put_nowait(process)


class ThreadPool:
    """Pool of threads with a limited queue, in which blocking functions run.

    Parameters
    ----------
    threads : int
        Number of threads.
    max_queued : int, optional
        Largest number of function calls that wait for a thread.
    """

    def __init__(self, threads: int, max_queued: int = MAX_QUEUED) -> None:
        self._threads, self._max_queued = ThreadPoolExecutor(threads), max_queued
        self._slots = threading.BoundedSemaphore(threads + max_queued)

    async def run(
        self, function: Callable[Arguments, Item], *arguments: Arguments.args, **keywords: Arguments.kwargs
    ) -> Item:
        """Run a function in a thread and return its result; errors of the function are raised again.

        If the caller is cancelled while the function waits for a thread, the function is not run.

        Parameters
        ----------
        function : callable
            Function to run.
        *arguments, **keywords
            Arguments of the function.

        Returns
        -------
        object
            Result of the function.

        Raises
        ------
        Busy
            If all threads are busy and the queue is full.
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
        # Free the place in the queue only when the thread has finished, even if the caller has been cancelled.
        future.add_done_callback(lambda _: self._slots.release())
        return await asyncio.wrap_future(future)

    def close(self) -> None:
        """Accept no further functions; functions that wait for a thread are still run."""
        self._threads.shutdown(wait=False)


@dataclass(frozen=True, slots=True)
class RequestTables:
    """Tables of one request (a simulation that a user asked for), including tables that all requests share.

    Attributes
    ----------
    request : str or None
        Name of the request, or the first name if several requests have the same versions. None if the lake has no other
        versions of the tables, so that a name is not necessary.
    names : tuple of str
        Names of all requests with these versions; empty in a lake without named requests.
    versions : mapping of str to Version
        Version of each table, by name of the table.
    """

    request: str | None
    names: tuple[str, ...]
    versions: Mapping[str, read.Version]

    def rows(
        self, table: str, columns: Sequence[str] | None = None, exposures: Collection[int] | None = None
    ) -> list[dict[str, Any]]:
        """Read rows of a table into memory.

        Parameters
        ----------
        table : str
            Name of the table.
        columns : sequence of str, optional
            Names of the columns. The default is all columns.
        exposures : collection of int, optional
            Numbers of exposures: only rows with these values in the column `exposure_id` are read. The default is all
            rows.

        Returns
        -------
        list of dict
            One dictionary per row, by column; empty if the request has no such table.
        """
        version = self.versions.get(table)
        numbers = None if exposures is None else pa.array([*exposures], pa.int64())
        where = None if numbers is None else pc.field("exposure_id").isin(numbers)
        return [] if version is None else version.rows(columns, where=where).to_pylist()

    def iterate_rows(self, table: str, columns: Sequence[str]) -> Iterator[pa.Table]:
        """Yield the rows of a table file by file, because all rows together may need more than the memory.

        Nothing is yielded if the request has no such table.
        """
        version = self.versions.get(table)
        return iter(()) if version is None else (version.rows(columns, [part]) for part in version.partitions)


class LakeSession:
    """An open lake with the processes and threads that answer HTTP requests about it.

    Parameters
    ----------
    root : Folder
        Folder of the lake.
    request : str, optional
        Name of the request whose tables are shown. The default is all requests.
    memory : float, optional
        Memory limit of an SQL query and its result together, in bytes.
    timeout : float, optional
        Time limit of an SQL query, in seconds.

    Attributes
    ----------
    key : str
        Hash of the names and versions of all tables, which identifies the open lake; it changes if a table changes.
    """

    def __init__(
        self, root: Folder, request: str | None = None, memory: float = MEMORY, timeout: float = TIMEOUT
    ) -> None:
        self.explorer = Explorer(root, memory, timeout, request)
        self.root, self.request, self.timeout = self.explorer.root, request, timeout
        self.key = digest({name: version.key for name, version in self.explorer.versions.items()})[:_KEY_LENGTH]
        # An SQL query of the user may take minutes. Queries that the page needs run in a separate process, so that they
        # do not wait for it.
        self.user_queries = ProcessPool(self.explorer.process, 2)
        self.page_queries = ProcessPool(self.explorer.process, 1)
        self.pixel_pool, self.table_pool = ThreadPool(PIXEL_THREADS), ThreadPool(TABLE_THREADS)
        self.threads = min(os.cpu_count() or 1, 8)
        # Memory-mapped columns of the charts. The key is the selection of rows, and then the SQL expressions.
        self.cached_columns: dict[tuple[Hashable, ...], ChartColumns] = {}

    @property
    def versions(self) -> Mapping[str, read.Version]:
        """Versions of all tables, by name: "products", and "demo.products" for the table of the request "demo"."""
        return self.explorer.versions

    @property
    def listed_versions(self) -> Mapping[str, read.Version]:
        """Versions of the tables in lists for the user, by name.

        The name is "products" if this name is unambiguous, else "demo.products" for the table of the request "demo".
        """
        return {name: version for name, version in sorted(self.versions.items()) if self.explorer.is_listed(name)}

    def find_version(self, table: str) -> read.Version:
        """Return the version of the table with this name (such as "products" or "demo.products").

        BadInput is raised if the lake has no such table, or if it cannot be opened.
        """
        if table not in self.versions:
            raise BadInput(f"the lake has no table {table}")
        return self.versions[table]

    def request_tables(self, *tables: str) -> list[RequestTables]:
        """Return all tables of each request that has at least one of the tables `tables`.

        Requests with the same versions of these tables are returned once.
        """
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
        """All tables of each request that has a plan or images; exposure numbers are unique only within a request."""
        return self.request_tables(*_EXPOSURE_TABLES)

    def is_changed(self) -> bool:
        """Return True if a table was added, removed or published again since the lake was opened, or is damaged now."""
        try:
            return _table_keys(Explorer(self.root, request=self.request)) != _table_keys(self.explorer)
        except LakeError:
            return True

    async def run_query(self, text: str, parameters: Mapping[str, object] | None = None) -> pa.Table:
        """Run an SQL query that the page needs, and return all rows of its result.

        `parameters` contains the values of $name in the text. Busy is raised if too many queries are waiting, and
        BadInput if the query fails.
        """
        async with self.page_queries.process() as process:
            return await self.page_queries.threads.run(process.ask, text, dict(parameters or {}), self.timeout)

    async def warm(self) -> None:
        """Start all query processes now, because otherwise the first query in each would wait for its start."""
        for pool in (self.page_queries, self.user_queries):
            await pool.warm()

    def close(self) -> None:
        """Stop all processes and threads. Queries that are running finish with the versions of this lake."""
        self.user_queries.close()
        self.page_queries.close()
        self.pixel_pool.close()
        self.table_pool.close()
        self.explorer.close()


def _table_keys(explorer: Explorer) -> tuple[dict[str, str], set[str]]:
    """Return the key (hash) of the version of each table by name, and the names of the tables that cannot be opened."""
    return {name: version.key for name, version in explorer.versions.items()}, {*explorer.damaged}


async def iterate_in_thread(batches: Iterator[Item], threads: ThreadPool | None = None) -> AsyncIterator[Item]:
    """Yield the items of a blocking iterator, which runs in a thread, so that the server can do other work.

    By default it runs in the threads of `asyncio.to_thread`.
    """
    sentinel, run = object(), asyncio.to_thread if threads is None else threads.run
    while (piece := await run(next, batches, sentinel)) is not sentinel:
        yield piece  # type: ignore[misc]
