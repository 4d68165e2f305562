"""Queues of requests: their limits, and the refusal of further requests."""

import asyncio
import io
import json
import os
import socket
import threading
from contextlib import asynccontextmanager
from pathlib import Path
from urllib.parse import quote

import pytest

from tests.waiting import PATIENCE, reach, until
from truesky.explore.process import Process
from truesky.page import downloads, pictures, sky_maps
from truesky.page.lake_session import MAX_QUEUED, MAX_WAITING, PIXEL_THREADS, Busy, Closed, ProcessPool, ThreadPool
from truesky.page.tap import queries
from truesky.page.tap.queries import PARALLEL_JOBS, Jobs


def test_a_pool_refuses_beyond_its_bound_and_takes_others_when_done():
    go = threading.Event()

    async def run():
        pool = ThreadPool(2, 3)
        asked = [asyncio.create_task(pool.run(go.wait)) for _ in range(5)]
        await asyncio.sleep(0)
        with pytest.raises(Busy, match="3 requests are waiting"):
            await pool.run(go.wait)
        # If a waiting request is cancelled, its slot is free.
        asked[4].cancel()
        await asyncio.gather(asked[4], return_exceptions=True)
        sixth = asyncio.create_task(pool.run(go.wait))
        await asyncio.sleep(0)
        with pytest.raises(Busy):
            await pool.run(go.wait)
        go.set()
        assert await asyncio.gather(*asked[:4], sixth) == [True] * 5
        with pytest.raises(ZeroDivisionError):
            await pool.run(divmod, 1, 0)
        assert [await pool.run(divmod, 7, k) for k in range(1, 9)][-1] == (0, 7)
        pool.close()
        with pytest.raises(Closed):
            await pool.run(divmod, 1, 1)

    asyncio.run(run())


def test_a_thread_whose_user_has_gone_is_in_use_until_it_is_done():
    go, started = threading.Event(), threading.Event()

    async def run():
        pool = ThreadPool(1, 0)
        asked = asyncio.create_task(pool.run(lambda: started.set() or go.wait()))
        await reach(started.is_set)
        asked.cancel()
        await asyncio.gather(asked, return_exceptions=True)
        with pytest.raises(Busy):
            await pool.run(divmod, 1, 1)
        go.set()
        await reach(lambda: pool._slots._value)
        assert await pool.run(divmod, 1, 1) == (1, 0)

    asyncio.run(run())


def test_queries_are_answered_while_the_threads_for_other_work_are_busy(page):
    """Queries are answered in threads of their own, and not in those of `asyncio.to_thread`."""
    go, occupied = threading.Event(), threading.Event()
    sync = f"/tap/{page.gate.tap_token}/sync?LANG=ADQL&QUERY=SELECT+7+AS+a"
    assert page.ask(sync, cookie="")[0] == 200

    def occupy():
        # asyncio has at most 32 threads.
        for _ in range(32):
            page.loop.run_in_executor(None, go.wait, PATIENCE)
        occupied.set()

    page.loop.call_soon_threadsafe(occupy)
    try:
        assert occupied.wait(PATIENCE)
        assert b"<TD>7</TD>" in page.ask(sync, cookie="")[2]
        assert page.json("sql", method="POST", body=b'{"sql": "SELECT 7 AS a"}')["rows"] == [[7]]
        assert page.of_lake("export?format=csv&sql=SELECT+7+AS+a")[2] == b'"a"\n7\n'
        assert page.of_lake("sky/galaxies/density?order=3")[0] == 200
    finally:
        go.set()


def test_tiles_are_refused_beyond_the_queue_and_hold_up_nothing_else(page, monkeypatch):
    """If all threads for tiles are busy and their queue is full, tiles get status 429, but sky maps are answered."""
    go, started = threading.Event(), []
    real = pictures.picture
    monkeypatch.setattr(pictures, "picture", lambda *given: started.append(1) or (go.wait(PATIENCE) and real(*given)))
    told = []
    number = PIXEL_THREADS + MAX_QUEUED
    asking = [
        threading.Thread(target=lambda: told.append(page.of_lake("tile/0/0/0/0")[0]), daemon=True)
        for _ in range(number)
    ]
    for one in asking:
        one.start()
    try:
        until(lambda: not page.server.lake.pixel_pool._slots._value)
        status, _, body = page.of_lake("tile/0/0/0/0")
        assert (status, "waiting" in json.loads(body)["error"]) == (429, True)
        assert page.of_lake("source/1")[0] == 429
        assert page.of_lake("regions")[0] == page.of_lake("sky/galaxies/parts")[0] == 200
        assert len(started) == PIXEL_THREADS
    finally:
        go.set()
    for one in asking:
        one.join(PATIENCE)
    assert told == [200] * number
    assert page.of_lake("tile/0/0/0/0")[0] == 200


def test_tiles_and_other_requests_have_separate_queues(page, monkeypatch):
    go = threading.Event()
    monkeypatch.setattr(sky_maps, "coverage", lambda *given: go.wait(PATIENCE) and b"")
    free = page.server.lake.table_pool._slots._value
    asking = [threading.Thread(target=page.of_lake, args=("coverage?order=5",), daemon=True) for _ in range(4)]
    for one in asking:
        one.start()
    try:
        until(lambda: page.server.lake.table_pool._slots._value == free - len(asking))
        assert page.of_lake("tile/0/0/0/0")[0] == 200
    finally:
        go.set()
        for one in asking:
            one.join(PATIENCE)


# ------------------------------------------------------------------------------------------------ jobs


def test_jobs_beyond_those_that_run_are_queued():
    go, running = asyncio.Event(), []

    @asynccontextmanager
    async def run_one(parameters, seconds):
        running.append(parameters["number"])

        async def pieces():
            await go.wait()
            yield b"x" * parameters["number"]

        yield "text/plain", pieces()

    async def run():
        jobs = Jobs(run_one)
        many = [jobs.add({"number": k}, 1.0) for k in range(PARALLEL_JOBS + MAX_WAITING + 5)]
        for job in many:
            jobs.start(job)
        await reach(lambda: [job.phase for job in many[:PARALLEL_JOBS]] == ["EXECUTING"] * PARALLEL_JOBS)
        assert {job.phase for job in many[PARALLEL_JOBS:]} == {"QUEUED"}
        assert all(job.start_time is None for job in many[PARALLEL_JOBS:])
        jobs.abort(many[PARALLEL_JOBS])
        go.set()
        await asyncio.gather(*(job.task for job in many), return_exceptions=True)
        phases = [job.phase for job in many]
        assert phases.pop(PARALLEL_JOBS) == "ABORTED"
        assert set(phases) == {"COMPLETED"}
        assert PARALLEL_JOBS not in running
        assert jobs.file(many[7]).read_bytes() == b"x" * 7
        await jobs.close()

    asyncio.run(run())


def test_patient_queries_are_not_refused():
    async def run():
        lane = ProcessPool(lambda: Process(Path(), []), 1)

        async def one(is_patient):
            async with lane.process(is_patient):
                return True

        async with lane.process():
            patient = [asyncio.create_task(one(True)) for _ in range(MAX_WAITING + 4)]
            await asyncio.sleep(0)
            others = [asyncio.create_task(one(False)) for _ in range(MAX_WAITING + 1)]
            await asyncio.sleep(0)
        found = await asyncio.gather(*patient, *others, return_exceptions=True)
        assert [type(one) for one in found] == [bool] * (len(found) - 1) + [Busy]

    asyncio.run(run())


@pytest.mark.parametrize(
    ("bounds", "words"), [((50, 1000), "the result is larger"), ((1000, 150), "all results are larger")]
)
def test_results_have_a_bound(monkeypatch, bounds, words):
    monkeypatch.setattr(queries, "MAX_RESULT_BYTES", bounds[0])
    monkeypatch.setattr(queries, "MAX_TOTAL_BYTES", bounds[1])

    @asynccontextmanager
    async def run_one(parameters, seconds):
        async def pieces():
            for _ in range(parameters["pieces"]):
                yield b"x" * 10

        yield "text/plain", pieces()

    async def run():
        jobs = Jobs(run_one)
        few, lots = jobs.add({"pieces": 5}, 1.0), jobs.add({"pieces": 99}, 1.0)
        for job in (few, lots):
            jobs.start(job)
            await job.task
        assert (few.phase, lots.phase) == ("COMPLETED", "ERROR")
        assert words in lots.error
        assert jobs.file(few).stat().st_size == 50
        assert not jobs.file(lots).exists()
        again = jobs.add({"pieces": 5}, 1.0)
        jobs.start(again)
        await again.task
        assert again.phase == "COMPLETED"
        await jobs.close()

    asyncio.run(run())


def test_results_are_private():
    """Other users of the machine cannot read the folder of the results, whatever the user's mask allows."""
    previous = os.umask(0)
    try:
        jobs = Jobs(None)
    finally:
        os.umask(previous)
    folder = jobs.file(jobs.add({}, 1.0)).parent
    assert folder.stat().st_mode & 0o777 == 0o700
    asyncio.run(jobs.close())
    assert not folder.exists()


def test_an_aborted_job_leaves_nothing():
    """The file is deleted, and its size no longer counts for the total."""
    waiting = asyncio.Event()

    @asynccontextmanager
    async def run_one(parameters, seconds):
        async def pieces():
            yield b"x" * 1000
            waiting.set()
            await asyncio.Event().wait()

        yield "text/plain", pieces()

    async def run():
        jobs = Jobs(run_one)
        job = jobs.add({}, 1.0)
        jobs.start(job)
        await waiting.wait()
        assert (job.result_bytes, jobs.file(job).exists()) == (1000, True)
        jobs.abort(job)
        await asyncio.gather(job.task, return_exceptions=True)
        assert (job.phase, job.result_bytes, jobs.file(job).exists()) == ("ABORTED", 0, False)
        await jobs.close()

    asyncio.run(run())


def test_others_are_answered_while_a_result_is_written(monkeypatch):
    go, writing = threading.Event(), threading.Event()

    class Slow(io.BytesIO):
        def write(self, piece):
            writing.set()
            assert go.wait(PATIENCE)
            return super().write(piece)

    monkeypatch.setattr(Path, "open", lambda self, mode: Slow())

    @asynccontextmanager
    async def run_one(parameters, seconds):
        async def pieces():
            yield b"x"

        yield "text/plain", pieces()

    async def run():
        jobs = Jobs(run_one)
        job = jobs.add({}, 1.0)
        jobs.start(job)
        # The event loop must continue, or the write would never be allowed to finish.
        await reach(writing.is_set)
        assert job.phase == "EXECUTING"
        go.set()
        await job.task
        assert (job.phase, job.result_bytes) == ("COMPLETED", 1)
        await jobs.close()

    asyncio.run(run())


def test_a_client_that_does_not_read_loses_its_process(page, monkeypatch):
    """A stalled client is disconnected, and its process is free for others."""
    monkeypatch.setattr(downloads, "STALL_TIMEOUT", 0.5)
    lane = page.server.lake.user_queries
    until(lambda: page.server._warm_up_task.done() and lane._free.qsize() == 2)
    before = set(lane._processes)
    sql = quote("SELECT range AS a FROM range(100000000)")
    head = (
        f"GET /api/{page.server.lake.key}/export?format=csv&sql={sql} HTTP/1.1\r\nHost: 127.0.0.1:{page.gate.port}\r\n"
    )
    with socket.create_connection(("127.0.0.1", page.gate.port)) as connection:
        connection.sendall(f"{head}Cookie: {page.cookie}\r\n\r\n".encode())
        assert connection.recv(100).startswith(b"HTTP/1.1 200")
        until(lambda: lane._processes != before and lane._free.qsize() == 2)
    assert page.json("sql", method="POST", body=b'{"sql": "SELECT 1 AS a"}')["rows"] == [[1]]
