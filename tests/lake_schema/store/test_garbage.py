"""gc removes no version that a name links to, nor a version from which such a version was made, even indirectly."""

import errno
import fcntl
import tempfile
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from lake_schema.errors import BadInput, Damaged
from lake_schema.store import garbage, layout, locks, manifest, publish, read, request_links
from lake_schema.store.plan import Plan, Task
from tests.universe import PLAIN, plain_plan, plain_work, toy_plan, toy_work

TABLES = ("first", "second", "third")


def plan_of(table, number, inputs=()):
    facts = {"seed": number, "made of": {f"x{i}": key for i, key in enumerate(inputs)}}
    return Plan(replace(PLAIN, name=table), facts, (Task("0.parquet", {"part": 0}),))


# (table, request or None, indices of the earlier versions from which it was made)
PUBLISHED = st.tuples(
    st.sampled_from(TABLES), st.sampled_from(["a", "b", None]), st.lists(st.integers(0, 9), max_size=2)
)


@settings(max_examples=25)
@given(st.lists(PUBLISHED, min_size=1, max_size=8), st.sampled_from([None, *TABLES]))
@example([("second", "b", []), ("second", "b", []), ("first", "a", [0, 1]), ("first", "a", [])], None)
def test_versions_that_a_request_needs_are_kept(published, chosen):
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.fsync", lambda descriptor: None)
        root, every, pinned, made_of = Path(folder), [], {}, {}
        for number, (table, request, before) in enumerate(published):
            inputs = [every[i % len(every)] for i in before if every]
            plan = plan_of(table, number, [key for _, key in inputs])
            publish.make_version(root, plan, plain_work, name=request)
            this = (table, plan.key)
            every.append(this)
            made_of[this] = inputs
            pinned[table, None] = this
            if request:
                pinned[table, request] = this
                # If it was made from two versions of a table, the request is linked to the one with the lower key.
                for one in sorted(one for one in inputs if one[0] != table):
                    pinned.setdefault((one[0], request), one)
        reached, waiting = set(), list(pinned.values())
        while waiting:
            one = waiting.pop()
            reached.add(one)
            waiting += made_of[one]
        there = set(every)
        rest = {one for one in there - reached if chosen in (None, one[0])}
        if chosen in (None, *(table for table, _ in there)):
            said = garbage.collect(root, chosen)
            assert {(path.parent.name, path.name[2:]) for path in said} == rest
            assert all(path.exists() for path in said)
            assert garbage.collect(root, chosen, delete=True) == said
            assert garbage.collect(root, chosen) == []
        for table, key in there - rest:
            assert read.find_faults(read.version(root, table, key), deep=True) == []
        assert not any(layout.version_folder(root, *one).exists() for one in rest)


def test_gc_without_delete_removes_nothing(lake):
    for seed in (1, 2):
        publish.make_version(lake, plain_plan(seed), plain_work, name="a")
    before = sorted(lake.rglob("*"))
    assert garbage.collect(lake) == [layout.version_folder(lake, "plain", plain_plan(1).key)]
    assert sorted(lake.rglob("*")) == before


def test_the_images_of_another_request_stay(lake):
    publish.make_version(lake, plain_plan(1), plain_work, name="a")
    publish.make_version(lake, plain_plan(2), plain_work, name="b")
    assert garbage.collect(lake, delete=True) == []
    assert [read.version(lake, "plain", request=name).num_rows for name in "ab"] == [60, 60]


@pytest.mark.parametrize("what", ["manifest", "version", "link"])
def test_nothing_is_removed_if_inputs_are_unknown(lake, what):
    publish.make_version(lake, plain_plan(1), plain_work)
    first = publish.make_version(lake, toy_plan(1), toy_work, name="a")
    publish.make_version(lake, toy_plan(2), toy_work, name="b")
    publish.make_version(lake, plain_plan(2), plain_work)
    if what == "manifest":
        (first / "manifest.json").write_text("{}")
    elif what == "version":
        first.rename(lake / "elsewhere")
    else:
        link = layout.request_link(lake, "a", "toy")
        link.unlink()
        link.symlink_to("/etc")
    for delete in (False, True):
        with pytest.raises(Damaged):
            garbage.collect(lake, "plain", delete)
    assert layout.version_folder(lake, "plain", plain_plan(1).key).exists()


def test_a_stage_in_use_is_neither_listed_nor_removed(lake):
    plan = plain_plan(1)
    stage = layout.stage_folder(lake, "plain", plan.key)
    stage.mkdir(parents=True)
    with locks.hold(stage.parent / f".lock-{plan.key}", "in use"):
        assert garbage.collect(lake) == garbage.collect(lake, delete=True) == []
    assert garbage.collect(lake) == garbage.collect(lake, delete=True) == [stage]
    assert not stage.exists()


def test_manifests_are_read_without_locks(lake, monkeypatch):
    """Reading the manifests of many versions takes longer than the time limit of a run that publishes."""
    for seed in (1, 2):
        publish.make_version(lake, plain_plan(seed), plain_work, name="a")
    load, held = manifest.load, []

    def watched(*args):
        held.append(locks.is_held(lake / "plain" / ".lock"))
        return load(*args)

    monkeypatch.setattr(manifest, "load", watched)
    assert garbage.collect(lake, delete=True) == [layout.version_folder(lake, "plain", plain_plan(1).key)]
    assert held == [False]


def test_versions_published_during_gc_are_kept_with_their_inputs(lake, monkeypatch):
    first, second = (plan_of("first", number) for number in (1, 2))
    for plan in (first, second):
        publish.make_version(lake, plan, plain_work)
    late, load = plan_of("second", 3, [first.key]), manifest.load

    def watched(*args):
        found = load(*args)
        monkeypatch.undo()
        publish.make_version(lake, late, plain_work)
        return found

    monkeypatch.setattr(manifest, "load", watched)
    assert garbage.collect(lake, delete=True) == []
    assert all(layout.version_folder(lake, plan.table.name, plan.key).exists() for plan in (first, second, late))


def test_checking_a_lock_blocks_nothing(lake):
    plan = plain_plan(1)
    lock = layout.table_folder(lake, "plain") / f".lock-{plan.key}"
    lock.parent.mkdir()
    with lock.open("a") as stream:
        # This does the same as is_held, but longer.
        fcntl.flock(stream.fileno(), fcntl.LOCK_EX)
        timer = threading.Timer(0.2, fcntl.flock, (stream.fileno(), fcntl.LOCK_UN))
        timer.start()
        publish.make_version(lake, plan, plain_work)
        timer.join()
    assert read.version(lake, "plain").num_rows == 60


def test_a_name_that_is_removed_by_hand_keeps_nothing(lake):
    first = publish.make_version(lake, plain_plan(1), plain_work, name="a")
    publish.make_version(lake, plain_plan(2), plain_work, name="b")
    layout.request_link(lake, "a", "plain").unlink()
    layout.request_link(lake, "a", "plain").parent.rmdir()
    assert request_links.request_names(lake) == ["b"]
    assert garbage.collect(lake, delete=True) == [first]


def test_a_lake_that_is_not_writable_is_named(lake, monkeypatch):
    publish.make_version(lake, plain_plan(), plain_work)

    def refuse(path, mode="r", *args):
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(BadInput, match=f"^lake {lake} cannot be written: {lake}/plain/.lock: Read-only file system$"):
        garbage.collect(lake, delete=True)
