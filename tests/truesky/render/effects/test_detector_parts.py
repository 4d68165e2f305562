"""A fixed pattern of a detector is the same in a window as in the same pixels of the whole detector."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from truesky.render.camera.windows import DetectorPart, Window
from truesky.render.effects.charge import dark_current, dark_map, pixel_response, ramp_nonlinearity

NY, NX = 61, 83
SEGMENTS = (0, 30, False), (33, NY, True)
# Function, frame of the whole detector and parameters. All kinds of defects are frequent.
PATTERNS = {
    "pixel_response": (pixel_response.apply, (NY, NX), (0.1, (0.05, 30.0), (5e-3, 3.0, 0.5), SEGMENTS)),
    "dark_map": (dark_map.apply, (NY, NX), (3.0, 0.5, 0.05, 300.0)),
    "hot_pixels": (dark_current.apply_hot, (NY, NX), (0.05, 300.0)),
    "ramp_nonlinearity": (ramp_nonlinearity.apply, (3, NY, NX), (1e-6, 0.3)),
    "signal_nonlinearity": (ramp_nonlinearity.apply_signal, (2, NY, NX), (1e-6, 0.3)),
}


@st.composite
def parts(draw):
    column, row = draw(st.integers(0, NX - 1)), draw(st.integers(0, NY - 1))
    nx, ny = draw(st.integers(1, NX - column)), draw(st.integers(1, NY - row))
    return DetectorPart(Window(column, row, nx, ny), NX, NY)


@pytest.mark.parametrize("name", PATTERNS)
@settings(max_examples=40, deadline=None)
@given(part=parts(), seed=st.integers(0, 2**32))
def test_a_window_has_the_pattern_of_its_detector(name, part, seed):
    apply, shape, parameters = PATTERNS[name]
    frame = 1000.0 * np.random.default_rng(1).random(shape)
    rows = slice(part.window.row, part.window.row + part.window.ny)
    columns = slice(part.window.column, part.window.column + part.window.nx)
    whole = apply(frame, *parameters, np.random.default_rng(seed))
    window = apply(frame[..., rows, columns], *parameters, np.random.default_rng(seed), part=part)
    np.testing.assert_array_equal(window, whole[..., rows, columns])


@pytest.mark.parametrize("name", PATTERNS)
def test_every_defect_occurs_in_the_patterns(name):
    """Otherwise the comparison of windows would not notice if one were lost."""
    apply, shape, parameters = PATTERNS[name]
    frame = np.full(shape, 1000.0)
    changed = apply(frame, *parameters, np.random.default_rng(1))
    assert len(np.unique(changed)) > 100
    if name == "pixel_response":
        assert (changed == 0.0).sum() > 200
