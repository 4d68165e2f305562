"""Published versions are complete and repeatable, and wrong ones are refused."""

import json
import os
import shutil

import pytest

from lake_schema.errors import BadInput, Damaged, Superseded, TasksFailed
from lake_schema.store import garbage, hats_files, layout, locks, manifest, parquet, publish, read
from lake_schema.store.plan import Output, Plan, Task, data_path
from lake_schema.store.stage import missing_tasks, run_task
from tests.universe import CELLS, TOY, plain_plan, plain_work, toy_plan, toy_rows, toy_work


def sums(lake):
    return {f["path"]: f["sha256"] for f in read.version(lake, "toy").manifest["files"]}


def test_published_rows_can_be_read(lake):
    folder = publish.make_version(lake, toy_plan(), toy_work)
    version = read.version(lake, "toy")
    assert version.folder == folder
    assert version.num_rows == sum(n for _, n in CELLS) == version.rows().num_rows
    assert read.find_faults(version, deep=True) == []
    left = {path.name for path in layout.table_folder(lake, "toy").iterdir()} - {".lock"}
    assert left == {"current", folder.name}


def test_the_same_plan_gives_the_same_bytes_in_any_order(lake, tmp_path):
    publish.make_version(lake, toy_plan(), toy_work)
    other = tmp_path / "other"
    other.mkdir()
    publish.make_version(other, toy_plan(), toy_work, mapper=lambda f, parts: map(f, reversed(parts)))
    assert sums(lake) == sums(other)
    assert (layout.current_link(lake, "toy") / "manifest.json").read_bytes() == (
        layout.current_link(other, "toy") / "manifest.json"
    ).read_bytes()


def test_a_second_run_makes_nothing(lake):
    publish.make_version(lake, toy_plan(), toy_work)

    def never(root, facts):
        raise AssertionError("made again")

    publish.make_version(lake, toy_plan(), never)


def test_failed_tasks_are_listed_and_the_rest_is_kept(lake):
    made = []

    def work(root, facts):
        made.append(facts["cell"])
        if facts["cell"] == 1608 and len(made) <= len(CELLS):
            raise ValueError("no luck")
        return toy_work(root, facts)

    with pytest.raises(TasksFailed, match=r"1 of 4 tasks failed: .*Npix=1608.*ValueError: no luck"):
        publish.make_version(lake, toy_plan(), work)
    with pytest.raises(BadInput, match="no table toy"):
        read.version(lake, "toy")
    publish.make_version(lake, toy_plan(), work)
    assert made == [1607, 1608, 1610, 8000, 1608]
    assert read.find_faults(read.version(lake, "toy"), deep=True) == []


def test_a_worker_without_a_receipt_is_detected(lake):
    with pytest.raises(TasksFailed, match="ended without a receipt"):
        publish.make_version(lake, toy_plan(), toy_work, mapper=lambda f, parts: [])


@pytest.mark.parametrize("wrong", ["unsorted", "duplicate", "columns"])
def test_wrong_rows_are_never_published(lake, wrong):
    def work(root, facts):
        rows = toy_rows(facts["cell"], 10)
        if wrong == "unsorted":
            rows = rows.take(list(reversed(range(10))))
        if wrong == "duplicate":
            rows = rows.take([0, 0, 1])
        if wrong == "columns":
            rows = rows.drop_columns(["flux"])
        return Output(rows)

    with pytest.raises(TasksFailed, match="table toy"):
        publish.make_version(lake, toy_plan(), work)


def test_every_fact_of_a_plan_changes_its_key():
    plan = toy_plan()
    others = [
        toy_plan(seed=2),
        toy_plan(cells=CELLS[:-1]),
        Plan(TOY, {"seed": 1, "code": "x"}, plan.tasks),
        Plan(TOY, {"seed": 1}, (Task("x", {}),)),
    ]
    keys = {p.key for p in [plan, *others]}
    assert len(keys) == len(others) + 1
    assert toy_plan().key == plan.key


def test_a_plan_names_a_part_once():
    with pytest.raises(BadInput, match="twice"):
        Plan(TOY, {}, (Task("a", {}), Task("a", {})))


def test_a_catalogue_has_cells_though_they_may_be_empty(lake):
    with pytest.raises(BadInput, match="no cells"):
        Plan(TOY, {}, ())
    publish.make_version(lake, toy_plan(cells=((8000, 0), (1607, 0))), toy_work)
    version = read.version(lake, "toy")
    assert version.rows().num_rows == version.cone(10.0, 10.0, 5.0).num_rows == 0
    assert read.find_faults(version, deep=True) == []


def test_versions_follow_each_other_and_gc_keeps_the_last(lake):
    first = publish.make_version(lake, toy_plan(1), toy_work)
    second = publish.make_version(lake, toy_plan(2), toy_work)
    assert read.version(lake, "toy").folder == second
    assert first.exists()
    assert garbage.collect(lake, "toy", delete=True) == [first]
    assert not first.exists()
    assert read.find_faults(read.version(lake, "toy"), deep=True) == []


def test_going_back_to_an_earlier_version_only_moves_the_link(lake):
    first = publish.make_version(lake, toy_plan(1), toy_work)
    publish.make_version(lake, toy_plan(2), toy_work)
    publish.make_version(lake, toy_plan(1), None)
    assert read.version(lake, "toy").folder == first


def test_a_version_that_was_overtaken_is_not_published(lake):
    publish.make_version(lake, toy_plan(1), toy_work)
    base = layout.current_key(lake, "toy")
    publish.make_version(lake, toy_plan(2), toy_work)
    with pytest.raises(Superseded, match="published since"):
        publish.make_version(lake, toy_plan(3), toy_work, base=base)
    assert read.version(lake, "toy").key == toy_plan(2).key


def test_a_second_run_of_a_running_plan_is_refused(lake, monkeypatch):
    monkeypatch.setattr(locks, "SHORT_TIMEOUT", 0.1)

    def work(root, facts):
        with pytest.raises(Superseded, match="another run is making"):
            publish.make_version(lake, toy_plan(), toy_work)
        return toy_work(root, facts)

    publish.make_version(lake, toy_plan(), work)


def test_files_beside_the_rows_are_published_with_them(lake):
    table = toy_plan().table

    def work(root, facts):
        return Output(toy_rows(facts["cell"], 3), {"images/a.txt": lambda path: path.write_text("pixels")})

    publish.make_version(lake, Plan(table, {}, toy_plan().tasks[:1]), work)
    assert read.version(lake, "toy").sidecar_path("images/a.txt").read_text() == "pixels"
    with pytest.raises(BadInput, match="no file"):
        read.version(lake, "toy").sidecar_path("images/b.txt")


def test_a_file_that_would_leave_the_stage_is_refused(lake):
    def work(root, facts):
        return Output(toy_rows(facts["cell"], 3), {"../../../x": lambda path: path.write_text("out")})

    with pytest.raises(TasksFailed, match="is outside"):
        publish.make_version(lake, toy_plan(), work)
    assert not (lake.parent / "x").exists()


def test_a_receipt_without_its_file_does_not_count(lake):
    plan = toy_plan()
    stage = layout.stage_folder(lake, "toy", plan.key)
    stage.mkdir(parents=True)
    for part in plan.tasks:
        run_task(lake, plan.key, TOY, plan.facts, toy_work, part)
    assert missing_tasks(stage, plan) == []
    victim = stage / data_path(TOY, plan.tasks[0].name)
    os.truncate(victim, victim.stat().st_size - 1)
    assert missing_tasks(stage, plan) == [plan.tasks[0]]
    victim.unlink()
    assert missing_tasks(stage, plan) == [plan.tasks[0]]


def test_copies_of_a_task_that_are_late_change_nothing(lake, monkeypatch):
    plan = toy_plan()
    stage, part = layout.stage_folder(lake, "toy", plan.key), plan.tasks[0]
    path, first = stage / data_path(TOY, part.name), []

    def slow(root, facts):
        # Another copy of the task ends while this one renders.
        run_task(root, plan.key, TOY, plan.facts, toy_work, part)
        first.append(path.stat().st_ino)
        return toy_work(root, facts)

    def mapper(function, parts):
        yield run_task(lake, plan.key, TOY, plan.facts, slow, part)
        yield from map(function, parts)

    write, writing = hats_files.write_metadata, manifest.temporary_path(path)

    def while_another_writes(*given):
        write(*given)
        writing.write_bytes(b"half")

    monkeypatch.setattr(hats_files, "write_metadata", while_another_writes)
    folder = publish.make_version(lake, plan, toy_work, mapper)
    assert (folder / data_path(TOY, part.name)).stat().st_ino == first[0]
    assert (folder / writing.relative_to(stage)).exists()
    assert read.find_faults(read.version(lake, "toy"), deep=True) == []
    assert "was published before" in run_task(lake, plan.key, TOY, plan.facts, toy_work, part)["error"]
    assert not stage.exists()
    assert publish.make_version(lake, plan, toy_work) == folder


def test_a_finished_version_needs_no_lock(lake, monkeypatch):
    """A lake that is not writable is no reason to fail if there is nothing to do."""
    folder = publish.make_version(lake, toy_plan(), toy_work)
    monkeypatch.delattr(locks, "hold")
    assert publish.make_version(lake, toy_plan(), None) == folder


def test_a_current_version_that_is_gone_can_be_made_again(lake):
    folder = publish.make_version(lake, toy_plan(), toy_work)
    shutil.rmtree(folder)
    with pytest.raises(Damaged, match="which is missing"):
        read.version(lake, "toy")
    assert read.table_names(lake) == ["toy"]
    assert publish.make_version(lake, toy_plan(), toy_work) == folder
    assert read.find_faults(read.version(lake, "toy"), deep=True) == []


def test_two_exchanged_versions_are_detected(lake):
    first, second = (publish.make_version(lake, toy_plan(seed), toy_work) for seed in (1, 2))
    other = first.with_name("other")
    first.rename(other)
    second.rename(first)
    other.rename(second)
    for key in (None, toy_plan(1).key, toy_plan(2).key):
        with pytest.raises(Damaged, match="belongs to table toy, version"):
            read.version(lake, "toy", key)
    for seed in (1, 2):
        with pytest.raises(Damaged, match="belongs to table toy, version"):
            publish.make_version(lake, toy_plan(seed), toy_work)


def test_a_link_to_another_table_is_detected(lake):
    folder = publish.make_version(lake, toy_plan(), toy_work)
    publish.make_version(lake, plain_plan(), plain_work)
    link = layout.current_link(lake, "plain")
    link.unlink()
    link.symlink_to(f"../toy/{folder.name}")
    with pytest.raises(Damaged, match="does not lead to a version of table plain"):
        read.version(lake, "plain")
    shutil.copytree(folder, link.with_name(folder.name))
    with pytest.raises(Damaged, match="belongs to table toy"):
        read.version(lake, "plain", toy_plan().key)


CHANGES = {
    "a fact is missing": lambda facts: facts.pop("parts"),
    "a fact is another thing": lambda facts: facts.update(rows="550"),
    "a part has no name": lambda facts: facts["parts"].append({}),
    "a file has no sha256": lambda facts: facts["files"][0].pop("sha256"),
    "a file is a text": lambda facts: facts["files"].append("x"),
    "a file above the version": lambda facts: facts["files"][0].update(path="../x"),
    "a file elsewhere": lambda facts: facts["files"][0].update(path="/etc/hosts"),
    "blocks of another form": lambda facts: facts["files"][0].update(blocks=["x"]),
    "blocks that are no base64": lambda facts: facts["files"][0].update(blocks="x"),
    "blocks of a file of another size": lambda facts: facts["files"][0].update(blocks="AAAAAAAAAAA="),
    "a deflection in words": lambda facts: facts.update(deflection_deg="far"),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_a_manifest_of_another_form_is_damage(lake, change):
    folder = publish.make_version(lake, toy_plan(), toy_work)
    facts = dict(read.version(lake, "toy").manifest)
    manifest.write(folder, facts)
    read.version(lake, "toy")
    change(facts)
    manifest.write(folder, facts)
    with pytest.raises(Damaged, match="not a valid manifest"):
        read.version(lake, "toy")


def test_a_changed_page_is_not_read_while_a_version_is_made(lake):
    version = read.version(lake, "toy", publish.make_version(lake, toy_plan(), toy_work).name[2:])
    path = version.partition_path(version.partitions[0])
    entry = manifest.file_entry(path, path.relative_to(lake).as_posix())
    assert parquet.read(lake, entry, ["id"])["id"].equals(version.rows(["id"], [version.partitions[0]])["id"])
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(data)
    with pytest.raises(Damaged, match=r"Npix=1607"):
        parquet.read(lake, entry)


def test_a_broken_manifest_is_named(lake):
    publish.make_version(lake, toy_plan(), toy_work)
    manifest = layout.current_link(lake, "toy") / "manifest.json"
    facts = json.loads(manifest.read_text())
    manifest.write_text(manifest.read_text()[:-20])
    with pytest.raises(Damaged, match=r"manifest\.json"):
        read.version(lake, "toy")
    facts["rows"] += 1
    manifest.write_text(json.dumps(facts))
    with pytest.raises(Damaged, match="digest"):
        read.version(lake, "toy")
