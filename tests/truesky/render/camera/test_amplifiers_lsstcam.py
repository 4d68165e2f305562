"""Amplifiers of LSSTCam: read corners, sizes and order as in the camera description of the observatory's pipeline."""

import numpy as np
import pytest

from tests.truesky.render.fields import MISSION
from truesky.render.camera import amplifiers, detectors
from truesky.render.camera.sections import Section

# Rubin Observatory, obs_lsst, policy/cameraHeader.yaml: amplifiers in the order of the extensions (hdu 1 to 16), and
# flipXY of C1x and C0x. The read corner of the array in the file is LL (lower left), so that flipXY tells the corner of
# the amplifier's pixels on the sensor that is read first.
NAMES = [*(f"C1{n}" for n in range(8)), *(f"C0{n}" for n in reversed(range(8)))]
FLIPS = {"e2v": {"1": (True, True), "0": (False, False)}, "itl": {"1": (True, True), "0": (True, False)}}
# rawDataBBox, rawSerialPrescanBBox, rawSerialOverscanBBox, rawParallelOverscanBBox: x0, y0, xsize, ysize.
BOXES = {
    "e2v": ((10, 0, 512, 2002), (0, 0, 10, 2002), (522, 0, 54, 2002), (10, 2002, 512, 46)),
    "itl": ((3, 0, 509, 2000), (0, 0, 3, 2000), (512, 0, 64, 2000), (3, 2000, 509, 48)),
}
# Each maker's sensor of which the observatory publishes headers of raw files.
SENSORS = {"e2v": "R22_S22", "itl": "R10_S02"}


@pytest.fixture(params=SENSORS)
def maker(request):
    """Return the maker, its layout of amplifiers, and pixels that are numbered on the sensor."""
    one = detectors.detector("lsstcam", SENSORS[request.param], MISSION)
    assert one.kind == request.param
    layout = amplifiers.layout(one, MISSION)
    return request.param, layout, np.arange(one.ny * one.nx).reshape(one.ny, one.nx)


def test_amplifiers_are_in_the_order_of_the_extensions(maker):
    _, layout, _ = maker
    assert [a.name for a in layout.amplifiers] == NAMES


def test_each_amplifier_is_read_from_the_corner_of_the_camera_description(maker):
    """Flipped as the description says, the plane of an amplifier is its part of the sensor: ixy is (n, row)."""
    kind, layout, frame = maker
    _, _, nx, ny = BOXES[kind][0]
    planes = layout.split(frame)
    for plane, amplifier in zip(planes, layout.amplifiers, strict=True):
        row, column = (int(digit) for digit in amplifier.name[1:])
        assert amplifier.pixels == Section(column * nx, row * ny, nx, ny)
        flip_x, flip_y = FLIPS[kind][amplifier.name[1]]
        assert (amplifier.read_right, amplifier.read_top) == (flip_x, flip_y)
        x, y, *_ = BOXES[kind][0]
        pixels = plane[y : y + ny, x : x + nx]
        on_sensor = frame[row * ny : (row + 1) * ny, column * nx : (column + 1) * nx]
        np.testing.assert_array_equal(pixels[:: -1 if flip_y else 1, :: -1 if flip_x else 1], on_sensor)


def test_planes_have_the_boxes_of_the_camera_description(maker):
    kind, layout, _ = maker
    data, prescan, overscan, rows = (Section(*box) for box in BOXES[kind])
    assert layout.planes_shape == (16, 2048, 576)
    assert (layout.prescan, layout.overscan, layout.overscan_rows) == (prescan.nx, overscan.nx, rows.ny)
    assert (data.x, overscan.x, rows.y) == (prescan.nx, data.x + data.nx, data.ny)
    for number in range(16):
        parts = layout.amplifier_sections(number)
        # The overscan columns are also read in the overscan rows; headers of LSSTCam name the rows of pixels only.
        assert (parts.data, parts.bias) == (data, Section(overscan.x, 0, overscan.nx, 2048))


# DETSEC of the first and last amplifier of each row, as the simulator imSim 0.6 and the camera description give it.
# Headers of the camera exchange rows of C0x and C1x, which obs_lsst names a known error.
PLACES = {
    "e2v": {"C10": "[512:1,4004:2003]", "C17": "[4096:3585,4004:2003]",
            "C07": "[3585:4096,1:2002]", "C00": "[1:512,1:2002]"},
    "itl": {"C10": "[509:1,4000:2001]", "C17": "[4072:3564,4000:2001]",
            "C07": "[4072:3564,1:2000]", "C00": "[509:1,1:2000]"},
}  # fmt: skip


def test_sections_on_the_sensor_are_in_the_direction_of_the_readout(maker):
    kind, layout, _ = maker
    for number, amplifier in enumerate(layout.amplifiers):
        parts = layout.amplifier_sections(number)
        if amplifier.name in PLACES[kind]:
            assert parts.ccd.text_along(parts.steps) == PLACES[kind][amplifier.name]
