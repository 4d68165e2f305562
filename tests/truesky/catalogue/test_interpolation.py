"""Places between the nodes of a table."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from truesky.catalogue.interpolation import bracket

NODES = np.array([0.0, 1.0, 3.0, 3.5, 8.0])


@given(st.lists(st.floats(-5.0, 15.0), min_size=1, max_size=20))
def test_linear_interpolation_between_its_nodes_is_numpys(values):
    table, values = NODES**2 - 3.0 * NODES, np.array(values)
    index, weight = bracket(NODES, values)
    found = table[index] * (1.0 - weight) + table[index + 1] * weight
    assert found == pytest.approx(np.interp(values, NODES, table), rel=1e-12, abs=1e-12)


@given(st.lists(st.floats(-5.0, 15.0), min_size=1, max_size=20))
def test_extrapolation_is_linear(values):
    values = np.array(values)
    index, weight = bracket(NODES, values, extrapolated=True)
    assert NODES[index] * (1.0 - weight) + NODES[index + 1] * weight == pytest.approx(values, rel=1e-12, abs=1e-12)
