"""Clients that send too much, too slowly or nothing: other users are served, and the server forgets these clients."""

import http.client
import itertools
import json
import logging
import os
import selectors
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import quote

import pytest

from tests.waiting import PATIENCE, until
from truesky.page import access_control

ROOT = Path(__file__).resolve().parents[3]
# Other users get an answer within this time (s), and the memory of the server grows by at most this size for each
# connection (bytes). With 500 connections, 1.3 s and 0.4 MB were seen on two busy cores.
MOST_SECONDS, MOST_BYTES = 10.0, 1 << 20
MEGABYTE = b"a" * (1 << 20)
FORM = "Content-Type: application/x-www-form-urlencoded\r\n"


def slowly(data):
    """Yield one byte per second; None means to wait."""
    for at in range(len(data)):
        yield data[at : at + 1]
        next_byte = time.monotonic() + 1.0
        while time.monotonic() < next_byte:
            yield None


# What a client of each attack sends after the first lines of a request, in pieces. Afterwards it sends nothing.
ATTACKS = {
    "idle": lambda head: iter(()),
    "long header": lambda head: iter((head, b"X: ", MEGABYTE)),
    "many headers": lambda head: iter((head, b"X: aaaaaaaa\r\n" * 80_000)),
    "long line": lambda head: iter((b"GET /", MEGABYTE, b" HTTP/1.1\r\n")),
    "slow line": lambda head: slowly(head),
    "endless chunks": lambda head: itertools.chain(
        (head, b"Transfer-Encoding: chunked\r\n\r\n"), itertools.repeat(b"10000\r\n" + MEGABYTE[:65536] + b"\r\n")
    ),
    "endless chunk size": lambda head: itertools.chain(
        (head, b"Transfer-Encoding: chunked\r\n\r\n5;"), itertools.repeat(MEGABYTE[:65536])
    ),
    "slow body": lambda head: itertools.chain((head, b"Content-Length: 100000\r\n\r\n"), slowly(b"{" * 100_000)),
    "short body": lambda head: iter((head, b"Content-Length: 100\r\n\r\n{}")),
    "long body": lambda head: iter((head, b"Content-Length: 2\r\n\r\n{}", MEGABYTE)),
}  # fmt: skip


def attacked(port, heads, kinds, number, is_over):
    """Keep `number` connections of the attacks open until `is_over()`; replace those that the server closes."""
    selector, kinds = selectors.DefaultSelector(), itertools.cycle(kinds)
    heads = itertools.cycle(heads)

    def connect():
        client = socket.create_connection(("127.0.0.1", port))
        client.setblocking(False)
        selector.register(
            client, selectors.EVENT_READ | selectors.EVENT_WRITE, [ATTACKS[next(kinds)](next(heads)), b""]
        )

    for _ in range(number):
        connect()
    while not is_over():
        for key, events in selector.select(0.1):
            client, state = key.fileobj, key.data
            try:
                if events & selectors.EVENT_READ and not client.recv(1 << 16):
                    raise ConnectionResetError
                state[1] = state[1] or next(state[0], None) or b""
                state[1] = state[1][client.send(state[1]) :] if state[1] else b""
            except BlockingIOError:
                continue
            except OSError:
                selector.unregister(client)
                client.close()
                connect()
        # Waiting clients could always send, so the selector does not wait for them.
        time.sleep(0.005)
    for key in [*selector.get_map().values()]:
        key.fileobj.close()
    selector.close()


class Process:
    """State of a server's process."""

    def __init__(self, number):
        self.folder = Path(f"/proc/{number}")

    def bytes(self):
        return int(self.folder.joinpath("statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    def files(self):
        """Return the number of its sockets, pipes and files."""
        return len([*self.folder.joinpath("fd").iterdir()])

    def threads(self):
        return len([*self.folder.joinpath("task").iterdir()])


class User:
    """A user of the page and of TAP who has nothing to do with the attack."""

    def __init__(self, port, cookie, tap):
        self.port, self.cookie, self.tap, self.longest = port, cookie, tap, 0.0

    def ask(self, path, body=None):
        started = time.monotonic()
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE)
        connection.request("POST" if body else "GET", path, body, {"Cookie": self.cookie})
        answer = connection.getresponse()
        found = answer.status, answer.read()
        connection.close()
        self.longest = max(self.longest, time.monotonic() - started)
        return found

    def works(self):
        """Use the page and TAP once."""
        status, found = self.ask("/api/lake")
        assert status == 200
        status, found = self.ask(f"/api/{json.loads(found)['key']}/sql", b'{"sql": "SELECT 7 AS a"}')
        assert (status, json.loads(found)["rows"]) == (200, [[7]])
        assert self.ask("/static/app.js")[0] == 200
        status, found = self.ask(f"{self.tap}/sync?LANG=ADQL&QUERY={quote('SELECT 7 AS a')}")
        assert (status, b"<TD>7</TD>" in found) == (200, True)


def survives(user, process, kinds, number, seconds):
    """Attack a server while a user works; then it has as many threads and open files as before."""
    key = json.loads(user.ask("/api/lake")[1])["key"]
    common = f"Host: 127.0.0.1:{user.port}\r\nCookie: {user.cookie}\r\n{FORM}"
    heads = [f"POST {path} HTTP/1.1\r\n{common}".encode() for path in (f"/api/{key}/sql", f"{user.tap}/sync")]
    # The first answers wait for the start of processes, and many at once start all threads of the pools.
    users = [threading.Thread(target=user.works) for _ in range(8)]
    for one in users:
        one.start()
    for one in users:
        one.join(PATIENCE)
    user.longest = 0.0
    user.works()
    usual, user.longest = user.longest, 0.0
    before, size, over = (process.threads(), process.files()), process.bytes(), threading.Event()
    attack = threading.Thread(target=attacked, args=(user.port, heads, kinds, number, over.is_set))
    attack.start()
    try:
        started, largest = time.monotonic(), 0
        until(lambda: process.files() >= before[1] + number // 2)
        while time.monotonic() - started < seconds:
            user.works()
            largest = max(largest, process.bytes())
    finally:
        over.set()
        attack.join(PATIENCE)
    print(f"longest answer {user.longest:.1f} s, {(largest - size) / number / 1e6:.2f} MB per connection")
    assert largest - size < number * MOST_BYTES
    # On a busy machine, every answer takes longer.
    assert user.longest < MOST_SECONDS + 5.0 * usual
    user.works()
    # The server may have started another worker for queries meanwhile; a leak would have one file per connection.
    until(lambda: process.files() <= before[1] + 8)
    until(lambda: process.threads() <= before[0] + 4)


def test_other_users_are_served_during_an_attack(page):
    until(page.server._warm_up_task.done)
    user = User(page.gate.port, page.cookie, page.tap.removeprefix(page.origin))
    # Test and server share a process here, so the thread of the attack and its sockets must have gone as well.
    survives(user, Process(os.getpid()), ATTACKS, 40, 0.5)


@contextmanager
def server_of(lake):
    """Serve a lake in a process of its own."""
    command = [sys.executable, "-m", "truesky.page", str(lake), "--no-open", "--token", "a-token-of-the-tests"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        try:
            address, tap = (running.stdout.readline().split()[-1] for _ in range(2))
            port = int(address.rpartition("/")[0].rpartition(":")[2])
            yield User(port, f"truesky-{port}=a-token-of-the-tests", f"/tap/{tap.rpartition('/')[2]}"), running
        finally:
            running.terminate()
            said = running.communicate(timeout=PATIENCE)[1]
    assert said == ""


@pytest.mark.nightly
@pytest.mark.parametrize("kinds", [*([kind] for kind in ATTACKS), [*ATTACKS]], ids=[*ATTACKS, "all"])
def test_500_connections_of_each_attack(shown, kinds):
    """The server also prints nothing, for example no tracebacks about the requests."""
    with server_of(shown) as (user, running):
        user.works()
        survives(user, Process(running.pid), kinds, 500, 20.0)


def talk(page, *pieces, pause=0.0):
    """Send pieces over a connection, and return what the server answers until it closes the connection."""
    with socket.create_connection(("127.0.0.1", page.gate.port), PATIENCE) as client:
        answer = b""
        with suppress(ConnectionError):
            for piece in pieces:
                client.sendall(piece)
                time.sleep(pause)
            while data := client.recv(1 << 16):
                answer += data
        return answer


# The same middleware reads the bodies of the page and of TAP. Tests that wait for a time limit ask the page.
PAGE_AND_NIGHTLY_TAP = ["page", pytest.param("TAP", marks=pytest.mark.nightly)]


@pytest.fixture(params=["page", "TAP"])
def head(page, request):
    """First lines of a request with a body, for the page and for TAP."""
    path = (
        f"/api/{page.server.lake.key}/sql" if request.param == "page" else f"{page.tap.removeprefix(page.origin)}/sync"
    )
    return f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1:{page.gate.port}\r\nCookie: {page.cookie}\r\n{FORM}".encode()


@pytest.mark.parametrize("head", PAGE_AND_NIGHTLY_TAP, indirect=True)
def test_a_body_that_does_not_come_has_a_time_limit(page, head, monkeypatch):
    monkeypatch.setattr(access_control, "BODY_TIMEOUT", 0.2)
    answer = talk(page, head + b"Content-Length: 100\r\n\r\n{}")
    assert answer.startswith(b"HTTP/1.1 408 ")


@pytest.mark.parametrize("head", PAGE_AND_NIGHTLY_TAP, indirect=True)
@pytest.mark.parametrize(
    "pieces",
    [
        (b"Transfer-Encoding: chunked\r\n\r\n5\r\n{}", b"aaaaaaa\r\nzz\r\n"),
        (b"Content-Encoding: gzip\r\nContent-Length: 5\r\n\r\naaaaa",),
        (b"Content-Encoding: gzip\r\nContent-Length: 5\r\n\r\n", b"aaaaa"),
    ],
)
def test_a_body_that_breaks_the_rules_is_refused(page, head, pieces, caplog, monkeypatch):
    """The reason is in the answer, and the log of the server has no traceback that any client could cause."""
    monkeypatch.setattr(access_control, "BODY_TIMEOUT", 1.0)
    first, *rest = pieces
    answer = talk(page, head + b"Connection: close\r\n" + first, *rest, pause=0.1)
    # aiohttp does not notice that a chunk is broken if it comes later, so the time limit applies.
    assert answer.startswith((b"HTTP/1.1 400 ", b"HTTP/1.0 400 ", b"HTTP/1.1 408 "))
    assert [record.message for record in caplog.records if record.levelno >= logging.WARNING] == []


@pytest.mark.parametrize(
    "broken", [b"GET /" + MEGABYTE, b"GET / HTTP/1.1\r\nX: " + MEGABYTE, b"GET / HTTP/1.1\r\n" + b"X: a\r\n" * 200_000,
               b"\0" * 1000, b"GET / HTTP/9.9\r\n\r\n"]
)  # fmt: skip
def test_a_broken_header_is_refused_without_a_traceback(page, broken, caplog):
    answer = talk(page, broken)
    assert answer == b"" or answer.startswith(b"HTTP/1.0 400 ")
    assert [record.message for record in caplog.records if record.levelno >= logging.WARNING] == []


def test_compressed_bodies_are_not_expanded(page, head):
    """A body of 256 kB may expand to 256 MB, for which the server would need seconds."""
    import zlib

    packer = zlib.compressobj(1, zlib.DEFLATED, 31)
    bomb = b"".join(packer.compress(MEGABYTE) for _ in range(10)) + packer.flush()
    answer = talk(
        page, head + b"Connection: close\r\nContent-Encoding: gzip\r\nContent-Length: %d\r\n\r\n" % len(bomb) + bomb
    )
    assert answer.startswith(b"HTTP/1.1 400 ")


def test_an_idle_connection_is_closed(page, monkeypatch):
    from tests.truesky.page.conftest import serving

    monkeypatch.setitem(access_control.CONNECTION_SETTINGS, "keepalive_timeout", 0.3)
    with serving(page.server.lake.root) as short:
        assert talk(short) == b""
        assert talk(short, b"GET / HTTP/1.1\r\nHost: ") == b""
