"""Wrong arguments are refused by name, and NumPy numbers are accepted."""

import numpy as np
import pytest

from lake_schema import arguments
from lake_schema.errors import BadInput


def test_good_arguments_are_returned_as_pythons():
    assert arguments.check_number("radius", np.float32(0.5), 0.0, 1.0) == 0.5
    assert type(arguments.check_number("radius", 1, 0.0, 1.0)) is float
    assert type(arguments.check_integer("bins", np.int64(3), 1, 3)) is int
    assert arguments.check_names("columns", "ra") == ("ra",)
    assert arguments.check_names("columns", np.array(["ra", "dec"])) == ("ra", "dec")


@pytest.mark.parametrize("value", [float("nan"), -0.1, 1.1, float("inf"), "0.5", None, [0.5], np.arange(2.0), 10**400])
def test_another_number_is_refused(value):
    with pytest.raises(BadInput, match=r"^radius = .*(outside \[0\.0, 1\.0\]|not a number)$"):
        arguments.check_number("radius", value, 0.0, 1.0)


@pytest.mark.parametrize("value", [2.0, np.float64(2.0), "2", None, 0, 4, np.arange(2)])
def test_another_whole_number_is_refused(value):
    with pytest.raises(BadInput, match=r"^bins = .*(outside \[1, 3\]|not a whole number)$"):
        arguments.check_integer("bins", value, 1, 3)


@pytest.mark.parametrize("value", [3, None, [3], ["ra", None]])
def test_other_names_are_refused(value):
    with pytest.raises(BadInput, match=r"^columns = .* is not a name or a list of names$"):
        arguments.check_names("columns", value)
