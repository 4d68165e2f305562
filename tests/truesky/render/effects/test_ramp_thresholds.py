"""Only what a scene requires, up a ramp: on either side of each threshold, what is left out is not noticed."""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from tests.truesky.render.effects.battery import EFFECTS
from tests.truesky.render.fields import small
from truesky.randomness import rng
from truesky.render.channels import nisp_p
from truesky.render.effects.effect import apply_all
from truesky.render.effects.scene import NOTICEABLE, STACK_SIZE, Scene

MISSION, N = resolve(), 128
# Effects with different values in every frame.
RANDOM = ("group_noise", "drift")


def scene(sky=1.0, peak=2e4, remembered=None, **values):
    units = {key: MISSION.parameter(f"nisp.{key.replace('__', '.')}").unit for key in values}
    database = {f"nisp.{key.replace('__', '.')}": (value, units[key]) for key, value in values.items()}
    return Scene(
        resolve(overrides=database), "nisp", 87.24, sky, peak, small("nisp", "DET22", N), ramp="photometric",
        persistence_charge=remembered,
    )  # fmt: skip


# For each effect what makes it large, from far below its threshold to far above.
CASES = {
    "chromatic_response": lambda x: scene(sky=100.0, response__slope=min(1e-4 * x, 0.5), response__curvature=0.0),
    "lamp_response": lambda x: replace(
        scene(sky=0.0, flat__signal=300.0, response__slope=min(1e-4 * x, 0.5), response__curvature=0.0), lamp=2
    ),
    "dark_map": lambda x: scene(dark_current=2e-3 * x, hot_pixels=0.0),
    "persistence": lambda x: scene(remembered=np.full((N, N), 0.03 * x)),
    "ramp_nonlinearity": lambda x: scene(nonlinearity=min(1e-9 * x, 1e-5)),
    "signal_nonlinearity": lambda x: scene(nonlinearity=min(1e-9 * x, 1e-5), nonlinearity_of_signal=1.0),
    "ipc": lambda x: scene(ipc__side=min(1e-6 * x, 0.05), ipc__diagonal=0.0),
    "group_noise": lambda x: scene(sky=10.0, read_noise=x),
    "drift": lambda x: scene(drift_photometric=x),
    "output_gain": lambda x: scene(gain_spread=min(1e-5 * x, 1.0)),
}
ALWAYS = ("ramp_cosmic_rays", "reset_level")


def signal(one, name, applied):
    """float64[ny, nx] e- of a star on the sky: with what cannot be left out, and the effect or not."""
    y, x = np.mgrid[:N, :N]
    star = one.peak_electrons * np.exp(-((x - 64) ** 2 + (y - 64) ** 2) / (2 * 0.7**2))
    chain, light = (nisp_p.FLAT, "calibration_lamp") if name == "lamp_response" else (nisp_p.SKY, "background")
    forced = {effect.name: False for effect in chain if effect.optional} | {light: True, name: applied}
    some = [effect for effect in chain if effect.name != "signal_adc"]
    found, _ = apply_all(star, some, replace(one, forced=forced), lambda e: rng.stream(1, e.name))
    return found[0]


@pytest.mark.parametrize("name", CASES)
def test_effects_that_are_left_out_are_not_noticeable(name):
    effect, needed = EFFECTS[name], []
    for size in np.geomspace(1e-5, 1e4, 10):
        one = CASES[name](size)
        needed.append(effect.is_needed(one))
        if needed[-1]:
            continue
        change = signal(one, name, True) - signal(one, name, False)
        assert np.sqrt(np.mean(change**2)) < NOTICEABLE * one.pixel_noise
        assert np.abs(change).max() < one.pixel_noise
        # The bias of a mean of STACK_SIZE frames or pixels is less than a tenth of its noise.
        chance = 5.0 * change.std() / N if name in RANDOM else 0.0
        assert abs(change.mean()) < NOTICEABLE * one.pixel_noise / np.sqrt(STACK_SIZE) + chance
    assert sorted(needed) == needed
    assert len(set(needed)) == 2


@pytest.mark.parametrize("name", ["ramp_nonlinearity", "signal_nonlinearity", "output_gain"])
def test_hot_pixels_and_hits_are_read_as_any_light(name):
    """Without a star or sky: what is left out of a dark is not noticed in any of its pixels."""
    of_signal = {"nonlinearity_of_signal": 1.0} if name == "signal_nonlinearity" else {}
    one = replace(scene(sky=0.0, peak=0.0, hot_pixels=0.1, hot_current=100.0, **of_signal), exposure_time_s=561.15)
    frame, forced = np.zeros((N, N)), {effect.name: False for effect in nisp_p.DARK if effect.optional}
    found = []
    for applied in (True, False):
        some = [effect for effect in nisp_p.DARK if effect.name != "signal_adc"]
        given = replace(one, forced={**forced, "dark_map": True, "ramp_cosmic_rays": True, name: applied})
        found.append(apply_all(frame, some, given, lambda e: rng.stream(1, e.name))[0][0])
    assert np.abs(found[0] - found[1]).max() > one.pixel_noise
    assert EFFECTS[name].is_needed(one)


@pytest.mark.parametrize("name", ALWAYS)
def test_effects_that_are_always_applied(name):
    assert EFFECTS[name].is_needed(scene(sky=0.0, peak=0.0))


def test_noise_is_that_of_the_signal():
    """7 e- in the dark, as measured of NISP: reads of 13 e-, and the drift of the outputs."""
    assert scene(sky=0.0, dark_current=0.0).pixel_noise == pytest.approx(7.0, abs=0.2)


def test_one_of_the_two_non_linearities_acts():
    for choice, wanted in ((0.0, "ramp_nonlinearity"), (1.0, "signal_nonlinearity")):
        one = scene(nonlinearity_of_signal=choice)
        both = [name for name in ("ramp_nonlinearity", "signal_nonlinearity") if EFFECTS[name].is_needed(one)]
        assert both == [wanted]
