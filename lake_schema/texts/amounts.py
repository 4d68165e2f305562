"""Write durations and sizes of files for readers, in the unit that suits the amount."""

from __future__ import annotations

import math

# Largest amount in each unit of time, and its length in seconds.
_TIME_UNITS = (("s", 90.0, 1.0), ("min", 90.0, 60.0), ("h", math.inf, 3600.0))
_SIZE_UNITS = (
    ("B", 1000.0, 1.0),
    ("kB", 1000.0, 1e3),
    ("MB", 1000.0, 1e6),
    ("GB", 1000.0, 1e9),
    ("TB", math.inf, 1e12),
)


def format_duration(seconds: float) -> str:
    """Return a duration in s, min or h with two or three digits, such as "0.4 s", "12 s", "3.5 min" or "1,200 h"."""
    return _format_amount(seconds, _TIME_UNITS)


def format_size(size: float) -> str:
    """Return a number of bytes in B, kB, MB, GB or TB with two or three digits, such as "480 MB" or "1.2 GB"."""
    return _format_amount(size, _SIZE_UNITS)


def _format_amount(amount: float, units: tuple[tuple[str, float, float], ...]) -> str:
    """Return an amount in the first unit (name, largest number, length) in which the rounded number is small enough."""
    if not math.isfinite(amount):
        return "-"
    name, number = next(
        (name, number) for name, largest, length in units if abs(number := _round(amount / length)) < largest
    )
    digits = 1 if abs(number) < 10.0 and number != round(number) else 0
    return f"{number:,.{digits}f} {name}"


def _round(number: float) -> float:
    """Round a number to one decimal below 10, to an integer below 100, else to three digits."""
    if number == 0.0:
        return 0.0
    return round(number, 1 if abs(number) < 9.95 else min(0, 2 - math.floor(math.log10(abs(number)))))
