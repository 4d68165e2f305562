"""The sky of a detector: a plane over the field of view in twilight, otherwise a constant."""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from lake_schema.tables.exposures import ExposureRow
from truesky.render.camera import detectors, pointing
from truesky.render.camera.windows import Window
from truesky.render.effects.light import background
from truesky.render.exposure import scene_factory
from truesky.request.accuracy import SURVEY

MISSION = resolve()
ROW = ExposureRow(
    1, "EXT", "lsstcam", "lsst_r", "science", 30.0, -40.0, 25.0, 60999.0, 30.0, 40.0, 0.7, 28.3, "test",
    sky_slope_x=0.05, sky_slope_y=-0.08,
)  # fmt: skip


def sky_of(name, row=ROW, window=None):
    """Return the electrons of the sky on a detector, or on a window of it."""
    scene = scene_factory.from_exposure(row, detectors.detector(row.camera, name, MISSION), MISSION, SURVEY)
    shape = (scene.ny, scene.nx)
    if window is not None:
        scene, shape = replace(scene, window=window), (window.ny, window.nx)
    return background.apply(np.zeros(shape), *background.parameters(scene))


@pytest.mark.parametrize(("camera", "name"), [("lsstcam", "R22_S11"), ("lsstcam", "R10_S00"), ("decam", "S29")])
def test_the_sky_is_a_plane_over_the_field(camera, name):
    detector = detectors.detector(camera, name, MISSION)
    sky = sky_of(name, replace(ROW, camera=camera))
    # Corners in the order of the outline: (first column, first row), (last, first), (last, last), (first, last).
    x, y = (axis[0, 1:] / 3600.0 for axis in pointing.outline((detector,)))
    corners = np.array([sky[0, 0], sky[0, -1], sky[-1, -1], sky[-1, 0]])
    assert corners == pytest.approx(1200.0 * (1.0 + 0.05 * x - 0.08 * y), rel=1e-4)


def test_neighbouring_detectors_and_windows_have_the_same_sky():
    left, right = sky_of("R22_S11"), sky_of("R22_S12")
    assert left[:, -1].mean() == pytest.approx(right[:, 0].mean(), rel=1e-3)
    window = Window(1000, 2000, 64, 32)
    assert np.array_equal(sky_of("R22_S11", window=window), left[2000:2032, 1000:1064])


def test_a_night_sky_is_constant():
    night = replace(ROW, sky_slope_x=0.0, sky_slope_y=0.0)
    assert set(sky_of("R10_S00", night).ravel()) == {1200.0}
    assert set(sky_of("R10_S00", replace(ROW, sky_slope_x=None, sky_slope_y=None)).ravel()) == {1200.0}


def test_steep_planes_are_never_negative():
    assert sky_of("R10_S00", replace(ROW, sky_slope_x=3.0)).min() >= 0.0
