"""Error messages are one printable line, even if they name something long or strange."""

import math
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


def test_a_number_without_limits_must_be_finite():
    refusal = errors.OutOfRange("gain", float("nan"), -math.inf, math.inf, "electron")
    assert str(refusal) == "gain = nan is not a finite number"
    assert str(errors.OutOfRange("gain", 3.0, 0.0, 1.0)) == "gain = 3.0 is outside [0.0, 1.0]"


def read_with_mistakes():
    with errors.Mistakes() as mistakes:
        assert mistakes.read(int, "3") == 3
        for problem in ("a is wrong", "b is wrong", "a is wrong"):
            mistakes.add(errors.BadInput(problem))
        assert mistakes.read(refuse, "c is wrong") is None
        assert len(mistakes) == 3


def test_mistakes_are_raised_together_at_the_end_of_the_block():
    with pytest.raises(errors.BadInputs) as caught:
        read_with_mistakes()
    assert caught.value.messages == ("a is wrong", "b is wrong", "c is wrong")
    assert str(caught.value) == "a is wrong; b is wrong; c is wrong"
    assert caught.value.with_prefix("x").messages[1] == "x: b is wrong"
    back = pickle.loads(pickle.dumps(caught.value))
    assert (type(back), back.messages) == (errors.BadInputs, caught.value.messages)


def refuse(problem):
    raise errors.BadInput(problem)


def refuse_after_a_mistake():
    with errors.Mistakes() as mistakes:
        mistakes.add(errors.BadInput("a is wrong"))
        raise errors.BadInput("b is wrong")


def test_a_refusal_inside_the_block_is_raised_with_the_mistakes_before_it():
    with pytest.raises(errors.BadInputs) as caught:
        refuse_after_a_mistake()
    assert caught.value.messages == ("a is wrong", "b is wrong")


def fail_after_a_mistake():
    with errors.Mistakes() as mistakes:
        mistakes.add(errors.BadInput("a is wrong"))
        mistakes.read(lambda: 1 / 0)


def test_a_single_mistake_keeps_its_kind_and_other_errors_pass():
    with pytest.raises(errors.OutOfRange), errors.Mistakes() as mistakes:
        mistakes.add(errors.OutOfRange("a", 3, 0, 1))
    with pytest.raises(ZeroDivisionError):
        fail_after_a_mistake()
    with errors.Mistakes() as mistakes:
        assert mistakes.messages == ()


def test_a_list_of_messages_is_refused_with_each_message_once():
    errors.refuse_mistakes([])
    with pytest.raises(errors.BadInput) as single:
        errors.refuse_mistakes(["a: wrong", "a: wrong"])
    assert (type(single.value), str(single.value)) == (errors.BadInput, "a: wrong")
    with pytest.raises(errors.BadInputs) as several:
        errors.refuse_mistakes(["a: wrong\nvalue", "b: missing"])
    assert several.value.messages == ("a: wrong value", "b: missing")
