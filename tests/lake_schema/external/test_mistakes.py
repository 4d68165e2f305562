"""Wrong values of a table are reported in one line per column and kind of mistake."""

from pathlib import Path

import numpy as np
import pytest

from lake_schema.errors import BadInput
from lake_schema.external.mistakes import TableMistakes, find_out_of_bounds


def test_rows_of_one_kind_are_counted():
    mistakes = TableMistakes()
    for number, first_row in (("a", 1), ("b", 11)):
        values = np.array([0.5, 3.0, 4.0])
        mistakes.add_rows(Path(number), first_row, "Z", values > 1.0, values, "must be from 0 to 1")
    mistakes.add_rows(Path("b"), 11, "Z", np.zeros(3, bool), np.zeros(3), "must be a number")
    mistakes.add(BadInput("c: no such file"))
    mistakes.add_row(Path("d"), "ra", "range", "d line 4: ra = 400 is outside -360 to 360")
    with pytest.raises(BadInput) as caught:
        mistakes.refuse()
    assert caught.value.messages == (
        "a: column Z of row 2 is 3, but must be from 0 to 1 (3 more rows in 2 files)",
        "c: no such file",
        "d line 4: ra = 400 is outside -360 to 360",
    )


def test_all_columns_are_compared_with_their_bounds():
    columns = {"x": np.array([1.0, np.nan, 7.0]), "y": np.array([0.0, 1.0, 2.0]), "z": np.array([5.0, 0.0, 0.0])}
    mistakes = find_out_of_bounds(Path("t.csv"), columns, dict.fromkeys("xyz", (0.0, 2.0)))
    with pytest.raises(BadInput) as caught:
        mistakes.refuse()
    assert caught.value.messages == (
        "t.csv: column x of row 2 is NaN, but must be a number from 0 to 2 (1 more row)",
        "t.csv: column z of row 1 is 5, but must be a number from 0 to 2",
    )
    find_out_of_bounds(Path("t.csv"), {"y": columns["y"]}, {"y": (0.0, 2.0)}).refuse()
