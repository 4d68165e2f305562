"""Effects on extreme frames are finite, conserve charge and take bounded time."""

import time

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from tests.truesky.render.effects.battery import CASES, END_OF_LIFE, call
from truesky.render.effects.charge import bleeding, cosmic_rays, poisson
from truesky.render.effects.readout import charge_transfer, readout_cosmic_rays, traps
from truesky.render.effects.readout.traps import Sweeps
from truesky.render.effects.scene import Scene

SIDE = 256
# Seconds of processor time: the slowest effect takes 0.05 for a frame of SIDE x SIDE, what does not end takes for ever.
HANGS = 120.0


def scenes(shape):
    """Return extreme frames."""
    ny, nx = shape
    star, column, ends = np.zeros(shape), np.full(shape, 130.0), np.zeros(shape)
    star[ny // 3, nx // 3] = 1e11
    column[:, nx // 2] = 2e5
    ends[0, 0] = ends[-1, -1] = 1e9
    return {
        "star of 1e11": star,
        "full column": column,
        "corners": ends,
        "empty": np.zeros(shape),
        "one electron": np.eye(ny, nx),
        "all saturated": np.full(shape, 1e7),
    }


@pytest.mark.parametrize("shape", [(SIDE, SIDE), (2, 2), (2, SIDE), (SIDE, 2)])
@pytest.mark.parametrize("name", CASES)
def test_finite_and_bounded(name, shape):
    case = CASES[name]
    for frame in scenes(shape).values():
        wanted = np.stack([frame] * 4) if case.planes else frame
        call(case, wanted[..., :2, :2])
        started = time.process_time()
        after = call(case, wanted)
        assert time.process_time() - started < HANGS
        assert np.isfinite(after).all()
        if case.conserves:
            assert after.sum() == pytest.approx(wanted.sum(), rel=1e-12)


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (300, 1)])
@pytest.mark.parametrize("name", [name for name in CASES if name not in ("quadrants", "amplifiers")])
def test_single_rows_and_columns(name, shape):
    case = CASES[name]
    for frame in scenes(shape).values():
        wanted = np.stack([frame] * 4) if case.planes else frame
        after = call(case, wanted)
        assert np.isfinite(after).all()
        if case.conserves:
            assert after.sum() == pytest.approx(wanted.sum(), rel=1e-12)


@pytest.mark.parametrize("shape", [(SIDE, SIDE), (1, SIDE), (SIDE, 1), (1, 1)])
def test_bleeding_and_transfer_account_for_every_electron(shape):
    """The input charge equals output charge + trapped charge + charge that left through the registers."""
    for frame in scenes((max(shape), max(shape))).values():
        part = np.ascontiguousarray(frame[: shape[0], : shape[1]])
        held, lost = bleeding.bleed(part, 2e5, [(0, len(part), False)])
        assert held.sum() + lost == part.sum()
        out, below = traps.shift_charge(held, END_OF_LIFE, Sweeps(1, 2), -2)
        read, along = traps.shift_charge(out, END_OF_LIFE, Sweeps(1, 2), -1)
        assert read.sum() + below + along + lost == pytest.approx(part.sum(), rel=1e-12)
        assert read.min() >= 0


@pytest.mark.parametrize("age", [0.0, 1.0, 10.0])
def test_no_traps_and_far_beyond_the_end_of_life(age):
    scene = Scene(resolve(overrides={"vis.cti.age": (age, "")}), "vis", 560.0, 0.25, 1e4)
    silicon = charge_transfer.silicon_traps(scene, "parallel")
    for frame in scenes((SIDE, 8)).values():
        out, still = traps.shift_charge(frame, silicon, Sweeps(1, 2), -2)
        assert out.sum() + still == pytest.approx(frame.sum(), rel=1e-12)
        if age == 0:
            np.testing.assert_array_equal(out, frame)


@pytest.mark.parametrize("seconds", [0.0, 1e5])
def test_exposure_times_from_zero_to_one_day(seconds):
    scene = Scene(resolve(), "vis", seconds, 0.25, 1e4)
    assert np.isfinite([effect.margin(scene) for effect in (cosmic_rays.EFFECT, readout_cosmic_rays.READOUT)]).all()
    expected, quantiles, _ = cosmic_rays.EFFECT.parameters(scene)
    started = time.process_time()
    image = cosmic_rays.draw_tracks((SIDE, SIDE), expected * (SIDE / 4096) ** 2, quantiles, np.random.default_rng(1))
    assert time.process_time() - started < HANGS
    assert (image.sum() > 0) == (seconds > 0)


@pytest.mark.parametrize("mean", [1e-300, 1e9, 1e18])
def test_poisson_noise_of_very_large_means(mean):
    """Sample of 40,000 pixels; significance 6e-5 of the mean (4 standard errors), 2e-5 of the variance (3 %)."""
    counted = poisson.apply(np.full((200, 200), mean), rng=np.random.default_rng(1))
    assert counted.mean() == pytest.approx(mean, abs=4 * np.sqrt(mean) / 200)
    assert counted.var() == pytest.approx(mean, rel=0.03, abs=1e-290)
