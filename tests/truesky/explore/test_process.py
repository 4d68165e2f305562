"""Process of queries: results piece by piece, a persistent session, and no mixing of answers."""

import signal
import subprocess
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from lake_schema.errors import BadInput, Damaged, LakeError
from lake_schema.store import publish, read
from tests.universe import plain_plan, plain_work
from tests.waiting import PATIENCE, until
from truesky.explore.process import Process
from truesky.explore.session import Session

SLOW = "SELECT count(*) FROM range(100000) a, range(100000) b WHERE a.range * b.range % 7 = 3"


@pytest.fixture(scope="module")
def process(explored):
    process = Process(explored, [f"plain={read.version(explored, 'plain').key}"], 1e9)
    yield process
    process.close()


def numbers(batches):
    return [value for batch in batches for value in batch.column(0).to_pylist()]


def test_row_limit(process):
    assert numbers(process.batches("SELECT * FROM range(1000000)", max_rows=100_001)) == list(range(100_001))
    assert numbers(process.batches("SELECT * FROM range(5)", max_rows=9)) == list(range(5))
    (empty,) = process.batches("SELECT 1::HUGEINT AS a WHERE false")
    assert (empty.num_rows, str(empty.schema.field("a").type)) == (0, "int64")


def test_a_result_that_is_too_large(process):
    with pytest.raises(BadInput, match="needs more memory"):
        list(process.batches("SELECT * FROM range(10000000)", max_bytes=1_000_000))


def test_error_after_some_pieces(process):
    """Some pieces arrive before the error; the same process then answers the next question."""
    process.ask("SELECT 1", {})
    worker, got = process._worker, []
    late = "SELECT CASE WHEN range = 4900000 THEN error('no') ELSE range END FROM range(5000000)"

    def read_on():
        for batch in process.batches(late):
            got.append(batch.num_rows)

    with pytest.raises(BadInput, match=r"SQL: .*no"):
        read_on()
    assert 0 < sum(got) < 5_000_000
    assert process.ask("SELECT 7 AS a", {})["a"].to_pylist() == [7]
    assert process._worker is worker


def test_unread_rows_do_not_reach_the_next_query(process):
    batches = process.batches("SELECT range + 100 FROM range(100000000)")
    assert next(batches).num_rows >= 0
    batches.close()
    assert numbers(process.batches("SELECT 7 AS a")) == [7]


def test_abandoned_generator_does_not_end_a_later_query(process):
    """A failed generator is kept alive by the traceback of its error, so its end can be noticed late."""
    given_up = process.batches("SELECT range + 100 FROM range(100000000)")
    assert next(given_up).num_rows >= 0
    later = process.batches("SELECT range FROM range(3000000)")
    first = next(later)
    worker = process._worker
    given_up.close()
    assert process._worker is worker
    assert numbers([first, *later]) == list(range(3_000_000))


def test_threads_get_their_answers(process):
    """Each thread gets the rows of its query, whatever other threads query meanwhile."""

    def rounds(number):
        return {process.ask(f"SELECT {number} AS a", {})["a"][0].as_py() for _ in range(10)}

    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(rounds, range(4))) == [{number} for number in range(4)]


def test_unread_rows_do_not_block_other_threads(process):
    """The query with unread rows ends, and further reading raises an error."""
    left = process.batches("SELECT range + 100 FROM range(100000000)")
    assert next(left).num_rows >= 0
    with ThreadPoolExecutor(1) as thread:
        assert thread.submit(process.ask, "SELECT 7 AS a", {}, PATIENCE).result(PATIENCE)["a"].to_pylist() == [7]
    with pytest.raises(BadInput, match="another query began before all rows of this one were read"):
        next(left)


def test_abandoned_rows_do_not_wait_for_other_threads(process):
    left, is_locked, is_done = process.batches("SELECT * FROM range(9)"), threading.Event(), threading.Event()
    next(left)

    def hold():
        with process._lock:
            is_locked.set()
            return is_done.wait(PATIENCE)

    with ThreadPoolExecutor(1) as thread:
        waiting = thread.submit(hold)
        assert is_locked.wait(PATIENCE)
        left.close()
        is_done.set()
        assert waiting.result(PATIENCE)
    assert process.ask("SELECT 7 AS a", {})["a"].to_pylist() == [7]


def test_query_closed_by_another_thread_raises(process):
    process.ask("SELECT 1", {})
    with ThreadPoolExecutor(1) as thread:
        waiting = thread.submit(process.ask, SLOW, {}, PATIENCE)
        until(lambda: process._answer is not None)
        process.close()
        with pytest.raises(BadInput, match="the lake was closed before the query was answered"):
            waiting.result(PATIENCE)
    assert process.ask("SELECT 7 AS a", {})["a"].to_pylist() == [7]


def test_a_discarded_process_starts_nothing(explored, monkeypatch):
    """Neither if another thread discards it while a query starts it, nor later."""
    discarded, started = Process(explored, [], 1e9), []

    class Started(subprocess.Popen):
        def __init__(self, *given, **options):
            super().__init__(*given, **options)
            started.append(self)
            discarded.discard()

    monkeypatch.setattr(subprocess, "Popen", Started)
    for _ in range(2):
        with pytest.raises(BadInput, match="the lake was closed before the query was answered"):
            discarded.ask(SLOW, {}, PATIENCE)
    (worker,) = started
    assert worker.wait(PATIENCE) == -signal.SIGKILL


def test_an_answer_names_its_question(process):
    answer = process._send({"sql": "SELECT 1", "parameters": {}}, PATIENCE)
    answer.number += 1
    with pytest.raises(LakeError, match="got the answer to question"):
        process._next(answer)
    assert process.ask("SELECT 7 AS a", {})["a"].to_pylist() == [7]


def test_query_is_stopped_while_it_sends(process):
    with pytest.raises(BadInput, match=r"stopped after 0\.3 s"):
        list(process.batches(SLOW, timeout=0.3))
    assert numbers(process.batches("SELECT 7 AS a")) == [7]


def test_session_is_kept_and_restarts_after_an_error(lake):
    publish.make_version(lake, plain_plan(), plain_work)
    version = read.version(lake, "plain")
    session = Session(lake, {"plain": version.key}, 1 << 30)

    def ask(text):
        return numbers(session.run(session.check_query(text), {}))

    assert ask("SELECT count(*) FROM plain") == [60]
    kept = session._database
    assert ask("SELECT sum(value) FROM plain") == [60.0]
    assert session._database is kept
    with pytest.raises(BadInput, match="nothing"):
        ask("SELECT nothing FROM plain")
    assert session._database is None
    assert ask("SELECT count(*) FROM plain") == [60]
    # The page's checksum is compared again for the next query.
    path = version.partition_path("1.parquet")
    data = bytearray(path.read_bytes())
    data[60] ^= 1
    path.write_bytes(data)
    with pytest.raises(Damaged):
        ask("SELECT sum(value), sum(id) FROM plain")
    data[60] ^= 1
    path.write_bytes(data)
    assert ask("SELECT sum(value) FROM plain") == [60.0]
    session.close()
