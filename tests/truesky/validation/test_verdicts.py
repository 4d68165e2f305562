"""Verdicts distinguish faults, chance and insufficient data."""

import math

import pytest

from truesky.validation.verdicts import FAIL, PASS, UNDECIDED, verdict


@pytest.mark.parametrize(
    ("value", "error", "kind", "found"),
    [
        (1.0, 0.01, "around", PASS),
        (1.11, 0.001, "around", FAIL),
        (0.89, 0.001, "around", FAIL),
        # Beyond the tolerance, but within three errors.
        (1.12, 0.01, "around", UNDECIDED),
        # Within the tolerance, possibly by chance.
        (1.05, 0.2, "around", UNDECIDED),
        (5.0, 0.01, "least", PASS),
        (5.0, 1.0, "least", PASS),
        (0.89, 0.001, "least", FAIL),
        (0.0, 0.01, "most", PASS),
        (1.2, 0.01, "most", FAIL),
        (math.nan, 0.01, "around", UNDECIDED),
        (1.0, math.inf, "around", UNDECIDED),
    ],
)
def test_verdicts(value, error, kind, found):
    assert verdict(value, error, 1.0, 0.1, kind) == found
