"""Compare the model of a ramp's estimated signal with simulated ramps."""

from dataclasses import replace

import numpy as np
import pytest

from tests.truesky import nightly
from tests.truesky.render import infrared
from truesky.fluxes import passbands
from truesky.reduction.infrared import lamp_mix
from truesky.reduction.infrared.ramps import Estimator, RampNonlinearity
from truesky.render.effects.charge import ipc, ramp
from truesky.render.effects.readout import macc, ramp_noise

SIDE = 300
EVERY = {"drift", "ipc", "ramp_nonlinearity"}


def scene_of(kind="photometric"):
    return replace(infrared.rendered().scene, ramp=kind, exposure_time_s=infrared.TIME * (1 if kind[0] == "p" else 6.3))


def estimated(scene, signal, b=0.0, coupled=False, seed=1):
    """Return signals of SIDE x SIDE ramps with read noise and without drift."""
    rng, mode = np.random.default_rng(seed), ramp.mode_of_scene(scene)
    light = np.full((SIDE, SIDE), signal)
    frame = light if b == 0.0 else np.stack([light, 0 * light, 0 * light, 0 * light + b])
    groups = ramp.apply(frame, mode, 1.3e5, rng=rng)
    if coupled:
        groups = ipc.apply(groups, *ipc.EFFECT.parameters(scene), rng)
    noise = scene.value("read_noise", "electron")
    groups = ramp_noise.apply(groups, noise, mode.reads, rng)
    return macc.apply(groups, mode, noise, rng)


@pytest.mark.parametrize(("kind", "signal"), [("photometric", 1.7), ("photometric", 130.0), ("spectroscopic", 600.0)])
def test_bias_and_variance_are_those_of_drawn_ramps(kind, signal):
    scene = scene_of(kind)
    estimator = replace(Estimator.from_scene(scene, EVERY - {"drift"}), rounding=0.0)
    found = estimated(scene, signal, coupled=True)[0]
    error = found.std() / SIDE
    assert found.mean() - signal == pytest.approx(float(estimator.bias(np.array(signal))), abs=4 * error)
    assert found.var() == pytest.approx(float(estimator.variance(np.array(signal))), rel=0.02)
    # For comparison: the bias is a third of a per cent of a typical sky.
    assert -0.8 < float(estimator.bias(np.array(signal))) < -0.05


@nightly.parametrize(("kind", "signal"), [("photometric", 6e4), ("spectroscopic", 4e4)], (0,))
def test_nonlinearity_of_a_ramp_is_corrected(kind, signal):
    scene, b = scene_of(kind), 6e-7
    bend = RampNonlinearity.from_scene(scene, EVERY)
    found, misfit = estimated(scene, signal, b=b)
    seen = found.mean()
    assert seen < 0.98 * signal
    assert float(bend.nonlinear_signal(np.array(signal), np.array(b))) == pytest.approx(seen, rel=5e-4)
    assert float(bend.linearise(np.array(seen), np.array(b))) == pytest.approx(signal, rel=5e-4)
    straight = estimated(scene, signal)[1]
    more = float(bend.chi_square(np.array(signal), np.array(b)))
    assert misfit.mean() - straight.mean() == pytest.approx(more, rel=0.1, abs=0.1)


@pytest.mark.parametrize(
    ("band", "lamps"), [("euclid_y", (1, 2)), ("euclid_j", (2, 3)), ("euclid_h", (4, 5)), ("nisp_red", (2, 3, 4, 5))]
)
def test_a_mix_of_lamps_has_the_sky_s_colour(band, lamps):
    """The mean wavelength of its light is that of the sky, which corrects a response that is linear in wavelength."""
    from truesky.render.effects.light import calibration_lamp
    from truesky.render.sky import diffuse_light

    curve = passbands.load(band)
    scene = replace(scene_of(), band=curve)
    weights = lamp_mix.weights(scene, lamps)
    assert min(weights) >= 0.0
    assert sum(weights) == pytest.approx(1.0)
    x = curve.wavelength
    of_lamps = [
        np.average(x, weights=calibration_lamp.detected_photons(curve, lamp, "nisp", scene.mission)) for lamp in lamps
    ]
    of_sky = np.average(x, weights=diffuse_light.photons("nisp", 1.0, curve, scene.mission))
    assert np.dot(weights, of_lamps) == pytest.approx(of_sky, abs=0.002 * (x[-1] - x[0]))
    assert lamp_mix.weights(scene, lamps[:1]) == (1.0,)
