"""Every quantity at, within and up to three decades beyond its limits gives a correct result or one clear message."""

import math
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lake_schema.errors import BadInput
from tests.extremes import quantities, references
from tests.extremes.quantities import IMPOSSIBLE, REFUSED, SUBJECTS

# GalSim needs seconds to prepare a profile of another index.
INDICES = {"default": (0.3, 0.5, 1.0), "nightly": (0.3, 0.5, 1.0, 1.5, 2.5, 4.0, 6.2)}
# Number of cases of each subject by default, where the reference is slow.
CASES, SLOW_CASES = 40, {"seeing through turbulent air": 12}
# Cases of each subject in nightly tests, 20,000 in all.
NIGHTLY_CASES, SLOW_NIGHTLY_CASES = 1960, {"seeing through turbulent air": 400}


@st.composite
def values_of(draw, subject, indices):
    """Return (quantity, values): one quantity is at or beyond its limits, or anywhere between them."""
    chosen = draw(st.sampled_from(subject.quantities))
    values = {
        one.name: quantities.value_between(one, draw(st.floats(0.0, 1.0)), usual=True) for one in subject.quantities
    }
    if "bulge_sersic_index" in values:
        values["bulge_sersic_index"] = draw(st.sampled_from(indices))
    beyond = st.tuples(st.floats(1e-3, 3.0), st.booleans()).map(lambda at: chosen.value_beyond(*at))
    inside = st.sampled_from([0.0, 1.0]) | st.floats(0.0, 1.0)
    kinds = [inside.map(lambda share: quantities.value_between(chosen, share, usual=False))]
    if chosen.beyond != IMPOSSIBLE:
        kinds.append(beyond)
    if chosen.name == "bulge_sersic_index":
        kinds[0] = st.sampled_from([chosen.lo, *indices])
    if chosen.beyond == REFUSED:
        kinds.append(st.sampled_from([math.nan, math.inf, -math.inf]))
    values[chosen.name] = draw(st.one_of(kinds))
    return chosen, values


def is_refused(subject, values):
    """Return True or False if the values must be refused or accepted, and None if both are right."""
    if any(one.beyond == REFUSED and one.is_outside(values[one.name]) for one in subject.quantities):
        return True
    if subject.name == "galaxy on a stamp":
        return references.is_near_caustic(values["kappa"], values["reduced_shear"])
    if subject.name == "galaxy in a passband of one sample":
        # Magnifications above 100 are refused.
        stretch = abs(1.0 - values["kappa"])
        return stretch < 0.1 if abs(stretch - 0.1) > 1e-9 else None
    if subject.name == "passband from a file":
        if values["rows"] < 2:
            return True
        first, last = (values["wavelength"] + 0.5 * sign * values["width"] for sign in (-1.0, 1.0))
        limit = next(one for one in subject.quantities if one.name == "wavelength")
        # The last hundredth of the width of a triangle has 2e-4 of its area, and the last tenth 2e-2.
        beyond = (last - limit.hi) / values["width"]
        if beyond > 0.01:
            return True if beyond > 0.1 else None
        return None if last - first <= 2.0 or first < limit.lo or last / first > 1.2 else False
    if subject.name == "seeing through turbulent air":
        return None if values["seeing"] < 1.5 or not 10.0 <= values["outer_scale"] <= 500.0 else False
    return False


def check(subject, values):
    """Return the error of the result, or None if the values are refused."""
    must, error, messages = is_refused(subject, values), None, ()
    try:
        error = references.COMPARISONS[subject.name](values)
    except BadInput as refusal:
        messages = refusal.messages
    if error is None:
        assert must is not False, messages
        assert all(line and line.isprintable() for line in messages)
        return None
    assert must is not True, f"not refused: {values}"
    assert error <= subject.error
    return error


def run(subject, cases, indices):
    """Check a number of cases, and print how many were accepted and refused and the largest error of each quantity."""
    count, largest = Counter(), Counter()

    @given(values_of(subject, indices))
    @settings(max_examples=cases, deadline=None, suppress_health_check=list(HealthCheck))
    def check_one(case):
        chosen, values = case
        error = check(subject, values)
        count["refused" if error is None else "accepted"] += 1
        largest[chosen.label] = max(largest[chosen.label], error or 0.0)

    check_one()
    errors = ", ".join(f"{name} {error:.2g}" for name, error in largest.items())
    print(f"{subject.name}: {count['accepted']} accepted, {count['refused']} refused; largest error: {errors}")
    return count


@pytest.mark.parametrize("subject", SUBJECTS, ids=lambda subject: subject.name)
def test_values_are_right_or_refused(subject):
    count = run(subject, SLOW_CASES.get(subject.name, CASES), INDICES["default"])
    assert count["accepted"]


@pytest.mark.nightly
@pytest.mark.parametrize("subject", SUBJECTS, ids=lambda subject: subject.name)
def test_many_values_are_right_or_refused(subject):
    count = run(subject, SLOW_NIGHTLY_CASES.get(subject.name, NIGHTLY_CASES), INDICES["nightly"])
    assert count["accepted"]
    assert count["refused"] or not any(one.beyond == REFUSED for one in subject.quantities)


def test_every_subject_has_a_reference():
    assert set(references.COMPARISONS) == {subject.name for subject in SUBJECTS}


def test_the_documentation_has_the_declared_limits():
    """The largest errors in docs/promises.md are those that a nightly run printed."""
    lines = (Path(__file__).parents[2] / "docs" / "promises.md").read_text(encoding="utf-8").splitlines()
    rows = [line for line in lines if line.startswith(tuple(f"| {subject.name} |" for subject in SUBJECTS))]
    assert [
        row for row in rows if row.count("|") == 5 and row in quantities.quantity_rows()
    ] == quantities.quantity_rows()
    others = [row for row in rows if row not in quantities.quantity_rows()]
    for subject, row in zip(SUBJECTS, others, strict=True):
        seen = float(row.split("|")[3].split()[0])
        assert row == quantities.reference_row(subject, seen)
        assert seen <= subject.error
