"""Inter-pixel capacitance against a convolution; charge stays, at the edges, too."""

import numpy as np
import pytest
from scipy import ndimage

from lake_schema.errors import BadInput, OutOfRange
from truesky.render.effects.charge import ipc

RNG = np.random.default_rng(1)
SIDE, DIAGONAL = 0.0065, 0.0004


def test_against_a_convolution():
    frame = np.random.default_rng(2).uniform(0.0, 1e5, (3, 20, 31))
    centre = 1.0 - 4.0 * (SIDE + DIAGONAL)
    kernel = [[DIAGONAL, SIDE, DIAGONAL], [SIDE, centre, SIDE], [DIAGONAL, SIDE, DIAGONAL]]
    seen = ipc.apply(frame, SIDE, DIAGONAL, RNG)
    inside = np.s_[:, 1:-1, 1:-1]
    expected = np.array([ndimage.convolve(plane, kernel) for plane in frame])
    np.testing.assert_allclose(seen[inside], expected[inside], rtol=1e-13, atol=0)


def test_edges_by_pairs():
    """Every pair of neighbours gives and takes the same."""
    frame = np.random.default_rng(3).uniform(0.0, 1e5, (3, 4))
    expected = frame.copy()
    for y, x in np.ndindex(frame.shape):
        for v, u in np.ndindex(frame.shape):
            if max(abs(y - v), abs(x - u)) == 1:
                expected[y, x] += (SIDE if y == v or x == u else DIAGONAL) * (frame[v, u] - frame[y, x])
    np.testing.assert_allclose(ipc.apply(frame, SIDE, DIAGONAL, RNG), expected, rtol=1e-13, atol=0)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_charge_is_kept(dtype):
    frame = np.zeros((2, 7, 5), dtype)
    frame[0, 0, 0] = frame[1, 3, 2] = frame[0, 6, 2] = 1e5
    seen = ipc.apply(frame, SIDE, DIAGONAL, RNG)
    assert seen.dtype == dtype
    np.testing.assert_allclose(seen.sum(axis=(1, 2), dtype=float), frame.sum(axis=(1, 2), dtype=float), rtol=1e-7)
    assert seen[1, 3, 2] == pytest.approx(1e5 * (1 - 4 * (SIDE + DIAGONAL)))
    assert frame[0, 0, 0] == 1e5


def test_even_light_stays_as_it_is():
    frame = np.full((4, 4), 123.456)
    np.testing.assert_array_equal(ipc.apply(frame, SIDE, DIAGONAL, RNG), frame)


def test_impossible_parameters_are_refused():
    with pytest.raises(OutOfRange, match="side"):
        ipc.apply(np.zeros((2, 2)), -1e-3, 0.0, RNG)
    with pytest.raises(BadInput, match="neighbours get"):
        ipc.apply(np.zeros((2, 2)), 0.1, 0.1, RNG)
