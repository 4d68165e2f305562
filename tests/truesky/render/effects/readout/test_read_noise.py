"""Prescan and overscan have read noise whatever the sky, with the same random numbers as if all pixels had it."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits

from lake_schema.mission.parameter import CAMERAS
from tests.truesky.render.fields import MISSION, small
from tests.truesky.render.products import test_tools as tools
from truesky.randomness import rng
from truesky.render.camera import detectors
from truesky.render.camera.sections import Section
from truesky.render.effects.effect import apply_all
from truesky.render.effects.readout import quadrants, read_noise
from truesky.render.effects.scene import Scene
from truesky.validation.lake.images.noise import read_variance
from truesky.validation.lake.measure import frames

SIDE = 512
# Sky in electrons per second and pixel whose noise in 100 s hides the read noise of each camera.
BRIGHT = 1e3


def scene_of(camera, sky=BRIGHT, **changed):
    one = small(camera, detectors.detectors(camera, MISSION)[0].name, SIDE)
    return replace(Scene(MISSION, one.section, 100.0, sky, 1e3, one), **changed)


def read(scene):
    """Return planes of a detector without light after the readout, and the decision about read noise."""
    split = quadrants.EFFECT if scene.section == "vis" else quadrants.AMPLIFIERS
    frame, decisions = apply_all(
        np.zeros((SIDE, SIDE)), (split, read_noise.EFFECT), scene, lambda effect: rng.stream(1, effect.name)
    )
    return frame, decisions[-1]


@pytest.mark.parametrize("camera", ["vis", *CAMERAS])
def test_prescan_and_overscan_have_read_noise_under_a_bright_sky(camera):
    """Sample of at least 3e3 pixels per amplifier or 1e5 per detector; significance 6e-7 (5 standard errors)."""
    scene = scene_of(camera)
    hidden, decision = read(scene)
    assert not decision.applied
    everywhere, _ = read(replace(scene, forced={"read_noise": True}))
    rows, columns = scene.pixels_in_plane
    scans = np.ones(hidden.shape, bool)
    scans[:, rows, columns] = False
    # Pixels of the detector have no read noise, and all others have that of the full effect.
    assert not hidden[~scans].any()
    np.testing.assert_array_equal(hidden[scans], everywhere[scans])
    assert np.count_nonzero(hidden[scans]) == np.count_nonzero(scans)
    sigmas = np.broadcast_to(scene.amplifier_values("read_noise", "electron"), len(hidden))
    normals = np.concatenate([plane[out] / sigma for plane, out, sigma in zip(hidden, scans, sigmas, strict=True)])
    assert normals.std() == pytest.approx(1.0, abs=5.0 / np.sqrt(2.0 * normals.size))
    assert abs(normals.mean()) < 5.0 / np.sqrt(normals.size)


@pytest.mark.parametrize("camera", ["vis", "lsstcam"])
def test_the_request_switches_read_noise_off_everywhere(camera):
    frame, _ = read(scene_of(camera, forced={"read_noise": False}))
    assert not frame.any()


def test_a_faint_sky_has_read_noise_in_all_pixels():
    frame, decision = read(scene_of("lsstcam", sky=0.1))
    assert decision.applied
    assert frame.all()


def test_numbers_of_the_scans_do_not_depend_on_the_sky():
    """The same detector and exposure have the same overscan, whether or not read noise is left out of the pixels."""
    scans, (bright, faint) = slice(-20, None), (read(scene_of("lsstcam", sky=sky))[0] for sky in (BRIGHT, 0.1))
    np.testing.assert_array_equal(bright[:, :, scans], faint[:, :, scans])


def test_the_overscan_of_a_file_has_the_noise_of_its_header(tmp_path):
    """Sample of 512 x 54 pixels in each of 16 amplifiers; significance 6e-7 (5 standard errors)."""
    one = tools.stars_on("lsstcam", BRIGHT, small("lsstcam", "R22_S11", 1024), mission=MISSION, way="amplifiers")
    assert not next(d for d in one.decisions if d.name == "read_noise").applied
    path = tools.put(one, tmp_path).path
    with fits.open(path) as units:
        for unit in units[1:]:
            bias = unit.data[Section.from_text(unit.header["BIASSEC"]).slices].astype(float)
            noise = np.hypot(unit.header["RDNOISE"] / unit.header["GAIN"], np.sqrt(1.0 / 12.0))
            assert bias.std() == pytest.approx(noise, abs=5.0 * noise / np.sqrt(2.0 * bias.size))
            # The pixels of the detector have none: their header says so.
            assert unit.header["RDNDRAWN"] == 0.0
    # A check of the noise of the sky does not add the noise of the overscan.
    for amplifier in frames.open_frame(path).amplifiers:
        assert amplifier.noise > 4.0
        assert read_variance(amplifier) == pytest.approx(amplifier.gain**2 / 12.0)
