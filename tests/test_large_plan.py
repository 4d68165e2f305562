"""Readers of a plan that is larger than memory read one partition at a time, or only the requested rows."""

from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

from lake_schema.store import layout, publish, read, reuse
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.exposures import EXPOSURES, ExposureRow
from lake_schema.tables.products import PRODUCTS
from lake_schema.tables.tasks import TASKS
from tests.universe import rows_of
from truesky.commands import report
from truesky.page import runs, sky_maps
from truesky.page.lake_session import LakeSession
from truesky.render import coverage, plan_exposures
from truesky.render.exposure import persistence
from truesky.render.forecasting import actual_costs, speed
from truesky.render.planning import exposure_chunks, variants
from truesky.render.planning import tasks as planning
from truesky.render.planning.mission import mission_of
from truesky.request.from_toml import from_table
from truesky.running.task_metrics import peak_memory_gb, reset_peak_memory

BLOCK = {"channels": ["VIS", "NISP-P"], "fields": 1, "dither": "none", "mjd": 60400.0}
AREA = {"cone": {"ra": 60.0, "dec": -50.0, "radius": 1.0}}
REQUEST = from_table({"name": "large", "seed": 7, "area": AREA, "observation": [BLOCK]})
# Exposures of which a detector is rendered.
MADE = (1, 3)
# A part of 50,000 detectors is 30 MB in memory, and may be there several times.
MOST_GB = 0.3


def repeated(rows, start, times, many):
    """Repeat the rows of a field, one day apart; `many` is the number of exposures of the field."""
    found = []
    for i in range(start, start + times):
        own = rows.set_column(0, "exposure_id", pa.array(rows["exposure_id"].to_numpy() + i * many))
        if "mjd" in rows.column_names:
            place = rows.schema.get_field_index("mjd")
            own = own.set_column(place, "mjd", pa.array(rows["mjd"].to_numpy() + i))
        found.append(own.cast(rows.schema))
    return pa.concat_tables(found).combine_chunks()


def published(root, number, times):
    """Make a lake with a plan of given partitions, each with repeated fields, and two rendered detectors."""
    _, exposures, tasks = plan_exposures.plan(None, REQUEST)
    many, began = exposures.num_rows, exposures["mjd"].to_numpy()
    assert exposures.column_names[0] == tasks.column_names[0] == "exposure_id"
    cut = []
    for i in range(number):
        first = i * times * many + 1
        dates = [began.min() + i * times, began.max() + (i + 1) * times]
        facts = {"exposures": [first, first + times * many - 1], "mjd": dates, "block": i}
        cut.append(Task(f"{first:09d}.parquet", facts))

    def make(table, facts, some, work):
        plan = Plan(table, facts, tuple(some))
        publish.make_version(root, plan, work)
        return plan.key

    def block(rows, lake, facts):
        return Output(repeated(rows, facts["block"] * times, times, many))

    about = {"request": REQUEST.facts("area")}
    inputs = {"exposures": make(EXPOSURES, about, cut, partial(block, exposures))}
    inputs["tasks"] = make(TASKS, {"made_of": dict(inputs)}, cut, partial(block, tasks))
    rows = {row["exposure_id"]: row for row in tasks.to_pylist()}

    def image(lake, facts):
        legal = rows_of(PRODUCTS, 1).to_pylist()[0]
        planned = {name: value for name, value in rows[facts["exposure_id"]].items() if name in PRODUCTS.names}
        row = {**legal, **planned, "path": f"{facts['exposure_id']}", "content": "science"}
        return Output(PRODUCTS.build({name: [value] for name, value in row.items()}))

    facts = {"inputs": inputs, "request": REQUEST.facts("compression", "readout", "truth")}
    make(PRODUCTS, facts, [image_part(rows[number]) for number in MADE], image)
    return exposures, tasks


def image_part(task):
    name = f"{task['exposure_id']:06d}-{task['detector'].lower()}.parquet"
    return Task(name, {"exposure_id": task["exposure_id"], "detector": task["detector"], reuse.PRODUCT: "0"})


def versions(root):
    return {name: read.version(root, name) for name in ("exposures", "tasks")}


def chosen(root, **narrow):
    own = versions(root)
    request = replace(REQUEST, **(narrow or {"limit": 5}))
    found = exposure_chunks.select_for_rendering(own["exposures"], own["tasks"], request, MADE)
    missions = variants.mission_lookup(mission_of(REQUEST.mission))
    return found, exposure_chunks.with_previous_exposures(own, found.exposures, found.tasks, missions)


def drawn(root):
    own = versions(root)
    tasks, exposures = (
        partial(exposure_chunks.rows_by_partition, own["tasks"], coverage._TASK_COLUMNS),
        own["exposures"].rows(coverage._EXPOSURE_COLUMNS),
    )
    return coverage.depths(exposures, tasks, coverage.area_of(own["exposures"]), 20)


def paged(root, ask):
    lake = LakeSession(root)
    try:
        return ask(lake)
    finally:
        lake.close()


def in_view(lake):
    """Return a position outside the plan, because the plan has more rows than a page shows."""
    return sky_maps.exposure_footprints(lake, np.array([200.0, 10.0, 1.0]))


READERS = {
    "render": chosen,
    "forecast": lambda root: plan_exposures._print_published(root, read.version(root, "tasks")),
    "speed": speed.estimate_speed,
    "taken": actual_costs.summarise,
    "report": lambda root: report._forecast(root, 1.0),
    "coverage": drawn,
    "page, runs": partial(paged, ask=lambda lake: runs._remaining_work(lake.observed_requests[0], {(1, "none")})),
    "page, footprints": partial(paged, ask=sky_maps.regions),
    "page, exposures": partial(paged, ask=in_view),
    "page, bands": partial(paged, ask=sky_maps.bands),
    "page, depth": partial(paged, ask=lambda lake: sky_maps.coverage(lake, 6, None, "euclid_vis")),
}


# One detector of every exposure that has it: thousands.
ALSO = {"render, one detector": partial(chosen, detectors=("3-4",))}


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Make a lake with a plan of six partitions; return it with the rows of a field."""
    root = layout.resolve_lake(tmp_path_factory.mktemp("small") / "lake")
    return root, published(root, 6, 1)


@pytest.mark.parametrize("name", READERS)
def test_at_most_one_partition_is_read_at_once(small, name, monkeypatch):
    root, (exposures, tasks) = small
    monkeypatch.setattr(sky_maps, "LARGE_PLAN", tasks.num_rows)
    read_rows, seen = read.Version.rows, []

    def spied(version, columns=None, *rest, **more):
        found = read_rows(version, columns, *rest, **more)
        seen.append((version.table, found.num_rows, found.num_columns))
        return found

    monkeypatch.setattr(read.Version, "rows", spied)
    READERS[name](root)
    assert {table for table, *_ in seen} & {"exposures", "tasks"}
    # A few numbers of every exposure are little.
    most = {"exposures": 2 * exposures.num_rows, "tasks": 2 * tasks.num_rows}
    for table, rows, columns in seen:
        assert rows <= most.get(table, rows) or (table == "exposures" and columns <= 7)


NARROW = ({"limit": None}, {"limit": 5}, {"limit": 500}, {"detectors": ("3-4",)}, {"detectors": ("DET22",), "limit": 9})


@pytest.mark.parametrize("narrow", NARROW)
def test_selection_by_partition_equals_selection_of_the_whole(small, narrow):
    root, (_, tasks) = small
    own, request = versions(root), replace(REQUEST, **narrow)
    every, exposures = planning.sort_by_cost(own["tasks"].rows()), own["exposures"].rows()
    assert every.num_rows == 6 * tasks.num_rows
    found, (with_before, earlier) = chosen(root, **narrow)
    asked = planning.select_requested(every, request)
    assert list(map(place, found.requested)) == list(map(place, asked))
    wanted = {place(task) for task in asked}
    kept = [task for task in every.to_pylist() if place(task) in wanted or task["exposure_id"] in MADE]
    assert list(map(place, found.tasks)) == list(map(place, kept))
    assert all(task.items() <= whole.items() for task, whole in zip(found.tasks, kept, strict=True))
    numbers = {task["exposure_id"] for task in kept}
    assert found.exposures.equals(exposures.filter(pc.is_in(exposures["exposure_id"], pa.array([*numbers]))))
    counts = Counter(every["exposure_id"].to_pylist())
    assert found.detector_counts == {number: counts[number] for number in numbers}
    # Persistence of earlier exposures in their detectors.
    rows = {row.exposure_id: row for row in map(ExposureRow.from_row, exposures.to_pylist())}
    before = persistence.previous_tasks(every.to_pylist(), rows, variants.mission_lookup(mission_of(request.mission)))
    mine = {key: list(map(place, some)) for key, some in earlier.items() if key in set(map(place, kept))}
    assert mine == {key: list(map(place, some)) for key, some in before.items() if key in set(map(place, kept))}
    assert any(mine.values()) or narrow != NARROW[0]
    assert {number for some in mine.values() for number, _ in some} <= {*with_before["exposure_id"].to_pylist()}


def place(task):
    return task["exposure_id"], task["detector"]


def growth(name, small, large):
    """Return the additional memory (GB) for a large plan compared with a small one."""
    reader = {**READERS, **ALSO}[name]
    reader(small)
    reset_peak_memory()
    before = peak_memory_gb()
    reader(large)
    return peak_memory_gb() - before


@pytest.mark.nightly
def test_a_plan_of_a_million_detectors_takes_little_memory(small, tmp_path_factory):
    root = layout.resolve_lake(tmp_path_factory.mktemp("large") / "lake")
    rows = small[1][1].num_rows
    published(root, 20, 50_000 // rows)
    assert read.version(root, "tasks").num_rows > 20 * (50_000 - rows)
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as pool:
        names = [*READERS, *ALSO]
        grown = dict(zip(names, pool.map(partial(growth, small=small[0], large=root), names), strict=True))
    assert max(grown.values()) < MOST_GB, grown
