"""Series of the exponential function against the library's."""

import numpy as np
import pytest

from truesky.render.effects.series import SMALL, SMALL_EXP, small_exp, small_expm1


@pytest.mark.parametrize("x", [*np.linspace(-SMALL, SMALL, 41).tolist(), 1e-300, 0.0])
def test_the_exponential_less_1(x):
    assert small_expm1(x) == pytest.approx(np.expm1(x), rel=1e-14, abs=0)


@pytest.mark.parametrize("x", np.linspace(-SMALL_EXP, SMALL_EXP, 41).tolist())
def test_the_exponential(x):
    assert small_exp(x) == pytest.approx(np.exp(x), rel=1e-11, abs=0)
