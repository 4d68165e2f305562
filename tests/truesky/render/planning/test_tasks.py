"""Selection of the tasks to render, and the cost of persistence."""

from dataclasses import replace
from pathlib import Path

import pytest

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from tests.truesky.render.planning.test_survey import VIS, planned
from truesky.render.channels import registry
from truesky.render.planning import tasks
from truesky.request.from_toml import parse

DEMO = Path(__file__).parents[4] / "requests" / "demo.toml"


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    """Plan with three detectors of two exposures."""
    pointings = [{**VIS, "detectors": ["3-4", "1-1", "6-6"], "ra": ra} for ra in (53.0, 54.0)]
    return planned(tmp_path_factory.mktemp("plan"), pointing=pointings)[1]


def places(plan, **wanted):
    return [
        (row["exposure_id"], row["detector"]) for row in tasks.select_requested(plan, replace(parse(DEMO), **wanted))
    ]


def test_all_tasks_unless_detectors_or_a_limit_are_given(plan):
    whole = places(plan)
    assert len(whole) == 6
    assert whole == [(row["exposure_id"], row["detector"]) for row in plan.to_pylist()]
    assert places(plan, detectors=("6-6",)) == [place for place in whole if place[1] == "6-6"]
    # The first tasks by exposure and detector name, in the order of the plan.
    assert sorted(places(plan, limit=2)) == sorted(whole)[:2]
    assert sorted(places(plan, limit=4)) == sorted(whole)[:4]
    assert places(plan, limit=4) == [place for place in whole if place in sorted(whole)[:4]]
    assert len(places(plan, detectors=("3-4", "6-6"), limit=3)) == 3
    assert places(plan, limit=99) == whole


@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        ({"detectors": ("3-4", "7-7")}, r"7-7 is not in the plan of request \w+, which has [^ .]+, [^ .]+(, [^ .]+)*$"),
        ({"detectors": ("3_4",)}, r"3_4 is not in .* \(did you mean 3-4\?\)$"),
        ({"limit": 0}, "limit = 0"),
    ],
)
def test_unplanned_detectors_are_refused(plan, wanted, said):
    with pytest.raises(BadInput, match=said):
        places(plan, **wanted)


def test_persistence_adds_time(tmp_path, monkeypatch):
    """NISP draws the map of the last image of the sky, and adds all those in the persistence window; VIS has none."""
    blocks = [
        {"channels": ["VIS", "NISP-P", "NISP-S"], "fields": 1, "mjd": 60400.0, "short": False, "flat": False},
        {"channels": ["NISP-P"], "image_type": "dark", "exposures": 2},
    ]
    exposures, rows = planned(tmp_path, observation=blocks)
    with monkeypatch.context() as patch:
        patch.setattr(tasks, "add_persistence_cost", lambda rows, *_: rows)
        _, alone = planned(tmp_path, observation=blocks)
    without = {(row["exposure_id"], row["detector"]): row["seconds"] for row in alone.to_pylist()}
    every, days = exposures.to_pylist(), resolve().value("nisp.persistence.window", "d")
    added, drawn = {}, 0.0
    for row in rows.to_pylist():
        (own,) = (one for one in every if one["exposure_id"] == row["exposure_id"])
        before = [
            one for one in every
            if own["camera"] == one["camera"] == "nisp" and own["mjd"] - days <= one["mjd"] < own["mjd"]
        ]  # fmt: skip
        last = max(before, key=lambda one: one["mjd"], default={"image_type": "none"})
        drawing = registry.CHANNELS[last["channel"]].cost.redraw_s if last["image_type"] == "science" else 0.0
        more = row["seconds"] - without[row["exposure_id"], row["detector"]]
        cost = registry.CHANNELS[own["channel"]].cost
        assert more == pytest.approx(drawing + len(before) * cost.release_s, abs=1e-6)
        added[own["channel"], row["exposure_id"]] = more
        drawn += drawing
    assert len({round(more, 3) for more in added.values()}) > 10
    assert max(more for (channel, _), more in added.items() if channel == "VIS") == 0.0
    assert rows["seconds"].to_pylist() == sorted(rows["seconds"].to_pylist(), reverse=True)
    # In a sequence, the map of an image is drawn once per detector.
    science = [one for one in every if one["camera"] == "nisp" and one["image_type"] == "science"]
    once = sum(registry.CHANNELS[one["channel"]].cost.redraw_s for one in science)
    assert 0.8 * once < drawn / 16 <= once
