"""VIS as a whole: stars, a galaxy, the zodiacal light and flats agree with published or derived values."""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from tests.truesky.render import fields
from tests.truesky.render.fields import MISSION, fluxes, galaxies, small, stars
from truesky.randomness.rng import stream
from truesky.render.camera import astrometry, pointing
from truesky.render.channels import vis
from truesky.render.effects.charge import brighter_fatter
from truesky.render.effects.effect import apply_all
from truesky.render.effects.readout import nonlinearity
from truesky.render.effects.scene import Scene
from truesky.render.planning import planned_exposures
from truesky.request.accuracy import SURVEY

NOMINAL = MISSION.value("vis.exposure_time", "s")
SIDE = 64


def rendered(mission=MISSION, mag=20.0, body=None, x=SIDE / 2, y=SIDE / 2):
    """Render one source (or several points) in a nominal exposure."""
    detector = small("vis", "3-4", SIDE)
    ra, dec, angle = pointing.boresight_for(detector, 53.1, -27.8, 0.0)
    exposed = {
        "exposure_id": 1, "channel": "VIS", "camera": "vis", "band": "euclid_vis", "image_type": "science",
        "ra": ra, "dec": dec, "position_angle": angle, "mjd": 60905.0, "exposure_time_s": NOMINAL, "seeing": 0.0,
        "sky": 0.25, "zero_point": planned_exposures.zero_point_of("vis", "euclid_vis", mission),
    }  # fmt: skip
    system = astrometry.wcs(detector, ra, dec, angle)
    where = astrometry.sky_of_pixel(system, np.atleast_1d(x), np.atleast_1d(y))
    bodies = galaxies(*where, **(body or {}))
    points = stars(*where)
    bodies, points = (bodies, points.slice(0, 0)) if body else (bodies.slice(0, 0), points)
    flux = 10 ** (-0.4 * (mag - 23.9))
    tables = bodies, fluxes(bodies, "euclid_vis", flux), points, fluxes(points, "euclid_vis", flux)
    return fields.rendered(exposed, detector, tables, mission, SURVEY)


def test_stars_saturate_at_the_published_magnitude():
    """Nine stars are at different positions within a pixel."""
    x, y = (10.0 + 20.0 * i + i / 3 - 1 / 3 for i in np.mgrid[:3, :3])
    one = rendered(mag=20.0, x=x.ravel(), y=y.ravel())
    peaks = [one.noise_free[round(b) - 2 : round(b) + 3, round(a) - 2 : round(a) + 3].max()
             for a, b in zip(x.ravel(), y.ravel(), strict=True)]  # fmt: skip
    room = MISSION.value("vis.full_well") - one.scene.sky_electrons
    assert 20.0 - 2.5 * np.log10(room / np.mean(peaks)) == pytest.approx(17.8, abs=0.15)


@pytest.mark.parametrize(
    ("ladder", "least", "most"), [(None, 18.4, 22.6), (("REQ", "DES", "BLT", "CBE", "SIM"), 10, 25)]
)
def test_signal_to_noise_of_a_weak_lensing_galaxy_is_as_required(ladder, least, most):
    """The galaxy is exponential with r_e = 0.3" and I_E = 24.5, in an aperture of 1.3" and four exposures."""
    mission = resolve(ladder=ladder) if ladder else MISSION
    one = rendered(mission, 24.5, {"disk_half_light_radius": 0.3})
    y, x = np.mgrid[:SIDE, :SIDE] - SIDE / 2
    inside = np.hypot(x, y) < 6.5
    signal = one.noise_free[inside].sum()
    noise = np.sqrt(signal + inside.sum() * (one.scene.pixel_noise**2 + mission.value("vis.gain") ** 2 / 12))
    assert least <= 2.0 * signal / noise <= most


def flats(level, side, forced, seconds=10.0):
    """Return two flats of the same detector, in electrons above the column means of the biases."""
    # All quadrants are equal, and the bias does not drift.
    equal = {
        key: (MISSION.value(key), MISSION.parameter(key).unit) for key in ("vis.gain", "vis.read_noise", "vis.bias")
    }
    mission = resolve(overrides={
        "vis.flat.signal": (level, "electron"), "vis.flat.illumination": (0.0, ""), "vis.flat.gradient": (0.0, ""),
        "vis.bias_drift": (0.0, "adu"), "vis.bias_row_noise": (0.0, "adu"), **equal,
    })  # fmt: skip
    scene = Scene(mission, "vis", seconds, 0.25, 0.0, small("vis", "3-4", side))
    dark = replace(scene, exposure_time_s=0.0, sky_rate=0.0)

    def read(effects, one, number):
        def own(effect):
            return stream(1, "vis" if effect.fixed else number, effect.name)

        frame, _ = apply_all(np.zeros((side, side)), effects, replace(one, forced=forced), own)
        return frame[:, : side // 2, 51 : 51 + side // 2] * mission.value("vis.gain")

    bias = np.mean([read(vis.EFFECTS["bias"], dark, number) for number in (10, 11)], axis=(0, 2), keepdims=True)[0]
    return [read(vis.FLAT, scene, number) - bias for number in range(2)]


OFF = dict.fromkeys(("cosmic_rays", "readout_cosmic_rays", "hot_pixels"), False)
LINEAR = OFF | dict.fromkeys(("brighter_fatter", "nonlinearity", "parallel_cti", "serial_cti", "crosstalk"), False)


def test_photon_transfer_gives_back_gain_and_read_noise():
    gain, read_noise = MISSION.value("vis.gain"), MISSION.value("vis.read_noise")
    pairs = [flats(level, 512, LINEAR) for level in (0.0, 2e3, 1e4, 3e4)]
    adu = np.array([np.mean(a + b) / 2 for a, b in pairs]) / gain
    variance = np.array([np.var(a - b) / 2 for a, b in pairs]) / gain**2
    slope, level = np.polyfit(adu, variance, 1, w=1 / (variance + 1))
    assert 1 / slope == pytest.approx(gain, rel=0.01)
    assert np.sqrt(level - 1 / 12) * gain == pytest.approx(read_noise, rel=0.01)


def test_the_curvature_of_photon_transfer_is_the_predicted_one():
    """The brighter-fatter effect reduces the variance, and so does non-linearity."""
    level = 1.2e5
    forced = OFF | dict.fromkeys(("brighter_fatter", "nonlinearity", "crosstalk", "parallel_cti", "serial_cti"), True)
    a, b = flats(level, 768, forced)
    scene = Scene(MISSION, "vis", 10.0, 0.25, 0.0)
    parameters = nonlinearity.EFFECT.parameters(scene)
    there = nonlinearity.linearise(np.array([np.mean(a + b) / 2]), *parameters)
    slope = np.diff(nonlinearity.apply(np.array([there[0] - 50, there[0] + 50]), *parameters))[0] / 100
    noise = MISSION.value("vis.read_noise") ** 2 + MISSION.value("vis.gain") ** 2 / 12
    found = (np.var(a - b) / 2 - noise) / there[0]
    softness = brighter_fatter.EFFECT.parameters(scene)
    expected = slope**2 * (1 - brighter_fatter.variance_slope(*softness[:2]) * there[0])
    assert 1 - expected > 0.08
    assert 1 - found == pytest.approx(1 - expected, rel=0.1)
