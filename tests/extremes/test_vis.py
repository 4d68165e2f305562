"""VIS exposures with extreme settings are finite and in the range of the converter, and conserve charge."""

import time
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from lake_schema.errors import OutOfRange
from lake_schema.mission.bounds import bounds_of_parameter, is_count
from lake_schema.mission.configuration import resolve
from tests.extremes.test_effects import scenes
from tests.truesky.render import nominal
from tests.truesky.render.fields import small
from truesky.randomness.rng import stream
from truesky.render.channels import vis
from truesky.render.effects.charge import bleeding
from truesky.render.effects.effect import apply_all
from truesky.render.effects.readout import quadrants, traps
from truesky.render.effects.scene import Lights, Scene
from truesky.request.accuracy import SURVEY

SIDE = 128
# Seconds of processor time: a frame of SIDE x SIDE takes 0.1 through all of a channel, an endless one any number.
HANGS = 120.0
END = {"vis.cti.age": (1.0, "")}


def scene_of(shape, seconds=nominal.TIME, peak=1e11, light=0.0, middle=0, **overrides):
    ny, nx = shape
    detector = replace(small("vis", "3-4", 2), nx=nx, ny=ny, injection_rows=middle)
    lights = Lights(np.array([nx / 2]), np.array([ny / 3]), np.array([light]))
    return Scene(resolve(overrides=overrides), "vis", seconds, 0.25, peak, detector, lights, accuracy=SURVEY)


def through(frame, one, kind="science", forced=None, watch=None):
    """Return every effect of an image type, required or not."""
    effects = vis.EFFECTS[kind]
    forced = {effect.name: True for effect in effects} | (forced or {})
    return apply_all(frame, effects, replace(one, forced=forced), lambda effect: stream(1, effect.name), watch)[0]


@cache
def compiled(age):
    """Apply all effects once, so that compilation is not timed."""
    for kind in vis.EFFECTS:
        through(np.zeros((2, 2)), scene_of((2, 2), light=1e11, **{"vis.cti.age": (age, "")}), kind)


@pytest.mark.parametrize("age", [pytest.param(0.0, marks=pytest.mark.nightly), 1.0])
@pytest.mark.parametrize(
    "shape",
    [
        (2, SIDE),
        (SIDE, 2),
        pytest.param((SIDE, SIDE), marks=pytest.mark.nightly),
        pytest.param((2, 2), marks=pytest.mark.nightly),
    ],
)
def test_every_effect_on_every_frame(shape, age):
    traps_of = {"vis.cti.age": (age, "")}
    compiled(age)
    for frame in scenes(shape).values():
        one = scene_of(shape, light=float(frame.max()), **traps_of)
        for kind in vis.EFFECTS:
            started = time.process_time()
            raw = through(frame if kind != "bias" else np.zeros(shape), one, kind)
            assert time.process_time() - started < HANGS
            assert raw.min() >= 0
            assert raw.max() <= 65535
            np.testing.assert_array_equal(raw, np.rint(raw))


@pytest.mark.parametrize(
    ("key", "unit"),
    [
        ("vis.ghost.radius_out", "pix"),
        ("vis.intra_pixel_response", ""),
        ("vis.detector_temperature", "K"),
        ("vis.dark_reference_temperature", "K"),
        ("vis.fpa.prescan", "pix"),
        ("vis.fpa.parallel_overscan", "pix"),
    ],
)
def test_effects_accept_all_allowed_values(key, unit):
    """Effects accept the limits of each value; values outside are refused by name before drawing."""
    least, most = (edge(value[i] for value in bounds_of_parameter(key)) for i, edge in enumerate((max, min)))
    shape = (8, 8)
    for value in (least, most):
        one = scene_of(shape, light=1e8, peak=1e5, **{key: (value, unit)})
        assert vis.TRANSFER_EFFECT.apply(0.0, 0.0, *vis.TRANSFER_EFFECT.parameters(one)) == pytest.approx(1.0)
        assert np.isfinite(through(np.zeros(shape), one)).all()
    beyond = 1.0 if is_count(key) else 0.25
    for value in (least - beyond, most + beyond):
        with pytest.raises(OutOfRange, match=key):
            resolve(overrides={key: (value, unit)})


@pytest.mark.parametrize("kind", vis.EFFECTS)
def test_rows_between_the_halves_are_not_read(kind):
    """With four such rows in a full frame, quadrants are smaller and contain only the pixels of both halves."""
    frame = max(scenes((SIDE, SIDE)).values(), key=np.sum)
    one = scene_of((SIDE, SIDE), light=float(frame.max()), middle=4)
    found = {}
    raw = through(frame, one, kind, watch=lambda name, before, after: found.setdefault(name, after))
    assert raw.min() >= 0
    assert raw.max() <= 65535
    _, _, rows, middle = quadrants.overscan_sizes(one)
    assert middle == 4
    assert raw.shape[1] == SIDE // 2 - 2 + rows
    if "bleeding" in found:
        full = np.floor(one.full_well)
        half = SIDE // 2 - 2
        held = found["bleeding"]
        assert held[:half].max() <= full
        assert held[half + 4 :].max() <= full
        cut = found["quadrants"][:, :half]
        assert cut.sum() == pytest.approx(held[:half].sum() + held[half + 4 :].sum(), rel=1e-12)


@pytest.mark.parametrize("seconds", [0.0, 1e5])
@pytest.mark.parametrize("kind", vis.EFFECTS)
def test_exposure_times_of_zero_and_one_day(kind, seconds):
    """There is no sky or dark current in 0 s; the sky is near full well in one day."""
    one = scene_of((SIDE, SIDE), seconds, peak=0.0)
    quiet = nominal.off("cosmic_rays", "readout_cosmic_rays", "hot_pixels", "pixel_response")
    through(np.zeros((2, 2)), scene_of((2, 2), seconds, peak=0.0), kind)
    started = time.process_time()
    raw = through(np.zeros((SIDE, SIDE)), one, kind, quiet)
    assert time.process_time() - started < HANGS
    bias, gain = (
        np.reshape(one.amplifier_values(*of), (-1, 1, 1)) for of in (("bias", "adu"), ("gain", "electron / adu"))
    )
    pixels = (raw[:, : SIDE // 2, 51 : 51 + SIDE // 2] - bias) * gain
    assert np.isfinite(raw).all()
    if kind in ("science", "deep", "self_calibration"):
        assert np.median(pixels) == pytest.approx(0.25 * seconds, rel=0.05, abs=60)
    if kind in ("bias", "dark"):
        assert np.median(pixels) == pytest.approx(one.dark_electrons if kind == "dark" else 0.0, abs=60)
    busy = through(np.zeros((SIDE, SIDE)), one, kind)
    assert np.isfinite(busy).all()


@pytest.mark.parametrize("seconds", [0.0, 1e5])
def test_sources_with_exposure_times_of_zero_and_one_day(seconds):
    """Sources give no electrons in 0 s, and saturate in one day."""
    started = time.process_time()
    places = [100.0, 30.0, 200.0], [100.0, 220.0, 40.0]
    one = nominal.rendered(
        small("vis", "3-4", 256), [10.0, 18.0, 24.0], *places, seconds=seconds, truth=("saturation", "ghosts", "stars")
    )
    assert time.process_time() - started < HANGS
    # In one day, asteroids cross the field, too.
    assert (one.sources.trail_length == 0.0).sum() == 3 * (seconds > 0)
    assert np.isfinite(one.noise_free).all()
    assert one.noise_free.any() == (seconds > 0)
    assert one.maps["saturation"].any() == (seconds > 0)
    assert 0 < one.raw.min() < one.raw.max() < 65535


def counted(frame, one):
    """Return electrons (before, after, trapped, lost) for bleeding and both transfers."""
    seen = {}

    def watch(name, before, after):
        seen[name] = (before, after)

    through(frame, one, forced=nominal.off("readout_cosmic_rays"), watch=watch)
    before, after = seen["bleeding"][0], seen["serial_cti"][1]
    held, lost = bleeding.bleed(before, *bleeding.EFFECT.parameters(one))
    np.testing.assert_array_equal(held, seen["bleeding"][1])
    trapped = 0.0
    for name, axis in (("parallel_cti", -2), ("serial_cti", -1)):
        (effect,) = (e for e in vis.SKY if e.name == name)
        out, still = traps.shift_charge(seen[name][0], *effect.parameters(one)[:2], axis, effect.parameters(one)[2])
        np.testing.assert_array_equal(out, seen[name][1])
        trapped += still
    return before.sum(), after, trapped, lost


@pytest.mark.parametrize("scene", scenes((2, 2)))
def test_charge_is_conserved(scene):
    frame = scenes((SIDE, SIDE))[scene]
    before, after, trapped, lost = counted(frame, scene_of((SIDE, SIDE), **END))
    assert after.sum() + trapped + lost == pytest.approx(before, rel=1e-12)
    assert after.min() >= 0
    assert trapped > 0
    assert (lost > 0) == (frame.max() > 1e6)


def test_the_brightest_star_is_rendered():
    """A star of 1e11 electrons saturates the frame; values are finite, and the neighbour keeps its light."""
    detector = small("vis", "3-4", 256)
    mag = 25.93 + 2.5 * np.log10(nominal.TIME / 1e11)
    started = time.process_time()
    one = nominal.rendered(detector, [mag, 20.0], [100.2, 30.0], [110.7, 220.0], truth=("saturation", "ghosts"))
    assert time.process_time() - started < HANGS
    assert np.isfinite(one.noise_free).all()
    assert one.noise_free.sum(dtype=float) == pytest.approx(1e11, rel=0.1)
    assert one.sources.electrons.max() == pytest.approx(1e11, rel=0.01)
    # Its column is full from the register to the middle, where the flow stops.
    assert (one.maps["saturation"][:128, 100] == 1).all()
    assert one.raw.max() <= 65535
