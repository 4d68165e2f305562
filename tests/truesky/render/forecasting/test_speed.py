"""Speed of this machine: estimated from the lake if possible, else by a calibration, which is stored."""

import json

import pytest

from lake_schema.errors import Damaged
from lake_schema.store import layout, publish
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.store.provenance import machine
from lake_schema.tables.products import PRODUCTS
from lake_schema.tables.tasks import TASKS
from tests.universe import rows_of
from truesky.render import archive
from truesky.render.forecasting import speed
from truesky.running.task_metrics import WithMetrics

TASK = {
    "detector": "3-4", "channel": "VIS", "ra": 1.0, "dec": 1.0, "radius": 0.1, "cells": [], "s_region": "",
    "sources": 5, "memory": 1.0, "bytes": 10,
}  # fmt: skip


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def rendered(lake):
    """Four detectors that were to take 10, 20, 30 and 40 s."""
    rows = [{**TASK, "exposure_id": n, "seconds": 10.0 * n} for n in range(1, 5)]
    tasks = Plan(TASKS, {}, (Task("all.parquet", {}),))
    columns = {name: [row[name] for row in rows] for name in TASKS.names}
    publish.make_version(lake, tasks, lambda root, facts: Output(TASKS.build(columns)))
    parts = tuple(Task(f"{n}.parquet", {"exposure_id": n, "detector": "3-4", "part_path": f"{n}"}) for n in range(1, 5))
    plan = Plan(PRODUCTS, {"inputs": {"tasks": tasks.key}}, parts)

    def product(root, facts):
        rows = rows_of(PRODUCTS, 1)
        return Output(rows.set_column(rows.column_names.index("path"), rows.field("path"), [[facts["part_path"]]]))

    publish.make_version(lake, plan, product)
    return plan.key


def log(lake, key, factors, **about):
    lines = [{"key": key}]
    lines += [
        {"part": f"{n}.parquet", "cpu_s": 10.0 * n * factor, "machine": machine(), **about}
        for n, factor in enumerate(factors, 1)
    ]
    layout.runs_folder(lake).mkdir(exist_ok=True)
    text = "\n".join(json.dumps(line) for line in lines)
    (layout.runs_folder(lake) / f"2026-products-{len(list(layout.runs_folder(lake).iterdir()))}.jsonl").write_text(
        text + "\n{cut"
    )


def test_the_speed_is_estimated_from_the_lake(lake, rendered):
    log(lake, rendered, [2.0, 0.5, 0.4, 0.3])
    found = speed.estimate_speed(lake)
    assert found.factor == pytest.approx(0.45)
    assert "4 detectors" in found.source


def test_log_lines_of_other_machines_are_ignored(lake, rendered):
    log(lake, rendered, [9.0] * 4, machine="another")
    log(lake, "of another version", [9.0] * 4)
    log(lake, rendered, [9.0] * 4, error="it failed")
    assert "calibration" in speed.estimate_speed(lake).source


def test_damaged_logs_are_ignored(lake, rendered):
    """Nor does it keep others from it; the archive names it."""
    log(lake, rendered, [9.0] * 4)
    (path,) = layout.runs_folder(lake).iterdir()
    path.write_text(path.read_text().replace('"2.parquet"', "2"))
    log(lake, rendered, [2.0, 0.5, 0.4, 0.3])
    assert "4 detectors" in speed.estimate_speed(lake).source
    with pytest.raises(Damaged, match=f"{path.name} line 3 is not a valid log line"):
        archive.failures(lake)


def test_a_calibration_is_made_once(lake, monkeypatch):
    first = speed.estimate_speed(lake)
    assert 0.02 < first.factor < 50.0
    monkeypatch.setattr(speed, "run_calibration", None)
    assert speed.estimate_speed(lake) == first


def test_log_lines_contain_the_fields_that_are_read():
    """Log lines of tasks contain the fields that `speed` reads."""
    took = WithMetrics(lambda part: {"part": part.name, "machine": machine()})(Task("a", {}))
    assert {"cpu_s", "machine", "part"} <= took.keys()
