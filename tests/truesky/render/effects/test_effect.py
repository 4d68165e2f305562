"""The loop over effects: what a scene needs, what a request forces, and who draws which numbers."""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from truesky.randomness.rng import stream
from truesky.render.channels import ground, nisp_p, nisp_s, registry, vis
from truesky.render.effects.effect import Effect, apply_all, decide
from truesky.render.effects.scene import Scene
from truesky.render.exposure import truth_maps
from truesky.render.exposure.truth_maps import BYTES_PER_PIXEL
from truesky.request import schema
from truesky.request.accuracy import PRESETS

SCENE = Scene(resolve(), "vis", 560.0, 0.25, 1e4)
NAMES = ["background", "poisson", "dark_current", "bleeding", "read_noise", "adc"]
# Effects of a detector that is read as one frame.
SOME = tuple(effect for effect in ground.SKY if effect.name in NAMES)


def run(effects, frame, scene=SCENE, forced=None, seed=1):
    scene = replace(scene, forced=forced or {})
    return apply_all(frame, effects, scene, lambda effect: stream(seed, 7, "3-4", effect.name))


# The effects of each chain have this order in every channel that has them.
ORDER = (
    # Light falls on pixels, is counted once, and is charge from then on.
    (
        "ghosts",
        "background",
        "illumination",
        "shutter",
        "pixel_response",
        "tree_rings",
        "edge_displacement",
        "poisson",
        "brighter_fatter",
        "dark_current",
    ),
    ("straylight", "illumination"),
    ("ghosts", "filter_ghosts", "background"),
    ("background", "pixel_area", "pixel_response"),
    # A fixed part of the sky's light, which vignetting dims as it does satellites'.
    ("lens_ghosts", "satellite_trails", "background", "pixel_area", "fringes", "illumination", "poisson"),
    ("readout_trail", "poisson"),
    ("calibration_lamp", "pixel_response"),
    # All charge fills wells before it is read; what hits the register meanwhile misses the way down the columns.
    ("dark_current", "hot_pixels", "bleeding"),
    ("poisson", "cosmic_rays", "bleeding", "quadrants", "parallel_cti", "readout_cosmic_rays", "serial_cti"),
    ("charge_injection", "injection_noise", "trap_pumping", "dark_current", "bleeding"),
    ("dark_current", "bleeding", "amplifiers", "parallel_loss", "serial_loss", "nonlinearity"),
    # Charge is read before it is amplified and converted.
    ("serial_cti", "nonlinearity", "crosstalk", "detector_crosstalk", "bias_structure", "read_noise", "adc"),
    ("bias_structure", "bias_drift", "row_noise", "read_noise"),
    # A ramp counts all that is expected, and what hits meanwhile; a pixel's capacity bends what it holds.
    (
        "background",
        "dispersed_sky",
        "pixel_area",
        "chromatic_response",
        "pixel_response",
        "dark_map",
        "persistence",
        "ramp_cosmic_rays",
        "ramp",
    ),
    ("calibration_lamp", "lamp_response", "pixel_response", "dark_map"),
    ("ramp_cosmic_rays", "ramp_nonlinearity", "ramp", "ipc"),
    # Neighbours see charge, not the noise of reading; the signal is estimated of groups as read, then converted.
    ("ramp", "ipc", "reset_level", "group_noise", "drift", "output_gain", "macc", "signal_nonlinearity"),
    ("macc", "signal_adc"),
)


CHAINS = dict.fromkeys(effects for channel in (vis, nisp_p, nisp_s, ground) for effects in channel.EFFECTS.values())


@pytest.mark.parametrize("effects", CHAINS)
def test_the_order_of_physics(effects):
    names = [effect.name for effect in effects]
    assert len(set(names)) == len(names)
    assert names[-1] in ("adc", "signal_adc")
    for chain in ORDER:
        assert [name for name in names if name in chain] == [name for name in chain if name in names]


def test_every_effect_has_its_place():
    named = {name for chain in ORDER for name in chain} | {vis.TRANSFER_EFFECT.name}
    assert named == set(schema.EFFECTS)
    for effects in vis.EFFECTS.values():
        assert effects[-len(vis.EFFECTS["bias"]) :] == vis.EFFECTS["bias"]


def test_a_request_may_name_every_effect():
    """Effects of every channel may be named, also those that act while sources are drawn; other names may not."""
    channels = registry.CHANNELS.values()
    found = [effect for channel in channels for effects in channel.effects.values() for effect in effects]
    found += [channel.transfer_effect for channel in channels if channel.transfer_effect is not None]
    assert sorted(schema.EFFECTS) == sorted({effect.name for effect in found})
    assert set(schema.ALWAYS_ON) == {effect.name for effect in found if not effect.optional}


def test_pixel_noise_is_sky_dark_and_reading():
    mission = SCENE.mission
    dark, read = mission.value("vis.dark_current"), mission.value("vis.read_noise")
    assert SCENE.pixel_noise == pytest.approx(np.sqrt(0.25 * 560 + dark * 560 + read**2))


def test_a_frame_becomes_adu():
    frame = np.full((300, 300), 50.0)
    image, decisions = run(SOME, frame)
    assert [d.name for d in decisions] == NAMES
    assert (frame == 50.0).all()
    assert (image == np.rint(image)).all()
    expected = (50.0 + 140.0) / 3.48 + 1000
    assert image.mean() == pytest.approx(expected, abs=0.1)
    noise = np.sqrt(190.0 + 4.4**2) / 3.48
    assert image.std() == pytest.approx(np.hypot(noise, 12**-0.5), rel=0.02)


def test_frames_that_are_needed_later_are_not_changed():
    """Effects that work in place change neither the caller's frame nor a frame that is recorded."""
    first, second, third = (
        Effect(name, lambda frame, number, rng, out=None: np.add(frame, number, out=out), lambda scene, n=n: (n,),
               lambda scene: 1.0, optional=False, in_place=True)
        for n, name in enumerate("abc", 1)
    )  # fmt: skip
    frame, seen = np.zeros((3, 4)), []

    def record(name, before, after):
        seen.append((name, before.copy(), after.copy(), before is after))

    for recorded, expected in ((("b",), ["b"]), (None, ["a", "b", "c"]), ((), [])):
        seen.clear()
        found, _ = apply_all(frame, (first, second, third), SCENE, lambda effect: stream(1, 7), record, recorded)
        assert (frame == 0.0).all()
        assert (found == 6.0).all()
        assert [name for name, *_ in seen] == expected
        for name, before, after, same in seen:
            assert not same
            assert (after - before == "abc".index(name) + 1).all()


def test_effects_work_in_place_if_nothing_is_recorded():
    arrays = []

    def add(frame, rng, out=None):
        arrays.append((frame, out))
        return frame + 1.0 if out is None else np.add(frame, 1.0, out=out)

    effect = Effect("a", add, lambda scene: (), lambda scene: 1.0, optional=False, in_place=True)
    apply_all(
        np.zeros((3, 4)), (effect, effect, replace(effect, in_place=False), effect), SCENE, lambda e: stream(1, 7)
    )
    assert [out is None for _, out in arrays] == [True, False, True, False]
    assert all(out is None or out is frame for frame, out in arrays)


@pytest.mark.parametrize("name", BYTES_PER_PIXEL)
def test_effects_of_truth_maps_are_recorded(name):
    """The recorder uses frames of the effects that are listed for a map, and of no other effects."""
    recorded, record = truth_maps.recorded_effects([name]), truth_maps.map_recorder({}, SCENE, [name], None)
    for effect in schema.EFFECTS:
        if effect in recorded:
            with pytest.raises((AttributeError, TypeError, BadInput, KeyError)):
                record(effect, None, None)
        else:
            record(effect, None, None)


@pytest.mark.parametrize("seed", [1, 2])
def test_numbers_are_the_effects_own(seed):
    """Switching the dark current on leaves the shot noise and the read noise as they were."""
    frame = np.full((50, 50), 100.0)
    without, _ = run(SOME[:5], frame, forced={"dark_current": False}, seed=seed)
    with_dark, _ = run(SOME[:5], frame, forced={"dark_current": True}, seed=seed)
    extra = with_dark - without
    np.testing.assert_allclose(extra, np.rint(extra), atol=1e-9)
    assert 0 < extra.mean() < 1
    again, _ = run(SOME[:5], frame, forced={"dark_current": False}, seed=seed)
    np.testing.assert_array_equal(without, again)
    other, _ = run(SOME[:5], frame, forced={"dark_current": False}, seed=seed + 10)
    assert (other != without).any()


def test_margins_follow_the_accuracy():
    """Limits of `survey` and finer accuracies are equal; noise has the same limit at all accuracies."""
    (dark,) = (e for e in ground.SKY if e.name == "dark_current")
    (counted,) = (e for e in ground.SKY if e.name == "poisson")
    survey, draft, quick, reference = (replace(SCENE, accuracy=PRESETS[name]) for name in (
        "survey", "draft", "quicklook", "reference",
    ))  # fmt: skip
    for effect in (dark, counted):
        assert effect.margin(survey) == effect.margin(reference)
    assert dark.margin(survey) == pytest.approx(5.0 * dark.margin(draft))
    assert dark.margin(survey) == pytest.approx(25.0 * dark.margin(quick))
    assert counted.margin(survey) == counted.margin(draft) == counted.margin(quick)


def test_a_frame_is_changed_only_if_the_caller_allows_it():
    rays = [replace(e, apply=lambda frame, rng, out=None: _add_one(frame, out), parameters=lambda scene: ())
            for e in vis.SKY if e.name == "cosmic_rays"]  # fmt: skip
    scene = replace(SCENE, forced={"cosmic_rays": True})
    for reuse in (False, True):
        frame = np.zeros((4, 4))
        found, _ = apply_all(frame, rays, scene, lambda e: None, reuse_frame=reuse)
        assert (found == 1.0).all()
        assert (found is frame) == reuse
        assert frame.any() == reuse


def _add_one(frame, out):
    out = np.empty_like(frame) if out is None else out
    return np.add(frame, 1.0, out=out)


def test_what_a_request_forces_is_recorded():
    decisions = {d.name: d for d in decide(SOME, replace(SCENE, forced={"poisson": False, "dark_current": True}))}
    assert not decisions["poisson"].applied
    assert decisions["poisson"].forced
    assert decisions["dark_current"].applied
    assert decisions["read_noise"].applied
    assert not decisions["read_noise"].forced


def test_a_contribution_is_computed_once_for_a_decision():
    """Some take as long as the effect itself."""
    (dark,) = (e for e in ground.SKY if e.name == "dark_current")
    for kept in (None, lambda scene: 3.0):
        asked = []
        counted = replace(dark, contribution=lambda scene, asked=asked: asked.append(scene) or 2.0, systematic=kept)
        (decision,) = decide([counted], SCENE)
        assert len(asked) == 1
        assert decision.margin == pytest.approx(32.0 * (2.0 if kept is None else 3.0) / (0.1 * SCENE.pixel_noise))
        assert decision.applied


def test_unknown_effects_and_effects_that_cannot_be_off_are_refused():
    # Of another channel.
    assert len(decide(SOME, replace(SCENE, forced={"ghosts": True}))) == len(SOME)
    with pytest.raises(BadInput, match="adc"):
        decide(SOME, replace(SCENE, forced={"adc": False}))


def test_without_noise_every_change_is_noticeable():
    """A bias of an amplifier without noise."""
    silent = resolve(overrides={"vis.read_noise": (0.0, "electron")})
    bias = Scene(silent, "vis", 0.0, 0.0, 0.0)
    assert bias.pixel_noise == 0.0
    margins = {decision.name: decision.margin for decision in decide(vis.EFFECTS["bias"], bias)}
    assert margins["bias_structure"] == np.inf
    assert margins["read_noise"] == 0.0


def test_margins_tell_the_ratio():
    (dark,) = (e for e in ground.SKY if e.name == "dark_current")
    d = SCENE.dark_electrons
    # The margin is for a mean of 1024 frames, which keeps the mean and reduces the noise.
    assert dark.margin(SCENE) == pytest.approx(32.0 * d / (0.1 * SCENE.pixel_noise))
    (counted,) = (e for e in ground.SKY if e.name == "poisson")
    counts = np.sqrt(SCENE.peak_electrons + SCENE.sky_electrons)
    assert counted.margin(SCENE) == pytest.approx(counts / (0.1 * SCENE.pixel_noise))
    longer = replace(SCENE, exposure_time_s=1e5, sky_rate=0.0)
    assert dark.is_needed(longer)
    assert not dark.is_needed(replace(SCENE, exposure_time_s=0.1))
