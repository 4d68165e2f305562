"""Test killed processes, concurrent publishers, and readers during publication."""

import io
import os
import re
import signal

import pyarrow.parquet as pq
import pytest

from lake_schema.errors import BadInput, Damaged, Superseded
from lake_schema.store import garbage, layout, locks, parquet, read
from tests.faults import promise, victims
from tests.faults.disc import Disc


def phases(root, kind):
    """Return the indices of the disc calls at which a run changes its state."""
    promise.make(root, kind, 1)
    with Disc(root) as disc:
        promise.make(root, kind, 2)
    about = {
        "a part is written": lambda c: c.startswith("write") and "tmp" in c,
        "a receipt is named": lambda c: c.startswith("replace") and ".receipts" in c,
        "all parts are there": lambda c: ".manifest" in c,
        "the stage is renamed": lambda c: c.startswith("rename"),
        "the link is swapped": lambda c: c.startswith("replace") and ".current" in c,
        "the receipts go": lambda c: c.startswith("rmdir"),
    }
    return {name: 1 + max(n for n, c in enumerate(disc.calls) if test(c)) for name, test in about.items()}


@pytest.fixture(scope="module")
def plain_phases(tmp_path_factory):
    return phases(tmp_path_factory.mktemp("counted"), "plain")


@pytest.fixture(scope="module")
def wanted(tmp_path_factory):
    root = tmp_path_factory.mktemp("undisturbed")
    for kind in promise.KINDS:
        promise.make(root, kind, 2)
    return {kind: promise.sums(root, kind) for kind in promise.KINDS}


@pytest.mark.parametrize("kind", ["plain", pytest.param("toy", marks=pytest.mark.nightly)])
def test_kill_9_at_every_phase(kind, wanted, tmp_path_factory):
    for name, n in phases(tmp_path_factory.mktemp("counted"), kind).items():
        root = tmp_path_factory.mktemp("lake")
        promise.make(root, kind, 1)
        old, new = (promise.key(kind, seed) for seed in (1, 2))
        assert victims.run(victims.kill_at, root, kind, 2, n) == -signal.SIGKILL, name
        assert promise.current(root, kind) == (new if name == "the receipts go" else old), name
        promise.make(root, kind, 2)
        assert promise.current(root, kind) == new, name
        assert promise.sums(root, kind) == wanted[kind], name


def race(root, seeds, stops):
    """Run two publishers; each pauses at a disc call, first one, then the other, then both continue."""
    promise.make(root, "plain", 1)
    base = promise.key("plain", 1)
    answers = victims.CONTEXT.SimpleQueue()
    runners = []
    for seed, n in zip(seeds, stops, strict=True):
        reached, go = victims.CONTEXT.Event(), victims.CONTEXT.Event()
        child = victims.start(victims.stop_at, root, "plain", seed, n, base, reached, go, answers)
        assert reached.wait(60)
        runners.append((child, go))
    for child, go in runners:
        go.set()
        child.join()
    return [answers.get() for _ in runners]


@pytest.mark.parametrize("seeds", [(2, 2), (2, 3)], ids=["same plan", "two plans"])
@pytest.mark.parametrize("every", [9, pytest.param(1, marks=pytest.mark.nightly)])
def test_the_second_of_two_publishers_gets_an_error(every, seeds, plain_phases, tmp_path_factory):
    stops = list(plain_phases.values())
    for i, first in enumerate(stops):
        for second in stops[i % every :: every]:
            root = tmp_path_factory.mktemp("lake")
            answers = race(root, seeds, (first, second))
            where = f"stopped at calls {first} and {second}: {answers}"
            won = [seed for seed, answer in answers if answer == "published"]
            assert won, where
            assert {answer for _, answer in answers} <= {"published", "Superseded"}, where
            assert promise.current(root, "plain") in {promise.key("plain", seed) for seed in won}, where
            if len(set(seeds)) == 2:
                assert len(won) == 1, where
                # The second publisher can start again from the current version.
                promise.make(root, "plain", 9)
                assert promise.current(root, "plain") == promise.key("plain", 9)


@pytest.mark.parametrize(
    ("kind", "versions", "reads"),
    [("plain", 20, 100), *(pytest.param(kind, 20, 1000, marks=pytest.mark.nightly) for kind in ("plain", "toy"))],
)
def test_a_reader_never_sees_two_versions(kind, versions, reads, lake):
    promise.make(lake, kind, 1)
    stop = victims.CONTEXT.Event()
    child = victims.start(victims.publish_many, lake, kind, versions, stop)
    seen, gone, whole = set(), [], 0
    # However fast either is: so long until versions were published while they were read.
    while whole < reads or (len(seen) <= 3 and child.is_alive()):
        try:
            version = read.version(lake, kind)
            rows = version.rows()
        except (BadInput, Damaged) as error:
            # gc may remove an old version while it is read; the error reports it.
            gone.append(str(error))
            continue
        whole += 1
        seen.add(version.key)
        assert rows.num_rows == version.num_rows
        if kind == "plain":
            assert set(rows["value"].to_pylist()) == {float(version.manifest["facts"]["seed"])}
    stop.set()
    child.join()
    assert child.exitcode == 0
    assert len(seen) > 3
    assert [text for text in gone if not re.search(r"missing|No such file|no table", text)] == []


def test_gc_leaves_a_running_publisher_alone(lake, plain_phases, monkeypatch):
    monkeypatch.setattr(locks, "TABLE_TIMEOUT", victims.PATIENCE)
    promise.make(lake, "plain", 1)
    answers = victims.CONTEXT.SimpleQueue()
    for name, n in plain_phases.items():
        reached, go = victims.CONTEXT.Event(), victims.CONTEXT.Event()
        seed = 10 + n
        child = victims.start(
            victims.stop_at, lake, "plain", seed, n, layout.current_key(lake, "plain"), reached, go, answers
        )
        assert reached.wait(60)
        try:
            garbage.collect(lake, "plain", delete=True)
        except Superseded:
            assert name in ("the stage is renamed", "the link is swapped")  # it holds the table's lock here
        finally:
            go.set()
            child.join()
        assert answers.get() == (seed, "published"), name
        assert promise.current(lake, "plain") == promise.key("plain", seed)


def test_a_version_removed_during_reading_is_reported_missing(lake, tmp_path_factory):
    """Remove the version before each disc call of a reader."""
    promise.make(lake, "plain", 1)
    calls = _reads(lake, 0)
    assert calls > 5
    for n in range(1, calls + 1):
        root = tmp_path_factory.mktemp("lake")
        promise.make(root, "plain", 1)
        with pytest.raises((BadInput, Damaged), match=r"missing|[Nn]o such file|no table"):
            _reads(root, n)


def _reads(root, n):
    """Read a table whose folder is renamed before the n-th look at a file; returns how often it looked."""
    seen = []

    def looked(real):
        def call(path, *args, **kwargs):
            if str(root) in str(path):
                seen.append(path)
                if len(seen) == n:
                    (root / "plain").rename(root / "gone")
            return real(path, *args, **kwargs)

        return call

    with pytest.MonkeyPatch.context() as patch:
        for module, name in ((os, "stat"), (io, "open"), (pq, "read_schema"), (parquet, "open_dataset")):
            patch.setattr(module, name, looked(getattr(module, name)))
        read.version(root, "plain").rows()
    return len(seen)
