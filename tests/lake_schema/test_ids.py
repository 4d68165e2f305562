"""Identifiers are unique and reversible, and overflows are refused."""

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
    assert ids.kind_from_id(one) == kind
    assert (
        ids.halo_from_id(one)
        == ids.halo_from_id(ids.source_id(0, cell, number, 0))
        == ids.source_id(0, cell, number, 0)
    )


DRAWN = st.tuples(
    st.integers(0, 12 * 4**8 - 1), st.integers(0, ids.BLOCK_COUNT - 1), st.integers(0, 7), st.floats(8.0, 16.0),
    st.integers(0, 127),
)  # fmt: skip


@given(DRAWN, DRAWN)
def test_members_of_drawn_halos_have_their_own_ids(a, b):
    made = []
    for cell, block, number, mass, member in (a, b):
        bits = ids.member_bits(mass)
        halo = ids.drawn_halo_id(cell, np.array([block]), np.array([number]), bits)
        one = ids.satellite_id(halo, np.array([member]), bits)
        assert 0 <= halo[0] < 1 << 60 <= one[0]
        assert ids.kind_from_id(one) == 1
        assert one[0] >> ids.BLOCK_BITS == 1 << 20 | cell
        # Identifiers of drawn halos stay below the running numbers of other kinds.
        assert halo[0] & (1 << ids.BLOCK_BITS) - 1 < ids.FIRST_NUMBER << ids.MEMBER_BITS
        made.append((int(one[0]), int(bits)))
    if made[0][1] == made[1][1]:
        same = all(a[i] == b[i] for i in (0, 1, 2, 4))
        assert (made[0][0] == made[1][0]) == same


@pytest.mark.parametrize(
    ("mass", "most", "members"), [(8.5, 65535, 127), (11.5, 8191, 1023), (13.5, 63, 131071), (15.0, 7, 1048575)]
)
def test_an_overflow_of_a_block_is_refused(mass, most, members):
    bits, block = ids.member_bits(np.array([mass])), np.array([3])
    halo = ids.drawn_halo_id(0, block, np.array([most]), bits)
    assert ids.satellite_id(halo, np.array([members]), bits) > 0
    with pytest.raises(BadInput, match=f"number in its block {most + 1} is not in 0 .. {most}"):
        ids.drawn_halo_id(0, block, np.array([most + 1]), bits)
    with pytest.raises(BadInput, match=f"member {members + 1} is not in 0 .. {members}"):
        ids.satellite_id(halo, np.array([members + 1]), bits)


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
