"""Several requests in one lake have separate versions, which are never confused."""

import os
import shutil
from dataclasses import replace

import duckdb
import pyarrow.dataset as ds
import pytest

from lake_schema.errors import BadInput, Damaged, Superseded
from lake_schema.store import layout, locks, publish, read, request_links
from lake_schema.store.plan import Output, Plan, Task
from tests.universe import PLAIN, plain_plan, plain_work, toy_plan, toy_work


@pytest.fixture
def two(lake):
    """Publish tables of requests a and b: a separate one for each, and one that they share."""
    for name, seed in (("a", 1), ("b", 2)):
        publish.make_version(lake, toy_plan(), toy_work, name=name)
        publish.make_version(lake, plain_plan(seed), plain_work, name=name)
    return lake


def made_from(*keys):
    """Return a plan of a table whose facts name its inputs."""
    return Plan(replace(PLAIN, name="derived"), {"seed": 1, "inputs": list(keys)}, plain_plan().tasks)


def test_each_request_has_its_version(two):
    assert request_links.request_names(two) == ["a", "b"]
    assert [read.version(two, "plain", request=name).key for name in "ab"] == [plain_plan(1).key, plain_plan(2).key]
    assert {read.version(two, "toy", request=name).key for name in "ab"} == {toy_plan().key}
    assert read.latest_version(two, "plain").key == plain_plan(2).key
    assert request_links.tables_of_request(two, "a") == ["plain", "toy"]


def test_several_requests_require_a_name(two):
    assert read.version(two, "toy").key == toy_plan().key
    with pytest.raises(BadInput, match=r"requests a, b have different versions of table plain: name one"):
        read.version(two, "plain")
    assert read.version(two, "plain", plain_plan(1).key).key == plain_plan(1).key


def test_a_missing_name_is_refused(two):
    with pytest.raises(BadInput, match=r"has no request c; it has a, b"):
        read.version(two, "plain", request="c")
    with pytest.raises(
        BadInput, match=r"no request A, because names have only small letters.*; did you mean a\? it has"
    ):
        read.version(two, "plain", request="A")
    with pytest.raises(BadInput, match=r"no table halos of request a; it has plain, toy$"):
        read.version(two, "halos", request="a")
    with pytest.raises(BadInput, match="name"):
        read.version(two, "plain", request="../a")


def test_a_request_without_a_version_takes_the_last(two):
    assert read.input_version(two, "plain", "a").key == plain_plan(1).key
    assert read.input_version(two, "plain", "c").key == plain_plan(2).key
    with pytest.raises(
        BadInput, match=r"no table halos of request c: run .* truesky build; requests of the lake: a, b$"
    ):
        read.input_version(two, "halos", "c")


def test_an_input_of_an_empty_lake_is_made_with_commands(lake):
    words = rf"lake {lake} has no tables: run truesky run REQUEST {lake}, or first truesky build, fluxes and plan$"
    with pytest.raises(BadInput, match=words):
        read.input_version(lake, "mission", "c")


def test_a_request_of_one_lake_keeps_the_paths_that_users_hold(lake):
    folder = publish.make_version(lake, toy_plan(), toy_work, name="demo")
    assert layout.current_link(lake, "toy").resolve() == folder == (lake / "names/demo/toy").resolve()
    for path in ("toy/current/toy/dataset", "names/demo/toy/toy/dataset"):
        assert ds.dataset(lake / path, partitioning=None, exclude_invalid_files=True).count_rows() == 550
        assert duckdb.sql(f"SELECT count(*) FROM '{lake / path}/*/*/*.parquet'").fetchall() == [(550,)]


def test_requests_do_not_supersede_each_other(lake):
    """One request publishes while the other is running; a second run of the first request is refused."""

    def work(root, facts):
        if facts["part"] == 0:
            publish.make_version(lake, plain_plan(2), plain_work, name="b")
        return plain_work(root, facts)

    publish.make_version(lake, plain_plan(1), work, name="a")
    assert request_links.keys_by_request(lake, "plain") == {"a": plain_plan(1).key, "b": plain_plan(2).key}
    with pytest.raises(Superseded, match="published since"):
        publish.make_version(lake, plain_plan(3), plain_work, base=None, name="a")


def test_inputs_are_linked_to_the_request(lake):
    publish.make_version(lake, plain_plan(1), plain_work, name="a")

    def work(root, facts):
        # The inputs are linked before the first task, so that gc does not remove them while the job runs.
        assert request_links.linked_key(lake, "b", "plain") == plain_plan(1).key
        return plain_work(root, facts)

    publish.make_version(lake, made_from(plain_plan(1).key), work, name="b")
    assert request_links.tables_of_request(lake, "b") == ["derived", "plain"]
    publish.make_version(lake, plain_plan(2), plain_work, name="b")
    publish.make_version(lake, made_from(plain_plan(1).key, "more"), plain_work, name="b")
    assert request_links.linked_key(lake, "b", "plain") == plain_plan(2).key


def test_a_finished_version_needs_no_lock(two, monkeypatch):
    monkeypatch.delattr(locks, "hold")
    assert publish.make_version(two, plain_plan(2), None, name="b").name == f"v-{plain_plan(2).key}"


def test_a_request_that_runs_again_is_current_again(two):
    publish.make_version(two, plain_plan(1), None, name="a")
    assert read.latest_version(two, "plain").key == plain_plan(1).key
    assert request_links.linked_key(two, "b", "plain") == plain_plan(2).key


def test_parts_of_another_request_are_not_made_again(lake):
    def plan(seed, parts):
        own = [Task(f"{i}.parquet", {"part": i, "product": f"p{i}"}) for i in parts]
        return Plan(replace(PLAIN, key=("id", "value")), {"seed": seed}, tuple(own))

    made = []

    def work(root, facts):
        made.append(facts["part"])
        return Output(plain_work(root, {**facts, "seed": 1}).rows)

    publish.make_version(lake, plan(1, [0]), work, name="a")
    publish.make_version(lake, plan(2, [1]), work, name="b")
    publish.make_version(lake, plan(3, [0, 1, 2]), work, name="c")
    assert made == [0, 1, 2]


@pytest.mark.parametrize("to", ["../../toy/v-0123456789abcdef", "v-0123456789abcdef", "/etc"])
def test_a_link_that_leads_elsewhere_is_detected(two, to):
    link = layout.request_link(two, "a", "plain")
    link.unlink()
    link.symlink_to(to)
    with pytest.raises(Damaged, match="does not lead to a version of table plain"):
        read.version(two, "plain", request="a")


def test_a_version_that_is_gone_is_named_by_its_request(two):
    shutil.rmtree(layout.version_folder(two, "plain", plain_plan(1).key))
    with pytest.raises(Damaged, match=r"names/a/plain leads to v-.*, which is missing"):
        read.version(two, "plain", request="a")
    assert read.version(two, "plain", request="b").num_rows == 60


def test_a_request_called_current_is_no_table(lake):
    publish.make_version(lake, toy_plan(), toy_work, name="current")
    assert read.table_names(lake) == ["toy"]
    assert os.listdir(layout.requests_folder(lake)) == ["current"]
