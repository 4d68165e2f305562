"""Tree rings and edges: sources move and change as if every electron were displaced, and no charge is lost."""

import numpy as np
import pytest

from lake_schema.errors import OutOfRange
from tests.truesky.render.fields import moments
from truesky.render.effects.charge import pixel_borders

PERIOD, PIXELS = 30.0, 0.05
# Amplitude of the flat that belongs to a displacement of PIXELS.
AMPLITUDE = 2.0 * np.pi * PIXELS / PERIOD
SIDE = 96
# Number of fine pixels along the side of a pixel, in which sources are computed.
FINE = 8


def gaussian(x, y, sigma, n=SIDE, fine=1):
    """[n fine, n fine] of light one, on pixels `fine` times smaller."""
    at = (np.arange(n * fine) + 0.5) / fine - 0.5
    across, up = (np.exp(-0.5 * ((at - place) / sigma) ** 2) for place in (x, y))
    out = up[:, None] * across
    return out / out.sum()


def carried(x, y, sigma, move):
    """The same, each piece of light displaced by move(x, y) -> (dx, dy): the truth."""
    fine = gaussian(x, y, sigma, fine=FINE)
    at = (np.arange(SIDE * FINE) + 0.5) / FINE - 0.5
    column, row = np.meshgrid(at, at)
    dx, dy = move(column, row)
    # Each piece is a square, shared by the pixels that it lies on.
    out = np.zeros((SIDE + 1, SIDE + 1))
    first, share = zip(*(shared(at) for at in (column + dx, row + dy)), strict=True)
    for right in (0, 1):
        for up in (0, 1):
            part = np.abs(right - share[0]) * np.abs(up - share[1])
            np.add.at(out, (first[1] + up, first[0] + right), part * fine)
    return out[:-1, :-1]


def shared(at):
    """Return the first pixel that a piece of width 1 / FINE at a position overlaps, and the overlapping fraction."""
    first = np.floor(at - 0.5 / FINE + 0.5).astype(int)
    return first, np.clip((first + 0.5 - at) * FINE + 0.5, 0.0, 1.0)


def rings(frame, amplitude=AMPLITUDE, seed=3):
    return pixel_borders.apply_rings(frame, amplitude, PERIOD, PERIOD, 300.0, np.random.default_rng(seed))


def axis_and_phase(seed=3):
    rng = np.random.default_rng(seed)
    side, phase = np.sign(rng.random(2) - 0.5), 2 * np.pi * rng.random()
    return (SIDE - 1) / 2 + 300.0 * side, phase


def test_a_flat_shows_them_with_the_stated_amplitude():
    flat = rings(np.full((400, 300), 1000.0), 0.01) / 1000.0 - 1.0
    assert flat[5:-5, 5:-5].std() == pytest.approx(0.01 / np.sqrt(2), rel=0.05)
    assert np.abs(flat[5:-5, 5:-5]).max() == pytest.approx(0.01, rel=0.05)
    # Along the way to the axis, and with the stated period.
    line = flat[np.arange(300), np.arange(300)]
    power = np.abs(np.fft.rfft(line[20:280] - line[20:280].mean())) ** 2
    across = np.fft.rfftfreq(260)[np.argmax(power)] / np.sqrt(2)
    assert 1.0 / across == pytest.approx(PERIOD, rel=0.15) or across < 0.01


@pytest.mark.parametrize(("sigma", "moved", "widened"), [(1.2, 5e-4, 2e-3), (3.0, 3e-4, 1e-3)])
def test_sources_are_displaced_as_all_their_light_is(sigma, moved, widened):
    """Against every piece of light displaced for itself: centroids in pixels, second moments relative."""
    axis, phase = axis_and_phase()
    near, far = pixel_borders.distance_range(SIDE, SIDE, tuple(axis))
    table = pixel_borders.radial_displacement(AMPLITUDE, (PERIOD, PERIOD), phase, near, far)

    def move(x, y):
        distance = np.hypot(x - axis[0], y - axis[1])
        d = np.interp(distance, near + 0.25 * np.arange(len(table)), table)
        return d * (x - axis[0]) / distance, d * (y - axis[1]) / distance

    for x, y in ((48.2, 47.6), (40.7, 55.1)):
        before, truth = gaussian(x, y, sigma), carried(x, y, sigma, move)
        still = carried(x, y, sigma, lambda a, b: (0 * a, 0 * b))
        found = rings(before)
        shift, wanted = (moments(a)[0] - moments(b)[0] for a, b in ((found, before), (truth, still)))
        assert np.hypot(*wanted) > 5e-3
        np.testing.assert_allclose(shift, wanted, atol=moved)
        change = np.trace(moments(found)[1] - moments(before)[1]) - np.trace(moments(truth)[1] - moments(still)[1])
        assert abs(change) < widened * 2.0 * sigma**2


def crossed(frame, columns, rows, component=lambda along, across: 0.0):
    """Return a frame after charge crossed all borders: the slow calculation, one border after the other.

    `component` is the displacement along one axis at a position along and across it, in addition to `columns` and
    `rows`.
    """
    out = frame.copy()
    for line, changed, shifts in ((frame, out, columns), (frame.T, out.T, rows)):
        n = line.shape[1]
        for r, c in np.ndindex(len(line), n - 1):
            d = shifts[c] + component((c + 0.5, r) if line is frame else (r, c + 0.5), line is frame)
            q1, q2 = line[r, c], line[r, c + 1]
            level = 0.5 * (q1 + q2)
            if 0 < c < n - 2:
                level = (7.0 * (q1 + q2) - line[r, c - 1] - line[r, c + 2]) / 12.0
            moved = np.clip(d * (level - 0.5 * d * (q2 - q1)), -0.2 * q2, 0.2 * q1)
            changed[r, c] -= moved
            changed[r, c + 1] += moved
    return out


SHAPES = [(1, 1), (1, 7), (7, 1), (2, 2), (3, 2), (2, 3), (4, 5), (40, 33)]


@pytest.mark.parametrize("shape", SHAPES)
def test_rings_are_those_of_the_slow_calculation(shape):
    frame = 10.0 ** np.random.default_rng(4).uniform(0, 4, shape)
    rng = np.random.default_rng(3)
    side, phase = np.sign(rng.random(2) - 0.5), 2 * np.pi * rng.random()
    axis = [(n - 1) / 2 + 20.0 * sign for n, sign in zip(shape[::-1], side, strict=True)]
    near, far = pixel_borders.distance_range(*shape[::-1], tuple(axis))
    table = pixel_borders.radial_displacement(0.05, (8.0, 12.0), phase, near, far)

    def component(place, along_row):
        x, y = np.subtract(place, axis)
        distance = np.hypot(x, y)
        return np.interp(distance, near + 0.25 * np.arange(len(table)), table) * (x if along_row else y) / distance

    found = pixel_borders.apply_rings(frame, 0.05, 8.0, 12.0, 20.0, np.random.default_rng(3))
    expected = crossed(frame, np.zeros(shape[1]), np.zeros(shape[0]), component)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    assert shape == (1, 1) or np.abs(found - frame).max() > 1e-3


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("length", [0.3, 5.0])
def test_edges_are_those_of_the_slow_calculation(shape, length):
    frame = 10.0 ** np.random.default_rng(4).uniform(0, 4, shape)
    shifts = []
    for n in shape[::-1]:
        to_start = np.arange(n) + 1.0
        to_end = n - to_start
        shift = 0.2 * (np.exp(-to_end / length) - np.exp(-to_start / length))
        shifts.append(np.where(np.minimum(to_start, to_end) < 8.0 * length, shift, 0.0))
    found = pixel_borders.apply_edges(frame, 0.2, length)
    np.testing.assert_allclose(found, crossed(frame, *shifts), rtol=1e-9, atol=1e-9)


def test_charge_stays_and_nothing_is_negative():
    frame = 10.0 ** np.random.default_rng(1).uniform(0, 5, (60, 70))
    for out in (
        rings(frame, 0.1),
        pixel_borders.apply_edges(frame, 0.5, 5.0),
        pixel_borders.apply_edges(frame, -0.5, 5.0),
    ):
        assert out.sum() == pytest.approx(frame.sum(), rel=1e-12)
        assert out.min() >= 0.0


@pytest.mark.parametrize("shift", [0.2, -0.2])
def test_the_last_pixels_are_brighter_or_fainter(shift):
    flat = pixel_borders.apply_edges(np.full((60, 80), 100.0), shift, 4.0)
    level = flat[30, :8] / 100.0 - 1.0
    # Charge that enters minus charge that leaves. No charge crosses the outer border of the detector.
    at = np.exp(-np.arange(0, 9) / 4.0)
    at[0] = 0.0
    np.testing.assert_allclose(level[1:], shift * (at[2:] - at[1:-1]), atol=1e-3)
    assert level[0] == pytest.approx(shift * at[1], abs=1e-3)
    np.testing.assert_allclose(flat, flat[::-1])
    np.testing.assert_allclose(flat, flat[:, ::-1])
    assert np.abs(flat[20:40, 35:45] - 100.0).max() < 0.1


@pytest.mark.parametrize(
    ("numbers", "word"),
    [((0.2, 30.0, 30.0, 0.0), "tree rings"), ((0.01, 1.0, 30.0, 0.0), "period"), ((0.01, 30.0, np.nan, 0.0), "period")],
)
def test_impossible_rings_are_refused(numbers, word):
    with pytest.raises(OutOfRange, match=word):
        pixel_borders.apply_rings(np.ones((9, 9)), *numbers, np.random.default_rng(1))


def test_impossible_edges_are_refused():
    for numbers in ((0.6, 5.0), (0.1, 0.0), (np.nan, 5.0)):
        with pytest.raises(OutOfRange, match="edge"):
            pixel_borders.apply_edges(np.ones((9, 9)), *numbers)
