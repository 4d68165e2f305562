"""Amplifiers of DECam, HSC and MegaPrime: sections and read corners of published headers and camera descriptions.

Charge, bias and crosstalk of all cameras follow the direction of the readout in the axes of the detector. The read
corners of LSSTCam are compared with its camera description in test_amplifiers_lsstcam.py.
"""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema.mission.parameter import CAMERAS
from tests.truesky.render.fields import MISSION
from truesky.render.camera import amplifiers, detectors
from truesky.render.effects.charge import bleeding
from truesky.render.effects.readout import bias_structure, charge_transfer, crosstalk

# Corners from which the pixels of each amplifier are read (L lower, U upper, L left, R right). obs_decam, obs_subaru
# and obs_cfht: readoutcorner of the amplifiers, 0 to 3 for LL, LR, UR, UL.
CORNERS = {
    ("decam", "S1"): {"A": "UR", "B": "UL"},
    ("decam", "S29"): {"A": "UR", "B": "UL"},
    ("decam", "N1"): {"A": "LL", "B": "LR"},
    ("decam", "N31"): {"A": "LL", "B": "LR"},
    ("hsc", "1_12"): {"1": "LL", "2": "LR", "3": "LL", "4": "LR"},
    ("hsc", "1_07"): {"1": "LL", "2": "LR", "3": "LL", "4": "LR"},
    ("megacam", "ccd02"): {"A": "LL", "B": "LR"},
    ("megacam", "ccd20"): {"A": "LL", "B": "LR"},
}  # fmt: skip
# Pixels, overscan columns, overscan rows and prescan columns of each amplifier in the raw file. S1: DATASECA,
# BIASSECA, POSTSECA and PRESECA of raw headers. N1: boxes of the amplifiers in obs_decam. HSC: T_EFMN11, T_OSMN11 and
# the like in raw headers of CCDs 37 and 50. MegaPrime: DSECA and BSECA of raw headers, without overscan rows.
SECTIONS = {
    ("decam", "S1"): (
        ("[1081:2104,51:4146]", "[2105:2154,51:4146]", "[1081:2104,1:50]", "[2155:2160,51:4146]"),
        ("[57:1080,51:4146]", "[7:56,51:4146]", "[57:1080,1:50]", "[1:6,51:4146]"),
    ),
    ("decam", "N1"): (
        ("[57:1080,1:4096]", "[7:56,1:4096]", "[57:1080,4097:4146]", None),
        ("[1081:2104,1:4096]", "[2105:2154,1:4096]", "[1081:2104,4097:4146]", None),
    ),
    ("hsc", "1_12"): (
        ("[9:520,50:4225]", "[521:536,50:4225]", "[9:520,4226:4241]", None),
        ("[553:1064,50:4225]", "[537:552,50:4225]", "[553:1064,4226:4241]", None),
        ("[1081:1592,50:4225]", "[1593:1608,50:4225]", "[1081:1592,4226:4241]", None),
        ("[1625:2136,50:4225]", "[1609:1624,50:4225]", "[1625:2136,4226:4241]", None),
    ),
    ("megacam", "ccd02"): (
        ("[33:1056,1:4612]", "[1:32,1:4612]", None, None),
        ("[1057:2080,1:4612]", "[2081:2112,1:4612]", None, None),
    ),
}  # fmt: skip
# Detectors of all types, small.
SMALL = [*CORNERS, ("jpcam", "ccd01"), ("gpc1", "XY01"), ("lsstcam", "R22_S22"), ("lsstcam", "R10_S02")]


def layout_of(camera, name, **changed):
    return amplifiers.layout(replace(detectors.detector(camera, name, MISSION), **changed), MISSION)


def corner_steps(amplifier):
    """Return the directions (columns, rows) on the detector from one pixel to the next one that is read."""
    return -1 if amplifier.read_right else 1, -1 if amplifier.read_top else 1


def middle(amplifier):
    """Return row and column of a pixel of an amplifier on the detector."""
    pixels = amplifier.pixels
    return pixels.y + pixels.ny // 2, pixels.x + pixels.nx // 2


@pytest.mark.parametrize(("camera", "name"), CORNERS)
def test_each_amplifier_is_read_from_its_published_corner(camera, name):
    found = {a.name: "LU"[a.read_top] + "LR"[a.read_right] for a in layout_of(camera, name).amplifiers}
    assert found == CORNERS[camera, name]


def test_amplifiers_of_the_same_name_lie_on_the_published_sides():
    """Amplifier A is on the right in the southern CCDs of DECam, which are read from the top."""
    for name, side in (("S1", 1024), ("N1", 0)):
        (a,) = (amplifier for amplifier in layout_of("decam", name).amplifiers if amplifier.name == "A")
        assert (a.pixels.x, a.pixels.nx) == (side, 1024)


@pytest.mark.parametrize(("camera", "name"), SECTIONS)
def test_sections_of_raw_files_are_published_ones(camera, name):
    layout = layout_of(camera, name)
    for number, expected in enumerate(SECTIONS[camera, name]):
        found = (
            layout.amplifier_data_section(number),
            layout.amplifier_bias_section(number),
            layout.amplifier_overscan_section(number),
            layout.amplifier_prescan_section(number),
        )
        assert all(section.text == text for section, text in zip(found, expected, strict=True) if text)


def test_megaprime_reads_the_columns_of_its_headers():
    """ASECA and ASECB of raw headers."""
    layout = layout_of("megacam", "ccd02")
    assert [layout.amplifier_raw_section(n).text for n in (0, 1)] == ["[1:1056,1:4612]", "[1057:2112,1:4612]"]


@pytest.mark.parametrize(("camera", "name"), SMALL)
def test_charge_is_deferred_away_from_the_corner(camera, name):
    """Charge that a transfer leaves behind is read later: it lies farther from the corner than the pixel."""
    layout = layout_of(camera, name, nx=256, ny=192)
    frame = np.zeros((192, 256))
    for amplifier in layout.amplifiers:
        frame[middle(amplifier)] = 1e5
    planes = layout.split(frame)
    for apply, axis in ((charge_transfer.apply_serial_loss, 0), (charge_transfer.apply_parallel_loss, 1)):
        read = layout.assemble(apply(planes, 1e-5))
        for amplifier in layout.amplifiers:
            row, column = middle(amplifier)
            step = corner_steps(amplifier)[axis]
            along = (0, step) if axis == 0 else (step, 0)
            assert read[row + along[0], column + along[1]] > 1.0
            assert read[row - along[0], column - along[1]] == 0.0


@pytest.mark.parametrize(("camera", "name"), SMALL)
def test_the_bias_settles_from_the_corner(camera, name):
    layout = layout_of(camera, name, nx=256, ny=192)
    pattern = bias_structure.apply(np.zeros(layout.planes_shape), 0.0, -3.0, 40.0, 0.0, np.random.default_rng(1))
    read = layout.assemble(pattern)
    for amplifier in layout.amplifiers:
        row = read[amplifier.pixels.slices][0][:: corner_steps(amplifier)[0]]
        np.testing.assert_allclose(row, -3.0 * np.exp(-(layout.prescan + np.arange(len(row))) / 40.0), rtol=1e-12)


@pytest.mark.parametrize(("camera", "name"), SMALL)
def test_crosstalk_is_at_the_same_distance_from_the_corner(camera, name):
    layout = layout_of(camera, name, nx=256, ny=192)
    source, frame, (up, across) = layout.amplifiers[-1], np.zeros((192, 256)), (5, 7)
    column_step, row_step = corner_steps(source)
    frame[source.pixels.slices][::row_step, ::column_step][up, across] = 1e5
    count = len(layout.amplifiers)
    read = layout.assemble(crosstalk.apply(layout.split(frame), np.full((count, count), 1e-4)))
    for amplifier in layout.amplifiers:
        column_step, row_step = corner_steps(amplifier)
        part = read[amplifier.pixels.slices][::row_step, ::column_step]
        assert part[up, across] == pytest.approx(1e5 if amplifier is source else 10.0)
        assert np.count_nonzero(part) == 1


@pytest.mark.parametrize(("camera", "name"), SMALL)
def test_bleeding_charge_leaves_at_the_serial_register(camera, name):
    """Charge that flows to the end of a column where the register is leaves; at the other end it is turned back."""
    layout = layout_of(camera, name, nx=256, ny=192)
    for first, past, is_above in layout.column_segments:
        frame = np.zeros((192, 1))
        for place, is_lost in ((past - 2, is_above), (first + 1, not is_above)):
            frame[:] = 0.0
            frame[place, 0] = 9.0 * 1000.0
            bled, lost = bleeding.bleed(frame, 1000.0, layout.column_segments)
            assert (lost > 0.0) == is_lost
            assert bled[:first].sum() == bled[past:].sum() == 0.0


def test_read_tops_of_segments_are_those_of_corners():
    """Columns of southern CCDs of DECam are read at their upper ends, all others of one row of amplifiers below."""
    for (camera, name), corners in CORNERS.items():
        assert layout_of(camera, name).column_segments == (
            (0, detectors.detector(camera, name, MISSION).ny, corners[min(corners)][0] == "U"),
        )


@pytest.mark.parametrize("camera", CAMERAS)
def test_raw_files_contain_each_prescan_and_overscan_pixel_next_to_its_own_amplifier(camera):
    """In the columns of an amplifier's pixels, rows of the raw image follow one another as they are read.

    This holds if one row of amplifiers covers the detector.
    """
    one = detectors.detectors(camera, MISSION)[0]
    layout = layout_of(camera, one.name, nx=256, ny=192)
    planes = np.arange(1, np.prod(layout.planes_shape) + 1).reshape(layout.planes_shape)
    raw = layout.to_raw_image(planes)
    if len({a.pixels.y for a in layout.amplifiers}) > 1:
        return
    for number, amplifier in enumerate(layout.amplifiers):
        data = layout.amplifier_data_section(number)
        columns = raw[:: corner_steps(amplifier)[1], data.x : data.x + data.nx][:, :: corner_steps(amplifier)[0]]
        np.testing.assert_array_equal(columns, planes[number][:, layout.pixels_in_plane[1]])
