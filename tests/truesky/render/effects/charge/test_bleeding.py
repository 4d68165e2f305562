"""Bleeding: charge flows along columns and is never lost but through the serial register."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import OutOfRange
from tests.truesky.render.fields import MISSION
from truesky.render.camera import detectors
from truesky.render.effects.charge import bleeding
from truesky.render.effects.scene import Scene

FULL = 1000.0


def runs(ny, halves, between=0):
    """Return the segments of columns with a register at row 0, or at both ends."""
    middle = (ny - between + 1) // 2
    return [(0, ny, False)] if halves == 1 else [(0, middle, False), (middle + between, ny, True)]


def bleed(frame, capacity, halves, between=0):
    return bleeding.bleed(frame, capacity, runs(len(frame), halves, between))


def column(n, **pixels):
    frame = np.zeros((n, 1))
    for place, charge in pixels.items():
        frame[int(place[1:]), 0] = charge
    return frame


@given(
    seed=st.integers(0, 2**32 - 1), ny=st.integers(1, 40), halves=st.sampled_from([1, 2]),
    level=st.sampled_from([10.0, 900.0, 5000.0]), star=st.sampled_from([0.0, 1e5, 1e11]),
)  # fmt: skip
def test_charge_in_is_charge_out_and_lost(seed, ny, halves, level, star):
    rng = np.random.default_rng(seed)
    frame = rng.poisson(level, (ny, 6)).astype(float)
    frame[rng.integers(0, ny), rng.integers(0, 6)] += star
    out, lost = bleed(frame, FULL, halves)
    assert out.sum() + lost == frame.sum()
    assert out.max() <= FULL
    assert out.min() >= 0
    np.testing.assert_array_equal(out, np.rint(out))
    # A pixel that had room is never poorer.
    assert (out >= np.minimum(frame, FULL)).all()


def test_half_each_way():
    out, lost = bleed(column(41, p20=7000.0), FULL, 1)
    assert lost == 0
    np.testing.assert_array_equal(out, out[::-1])
    np.testing.assert_array_equal(np.flatnonzero(out[:, 0]), np.arange(17, 24))
    assert (out[17:24, 0] == FULL).all()


def test_what_flows_meets_what_is_there():
    """Between two bright stars, and onto a sky."""
    frame = column(60, p20=5000.0, p24=5000.0) + 100.0
    out, lost = bleed(frame, FULL, 1)
    assert lost == 0
    full = np.flatnonzero(out[:, 0] >= FULL)
    assert (np.diff(full) == 1).all()
    assert out.sum() == frame.sum()


def test_the_middle_stops_and_the_register_takes():
    """Two halves do not know of each other; what reaches a register is lost."""
    out, lost = bleed(column(40, p18=20_500.0), FULL, 2)
    assert (out[20:] == 0).all()
    assert (out[:20] == FULL).all()
    assert lost == 500.0
    up, lost_up = bleed(column(40, p21=20_500.0), FULL, 2)
    np.testing.assert_array_equal(up[::-1], out)
    assert lost_up == lost


def test_full_columns_and_frames():
    full = np.full((10, 3), 5000.0)
    out, lost = bleed(full, FULL, 2)
    assert (out == FULL).all()
    assert lost == full.sum() - out.sum()
    calm = np.full((10, 3), FULL)
    out, lost = bleed(calm, FULL, 2)
    assert lost == 0
    np.testing.assert_array_equal(out, calm)
    assert bleeding.saturated_pixels(out, FULL, runs(len(out), 2, 0)).all()


def test_each_segment_and_column_has_its_own_full_well():
    """A frame whose parts have different full wells bleeds as if each part were alone."""
    frame = np.rint(10 ** np.random.default_rng(4).uniform(1, 3.5, (40, 6)))
    parts, wells = runs(40, 2), np.array([[900.0, 900.0, 1e3, 1e3, 1e3, 1100.0], [800.0] * 3 + [1200.0] * 3])
    found, lost = bleeding.bleed(frame, wells, parts)
    expected, total = np.zeros_like(frame), 0.0
    for (first, past, above), row in zip(parts, wells, strict=True):
        for column_number, well in enumerate(row):
            alone = bleeding.bleed(frame[first:past, [column_number]], float(well), [(0, past - first, above)])
            expected[first:past, [column_number]], total = alone[0], total + alone[1]
    np.testing.assert_array_equal(found, expected)
    assert lost == total > 0
    full = bleeding.saturated_pixels(found, wells, parts)
    np.testing.assert_array_equal(full, found >= np.repeat(wells, 20, axis=0))
    assert 0 < full.sum() < full.size
    with pytest.raises(OutOfRange, match="full well"):
        bleeding.bleed(frame, np.where(wells == 800.0, np.nan, wells), parts)


def test_length_of_a_trail():
    """A star of F electrons, its pixels' excess over five columns: F 0.85 / (full well) / 5 rows, to a third."""
    y, x = np.mgrid[:2001, :31]
    for electrons in (1e7, 1e8):
        light = np.exp(-((x - 15) ** 2 + (y - 1000) ** 2) / (2 * 1.0**2))
        frame = np.rint(electrons * light / light.sum())
        out, lost = bleed(frame, 2e5, 1)
        rows = bleeding.saturated_pixels(out, 2e5, runs(len(out), 1, 0)).sum() / 5
        assert lost == 0
        assert rows == pytest.approx(electrons * 0.95 / 2e5 / 5, rel=0.3)


def test_the_rows_between_the_halves_stop_it_too():
    """Each half as if the other were not there; what is between them is not read, and stays."""
    rng = np.random.default_rng(3)
    frame = np.rint(10 ** rng.uniform(1, 5, (44, 6)))
    found, lost = bleed(frame, 2e4, 2, 4)
    lower, first = bleed(frame[:20], 2e4, 1)
    upper, second = bleed(frame[:23:-1], 2e4, 1)
    np.testing.assert_array_equal(found, np.concatenate([lower, frame[20:24], upper[::-1]]))
    assert lost == first + second > 0


@pytest.mark.parametrize(("capacity", "piece"), [(0.0, (0, 2, True)), (np.nan, (0, 2, True)), (1e5, (0, 3, True))])
def test_nonsense_is_refused(capacity, piece):
    with pytest.raises(OutOfRange, match=r"full well|rows of a column"):
        bleeding.bleed(np.zeros((2, 2)), capacity, [piece])


# Where charge stops: LSST's sensors and JPCam's are read at both ends, GPC1's cells one by one, the others at one end.
STOPS = {"decam": 1, "hsc": 1, "megacam": 1, "lsstcam": 2, "jpcam": 2, "gpc1": 8}


@pytest.mark.parametrize("camera", STOPS)
def test_ground_cameras_stop_it_where_their_columns_end(camera):
    """A star far too bright for its column fills its segment and no other; all charge is accounted for."""
    one = detectors.detectors(camera, MISSION)[0]
    scene = Scene(MISSION, one.section, 90.0, 10.0, 1e9, one)
    capacity, pieces = bleeding.EFFECT.parameters(scene)
    assert len(pieces) == STOPS[camera]
    first, past, _ = pieces[-1]
    frame = np.zeros((one.ny, 3))
    frame[(first + past) // 2, 1] = 1.5 * capacity * (past - first)
    out, lost = bleeding.bleed(frame, capacity, pieces)
    np.testing.assert_array_equal(np.flatnonzero(out[:, 1]), np.arange(first, past))
    assert out.sum() + lost == frame.sum()
