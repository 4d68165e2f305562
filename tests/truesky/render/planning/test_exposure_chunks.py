"""Plans in chunks: each chunk is made separately, and together they equal the whole plan."""

import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pytest

from lake_schema.errors import TasksFailed
from lake_schema.store import layout, publish, read
from tests.truesky import nightly
from tests.truesky.render.planning.test_survey import VIS
from truesky.render import plan_exposures
from truesky.render.planning import exposure_chunks, survey, tasks
from truesky.render.planning.mission import mission_of
from truesky.request.from_toml import from_table

# Two blocks with the same fields and dates, some of whose exposures differ only in their noise; a pointing with five
# realisations; frames without sky; a ground camera.
BLOCK = {"channels": ["VIS", "NISP-P"], "fields": 3, "mjd": 60400.0}
WANTED = {
    "name": "parts",
    "seed": 7,
    "area": {"cone": {"ra": 60.0, "dec": -50.0, "radius": 1.0}},
    "pointing": [{**VIS, "detectors": ["3-4", "1-1"], "realisations": 5}],
    "observation": [
        BLOCK,
        {"channels": ["VIS"], "image_type": "bias", "exposures": 4},
        {"channels": ["EXT"], "survey": "des", "exposures": 3},
        {**BLOCK, "realisations": 2},
    ],
}


@pytest.fixture(scope="module")
def request_():
    return from_table(WANTED)


@pytest.fixture(scope="module")
def whole(request_):
    """Rows of `exposures` and `tasks` of the plan as a single chunk."""
    return plan_exposures.plan(None, request_)[1:]


def planner(request_, most):
    mission = mission_of(request_.mission)
    found = plan_exposures.Planner.from_request(None, request_)
    return replace(found, layout=exposure_chunks.Layout.from_request(request_, mission, most))


@nightly.parametrize(
    "most",
    [pytest.param(1, marks=pytest.mark.nightly), 100, pytest.param(700, marks=pytest.mark.nightly), 9000],
    (1,),
)
def test_chunks_of_any_size_together_equal_the_plan(request_, whole, most):
    own = planner(request_, most)
    assert (len(own.layout.chunks) > 1) == (most < 9000)
    tables = list(own.tables())
    # Exposures in other chunks are counted, too.
    assert pa.concat_tables([exposures for exposures, _ in tables]).equals(whole[0])
    assert max(whole[0]["realisation"].to_pylist()) == 5
    # A chunk exceeds the limit only if a single field does.
    largest = max(rows.num_rows for _, rows in tables)
    assert largest <= max(most, 4 * (36 + 3 * 16 + 2 * 36) * 2)
    together = tasks.sort_by_cost(pa.concat_tables([rows for _, rows in tables]))
    assert together.equals(whole[1])


def test_realisation_numbers_continue_from_earlier_chunks(request_, whole):
    rows = whole[0].to_pylist()
    alike = [row for row in rows if row["survey"] == "wide" and row["image_type"] == "science"]
    first = {(row["camera"], row["band"], row["mjd"], row["exposure_time_s"]): [] for row in alike}
    for row in alike:
        first[row["camera"], row["band"], row["mjd"], row["exposure_time_s"]].append(row["realisation"])
    assert set(map(tuple, first.values())) == {(1, 2, 3)}


def test_planner_can_be_pickled(request_):
    own = planner(request_, 200)
    other = pickle.loads(pickle.dumps(own))
    piece = own.layout.chunks[3]
    exposures = other.rows_of_exposures(other.layout.chunks[3])
    assert exposures.equals(own.rows_of_exposures(piece))
    assert other.rows_of_tasks(piece, exposures).equals(own.rows_of_tasks(piece, exposures))


def test_facts_of_partitions_contain_exposures_and_dates(request_, whole):
    own = planner(request_, 200)
    dates = dict(zip(whole[0]["exposure_id"].to_pylist(), whole[0]["mjd"].to_pylist(), strict=True))
    named = own.layout.parts()
    assert [part.facts["exposures"][0] for part in named] == [piece.first for piece in own.layout.chunks]
    for before, now in pairwise(named):
        assert before.facts["exposures"][1] + 1 == now.facts["exposures"][0]
    for part in named:
        first, last = part.facts["exposures"]
        since, until = part.facts["mjd"]
        assert all(since <= dates[number] <= until for number in range(first, last + 1))
    assert own.layout.parts()[-1].facts["exposures"][1] == len(dates)


def published(root, request_, monkeypatch, mapper, most=200):
    monkeypatch.setattr(exposure_chunks, "MAX_TASKS_PER_CHUNK", most)
    monkeypatch.setattr(exposure_chunks.Layout.from_request.__func__, "__defaults__", (most,))
    for step in plan_exposures.steps(root, request_):
        publish.make_version(root, step.plan, step.run_task, mapper, name=request_.name)
    return {name: read.version(root, name) for name in ("exposures", "tasks")}


def test_bytes_depend_neither_on_order_nor_on_interruptions(request_, whole, tmp_path, monkeypatch):
    one = published(layout.resolve_lake(tmp_path / "one"), request_, monkeypatch, map)
    assert len(one["tasks"].partitions) > 5

    def dying(function, some):
        return (function(part) for part in some[::-1][: len(some) // 2])

    other = layout.resolve_lake(tmp_path / "other")
    for _ in range(2):
        with pytest.raises(TasksFailed):
            published(other, request_, monkeypatch, dying)
    two = published(other, request_, monkeypatch, lambda function, some: map(function, some[::-1]))
    for name, version in one.items():
        assert version.key == two[name].key
        assert version.fingerprint == two[name].fingerprint
        assert read.find_faults(two[name], deep=True) == []
    assert tasks.sort_by_cost(one["tasks"].rows()).equals(whole[1])
    # A reader opens only the partitions that it needs.
    numbers = [1, 2, whole[0].num_rows]
    holders = exposure_chunks.partition_names(one["tasks"], numbers)
    assert holders == [one["tasks"].partitions[0], one["tasks"].partitions[-1]]
    assert exposure_chunks.rows(one["exposures"], numbers)["exposure_id"].to_pylist()[0] == 1
    began = whole[0]["mjd"].to_numpy()
    near = (float(began[20]) - 0.01, float(began[20]))
    found = exposure_chunks.rows(one["exposures"], dates=near)["exposure_id"].to_numpy()
    assert {*(np.flatnonzero((began >= near[0]) & (began <= near[1])) + 1)} <= {*found}


def test_checks_lay_out_only_representative_fields(request_, monkeypatch):
    """For 100,000 exposures, only one field per grism is laid out to check them."""
    made, lay = [], survey.visit_exposures
    monkeypatch.setattr(survey, "visit_exposures", lambda field, **rest: made.append(field) or lay(field, **rest))
    wide = replace(request_, pointings=(), observations=(replace(request_.observations[0], fields=40),))
    assert len(exposure_chunks.Layout.from_request(wide, mission_of(wide.mission)).chunks[0]) > 600
    assert len(made) <= 4
