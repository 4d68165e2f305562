"""The same request gives the same bytes after any interruption; a different request reuses nothing."""

import hashlib
import os
import random
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from lake_schema.columns import Column, Table
from lake_schema.errors import BadInput, TasksFailed
from lake_schema.store import publish, read
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.store.provenance import code_version
from tests.faults import promise
from tests.faults.disc import Disc, Killed
from tests.universe import CELLS, PLAIN, TOY, plain_plan, plain_work, toy_plan, toy_rows, toy_work

ROOT = Path(__file__).resolve().parents[2]

# ------------------------------------------------------------------------------------------------ the same


def shuffled(seed):
    def mapper(function, parts):
        return map(function, random.Random(seed).sample(list(parts), len(parts)))

    return mapper


def threads(workers):
    def mapper(function, parts):
        with ThreadPoolExecutor(workers) as pool:
            return list(pool.map(function, parts))

    return mapper


def retried(function, parts):
    """Run every task twice, as a scheduler may do."""
    return [function(part) for part in [*parts, *parts]]


HOW = (
    {f"order {seed}": shuffled(seed) for seed in range(3)}
    | {f"{n} threads": threads(n) for n in (2, 4)}
    | {"twice": retried}
)


def test_bytes_do_not_depend_on_scheduling(tmp_path):
    found = {}
    for how, mapper in HOW.items():
        for past in ("fresh", "resumed"):
            root = tmp_path / f"{how} {past}"
            root.mkdir()
            if past == "resumed":
                with Disc(root, die_at=25), pytest.raises(Killed):
                    publish.make_version(root, toy_plan(), toy_work)
            publish.make_version(root, toy_plan(), toy_work, mapper)
            found[how, past] = promise.sums(root, "toy")
    first = next(iter(found.values()))
    assert [how for how, sums in found.items() if sums != first] == []
    assert len(first) > len(CELLS)


_PRINT_SUMS = """
import sys, tempfile
from pathlib import Path
from tests.faults import promise
with tempfile.TemporaryDirectory() as folder:
    root = Path(folder)
    promise.make(root, "toy", 1)
    print(sorted(promise.sums(root, "toy").items()), (root / "toy/current/manifest.json").read_bytes())
"""

ODD = {"TZ": "Asia/Kathmandu", "LC_ALL": "tr_TR.UTF-8", "LANG": "tr_TR.UTF-8", "PYTHONHASHSEED": "271828"}
WORLDS = [pytest.param(ODD, 0o077, id="all")] + [
    pytest.param({name: value}, 0o022, id=name, marks=pytest.mark.nightly) for name, value in ODD.items()
]


def _elsewhere(environment, umask):
    command = [sys.executable, "-c", _PRINT_SUMS]
    settings = {**os.environ, "PYTHONHASHSEED": "0", "TZ": "UTC", **environment}
    return subprocess.run(
        command, cwd=ROOT, env=settings, umask=umask, capture_output=True, check=True, text=True
    ).stdout


@pytest.mark.parametrize(("environment", "umask"), WORLDS)
def test_bytes_do_not_depend_on_environment_and_time(environment, umask, capsys):
    """Compare with this process, which has another seed of string hashes."""
    exec(_PRINT_SUMS, {})
    here = capsys.readouterr().out
    assert len(here) > 1000
    assert _elsewhere(environment, umask) == here


# ------------------------------------------------------------------------------------------------ another one


def counted(made):
    def work(root, facts):
        made.append(facts["part"])
        if len(made) == 2:
            raise OSError("broken off")
        return plain_work(root, facts)

    return work


@pytest.mark.parametrize(
    "change", [{"input": "b"}, {"mission": "b"}, {"request": {"seed": 2}}, {"code": "b"}], ids=lambda c: next(iter(c))
)
def test_tasks_of_another_version_are_not_reused(lake, change):
    facts = {"seed": 1, "input": "a", "mission": "a", "request": {"seed": 1}, "code": "a"}
    before = Plan(PLAIN, facts, plain_plan().tasks)
    after = Plan(PLAIN, {**facts, **change}, plain_plan().tasks)
    made = []
    with pytest.raises(TasksFailed):
        publish.make_version(lake, before, counted(made))
    publish.make_version(lake, after, counted(made))
    assert made == [0, 1, 2, 0, 1, 2]
    # Tasks of the first plan can still be resumed for it.
    publish.make_version(lake, before, counted(made))
    assert made[6:] == [1]


def test_fingerprint_depends_on_input_tables(lake):
    """A changed row of an input changes its fingerprint and the key of tables made from it."""
    keys, prints = set(), set()
    for seed in (1, 2):
        publish.make_version(lake, plain_plan(seed), plain_work)
        source = read.version(lake, "plain")
        prints.add(source.fingerprint)
        keys.add(Plan(TOY, {"input": source.key}, toy_plan().tasks).key)
    assert len(keys) == len(prints) == 2


def test_code_fingerprint_depends_on_every_byte(tmp_path):
    for package in ("lake_schema", "truesky"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    before = code_version(tmp_path)
    assert before == code_version(ROOT)
    for name in (
        "truesky/fluxes/passbands.csv",
        "lake_schema/mission/vis.csv",
        "truesky/randomness/rng.py",
        "truesky/catalogue/milky_way.toml",
    ):
        path = tmp_path / name
        whole = path.read_bytes()
        path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
        assert code_version(tmp_path) != before, name
        path.write_bytes(whole)
    (tmp_path / "truesky" / "notes.txt").write_text("not code")
    assert code_version(tmp_path) == before
    assert len(before) == len(hashlib.sha256().hexdigest())


# ---------------------------------------------------------------------------------------------- rows that do not add up


def silent(root, facts):
    return None


def fewer(root, facts):
    return Output(plain_work(root, facts).rows.slice(1))


@pytest.mark.parametrize(
    ("work", "words"),
    [(silent, "must return an Output, got NoneType"), (fewer, "must have 20 rows by the plan, got 19")],
)
def test_a_task_with_an_incomplete_receipt_is_refused(lake, work, words):
    with pytest.raises(TasksFailed, match=words):
        publish.make_version(lake, plain_plan(), work)


def test_a_task_that_raises_is_named_and_other_tasks_are_kept(lake):
    promise.make(lake, "plain", 1)

    def work(root, facts):
        if facts["part"] == 1:
            raise ValueError("row 17: no such template")
        return plain_work(root, facts)

    with pytest.raises(TasksFailed, match=r"1 of 3 tasks failed: 1\.parquet: ValueError: row 17: no such template"):
        publish.make_version(lake, plain_plan(2), work)
    assert promise.current(lake, "plain") == promise.key("plain", 1)
    assert len(list(lake.rglob(".receipts-*/[!.]*.json"))) == 2


def toy_with_ids(root, facts):
    rows = toy_rows(facts["cell"], facts["rows"])
    ids = rows["id"].to_numpy().copy()
    ids[-1] = facts["id"]
    return Output(rows.set_column(0, rows.schema.field(0), [ids]))


@pytest.mark.parametrize("number", [7, 7 << 46 | 7])
def test_a_duplicate_identifier_is_refused_with_both_cells(lake, number):
    parts = tuple(Task(p.name, {**p.facts, "id": number}) for p in toy_plan().tasks[:2])
    with pytest.raises(BadInput, match=rf"table toy: id {number} is in Npix=1607.parquet and in Npix=1608.parquet"):
        publish.make_version(lake, Plan(TOY, {}, parts), toy_with_ids)
    assert promise.current(lake, "toy") is None


def test_duplicates_of_scattered_identifiers_are_detected(lake):
    rng = np.random.default_rng(1)
    spread = rng.integers(0, 2**62, 3000)

    def work(root, facts):
        ids = spread[:2000] if facts["part"] == 0 else spread[1999:]
        return Output(PLAIN.build({"id": ids, "value": np.zeros(ids.size)}))

    with pytest.raises(BadInput, match=rf"id {spread[1999]} is in 0.parquet and in 1.parquet"):
        publish.make_version(lake, Plan(PLAIN, {}, tuple(Task(f"{i}.parquet", {"part": i}) for i in (0, 1))), work)


def test_a_duplicate_key_of_two_columns_is_refused(lake):
    table = Table("pairs", 1, (Column("a", "int64", doc="a"), Column("b", "string", doc="b")), "Pairs.", key=("a", "b"))

    def work(root, facts):
        return Output(table.build({"a": [facts["part"], 5], "b": ["x", "y"]}))

    with pytest.raises(BadInput, match=r"key \(5, 'y'\) is in 0.parquet and in 1.parquet"):
        publish.make_version(lake, Plan(table, {}, tuple(Task(f"{i}.parquet", {"part": i}) for i in (0, 1))), work)


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [("_healpix_29", (1607 << 48) + 5, "does not match its ra, dec"), ("_healpix_29", 1608 << 48, "another cell")],
)
def test_inconsistent_positions_are_refused(lake, column, value, words):
    def work(root, facts):
        rows = toy_rows(1607, 5)
        index = rows[column].to_numpy().copy()
        index[0 if value < 1608 << 48 else -1] = value
        return Output(rows.set_column(3, rows.schema.field(3), [index]))

    with pytest.raises(TasksFailed, match=words):
        publish.make_version(lake, Plan(TOY, {}, toy_plan().tasks[:1]), work)
