"""Test maps of amplifiers, and the correction of their effects, for quadrants and ground cameras."""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from truesky.reduction import amplifiers
from truesky.render.camera import detectors
from truesky.render.channels import readout
from truesky.render.effects.readout import crosstalk, nonlinearity
from truesky.render.effects.scene import Scene

CAMERAS = (("vis", 8, 6), ("decam", 8, 6), ("megacam", 10, 8), ("lsstcam", 32, 16), ("gpc1", 64, 64))


def scene_of(camera, nx, ny, overrides=None):
    """Return the scene of a small detector; the detector of VIS has rows between its halves."""
    mission = resolve(overrides=overrides or {})
    one = detectors.detectors(camera, mission)[4]
    one = replace(one, nx=nx, ny=ny + 4, injection_rows=4) if camera == "vis" else replace(one, nx=nx, ny=ny)
    return Scene(mission, one.section, 100.0, 0.0, 5e4, one)


@pytest.mark.parametrize(("camera", "nx", "ny"), CAMERAS)
def test_planes_contain_all_pixels_in_another_order(camera, nx, ny):
    scene = scene_of(camera, nx, ny)
    frame = np.random.default_rng(1).uniform(1.0, 2.0, (scene.ny, scene.nx))
    unread = amplifiers.unread_pixels(scene)
    again = readout.assemble_frame(readout.split_frame(frame, scene), scene)
    np.testing.assert_array_equal(again, np.where(unread, 0.0, frame))
    assert unread.any() == (camera == "vis")


def test_values_of_amplifiers_are_on_their_pixels():
    found = amplifiers.to_pixels(np.array([1.0, 2.0, 3.0, 4.0]), scene_of("vis", 6, 8))
    assert [found[-1, 0], found[-1, -1], found[0, -1], found[0, 0]] == [1, 2, 3, 4]
    assert not found[4:8].any()
    assert amplifiers.to_pixels(3.0, scene_of("vis", 6, 8)) == 3.0
    scene = scene_of("lsstcam", 32, 16)
    found = amplifiers.to_pixels(np.arange(16.0), scene)
    for number, amplifier in enumerate(scene.layout.amplifiers):
        assert np.all(found[amplifier.pixels.slices] == number)
    np.testing.assert_array_equal(amplifiers.to_pixels(np.arange(16.0), scene, slice(5, 11)), found[5:11])
    frame = np.random.default_rng(3).integers(0, 16, found.shape)
    np.testing.assert_array_equal(amplifiers.pixels_at_least(frame, np.arange(16.0), scene), frame >= found)
    np.testing.assert_array_equal(amplifiers.pixels_at_least(frame, 7.0, scene), frame >= 7)


@pytest.mark.parametrize("camera", ["vis", "decam", "lsstcam", "gpc1"])
def test_effects_of_amplifiers_are_undone(camera):
    """Each amplifier has another gain and response; the crosstalk has the largest allowed value."""
    vis = {"vis.gain.E": (3.0, "electron / adu"), "vis.crosstalk": (1e-3, "")}
    # So many rows of each amplifier that they are taken in more than one piece.
    nx, ny = (64, 16) if camera == "gpc1" else (32, 4 * amplifiers._ROWS + 6)
    scene = scene_of(camera, nx, ny, vis if camera == "vis" else None)
    came = np.random.default_rng(2).uniform(0.0, 8e4, (scene.ny, scene.nx))
    came[amplifiers.unread_pixels(scene)] = 0.0
    curve = nonlinearity.parameters(scene)
    assert any(np.ndim(number) for number in curve)
    given = nonlinearity.apply(readout.split_frame(came, scene), *curve)
    read = readout.assemble_frame(crosstalk.apply(given, crosstalk.coefficients(scene)), scene)
    assert np.abs(read - came).max() > 10.0
    found = amplifiers.undo_effects(read.copy(), scene, {"crosstalk", "nonlinearity"})
    np.testing.assert_allclose(found, came, atol=1e-3)
    left = amplifiers.undo_effects(read.copy(), scene, {"crosstalk"})
    np.testing.assert_allclose(left, readout.assemble_frame(given, scene), atol=1e-3)
    np.testing.assert_array_equal(amplifiers.undo_effects(read.copy(), scene, ()), read)
