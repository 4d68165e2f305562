"""Amplifiers of the ground cameras: each pixel is read exactly once, and the raw file contains its position."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from lake_schema.mission.parameter import CAMERAS
from tests.truesky.render.fields import MISSION
from truesky.render.camera import amplifiers, detectors
from truesky.render.camera.sections import Section
from truesky.render.effects.scene import Scene

GAIN = "electron / adu"
# Published numbers of rows and columns of raw files.
RAW = {"decam": (4146, 2160), "megacam": (4644, 2112), "hsc": (4241, 2144)}


def first(camera, **changed):
    return replace(detectors.detectors(camera, MISSION)[0], **changed)


def layout_of(detector, mission=MISSION):
    return amplifiers.layout(detector, mission)


@pytest.mark.parametrize("camera", CAMERAS)
def test_every_pixel_is_read_once_and_found_again(camera):
    """Each pixel is once in the planes, in the raw file, and in the sections that the header names."""
    own = layout_of(first(camera, nx=96, ny=80))
    frame = np.arange(1, 96 * 80 + 1).reshape(80, 96)
    planes = own.split(frame)
    there = ~own.unread_pixels
    np.testing.assert_array_equal(own.assemble(planes), np.where(there, frame, 0))
    assert np.count_nonzero(planes) == there.sum()
    # The raw file also contains each pixel of the prescan and overscan exactly once.
    marked = np.arange(1, planes.size + 1).reshape(planes.shape)
    raw = own.to_raw_image(marked)
    np.testing.assert_array_equal(np.sort(raw[raw > 0]), marked.ravel())
    data = own.to_raw_image(planes)
    # Prescan and overscan lie between the pixels in the files of HSC only.
    assert (own.data_section is None) == (camera == "hsc")
    if own.data_section is not None:
        np.testing.assert_array_equal(data[own.data_section.slices], np.where(there, frame, 0))
    for number, amplifier in enumerate(own.amplifiers):
        np.testing.assert_array_equal(data[own.amplifier_data_section(number).slices], frame[amplifier.pixels.slices])
        bias = raw[own.amplifier_bias_section(number).slices]
        rows, pixels = own.pixels_in_plane
        read = marked[number, rows, pixels.stop :] if own.overscan else marked[number, rows, : own.prescan]
        np.testing.assert_array_equal(np.sort(bias, axis=None), np.sort(read, axis=None))


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_place_of_a_pixel_is_that_in_the_split_frame(camera):
    own = layout_of(first(camera, nx=97, ny=83))
    rows, columns = np.indices((83, 97)).reshape(2, -1)
    numbers = np.arange(1, 83 * 97 + 1)
    planes, places = own.split(numbers.reshape(83, 97)), own.readout_places(rows, columns)
    there = ~own.unread_pixels.ravel()
    assert planes.shape == own.planes_shape
    np.testing.assert_array_equal(planes[tuple(places[there].T)], numbers[there])
    assert (places[~there] == -1).all()


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_first_pixel_to_be_read_is_at_its_corner(camera):
    own = layout_of(first(camera, nx=96, ny=80))
    frame = np.arange(96 * 80).reshape(80, 96)
    for plane, amplifier in zip(own.split(frame), own.amplifiers, strict=True):
        part = frame[amplifier.pixels.slices]
        assert plane[own.prescan_rows, own.prescan] == part[-int(amplifier.read_top), -int(amplifier.read_right)]


@pytest.mark.parametrize("camera", RAW)
def test_raw_files_have_their_published_size(camera):
    assert layout_of(first(camera)).raw_shape == RAW[camera]


def test_sensors_of_two_makers_have_segments_of_the_same_size():
    """Rubin Observatory gives 576 x 2048 pixels per segment with scans for both."""
    makers = {d.kind: d for d in detectors.detectors("lsstcam", MISSION)}
    for kind in ("e2v", "itl"):
        own = layout_of(makers[kind])
        assert (own.width + own.scan_columns, own.height + own.scan_rows) == (576, 2048)
        assert len(own.amplifiers) == 16


@pytest.mark.parametrize(
    ("camera", "detector", "amplifier", "gain", "read_noise"),
    [
        ("decam", "S29", "A", 4.039, 6.139),
        ("decam", "S29", "B", 3.781, 5.982),
        ("decam", "S1", "B", 3.958, 6.0),
        ("lsstcam", "R22_S00", "C10", 1.46712, 5.420),
        ("megacam", "ccd00", "A", 1.54, 3.0),
        ("megacam", "ccd00", "B", 1.63, 6.0),
        ("hsc", "1_12", "1", 3.7614, None),
        ("hsc", "1_07", "4", 3.3731, None),
    ],
)
def test_each_amplifier_has_its_measured_gain_and_read_noise(camera, detector, amplifier, gain, read_noise):
    """The camera descriptions of obs_decam, obs_lsst, obs_cfht and obs_subaru."""
    one = detectors.detector(camera, detector, MISSION)
    own = layout_of(one)
    number = [a.name for a in own.amplifiers].index(amplifier)
    for key, unit, wanted in (("gain", GAIN, gain), ("read_noise", "electron", read_noise)):
        if wanted is not None:
            found = np.broadcast_to(amplifiers.values(key, unit, one, MISSION, own), len(own.amplifiers))
            assert found[number] == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize("camera", ["decam", "hsc", "lsstcam", "megacam"])
def test_the_values_of_a_camera_are_the_medians_of_its_measured_amplifiers(camera):
    rows = MISSION.rows(f"ext.{camera}.amplifier_values")
    assert {d.name for d in detectors.detectors(camera, MISSION)} - {row["detector"] for row in rows} <= {
        f"ccd{i}" for i in range(36, 40)
    }
    for key in ("gain", "read_noise")[: 1 if camera == "hsc" else 2]:
        assert MISSION.value(f"ext.{camera}.{key}") == pytest.approx(
            np.median([float(row[key]) for row in rows]), rel=1e-4
        )
        assert MISSION.value(f"ext.{camera}.{key}_spread") == 0.0


def test_each_amplifier_of_lsstcam_has_its_measured_bias_level():
    """Run 13421 of LSSTCam, as imSim has it: 24735, 25064 and 26469 adu, and 18761.5 at the lowest."""
    for detector, amplifier, bias in (
        ("R01_S00", "C10", 24735.0),
        ("R01_S00", "C00", 25064.0),
        ("R43_S02", "C13", 18761.5),
        ("R22_S02", "C10", 26469.0),
    ):
        one = detectors.detector("lsstcam", detector, MISSION)
        own = layout_of(one)
        found = amplifiers.values("bias", "adu", one, MISSION, own)
        assert found[[a.name for a in own.amplifiers].index(amplifier)] == pytest.approx(bias, rel=1e-5)
    one = first("decam")
    assert amplifiers.values("bias", "adu", one, MISSION, layout_of(one)) == MISSION.value("ext.decam.bias")


def values_of_quadrants(key, unit, mission=MISSION):
    """Return the values of the 144 quadrants of VIS, shape (36, 4), as images are made with."""
    return np.array([
        np.broadcast_to(Scene(mission, "vis", 0.0, 0.0, 0.0, detector).amplifier_values(key, unit), 4)
        for detector in detectors.detectors("vis", mission)
    ])  # fmt: skip


@pytest.mark.parametrize(
    ("key", "unit", "mean", "spread"),
    [
        ("gain", GAIN, 3.48, 0.02),
        ("read_noise", "electron", 4.4, 0.05),
        ("full_well", "electron", 2e5, 0.03),
        ("bias", "adu", 1000.0, 0.1),
    ],
)
def test_the_quadrants_of_vis_differ(key, unit, mean, spread):
    """The median is the number of the camera; each detector has its own values."""
    found = values_of_quadrants(key, unit)
    assert found.shape == (36, 4)
    assert np.median(found) == pytest.approx(mean, rel=1e-3)
    assert found.std() / found.mean() == pytest.approx(spread, rel=0.05)
    # Neighbouring quadrants are not alike, and detectors are not alike.
    assert np.abs(np.diff(found, axis=1)).mean() > 0.8 * spread * mean
    assert found.mean(axis=1).std() > 0.3 * spread * mean
    # In the order of the planes: 1-1.H is the first line, 6-6.E the last.
    rows = MISSION.rows("vis.amplifier_values")
    assert [(row["detector"], row["amplifier"]) for row in rows[::143]] == [("1-1", "H"), ("6-6", "E")]
    np.testing.assert_allclose(found.ravel(), [float(row[key]) for row in rows], rtol=1e-5)


def test_a_request_replaces_values_of_quadrants():
    """A value for the camera makes all alike; one for a detector or a quadrant leaves the others as they are."""
    usual = values_of_quadrants("gain", GAIN)
    for name, replaced in (
        ("vis.gain", np.s_[:, :]), ("vis.gain@3-4", np.s_[15, :]), ("vis.gain.F", np.s_[:, 2]),
        ("vis.gain@3-4.E", np.s_[15, 3]),
    ):  # fmt: skip
        wanted = usual.copy()
        wanted[replaced] = 3.3
        mission = resolve(overrides={name: (3.3, GAIN)})
        np.testing.assert_array_equal(values_of_quadrants("gain", GAIN, mission), wanted)
        np.testing.assert_array_equal(values_of_quadrants("bias", "adu", mission), values_of_quadrants("bias", "adu"))


def test_measured_crosstalk_is_that_of_the_observatories():
    """obs_subaru's configuration for every CCD of HSC, and DECam_xtalk_20130606: ccd32 is N1."""
    hsc, n1 = detectors.detector("hsc", "1_12", MISSION), detectors.detector("decam", "N1", MISSION)
    found = amplifiers.measured_crosstalk(hsc, layout_of(hsc), MISSION)
    assert found[0, 2] == -171e-6
    assert found[2, 0] == -149e-6
    assert not found.diagonal().any()
    names = [a.name for a in layout_of(n1).amplifiers]
    found = amplifiers.measured_crosstalk(n1, layout_of(n1), MISSION)
    a, b = names.index("A"), names.index("B")
    assert (found[b, a], found[a, b]) == (-8.28e-4, 3.40e-4)
    for key in ("crosstalk", "crosstalk_max"):
        asked = resolve(overrides={f"ext.decam.{key}": (2e-3, "")})
        assert amplifiers.measured_crosstalk(n1, layout_of(n1), asked) is None
    assert amplifiers.measured_crosstalk(first("lsstcam"), layout_of(first("lsstcam")), MISSION) is None


@given(st.tuples(*[st.integers(0, 5000)] * 2), st.tuples(*[st.integers(1, 5000)] * 2))
def test_sections_are_written_and_read(start, size):
    section = Section(*start, *size)
    assert Section.from_text(section.text) == section
    assert Section.from_text("[1:1024,51:4146]") == Section(0, 50, 1024, 4096)


@pytest.mark.parametrize("camera", CAMERAS)
def test_each_amplifier_has_its_own_gain_the_same_in_every_lake(camera):
    one = first(camera)
    own = layout_of(one)
    gain = amplifiers.values("gain", GAIN, one, MISSION, own)
    np.testing.assert_array_equal(gain, amplifiers.values("gain", GAIN, one, MISSION, own))
    assert len(set(gain)) == len(own.amplifiers)
    mean, spread = (MISSION.value(f"ext.{camera}.{key}", GAIN) for key in ("gain", "gain_spread"))
    assert np.abs(gain - mean * np.array([a.ratios_to_first[0] for a in own.amplifiers])).max() <= 3.0 * spread + 1e-12
    other = detectors.detectors(camera, MISSION)[1]
    assert (gain != amplifiers.values("gain", GAIN, other, MISSION, layout_of(other))).any()


def test_what_a_request_gives_is_taken_as_it_is():
    one = detectors.detector("decam", "S29", MISSION)
    own = layout_of(one)
    for overrides, wanted in (
        ({"ext.decam.gain": 3.0}, 3.0),
        ({"ext.decam.gain@S29": 3.5}, 3.5),
        ({"ext.decam.gain@S29": 3.5, "ext.decam.gain.B": 2.0}, 3.5),
        ({"ext.decam.gain@S29.A": 1.0, "ext.decam.gain.B": 2.0}, [1.0, 2.0]),
    ):
        mission = resolve(overrides={key: (value, GAIN) for key, value in overrides.items()})
        np.testing.assert_array_equal(amplifiers.values("gain", GAIN, one, mission, own), wanted)


def test_a_detector_too_small_for_its_amplifiers_is_refused():
    with pytest.raises(BadInput, match=r"detector S29: 1 x 8 pixels are too few for 2 amplifiers"):
        layout_of(replace(detectors.detector("decam", "S29", MISSION), nx=1, ny=8))


def test_crosstalk_beyond_neighbours_is_as_small_as_measured():
    """Rubin Observatory measured 1.5e-4 to 2.9e-4 between neighbours in LSSTCam, and less than 5e-5 between others."""
    for one in detectors.detectors("lsstcam", MISSION)[:60]:
        own = layout_of(one)
        found = amplifiers.crosstalk_couplings(2.2e-4, 2.9e-4, one, own)
        columns, top = np.array([(a.pixels.x // own.width, a.read_top) for a in own.amplifiers]).T
        neighbours = (np.abs(columns[:, None] - columns) == 1) & (top[:, None] == top)
        assert 1.4e-4 < found[neighbours].min() < found[neighbours].max() <= 2.9e-4
        assert 0.0 < found[~neighbours].max() < 5e-5


def test_amplifiers_that_would_have_no_gain_are_refused():
    """A spread is refused exactly if it would give an amplifier of the camera a gain below 1e-3."""
    every, key = detectors.detectors("decam", MISSION), "ext.decam.gain_spread"
    amplifiers.refuse_spread(every, MISSION)
    for rms in (0.5, 1.0, 1.35, 1.5, 2.0, 3.0):
        mission = resolve(overrides={key: (rms, GAIN)})
        lowest = min(np.min(amplifiers.values("gain", GAIN, d, mission, layout_of(d))) for d in every)
        if lowest >= 1e-3:
            amplifiers.refuse_spread(every, mission)
            continue
        with pytest.raises(BadInput, match=rf"^mission: {key} = {rms:g}: amplifier [AB] of detector \w+ would have -"):
            amplifiers.refuse_spread(every, mission)
    assert lowest < 0.0
    with pytest.raises(BadInput, match="read_noise_spread = 9: amplifier"):
        amplifiers.refuse_spread(every, resolve(overrides={"ext.decam.read_noise_spread": (9.0, "electron")}))
