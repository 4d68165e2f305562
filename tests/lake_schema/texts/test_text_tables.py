"""Tables fit the terminal and lose no column; JSON has no value that other programs refuse."""

import json

import pytest

from lake_schema.texts import text_tables

HEADINGS = ("name", "meaning", "rows", "MB")
ROWS = [
    ("a", "short", "1", "2.0"),
    ("galaxies", "observed positions of all galaxies of the light cone", "123,456", "0.1"),
]


@pytest.fixture
def width(monkeypatch):
    return lambda columns: monkeypatch.setenv("COLUMNS", str(columns))


def lines():
    return text_tables.format_table(HEADINGS, ROWS, ("rows", "MB"))


def test_a_pipe_gets_complete_texts(width):
    width(0)
    head, first, second = lines()
    assert second.endswith("light cone  123,456  0.1")
    assert len(first) == len(second) == len(head)


@pytest.mark.parametrize("columns", [46, 60, 70])
def test_long_texts_end_in_an_ellipsis(width, columns):
    width(columns)
    head, _, second = lines()
    assert len(head) == columns
    assert second.startswith("galaxies  observed")
    assert "…  123,456" in second


def test_columns_without_room_follow_below(width):
    width(30)
    table = lines()
    assert all(len(line) <= 30 for line in table)
    blocks = "\n".join(table).split("\n\n")
    assert len(blocks) == 2
    assert all(block.splitlines()[2].startswith("galaxies") for block in blocks)
    assert {"meaning", "rows", "MB"} <= {word for block in blocks for word in block.splitlines()[0].split()}


def test_a_table_without_rows_has_its_headings(width):
    width(80)
    assert text_tables.format_table(HEADINGS, []) == ["name  meaning  rows  MB"]


def test_json_has_null_for_values_that_are_not_finite(capsys):
    text_tables.print_json([{"a": float("nan"), "b": [1.0, float("inf")]}, {"a": 2**60, "b": "x"}])
    text = capsys.readouterr().out
    assert json.loads(text, parse_constant=pytest.fail) == [{"a": None, "b": [1.0, None]}, {"a": 2**60, "b": "x"}]
    text_tables.print_json([])
    assert json.loads(capsys.readouterr().out) == []
