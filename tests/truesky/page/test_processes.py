"""Processes that end, queries that are cancelled, and lakes with new versions."""

import asyncio
import http.client
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import threading
import time
from contextlib import asynccontextmanager
from pathlib import Path
from urllib.parse import quote, urlencode

import pytest

from lake_schema.store import layout, publish
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.stars import STARS
from tests.truesky.page.conftest import GALAXIES_N, asked, serving, star_rows
from tests.universe import plain_plan, plain_work
from tests.waiting import PATIENCE, until
from truesky.explore.process import Process
from truesky.page.lake_session import Closed, ProcessPool
from truesky.page.tap.queries import MAX_JOBS, PARALLEL_JOBS, Jobs


def killed(lane):
    """Kill the processes of a pool, as the system does if memory is short, and return their number."""
    found = [process._worker.process for process in lane._processes if process._worker is not None]
    for worker in found:
        os.kill(worker.pid, signal.SIGKILL)
        worker.wait(PATIENCE)
    return len(found)


def test_a_killed_process_is_replaced(page):
    lake, question = page.server.lake, {"method": "POST", "body": b'{"sql": "SELECT 7 AS a"}'}
    until(page.server._warm_up_task.done)
    chart = {"source": "galaxies", "axes": ["dec + 1"], "charts": [{"axes": [0], "bins": [5]}]}
    assert killed(lake.user_queries)
    assert killed(lake.page_queries)
    for _ in range(3):
        assert page.json("sql", **question)["rows"] == [[7]]
    assert asked(page, **chart)[0]["rows"] == GALAXIES_N


def test_a_process_is_stopped_while_it_ends():
    """Another thread removes the worker between two accesses to it."""
    killed = []

    class Worker:
        @property
        def process(self):
            return self

        def kill(self):
            killed.append(self)

    class Ending(Process):
        looks = 0

        @property
        def _worker(self):
            self.looks += 1
            return Worker() if self.looks == 1 else None

        @_worker.setter
        def _worker(self, worker):
            """Ignore the value that the constructor sets."""

    Ending(Path(), []).stop()
    assert len(killed) == 1


def test_a_query_fails_if_its_process_is_killed(page):
    """A query whose process is killed gets an error in one line, and the next query is answered."""
    until(page.server._warm_up_task.done)
    body = json.dumps({"sql": "SELECT count(*) FROM range(100000000000) a, range(100) b"}).encode()
    told = []
    asking = threading.Thread(target=lambda: told.append(page.of_lake("sql", method="POST", body=body)))
    asking.start()
    lane = page.server.lake.user_queries
    until(lambda: any(process._answer is not None for process in lane._processes))
    assert killed(lane)
    asking.join(PATIENCE)
    ((status, _, answer),) = told
    assert status == 400
    assert "brought its process down" in json.loads(answer)["error"]
    assert page.json("sql", method="POST", body=b'{"sql": "SELECT 1 AS a"}')["rows"] == [[1]]


def test_a_client_that_disconnects_stops_its_query(page):
    body = json.dumps({"sql": "SELECT count(*) FROM range(100000000000) a, range(100) b"}).encode()
    lane = page.server.lake.user_queries
    until(lambda: page.server._warm_up_task.done() and lane._free.qsize() == 2)
    with socket.create_connection(("127.0.0.1", page.gate.port)) as connection:
        head = f"POST /api/{page.server.lake.key}/sql HTTP/1.1\r\nHost: 127.0.0.1:{page.gate.port}\r\n"
        connection.sendall(f"{head}Cookie: {page.cookie}\r\nContent-Length: {len(body)}\r\n\r\n".encode() + body)
        until(lambda: lane._free.qsize() == 1)
    # The query itself would take days.
    until(lambda: lane._free.qsize() == 2)
    assert page.json("sql", method="POST", body=b'{"sql": "SELECT 1 AS a"}')["rows"] == [[1]]


def test_queries_are_answered_after_many_jobs_were_deleted(page, monkeypatch):
    """No process works on for a deleted job, although some are deleted just when their process starts."""
    until(page.server._warm_up_task.done)
    # The time limit of a query must not end those of deleted jobs while the test runs.
    monkeypatch.setattr(page.server.lake, "timeout", 10.0 * PATIENCE)
    started, tap = [], f"/tap/{page.gate.tap_token}"

    def seconds_of_a_query():
        before = time.monotonic()
        status, _, body = page.ask(f"{tap}/sync?LANG=ADQL&QUERY=SELECT+7+AS+a", cookie="")
        assert (status, b"<TD>7</TD>" in body) == (200, True)
        return time.monotonic() - before

    seconds_of_a_query()
    killed(page.server.tap._lake_processes.process_pool)
    usual = seconds_of_a_query()

    class Started(subprocess.Popen):
        def __init__(self, *given, **options):
            super().__init__(*given, **options)
            started.append(self)

    monkeypatch.setattr(subprocess, "Popen", Started)
    slow = "SELECT count(*) FROM galaxies a, galaxies b, galaxies c, galaxies d"
    form = urlencode({"LANG": "ADQL", "QUERY": slow, "PHASE": "RUN"}).encode()
    kind = "application/x-www-form-urlencoded"
    try:
        jobs = [page.ask(f"{tap}/async", "POST", form, "", Content_Type=kind)[1]["Location"] for _ in range(MAX_JOBS)]
        for job in jobs:
            assert page.ask(job.removeprefix(page.origin), method="DELETE", cookie="")[0] == 303
        # A process takes longer to start on a busy machine.
        assert seconds_of_a_query() < 30.0 + 10.0 * usual
        until(lambda: sum(one.poll() is None for one in started) <= PARALLEL_JOBS + 1)
    finally:
        for one in started:
            one.kill()
            one.wait(PATIENCE)


def test_a_new_version_of_a_table_is_announced(shown, tmp_path):
    root = shutil.copytree(shown, tmp_path / "lake", symlinks=True)
    with serving(root) as page:
        old = page.server.lake.key
        assert json.loads(page.ask("/api/lake")[2])["is_changed"] is False
        publish.make_version(root, plain_plan(2), plain_work)
        told = json.loads(page.ask("/api/lake")[2])
        assert (told["is_changed"], told["key"]) == (True, old)
        sums = b'{"sql": "SELECT sum(value) AS s FROM plain"}'
        assert page.json("sql", method="POST", body=sums)["rows"] == [[60.0]]
        status, _, body = page.ask("/api/reopen", method="POST", body=b"")
        told = json.loads(body)
        assert (status, told["is_changed"]) == (200, False)
        assert told["key"] != old
        assert page.ask(f"/api/{old}/sql", method="POST", body=sums)[0] == 409
        assert page.json("sql", method="POST", body=sums)["rows"] == [[120.0]]


def test_a_new_table_is_announced(tmp_path):
    root = tmp_path / "lake"
    root.mkdir()
    publish.make_version(root, plain_plan(), plain_work)
    with serving(root) as page:
        assert json.loads(page.ask("/api/lake")[2])["is_changed"] is False
        part = Task(layout.cell_file(5, 1607), {})
        publish.make_version(root, Plan(STARS, {}, (part,)), lambda lake, facts: Output(star_rows()[0]))
        assert json.loads(page.ask("/api/lake")[2])["is_changed"] is True


def test_a_lake_is_opened_again_during_a_download(tmp_path):
    """A download completes while two requests open the lake again at the same time, and no lake stays open."""
    root = tmp_path / "lake"
    root.mkdir()
    publish.make_version(root, plain_plan(), plain_work)
    with serving(root) as page:
        server, opened = page.server, []
        before, open_ = server.lake, server._open_lake
        server._open_lake = lambda: opened.append(open_()) or opened[-1]
        connection = http.client.HTTPConnection("127.0.0.1", page.gate.port, timeout=PATIENCE)
        address = f"/api/{before.key}/export?format=csv&sql=" + quote("SELECT range AS a FROM range(3000000)")
        connection.request("GET", address, headers={"Cookie": page.cookie})
        answer = connection.getresponse()
        first = answer.read(1000)
        publish.make_version(root, plain_plan(2), plain_work)
        both = [threading.Thread(target=page.ask, args=("/api/reopen", "POST", b"")) for _ in range(2)]
        for one in both:
            one.start()
        for one in both:
            one.join(PATIENCE)
        assert opened == [server.lake]
        assert server.lake is not before
        assert (first + answer.read()).count(b"\n") == 3_000_001
        connection.close()
        old = before.user_queries._processes
        until(lambda: not any(one._worker is not None and one._worker.is_alive for one in old))


def test_a_closed_pool_lends_no_process():
    async def run():
        lane = ProcessPool(lambda: Process(Path(), []), 1)
        async with lane.process():
            waiting = asyncio.create_task(anext(aiter_of(lane)))
            await asyncio.sleep(0)
            lane.close()
        for one in (waiting, anext(aiter_of(lane))):
            with pytest.raises(Closed):
                await one

    async def aiter_of(lane):
        async with lane.process() as process:
            yield process

    asyncio.run(run())


def test_a_lake_of_two_requests(tmp_path):
    """Tables that both requests have are listed with the names of both."""
    root = tmp_path / "lake"
    root.mkdir()
    for name, seed in (("a", 1), ("my-b", 2)):
        publish.make_version(root, plain_plan(seed), plain_work, name=name)
    with serving(root) as page:
        told = json.loads(page.ask("/api/lake")[2])
        assert [table["name"] for table in told["tables"]] == ["a.plain", "my-b.plain"]
        for source, value in (("a.plain", 1.0), ('"my-b".plain', 2.0)):
            chart = {"axes": [0], "bins": [1], "spans": [[value - 0.1, value + 0.1]]}
            head, (counts,) = asked(page, source=source, axes=["value"], charts=[chart])
            assert (head["rows"], counts.tolist()) == (60, [60])
        status, _, body = page.ask(
            f"/tap/{page.gate.tap_token}/sync?LANG=ADQL&QUERY=" + quote('SELECT TOP 1 "value" FROM "my-b".plain'),
            cookie="",
        )
        assert (status, b"<TD>2.0</TD>" in body) == (200, True)
        status, _, body = page.ask(f"/tap/{page.gate.tap_token}/tables", cookie="")
        assert b"<name>&quot;my-b&quot;.plain</name>" in body or b'<name>"my-b".plain</name>' in body


@pytest.mark.parametrize(
    ("question", "words"),
    [
        ({"axes": "z"}, "axes"),
        ({"axes": 7}, "axes"),
        ({"charts": {"axes": [0]}}, "charts"),
        ({"charts": 7}, "charts"),
        ({"charts": [7]}, "charts"),
        ({"charts": [{"axes": [0], "bins": [2**40]}]}, "bins"),
        ({"charts": [{"axes": [0, 0], "bins": [2**40, 2**24]}]}, "bins"),
        ({"charts": [{"axes": [0], "bins": [1e999]}]}, "infinity"),
        ({"charts": [{"axes": [0], "bins": [3], "points": 1e999}]}, "infinity"),
        ({"charts": [{"axes": [-1], "bins": [3]}]}, "no expression"),
        ({"charts": [{"axes": [1], "bins": [3]}]}, "index"),
        ({"charts": [{"axes": [0], "bins": [8_000_000]}] * 2}, "together"),
        ({"limits": [[3, 0, 1]]}, "no expression"),
        ({"limits": 7}, "limits|iterable"),
    ],
)
def test_invalid_charts_are_refused(page, question, words):
    usual = {"source": "galaxies", "axes": ["z_obs"], "charts": [{"axes": [0], "bins": [3]}]}
    status, _, body = page.of_lake("charts", method="POST", body=json.dumps({**usual, **question}).encode())
    assert status == 400
    assert re.search(words, json.loads(body)["error"])


@pytest.mark.parametrize(
    "value",
    [
        "TIMESTAMP '20000-01-01'",
        *(pytest.param(f"'infinity'::{kind}", marks=pytest.mark.nightly) for kind in ("TIMESTAMP", "DATE")),
    ],
)
def test_times_outside_the_range_of_python(page, value):
    question = json.dumps({"sql": f"SELECT {value} AS moment"}).encode()
    status, _, body = page.of_lake("sql", method="POST", body=question)
    assert status == 400
    assert "column moment" in json.loads(body)["error"]
    tap = f"/tap/{page.gate.tap_token}"
    form = f"LANG=ADQL&PHASE=RUN&QUERY={quote(f'SELECT {value} AS moment')}".encode()
    status, headers, _ = page.ask(
        f"{tap}/async", method="POST", body=form, cookie="", Content_Type="application/x-www-form-urlencoded"
    )
    assert status == 303
    job = headers["Location"].removeprefix(page.origin)
    until(lambda: page.ask(f"{job}/phase", cookie="")[2] == b"ERROR")
    assert b"column moment" in page.ask(f"{job}/error", cookie="")[2]


def test_a_job_ends_whatever_goes_wrong():
    @asynccontextmanager
    async def broken(parameters, seconds):
        raise IndexError("of a fault of our own")
        yield

    async def run():
        jobs = Jobs(broken)
        job = jobs.add({}, 1.0)
        jobs.start(job)
        await asyncio.wait_for(asyncio.gather(job.task, return_exceptions=True), PATIENCE)
        found = job.phase, job.error
        await jobs.close()
        return found

    assert asyncio.run(run()) == ("ERROR", "IndexError: of a fault of our own")
