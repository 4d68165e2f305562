"""The key `universe.transients` of a request."""

from pathlib import Path

import pytest

from lake_schema.errors import BadInput
from truesky.request import transients
from truesky.request.transients import Transients

WINDOW = {"start": 61000.0, "end": 62000.0}


def parsed(**changes):
    return transients.parse({**WINDOW, **changes}, Path("/requests"))


def test_defaults():
    assert transients.parse(None, Path()) is None
    assert parsed() == Transients(61000.0, 62000.0, ("ia", "core_collapse"), 1.0, None)


def test_dates_may_be_texts_and_files_are_relative_to_the_request():
    found = parsed(start="2027-01-01", kinds=["ia"], boost=10, light_curves="mine.parquet")
    assert found == Transients(61406.0, 62000.0, ("ia",), 10.0, Path("/requests/mine.parquet"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"end": 61000.0}, "from 61000 to 61000 is empty: end must be after start"),
        ({"end": 60000.0}, "from 61000 to 60000 ends before it starts: end must be after start"),
        ({"end": 97900.0}, "window of time is .* years, at most 100"),
        ({"kinds": ["kilonova"]}, "universe.transients.kinds.*kilonova"),
        ({"kinds": []}, "kinds is empty: it needs one of ia, core_collapse"),
        ({"boost": -1.0}, "universe.transients.boost = -1"),
        ({"boost": float("nan")}, "universe.transients.boost"),
        ({"rate": 1.0}, "rate"),
        ({"start": "tomorrow"}, "universe.transients.start"),
    ],
)
def test_mistakes_have_one_line(changes, message):
    with pytest.raises(BadInput, match=message) as error:
        parsed(**changes)
    assert "\n" not in str(error.value)


def test_a_missing_date_is_named():
    with pytest.raises(BadInput, match=r"universe.transients.end"):
        transients.parse({"start": 61000.0}, Path())
