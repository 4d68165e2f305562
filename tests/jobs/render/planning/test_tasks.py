"""Which of a plan's detectors are rendered now."""

from dataclasses import replace
from pathlib import Path

import pytest

from jobs.render.planning import tasks
from jobs.request.from_toml import parse
from lake_schema.errors import BadInput
from tests.jobs.render.planning.test_survey import VIS, planned

DEMO = Path(__file__).parents[4] / "requests" / "demo.toml"


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    """Three detectors of two exposures."""
    pointings = [{**VIS, "detectors": ["3-4", "1-1", "6-6"], "ra": ra} for ra in (53.0, 54.0)]
    return planned(tmp_path_factory.mktemp("plan"), pointing=pointings)[1]


def places(plan, **wanted):
    return [(row["exposure_id"], row["detector"]) for row in tasks.part(plan, replace(parse(DEMO), **wanted))]


def test_all_of_a_plan_unless_a_part_is_asked_for(plan):
    whole = places(plan)
    assert len(whole) == 6
    assert whole == [(row["exposure_id"], row["detector"]) for row in plan.to_pylist()]
    assert places(plan, detectors=("6-6",)) == [place for place in whole if place[1] == "6-6"]
    # The first by exposure and name, wherever they stand in the plan, and in its order.
    assert sorted(places(plan, limit=2)) == sorted(whole)[:2]
    assert sorted(places(plan, limit=4)) == sorted(whole)[:4]
    assert places(plan, limit=4) == [place for place in whole if place in sorted(whole)[:4]]
    assert len(places(plan, detectors=("3-4", "6-6"), limit=3)) == 3
    assert places(plan, limit=99) == whole


@pytest.mark.parametrize(
    ("wanted", "said"), [({"detectors": ("3-4", "7-7")}, "7-7 is not in the plan"), ({"limit": 0}, "limit = 0")]
)
def test_what_is_not_in_a_plan_is_refused(plan, wanted, said):
    with pytest.raises(BadInput, match=said):
        places(plan, **wanted)
