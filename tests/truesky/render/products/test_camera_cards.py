"""Camera-specific headers: the sections that DECam's pipeline uses to trim a raw frame."""

import re

import numpy as np
import pytest
from astropy.io import fits

from tests.truesky.render.fields import MISSION
from tests.truesky.render.products import test_tools as tools
from truesky.render.camera.detectors import detectors
from truesky.render.products import camera_cards

# Some of the numbers of DECam's CCDs.
NUMBERS = {"S29": 1, "S25": 4, "S1": 25, "S4": 28, "S7": 31, "N1": 32, "N4": 35, "N30": 61, "N31": 62}


def ends(text):
    """First and last column and row of a section, in the order in which it lists them."""
    x0, x1, y0, y1 = map(int, re.fullmatch(r"\[(\d+):(\d+),(\d+):(\d+)\]", text).groups())
    return (x0, x1), (y0, y1)


@pytest.fixture(scope="module")
def decam(tmp_path_factory):
    field = tools.written("decam", tmp_path_factory.mktemp("decam"), sky=5.0)
    with fits.open(field.path) as units:
        return field.one, units[0].header, units[0].data


def test_a_ccd_has_its_number_and_its_name(decam):
    one, header, _ = decam
    names = [detector.name for detector in detectors("decam", MISSION)]
    assert len(names) == 62
    assert {name: names.index(name) + 1 for name in NUMBERS} == NUMBERS
    assert header["CCDNUM"] == names.index(one.detector.name) + 1
    assert (header["DETPOS"], header["OBSTYPE"], header["INSTRUME"]) == (one.detector.name, "object", "DECam")
    assert header["EXPNUM"] == one.exposure.exposure_id


def test_sections_of_both_amplifiers_cover_the_frame(decam):
    """Each pixel belongs to one section of one amplifier, except for the corners of the overscans."""
    one, header, pixels = decam
    seen = np.zeros(pixels.shape, int)
    for letter in "AB":
        assert header[f"TRIMSEC{letter}"] == header[f"DATASEC{letter}"]
        for key in ("DATASEC", "PRESEC", "BIASSEC", "POSTSEC"):
            seen[tools.window(header[f"{key}{letter}"])] += 1
    assert seen.max() == 1
    layout = one.scene.layout
    assert (seen == 0).sum() == layout.overscan_rows * layout.scan_columns * 2
    data = np.zeros(pixels.shape, bool)
    data[tools.window(header["DATASEC"])] = True
    for letter in "AB":
        assert data[tools.window(header[f"DATASEC{letter}"])].all()
        assert not data[tools.window(header[f"POSTSEC{letter}"])].any()
    # Pixels outside the detector have no light.
    sky = np.median(pixels[tools.window(header["DATASECA"])])
    for letter in "AB":
        level = np.median(pixels[tools.window(header[f"BIASSEC{letter}"])])
        for key in ("PRESEC", "POSTSEC"):
            assert abs(np.median(pixels[tools.window(header[f"{key}{letter}"])]) - level) < 0.1 * (sky - level)


def test_the_mosaic_is_of_both_amplifiers(decam):
    _, header, _ = decam
    whole, (a, b) = ends(header["DETSEC"]), (ends(header[f"DETSEC{letter}"]) for letter in "AB")
    along = [axis for axis in (0, 1) if a[axis] != b[axis]]
    assert len(along) == 1
    assert {*a[along[0]], *b[along[0]]} >= {min(whole[along[0]]), max(whole[along[0]])}
    assert a[1 - along[0]] == b[1 - along[0]] == whole[1 - along[0]]


def test_amplifiers_are_read_from_their_own_sides(decam):
    _, header, _ = decam
    (a, rows), (b, _) = (ends(header[f"AMPSEC{letter}"]) for letter in "AB")
    assert a[0] < a[1] < b[1] < b[0]
    assert rows[0] < rows[1]


def test_values_of_each_amplifier(decam):
    one, header, _ = decam
    for key, unit, name in (("gain", "electron / adu", "GAIN"), ("read_noise", "electron", "RDNOISE")):
        values = np.broadcast_to(one.scene.amplifier_values(key, unit), 2)
        assert values[0] != values[1]
        np.testing.assert_allclose([header[f"{name}{letter}"] for letter in "AB"], values)
    assert header["SATURATE"] == min(header["SATURATA"], header["SATURATB"])
    assert 30_000.0 < header["SATURATE"] < 65_535.0


def test_other_cameras_have_no_such_cards():
    assert camera_cards.cards(tools.stars_on("jpcam", 0.05)) == ()
