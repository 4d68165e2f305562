"""Comparison in which the given relative tolerance applies.

pytest.approx accepts values within the larger of its two tolerances, and the absolute tolerance is 1e-12 by default. If
a flux is 1e-30 W/m2, every other flux of that size is therefore "within 1e-9".
"""

from collections.abc import Mapping

import numpy as np
import pytest

DEFAULT_REL, DEFAULT_ABS = 1e-6, 1e-12
_approx = pytest.approx


def approx(expected, rel=None, abs=None, nan_ok=False):
    """Return pytest.approx; refuse numbers for which the default absolute tolerance exceeds the relative one.

    Zero has no relative tolerance, so it is accepted: it is compared within 1e-12.
    """
    if abs is None:
        least = smallest(expected)
        if least * (DEFAULT_REL if rel is None else rel) < DEFAULT_ABS:
            raise ValueError(
                f"approx of {least:g} within {DEFAULT_ABS:g}, which is pytest's absolute tolerance, not the relative "
                "one: give rel and abs=0.0"
            )
    return _approx(expected, rel=rel, abs=abs, nan_ok=nan_ok)


def smallest(expected):
    """Return the smallest finite non-zero absolute value of a number, array, sequence or mapping."""
    if isinstance(expected, Mapping):
        expected = list(expected.values())
    if isinstance(expected, (list, tuple)):
        return min(map(smallest, expected), default=np.inf)
    try:
        sizes = np.abs(np.asarray(expected, dtype=complex))
    except (TypeError, ValueError):
        return np.inf
    return float(np.min(sizes[np.isfinite(sizes) & (sizes > 0)], initial=np.inf))
