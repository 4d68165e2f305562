"""Test the selection of drawing settings for a requested accuracy."""

import tomllib
from dataclasses import asdict, fields, replace
from pathlib import Path

import pytest

from lake_schema.errors import BadInput
from truesky.request import accuracy
from truesky.request.accuracy import DRAFT, PRESETS, QUICKLOOK, SURVEY, Accuracy
from truesky.request.from_toml import from_table

NUMBERS = [field.name for field in fields(Accuracy)]
ANYTHING = Accuracy(1.0, 1.0, 1.0, 1.0)
GOOD = tomllib.loads((Path(__file__).parents[3] / "requests" / "demo.toml").read_text())


def error(row, name):
    return max(row[name], row[f"{name}_held"])


@pytest.mark.parametrize("name", NUMBERS)
def test_a_stricter_number_selects_a_slower_row(name):
    """A smaller error of one kind selects another, slower row, whatever the other errors are."""
    asked = sorted((error(row, name) for row in accuracy.rows()), reverse=True)
    seconds = [accuracy.fastest_row(replace(ANYTHING, **{name: value}))["seconds"] for value in asked]
    assert seconds == sorted(seconds)
    assert len(set(seconds)) >= 4, seconds


@pytest.mark.parametrize("name", NUMBERS)
def test_a_row_is_selected_at_its_errors_and_not_below(name):
    """The errors of a row select this row or a cheaper one; slightly smaller errors select another row."""
    for row in accuracy.rows():
        own = accuracy.fastest_row(replace(ANYTHING, **{name: error(row, name)}))
        assert own["seconds"] <= row["seconds"]
        assert error(own, name) <= error(row, name)


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_met_on_both_samples(preset):
    """Presets hold for sources for which the settings were chosen, and for other sources."""
    row, wanted = accuracy.fastest_row(PRESETS[preset]), asdict(PRESETS[preset])
    for name, value in wanted.items():
        assert row[name] <= value
        assert row[f"{name}_held"] <= value
    told = asdict(accuracy.expected_errors(PRESETS[preset]))
    assert told == {name: row[f"{name}_held"] for name in wanted}


def test_no_cheaper_row_is_accurate_enough():
    for wanted in PRESETS.values():
        mine = accuracy.fastest_row(wanted)
        for row in accuracy.rows():
            within = all(error(row, name) <= value for name, value in asdict(wanted).items())
            assert not within or row["seconds"] >= mine["seconds"]


def test_a_quicklook_takes_half_of_a_draft_at_most():
    quick, draft = (accuracy.fastest_row(wanted)["seconds"] for wanted in (QUICKLOOK, DRAFT))
    assert 0.0 < quick <= 0.5 * draft
    assert accuracy.fastest_row(ANYTHING)["seconds"] <= quick


@pytest.mark.parametrize("name", NUMBERS)
def test_an_unreachable_accuracy_is_refused_with_the_best_value(name):
    with pytest.raises(BadInput, match=rf"^accuracy\.{name} = 1e-12 cannot be reached, the best is \S+$") as refusal:
        accuracy.fastest_row(replace(SURVEY, **{name: 1e-12}))
    best = float(str(refusal.value).rpartition(" ")[2])
    row = accuracy.fastest_row(replace(ANYTHING, **{name: best}))
    assert error(row, name) <= best <= 1.2 * error(accuracy.rows()[-1], name)


def test_every_unreachable_number_is_named():
    with pytest.raises(BadInput) as refusal:
        accuracy.fastest_row(Accuracy(1e-12, 1e-12, 1e-12, 1e-12))
    assert all(f"accuracy.{name} = 1e-12" in str(refusal.value) for name in NUMBERS)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("where", ["accuracy", "explore"])
def test_a_request_is_refused_before_any_computation(where):
    own = asdict(SURVEY) | {"shape": 1e-9}
    wanted = {**GOOD, "accuracy": own} if where == "accuracy" else {**GOOD, "explore": {"accuracy": [own]}}
    with pytest.raises(BadInput, match=r"accuracy\.shape = 1e-09 cannot be reached, the best is"):
        from_table(wanted)


def test_the_best_value_is_rounded_up():
    for value in (1.01e-5, 9.96e-5, 2.0e-3, 0.0949, 1.0):
        assert value <= float(accuracy._round_up(value)) <= 1.11 * value
