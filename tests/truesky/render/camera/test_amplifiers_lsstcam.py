"""Amplifiers of LSSTCam: read corners, sizes and order as in the camera description of the observatory's pipeline."""

import numpy as np
import pytest

from tests.truesky.render.fields import MISSION
from truesky.render.camera import amplifiers, detectors
from truesky.render.camera.sections import Section
from truesky.render.effects.charge import bleeding
from truesky.render.effects.readout import bias_structure, charge_transfer, crosstalk

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


def corner_steps(amplifier):
    """Return the steps (column, row) away from the corner that the camera description gives for an amplifier."""
    kind = "e2v" if amplifier.pixels.nx == 512 else "itl"
    return tuple(-1 if flip else 1 for flip in FLIPS[kind][amplifier.name[1]])


def middle(amplifier):
    """Return the row and column of a pixel in the middle of an amplifier."""
    return amplifier.pixels.y + amplifier.pixels.ny // 2, amplifier.pixels.x + amplifier.pixels.nx // 2


def test_deferred_charge_trails_away_from_the_corner(maker):
    """A bright pixel of each amplifier leaves charge in the next pixel to be read, in both directions of transfer."""
    _, layout, _ = maker
    frame = np.zeros((layout.ny, layout.nx))
    for amplifier in layout.amplifiers:
        frame[middle(amplifier)] = 1e5
    planes = layout.split(frame)
    for apply, axis in ((charge_transfer.apply_serial_loss, 0), (charge_transfer.apply_parallel_loss, 1)):
        read = layout.assemble(apply(planes, 1e-5))
        for amplifier in layout.amplifiers:
            row, column = middle(amplifier)
            step = corner_steps(amplifier)[axis]
            along = (0, step) if axis == 0 else (step, 0)
            assert read[row + along[0], column + along[1]] > 100.0
            assert read[row - along[0], column - along[1]] == 0.0


def test_the_bias_settles_from_the_corner(maker):
    """The first column that is read lies in the prescan, so that pixels near the corner have the largest offset."""
    _, layout, _ = maker
    pattern = bias_structure.apply(np.zeros(layout.planes_shape), 0.0, -3.0, 40.0, 0.0, np.random.default_rng(1))
    read = layout.assemble(pattern)
    for amplifier in layout.amplifiers:
        row = read[amplifier.pixels.slices][0][:: corner_steps(amplifier)[0]]
        np.testing.assert_allclose(row, -3.0 * np.exp(-(layout.prescan + np.arange(len(row))) / 40.0), rtol=1e-12)


def test_crosstalk_is_at_the_same_distance_from_the_corner(maker):
    _, layout, _ = maker
    source = next(a for a in layout.amplifiers if a.name == "C13")
    frame = np.zeros((layout.ny, layout.nx))
    across, up = 20, 30
    column_step, row_step = corner_steps(source)
    part = frame[source.pixels.slices][::row_step, ::column_step]
    part[up, across] = 1e5
    coefficients = np.full((16, 16), 1e-4)
    read = layout.assemble(crosstalk.apply(layout.split(frame), coefficients))
    for amplifier in layout.amplifiers:
        column_step, row_step = corner_steps(amplifier)
        part = read[amplifier.pixels.slices][::row_step, ::column_step]
        expected = 1e5 if amplifier is source else 10.0
        assert part[up, across] == pytest.approx(expected)
        assert np.count_nonzero(part) == 1


def test_bleeding_charge_leaves_at_the_serial_register(maker):
    """Charge of a full column is lost at the edge of the sensor next to the corner, and turned back in its middle."""
    _, layout, _ = maker
    frame = np.zeros((layout.ny, 1))
    frame[10, 0] = frame[layout.ny - 11, 0] = 1e6
    bled, lost = bleeding.bleed(frame, 1000.0, layout.column_segments)
    assert lost > 0.0
    assert bled[0, 0] == bled[-1, 0] == 1000.0
    middle_only = np.zeros((layout.ny, 1))
    middle_only[layout.height - 1, 0] = 1e5
    bled, lost = bleeding.bleed(middle_only, 1000.0, layout.column_segments)
    assert lost == 0.0
    assert bled[layout.height :].sum() == 0.0
