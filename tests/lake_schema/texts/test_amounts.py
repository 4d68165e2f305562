"""Durations and sizes in the unit that suits them."""

import pytest

from lake_schema.texts.amounts import format_duration, format_size


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0 s"), (0.04, "0 s"), (0.44, "0.4 s"), (9.96, "10 s"), (59.6, "60 s"), (89.4, "89 s"), (90.0, "1.5 min"),
        (600.0, "10 min"), (5399.0, "1.5 h"), (36_000.0, "10 h"), (1.2345e8, "34,300 h"), (float("nan"), "-"),
    ],
)  # fmt: skip
def test_durations(seconds, text):
    assert format_duration(seconds) == text


@pytest.mark.parametrize(
    ("size", "text"),
    [
        (0, "0 B"), (999, "999 B"), (999.7, "1 kB"), (1500, "1.5 kB"), (478_900_000, "479 MB"), (9.99e8, "999 MB"),
        (1.24e9, "1.2 GB"), (123_456e9, "123 TB"), (1.5e16, "15,000 TB"),
    ],
)  # fmt: skip
def test_sizes(size, text):
    assert format_size(size) == text
