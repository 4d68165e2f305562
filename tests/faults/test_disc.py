"""Let the disc fail or stop at any call: the last version stays complete, and the next run repairs the lake."""

import shutil

import pytest

from lake_schema.errors import LakeError, TasksFailed
from lake_schema.store import garbage, layout, publish, read
from lake_schema.store.plan import Plan
from tests.faults import promise, victims
from tests.faults.disc import Disc, Killed
from tests.universe import plain_plan, plain_work

# (kind of table, stride between the disc calls that are tried)
SHORT = [("plain", 5), ("toy", 19)]
LONG = [pytest.param(kind, 1, marks=pytest.mark.nightly) for kind in ("plain", "toy")]


@pytest.fixture(scope="module")
def wanted(tmp_path_factory):
    sums = {}
    for kind in promise.KINDS:
        root = tmp_path_factory.mktemp("undisturbed")
        promise.make(root, kind, 2)
        sums[kind] = promise.sums(root, kind)
    return sums


@pytest.fixture(scope="module")
def older(tmp_path_factory):
    """Return kind -> function that returns a new lake with an older version, which is made once."""
    roots = {kind: tmp_path_factory.mktemp("older") for kind in promise.KINDS}
    for kind, root in roots.items():
        promise.make(root, kind, 1)

    def copied(kind):
        return shutil.copytree(roots[kind], tmp_path_factory.mktemp("lake"), symlinks=True, dirs_exist_ok=True)

    return copied


def calls(older, kind):
    """Return the number of disc calls of a run if there is an older version."""
    root = older(kind)
    with Disc(root) as disc:
        promise.make(root, kind, 2)
    return len(disc.calls)


@pytest.mark.parametrize(("kind", "stride"), SHORT + LONG)
def test_any_call_may_fail(kind, stride, wanted, older):
    failed = published = 0
    total = calls(older, kind)
    for n in range(total, 0, -stride):
        root = older(kind)
        old, new = (promise.key(kind, seed) for seed in (1, 2))
        try:
            with Disc(root, fail_at=n):
                promise.make(root, kind, 2)
            assert promise.current(root, kind) == new
            published += 1
        except (OSError, LakeError) as error:
            failed += "injected" in str(error)
            assert promise.current(root, kind) in (old, new)
        promise.make(root, kind, 2)
        assert promise.current(root, kind) == new
        assert promise.sums(root, kind) == wanted[kind]
    assert failed + published == len(range(total, 0, -stride))
    assert failed > published


@pytest.mark.parametrize(("kind", "stride"), SHORT + LONG)
def test_death_at_any_call(kind, stride, wanted, older):
    """After a given call nothing reaches the disc, including `finally` blocks, like kill -9."""
    seen = set()
    for n in range(calls(older, kind), 0, -stride):
        root = older(kind)
        old, new = (promise.key(kind, seed) for seed in (1, 2))
        with Disc(root, die_at=n), pytest.raises(Killed):
            promise.make(root, kind, 2)
        seen.add(promise.current(root, kind))
        promise.make(root, kind, 2)
        assert promise.current(root, kind) == new
        assert promise.sums(root, kind) == wanted[kind]
        left = {path.name for path in layout.table_folder(root, kind).iterdir()}
        assert not [name for name in left if name.startswith((".stage", ".receipts"))]
    assert seen == {old, new}


def test_death_in_gc_leaves_no_half_version(older):
    root = older("plain")
    promise.make(root, "plain", 2)
    with Disc(root) as disc:
        garbage.collect(root, "plain", delete=True)
    for n in range(1, len(disc.calls) + 1):
        root = older("plain")
        promise.make(root, "plain", 2)
        with Disc(root, die_at=n), pytest.raises(Killed):
            garbage.collect(root, "plain", delete=True)
        assert promise.current(root, "plain") == promise.key("plain", 2)
        promise.make(root, "plain", 1)
        assert promise.current(root, "plain") == promise.key("plain", 1)
        # The version whose deletion was interrupted has been made again. Now it is unused again.
        promise.make(root, "plain", 2)
        garbage.collect(root, "plain", delete=True)
        assert [path.name for path in layout.table_folder(root, "plain").glob("*v-*")] == [
            f"v-{promise.key('plain', 2)}"
        ]


@pytest.fixture(scope="module")
def two_requests(tmp_path_factory):
    """Return a function that makes a lake with a version of each of a and b and an unused older version."""
    root = tmp_path_factory.mktemp("two")
    for name, seed in (("a", 4), ("a", 1), ("b", 3)):
        promise.make(root, "plain", seed, name=name)
    return lambda: shutil.copytree(root, tmp_path_factory.mktemp("lake"), symlinks=True, dirs_exist_ok=True)


def versions(root):
    return [promise.current(root, "plain", name) for name in "ab"]


@pytest.mark.parametrize("stride", [15, pytest.param(1, marks=pytest.mark.nightly)])
def test_death_at_any_step_keeps_the_versions_of_all_requests(stride, two_requests):
    """The request that publishes has its complete old or new version; the other request keeps its version.

    Garbage collection then deletes neither of them. All steps that change a link are tried, and one in `stride` of the
    others.
    """
    first, other, new = (promise.key("plain", seed) for seed in (1, 3, 2))
    root = two_requests()
    with Disc(root) as disc:
        promise.make(root, "plain", 2, name="a")
    found = set()
    total = len(disc.calls)
    links = {n for n, call in enumerate(disc.calls, start=1) if "names/" in call or "current" in call}
    assert len(links) > 2
    for n in sorted(links | set(range(total, 0, -stride)), reverse=True):
        root = two_requests()
        with Disc(root, die_at=n), pytest.raises(Killed):
            promise.make(root, "plain", 2, name="a")
        now = versions(root)
        assert now in ([first, other], [new, other]), disc.calls[n - 1]
        found.add(now[0])
        garbage.collect(root, delete=True)
        assert versions(root) == now
        promise.make(root, "plain", 2, name="a")
        assert versions(root) == [new, other]
    assert found == {first, new}


def test_death_in_gc_keeps_linked_versions(two_requests):
    root = two_requests()
    with Disc(root) as disc:
        assert garbage.collect(root, delete=True) == [layout.version_folder(root, "plain", promise.key("plain", 4))]
    for n in range(1, len(disc.calls) + 1):
        root = two_requests()
        with Disc(root, die_at=n), pytest.raises(Killed):
            garbage.collect(root, delete=True)
        assert versions(root) == [promise.key("plain", seed) for seed in (1, 3)]
        garbage.collect(root, delete=True)
        assert garbage.collect(root) == []
        assert versions(root) == [promise.key("plain", seed) for seed in (1, 3)]


@pytest.mark.parametrize(
    ("work", "most_bytes", "file"), [(plain_work, 300, ".parquet"), (victims.with_image, 100_000, ".fits")]
)
def test_a_full_disc_is_a_clear_error(lake, work, most_bytes, file):
    promise.make(lake, "plain", 1)
    answers = victims.CONTEXT.SimpleQueue()
    victims.run(victims.on_a_small_disc, lake, work, most_bytes, answers)
    text = answers.get()
    assert text.startswith("TasksFailed: table plain: 3 of 3 tasks failed")
    assert "OSError" in text
    assert "File too large" in text or " requested and " in text, text
    assert promise.current(lake, "plain") == promise.key("plain", 1)
    assert not [path for path in lake.rglob("*") if path.is_file() and file in path.name and "v-" not in str(path)]
    publish.make_version(lake, plain_plan(2), work)
    assert read.find_faults(read.version(lake, "plain"), deep=True) == []


def test_failed_tasks_leave_no_temporary_files(lake):
    with Disc(lake, fail_at=5), pytest.raises(TasksFailed):
        promise.make(lake, "plain", 1)
    assert not list(lake.rglob("*.tmp*"))


def test_a_plan_without_tasks_gives_an_empty_table(lake):
    plan = plain_plan()
    publish.make_version(lake, Plan(plan.table, plan.facts, ()), plain_work)
    assert read.version(lake, "plain").rows().num_rows == 0
