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
    from truesky.explore.counting import Held

# Questions that wait for a process; those beyond are refused.
MOST_WAITING = 8
# Threads that answer from files and tables: of tiles and sources, which are asked for by the dozen and come soon, and
# of the rest, which may take s; and how many questions may wait for each.
PIXEL_THREADS, TABLE_THREADS, MOST_IN_LINE = 4, 2, 64
_KEY_LENGTH = 16
# What is planned and rendered: rows of it go by the number of an exposure, which every request counts for itself.
_OBSERVED = ("exposures", "tasks", "products")
Item = TypeVar("Item")
Given = ParamSpec("Given")


class Busy(LakeError):
    """Too many questions wait already."""


class Closed(Busy):
    """The lake has been opened anew while a question waited."""


class Lane:
    """Processes that answer questions, each one at a time.

    make : a process;  number : how many
    """

    def __init__(self, make: Callable[[], Process], number: int) -> None:
        self._make, self._waiting, self._is_closed = make, 0, False
        self._all = {make() for _ in range(number)}
        self._free: asyncio.Queue[Process] = asyncio.Queue()
        for process in self._all:
            self._free.put_nowait(process)

    @asynccontextmanager
    async def process(self, is_patient: bool = False) -> AsyncIterator[Process]:
        """A process that is free; where its user is cancelled another takes its place.

        is_patient : waits however many wait, and is none of those who wait
        Errors     : Busy where too many wait; Closed
        """
        self._refuse_closed()
        if self._free.empty() and self._waiting >= MOST_WAITING and not is_patient:
            raise Busy(f"{MOST_WAITING} questions are waiting: ask again later")
        self._waiting += not is_patient
        try:
            process = await self._free.get()
        finally:
            self._waiting -= not is_patient
        try:
            self._refuse_closed()
            yield process
        except LakeError:
            raise
        except BaseException:
            # Its user went away in the midst of an answer: whoever asks next must meet nothing of that.
            process.stop()
            self._all.discard(process)
            process = self._make()
            self._all.add(process)
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
        async with AsyncExitStack() as taken:
            processes = [await taken.enter_async_context(self.process()) for _ in range(len(self._all))]
            await asyncio.gather(*(asyncio.to_thread(process.ask, "SELECT 1", {}) for process in processes))

    def close(self) -> None:
        """End them, those that are in use when their users are done; nobody else is given one."""
        self._is_closed = True
        for _ in range(self._free.qsize()):
            process = self._free.get_nowait()
            process.stop()
            self._free.put_nowait(process)


class Pool:
    """Threads that answer questions, and a bound of how many wait for one.

    threads : that answer at a time;  most : questions that may wait beside
    """

    def __init__(self, threads: int, most: int = MOST_IN_LINE) -> None:
        self._threads, self._most = ThreadPoolExecutor(threads), most
        self._places = threading.BoundedSemaphore(threads + most)

    async def run(self, function: Callable[Given, Item], *given: Given.args, **named: Given.kwargs) -> Item:
        """What a function returns, without holding up anything else; one who goes away leaves the line.

        Errors : Busy where too many wait; Closed; those of the function
        """
        if not self._places.acquire(blocking=False):
            raise Busy(f"{self._most} questions are waiting: ask again later")
        try:
            asked = self._threads.submit(function, *given, **named)
        except RuntimeError:
            self._places.release()
            raise Closed("the lake has been opened anew") from None
        # Also where nobody waits any more: the thread is in use until it is done.
        asked.add_done_callback(lambda _: self._places.release())
        return await asyncio.wrap_future(asked)

    def close(self) -> None:
        """Take no other question; those that wait are answered."""
        self._threads.shutdown(wait=False)


@dataclass(frozen=True, slots=True)
class Requested:
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

    def pieces(self, table: str, columns: Sequence[str]) -> Iterator[pa.Table]:
        """The same, a part after the other: a plan may be larger than memory."""
        version = self.versions.get(table)
        return iter(()) if version is None else (version.rows(columns, [part]) for part in version.parts)


class Lake:
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
        self.questions = Lane(self.explorer.process, 2)
        self.own = Lane(self.explorer.process, 1)
        self.pixels, self.tables = Pool(PIXEL_THREADS), Pool(TABLE_THREADS)
        self.threads = min(os.cpu_count() or 1, 8)
        # Kept columns that are mapped, by selection and expressions.
        self.held: dict[tuple[Hashable, ...], Held] = {}

    @property
    def versions(self) -> Mapping[str, read.Version]:
        return self.explorer.versions

    @property
    def listed(self) -> Mapping[str, read.Version]:
        """Every table once: by its own name where that is clear."""
        return {name: version for name, version in sorted(self.versions.items()) if self.explorer.is_listed(name)}

    def version(self, table: str) -> read.Version:
        """A table of the lake.  Errors: BadInput where there is none."""
        if table not in self.versions:
            raise BadInput(f"the lake has no table {table}")
        return self.versions[table]

    def requested(self, *tables: str) -> list[Requested]:
        """Each request that has one of these tables; those that have the same versions of all of them count once."""
        own: dict[str, dict[str, read.Version]] = {}
        for name, version in sorted(self.versions.items()):
            request, _, table = name.rpartition(".")
            own.setdefault(request, {})[table] = version
        shared = own.pop("", {})
        held = {table for versions in own.values() for table in versions}
        free = {table: version for table, version in shared.items() if table not in held}
        found: dict[tuple[str, ...], list[str]] = {}
        for request, versions in (own or {"": shared}).items():
            versions |= {table: version for table, version in free.items() if table not in versions}
            if keys := tuple(versions[table].key for table in tables if table in versions):
                found.setdefault(keys, []).append(request)
        if not own:
            return [Requested(None, (), shared) for _ in found]
        return [
            Requested(
                names[0] if len(found) > 1 else None,
                tuple(names),
                {table: version for name in reversed(names) for table, version in own[name].items()},
            )
            for names in found.values()
        ]

    @cached_property
    def observed(self) -> list[Requested]:
        """Requests that have planned or rendered something; what goes by the number of an exposure is of one."""
        return self.requested(*_OBSERVED)

    def is_changed(self) -> bool:
        """Whether a table has been published since it was opened, or has come or gone."""
        try:
            return _facts(Explorer(self.root, request=self.request)) != _facts(self.explorer)
        except LakeError:
            return True

    async def rows(self, text: str, parameters: Mapping[str, object] | None = None) -> pa.Table:
        """The answer to a question of the page's own."""
        async with self.own.process() as process:
            return await asyncio.to_thread(process.ask, text, dict(parameters or {}), self.timeout)

    async def warm(self) -> None:
        """Start the processes, those first that the page itself asks: the first question of each would wait for it."""
        for lane in (self.own, self.questions):
            await lane.warm()

    def close(self) -> None:
        """End its processes; what is being answered is answered to its end, of the lake as it was."""
        self.questions.close()
        self.own.close()
        self.pixels.close()
        self.tables.close()
        self.explorer.close()


def _facts(explorer: Explorer) -> tuple[dict[str, str], set[str]]:
    """The keys of its tables, and the names of those that cannot be opened."""
    return {name: version.key for name, version in explorer.versions.items()}, {*explorer.damaged}


async def pieces(batches: Iterator[Item]) -> AsyncIterator[Item]:
    """What an iterator that waits gives, without holding up anything else."""
    nothing = object()
    while (piece := await asyncio.to_thread(next, batches, nothing)) is not nothing:
        yield piece  # type: ignore[misc]
