"""Identifiers: unique, reversible, refused where they would overflow."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import ids
from lake_schema.errors import BadInput

PARTS = st.tuples(
    st.integers(0, 7), st.integers(0, 12 * 4**8 - 1), st.integers(0, 2**22 - 1), st.integers(0, 2**18 - 1)
)


@given(PARTS, PARTS)
def test_two_sources_share_an_id_only_if_they_are_the_same(a, b):
    assert (int(ids.source_id(*a)) == int(ids.source_id(*b))) == (a == b)


@given(PARTS)
def test_an_id_is_positive_and_carries_kind_and_halo(parts):
    kind, cell, number, _ = parts
    one = ids.source_id(*parts)
    assert one >= 0
    assert ids.kind_of(one) == kind
    assert ids.halo_of(one) == ids.halo_of(ids.source_id(0, cell, number, 0)) == ids.source_id(0, cell, number, 0)


@pytest.mark.parametrize(
    ("args", "word"),
    [
        ((8, 0, 0), "kind"),
        ((0, 0, 2**22), "number"),
        ((0, 0, 0, 2**18), "member"),
        ((0, 0, -1), "number"),
        ((0, 12 * 4**8, 0), "cell"),
        ((0, -1, 0), "cell"),
    ],
)
def test_overflow_is_refused(args, word):
    with pytest.raises(BadInput, match=word):
        ids.source_id(*args)


def test_arrays():
    made = ids.source_id(np.array([0, 1]), 5, np.array([3, 3]), np.array([0, 1]))
    assert made.dtype == np.int64
    assert len(np.unique(made)) == 2
