"""Error messages are one printable line, even if they name something long or strange."""

import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import errors

KINDS = [errors.BadInput, errors.Damaged, errors.Superseded, errors.VersionMismatch, errors.TasksFailed]


@given(st.text() | st.text(st.characters(), min_size=1).map(lambda text: text * 2000), st.sampled_from(KINDS))
def test_a_refusal_is_one_printable_line(text, kind):
    said = str(kind(text))
    assert said.isprintable()
    assert len(said) <= 1000


def test_a_long_refusal_keeps_where_and_what():
    said = str(errors.Damaged(f"lake/manifest.json is that of version {'9' * 5000}, wanted another"))
    assert said.startswith("lake/manifest.json is that")
    assert said.endswith("9, wanted another")


@pytest.mark.parametrize("text", ["x", "row 3  of [1, 2]", "\u00e9 \u03bb", ""])
def test_a_short_refusal_says_what_it_was_given(text):
    assert str(errors.BadInput(text)) == text


def test_unprintable_characters_are_escaped():
    assert str(errors.BadInput("a\n  b\x1b[0m \ud800")) == r"a b\x1b[0m \ud800"


@pytest.mark.parametrize(
    "refusal", [errors.BadInput("no band u"), errors.OutOfRange("radius", 200.0, 0.0, 180.0), errors.Damaged("f")]
)
def test_a_refusal_comes_back_from_another_process(refusal):
    back = pickle.loads(pickle.dumps(refusal))
    assert (type(back), str(back)) == (type(refusal), str(refusal))
