"""Only what a scene requires: on either side of each threshold, what is left out is not noticed."""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from tests.truesky.render import nominal
from tests.truesky.render.effects import test_ramp_thresholds
from tests.truesky.render.effects.battery import EFFECTS
from tests.truesky.render.fields import small
from truesky.fluxes import passbands
from truesky.randomness import rng
from truesky.render.camera import detectors
from truesky.render.channels import vis
from truesky.render.effects.charge import cosmic_rays
from truesky.render.effects.effect import apply_all
from truesky.render.effects.scene import NOTICEABLE, STACK_SIZE, Lights, NeighbourCharge, Scene
from truesky.request.accuracy import DRAFT, QUICKLOOK, SURVEY

MISSION = resolve()
DETECTOR = detectors.detector("vis", "1-1", MISSION)
NX, NY = 8, DETECTOR.ny


def database(**values):
    """Return overrides of some of the camera's parameters. All quadrants are equal."""
    equal = {key: MISSION.value(f"vis.{key}") for key in ("gain", "read_noise", "bias", "full_well")}
    values = equal | values
    units = {key: MISSION.parameter(f"vis.{key.replace('__', '.')}").unit for key in values}
    return {f"vis.{key.replace('__', '.')}": (value, units[key]) for key, value in values.items()}


def scene(sky=0.25, peak=1e4, lights=None, **values):
    return Scene(
        resolve(overrides=database(**values)), "vis", 560.53, sky, peak, DETECTOR, lights or Lights(), 1
    )  # fmt: skip


def ground(sky=10.0, peak=1e4, **values):
    """Return the scene of a DECam detector."""
    keys = {f"ext.decam.{key.replace('__', '.')}": value for key, value in values.items()}
    mission = resolve(overrides={key: (value, MISSION.parameter(key).unit) for key, value in keys.items()})
    return Scene(mission, "ext.decam", 90.0, sky, peak, detectors.detector("decam", "S29", MISSION))


def crossed():
    """Return the scene of a DECam detector in a field with ten satellite trails."""
    rate = {"survey.satellites.rate": (0.05, "1 / (deg s)")}
    return replace(ground(), mission=MISSION.with_overrides(rate), seeing=0.9)


def star(electrons):
    return Lights(np.array([4.0]), np.array([1000.0]), np.array([electrons]))


# For each effect what makes it large, from far below its threshold to far above.
CASES = {
    "background": lambda x: scene(sky=0.01 * x),
    "pixel_area": lambda x: scene(sky=0.01 * x),
    "dispersed_sky": lambda x: replace(scene(), sky_change=np.full((3, 3), 0.01 * x)),
    "fringes": lambda x: replace(ground(des_z__fringes=min(1e-5 * x, 0.5)), band=passbands.load("des_z")),
    "satellite_trails": lambda x: replace(crossed(), zero_point=10.0 + 2.5 * np.log10(x)),
    "illumination": lambda x: scene(illumination=min(1e-4 * x, 0.5)),
    "shutter": lambda x: scene(shutter_map=min(0.05 * x, 280.0)),
    "pixel_response": lambda x: scene(
        peak=200.0, prnu=min(3e-3 * x, 0.5), dead_pixels=0.0, dark_columns=0.0, dust_depth=min(1e-3 * x, 1.0)
    ),
    "readout_trail": lambda x: scene(readout_time=0.3 * x),
    "brighter_fatter": lambda x: scene(peak=3e3 * x),
    "poisson": lambda x: scene(sky=1e-6 * x, peak=1e-3 * x),
    "dark_current": lambda x: scene(dark_current=2e-3 * x),
    "hot_pixels": lambda x: scene(hot_pixels=0.01, hot_current=2e-3 * x),
    "charge_injection": lambda x: scene(injection__level=x),
    "injection_noise": lambda x: scene(injection__level=1e4, injection__noise=x),
    "trap_pumping": lambda x: scene(pumping__phase_time=1e-6 * x),
    "calibration_lamp": lambda x: scene(flat__signal=x),
    "bleeding": lambda x: scene(peak=2e5 - 141 + (x - 1)),
    "parallel_cti": lambda x: scene(cti__age=1e-4 * x),
    "serial_cti": lambda x: scene(cti__age=3e-4 * x),
    "tree_rings": lambda x: ground(tree_rings__amplitude=min(1e-5 * x, 0.1)),
    "edge_displacement": lambda x: ground(edge__shift=min(1e-5 * x, 0.5)),
    "parallel_loss": lambda x: ground(cti__parallel=min(1e-8 * x, 1e-3)),
    "serial_loss": lambda x: ground(cti__serial=min(1e-8 * x, 1e-3)),
    "nonlinearity": lambda x: scene(nonlinearity__low=min(1e-4 * x, 0.9), nonlinearity__high=1e-4 * x),
    "crosstalk": lambda x: scene(crosstalk=min(1e-4 * x, 0.1)),
    "detector_crosstalk": lambda x: replace(
        scene(crosstalk_detectors=1e-4), neighbour_charge=NeighbourCharge(np.array([0]), np.array([1e3 * x]))
    ),
    "bias_structure": lambda x: scene(bias_offset=0.1 * x, bias_settling=0.1 * x, bias_stripes=0.1 * x),
    "bias_drift": lambda x: replace(scene(bias_drift=0.1 * x), mjd=60905.0),
    "row_noise": lambda x: scene(bias_row_noise=0.1 * x),
    "read_noise": lambda x: scene(sky=10.0, read_noise=x),
    "ghosts": lambda x: scene(lights=star(1e8 * x)),
    "lens_ghosts": lambda x: replace(ground(), lights=star(1e7 * x), band=passbands.load("des_r")),
    "straylight": lambda x: scene(lights=star(1e9 * x)),
}
# Effects with different values in every frame. Dark current also has a mean.
RANDOM = ("poisson", "read_noise", "injection_noise", "dark_current")
QUADRANTS = (
    "parallel_cti",
    "serial_cti",
    "parallel_loss",
    "serial_loss",
    "crosstalk",
    "detector_crosstalk",
    "bias_structure",
    "bias_drift",
    "row_noise",
    "readout_cosmic_rays",
)


def frame(name, one):
    """Return a frame for the effect, with sky and a star of the scene's peak."""
    y, x = np.mgrid[:NY, :NX]
    light = one.sky_electrons + one.peak_electrons * np.exp(-((x - 4) ** 2 + (y - 2000) ** 2) / (2 * 0.7**2))
    if name == "crosstalk":
        return np.stack([light, *(np.full(light.shape, one.sky_electrons) for _ in range(3))])
    if name == "serial_cti":
        return light[1990:2010].repeat(256, axis=1)[None, ::-1].copy()
    if name == "serial_loss":
        return light[1990:2010].repeat(128, axis=1)[None, ::-1].copy()
    return light[None] if name in QUADRANTS else light


def test_no_effect_is_left_out_here():
    """Each that a scene may do without has its test below."""
    optional = {name for name, effect in EFFECTS.items() if effect.optional}
    up_the_ramp = {*test_ramp_thresholds.CASES, *test_ramp_thresholds.ALWAYS}
    # Ghosts of another plate are ghosts.
    assert optional == set(CASES) | up_the_ramp | {"cosmic_rays", "readout_cosmic_rays", "filter_ghosts"}
    assert vis.TRANSFER_EFFECT.optional


@pytest.mark.parametrize("name", CASES)
def test_effects_that_are_left_out_are_not_noticeable(name):
    """Sample of eight columns; for random effects, a significance of 6e-7 of their mean (5 standard errors)."""
    effect = EFFECTS[name]
    needed = []
    for size in np.geomspace(1e-5, 1e4, 19):
        one = CASES[name](size)
        needed.append(effect.is_needed(one))
        if needed[-1]:
            continue
        before = frame(name, one)
        parameters = effect.parameters(one)
        if name in ("illumination", "shutter", "calibration_lamp"):
            *level, columns, rows = parameters
            parameters = (*level, columns[:NX], rows)
        if name == "pixel_area":
            electrons, u, v, stretch = parameters
            parameters = (electrons, u[:NX], v, stretch)
        change = effect.apply(before, *parameters, rng=np.random.default_rng(1)) - before
        assert np.sqrt(np.mean(change**2)) < NOTICEABLE * one.pixel_noise
        assert np.abs(change).max() < one.pixel_noise
        # The bias of a mean of STACK_SIZE frames or pixels is less than a tenth of its noise.
        left = NOTICEABLE * one.pixel_noise / np.sqrt(STACK_SIZE)
        chance = 5.0 * change.std() / np.sqrt(change.size) if name in RANDOM else 0.0
        assert abs(change.mean()) < left + chance
        if name not in RANDOM:
            assert np.sqrt(np.mean(change**2)) < left
    # Both sides were seen, and the larger side is the needed one.
    assert sorted(needed) == needed
    assert len(set(needed)) == 2


@pytest.mark.parametrize("name", ["cosmic_rays", "readout_cosmic_rays"])
def test_cosmic_rays_are_always_needed_but_without_time(name):
    effect = EFFECTS[name]
    assert effect.is_needed(scene())
    nothing = Scene(MISSION, "vis", 0.0, 0.25, 0.0, DETECTOR)
    assert effect.is_needed(nothing) == (name == "readout_cosmic_rays")


def test_a_pixel_s_own_response_is_left_out_of_faint_stars():
    """It is part of how they are drawn: five times five pixels of each."""
    detector, needed = small("vis", "3-4", 256), []
    for mag in (29.5, 26.0, 22.0):
        with_it, without = (
            nominal.rendered(detector, [mag], [31.8], [32.3], forced={**nominal.off(*nominal.COSMIC_RAYS), **forced})
            for forced in ({vis.TRANSFER_EFFECT.name: True}, {vis.TRANSFER_EFFECT.name: False})
        )
        needed.append(vis.TRANSFER_EFFECT.is_needed(with_it.scene))
        change = (with_it.noise_free.astype(float) - without.noise_free)[30:35, 30:35]
        noticed = np.sqrt(np.mean(change**2)) / with_it.scene.pixel_noise
        assert noticed > 0.0
        if not needed[-1]:
            assert noticed < NOTICEABLE / np.sqrt(STACK_SIZE)
    assert sorted(needed) == needed
    assert len(set(needed)) == 2
    assert noticed > NOTICEABLE


@pytest.mark.parametrize("mag", [pytest.param(14.0, marks=pytest.mark.nightly), 20.0, 24.0, 27.0])
def test_all_effects_that_are_left_out_are_not_noticeable_together(mag):
    """Stars so faint that little is needed, or so bright that next to everything is.

    Sample of 256 x 256 pixels; significance 6e-7 of the mean (5 standard errors).
    """
    x, y = nominal.lattice(256, 64)
    one = nominal.rendered(small("vis", "3-4", 256), np.full(len(x), mag), x, y)
    # Before it is rounded.
    effects = [effect for effect in vis.SKY if effect.name != "adc"]

    def read(forced):
        light = one.noise_free.astype(float)
        return apply_all(light, effects, replace(one.scene, forced=forced), lambda e: rng.stream(1, e.name))

    found, decisions = read({})
    left_out = {decision.name: True for decision in decisions if not decision.applied}
    assert left_out
    change = read(left_out)[0] - found
    assert 0.0 < np.sqrt(np.mean(change**2)) < NOTICEABLE * one.scene.pixel_noise, left_out
    # Nor in the mean of the sky: what is left out of every pixel is seen there.
    biased = NOTICEABLE * one.scene.pixel_noise / np.sqrt(STACK_SIZE)
    assert abs(change.mean()) < biased + 5.0 * change.std() / np.sqrt(change.size), left_out


def test_a_quicklook_leaves_out_no_more_than_the_error_that_it_allows():
    """The image with the effects that a survey applies is the reference; a draft applies the same ones.

    Sample of 256 x 256 pixels with 16 stars; significance 6e-7 of the mean (5 standard errors).
    """
    x, y = nominal.lattice(256, 64)
    one = nominal.rendered(small("vis", "2-5", 256), np.linspace(18.0, 26.0, len(x)), x, y, seconds=450.0)
    # Before it is rounded.
    effects = [effect for effect in vis.SKY if effect.name != "adc"]

    def read(allowed):
        light, of_one = one.noise_free.astype(float), replace(one.scene, accuracy=allowed)
        frame, decisions = apply_all(light, effects, of_one, lambda e: rng.stream(1, e.name))
        return frame, {decision.name for decision in decisions if decision.applied}

    (quick, few), (_, drafted), (fine, needed) = (read(each) for each in (QUICKLOOK, DRAFT, SURVEY))
    assert needed - few == {"pixel_area", "dark_current", "row_noise"}
    assert needed == drafted
    noise, change = one.scene.pixel_noise, fine - quick
    assert 0.0 < np.sqrt(np.mean(change**2)) < QUICKLOOK.background * noise
    # What repeats in every pixel may be 25 times as large as in a survey, because 25 times the background may be wrong.
    biased = QUICKLOOK.background / SURVEY.background * NOTICEABLE * noise / np.sqrt(STACK_SIZE)
    assert abs(change.mean()) < biased + 5.0 * change.std() / np.sqrt(change.size)


@pytest.mark.parametrize("seconds", [1.0, 100.0, 565.0])
def test_a_stack_of_darks_has_its_dark_current(seconds):
    """However little a frame has of it: left out, a thousand frames would show it."""
    one = Scene(MISSION, "vis", seconds, 0.0, 0.0, DETECTOR)
    bias = one.dark_electrons * np.sqrt(STACK_SIZE) / one.pixel_noise
    assert EFFECTS["dark_current"].is_needed(one) == (bias > NOTICEABLE)
    assert (bias > NOTICEABLE) == (seconds > 50.0)


def test_tracks_bleed_where_they_do_not_fit():
    """In a dark, too: a pixel of 5000 e- does not hold what a cosmic ray may leave."""
    small_well = scene(sky=0.0, peak=0.0, full_well=5e3)
    assert not EFFECTS["bleeding"].is_needed(small_well)
    assert EFFECTS["bleeding"].is_needed(replace(small_well, track_electrons=cosmic_rays.brightest_pixel(small_well)))


@pytest.mark.parametrize(
    ("kind", "seconds", "sky"), [("dark", 565.0, 0.0), ("bias", 0.0, 0.0), ("science", 560.5, 0.2)]
)
def test_nothing_is_missing_where_cosmic_rays_alone_are_bright(kind, seconds, sky):
    """All effects of a frame without sources, tracks and all: what one more that is left out would change."""
    one = nominal.rendered(small("vis", "3-4", 256), [], [], [], kind=kind, seconds=seconds, sky=sky)
    # Before it is rounded.
    effects = [effect for effect in vis.EFFECTS[kind] if effect.name != "adc"]

    def read(forced):
        return apply_all(
            np.zeros((256, 256)), effects, replace(one.scene, forced=forced), lambda e: rng.stream(1, kind, e.name)
        )

    found, decisions = read({})
    assert any(decision.applied for decision in decisions if "cosmic_rays" in decision.name)
    for decision in decisions:
        if not decision.applied:
            change = read({decision.name: True})[0] - found
            assert np.sqrt(np.mean(change**2)) < NOTICEABLE * one.scene.pixel_noise, decision.name
