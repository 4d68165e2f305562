"""WCS of CCDs of ground cameras: axes, parity and reference pixels as in published headers and camera descriptions.

The headers are of raw frames of the observatories, except for S29 and ccd14 (calibrated frames). They are test data of
astro_metadata_translator. Their WCS are estimates: linear, with a scale per CCD. They differ from the true scale of the
cameras, which changes by 1 % over the field of MegaPrime, and from the true rotation by up to 0.2 deg.
"""

import re

import numpy as np
import pytest

from tests.truesky.render.fields import MISSION
from truesky.render.camera import astrometry, detectors
from truesky.render.camera.sections import Section, to_mosaic_section

# CRPIX1, CRPIX2 counted in the pixels of the CCD without overscan, and the matrix CD in 1e-5 deg per pixel. Raw headers
# of DECam and MegaPrime count the overscan: [57:2104,51:4146] of S1 and [33:2080,1:4612] of MegaPrime are pixels.
HEADERS = {
    ("decam", "S1"): ((2151.2 - 56.0, 14826.0 - 50.0), ((-0.01825, 7.28536), (-7.28499, -0.01822))),
    ("decam", "S29"): ((13422.2, 6306.333), ((-0.00611, 7.28731), (-7.28620, -0.00345))),
    ("hsc", "1_12"): ((1024.5, 4395.167), ((0.0, 4.72222), (-4.72222, 0.0))),
    ("hsc", "1_07"): ((-3220.833, 17801.167), ((0.0, 4.72222), (-4.72222, 0.0))),
    ("megacam", "ccd02"): ((-3118.8 - 32.0, 9640.5), ((5.194, 0.0), (0.0, -5.194))),
}  # fmt: skip
POINTING = 342.0, 0.0, 0.0


def system_of(camera, name):
    return astrometry.wcs(detectors.detector(camera, name, MISSION), *POINTING)


@pytest.mark.parametrize(("camera", "name"), HEADERS)
def test_axes_are_those_of_a_published_header(camera, name):
    """The size of each element of CD differs by less than 1.5 % of the scale."""
    expected = np.array(HEADERS[camera, name][1])
    found = 1e5 * system_of(camera, name).wcs.cd
    assert np.sign(np.linalg.det(found)) == np.sign(np.linalg.det(expected))
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=0.015 * np.abs(expected).max())


@pytest.mark.parametrize(("camera", "name"), HEADERS)
def test_the_reference_pixel_is_that_of_a_published_header(camera, name):
    """It differs by less than 2 % of its distance from the centre of the CCD."""
    one, (expected, _) = detectors.detector(camera, name, MISSION), HEADERS[camera, name]
    found = system_of(camera, name).wcs.crpix
    distance = np.hypot(*(np.array(expected) - [(one.nx + 1) / 2, (one.ny + 1) / 2]))
    assert np.hypot(*(found - expected)) < 0.02 * distance


@pytest.mark.parametrize(("camera", "name"), HEADERS)
def test_the_centre_of_the_ccd_sees_the_sky_of_a_published_header(camera, name):
    """It lies within 15 arcsec, or 1 % of the distance from the boresight, of where the linear WCS of the header says.

    The WCS of the camera has the distortion of the optics. Headers of HSC assume 0.17 arcsec per pixel in the whole
    field: the camera has 0.168 at the boresight and less outside, and 4.5 % are allowed.
    """
    one, (crpix, cd) = detectors.detector(camera, name, MISSION), HEADERS[camera, name]
    from_reference = np.array([(one.nx + 1) / 2, (one.ny + 1) / 2]) - crpix
    east, north = 0.036 * np.array(cd) @ from_reference
    ra, dec = astrometry.centre(one, system_of(camera, name))
    found = [3600.0 * ((ra - POINTING[0] + 180.0) % 360.0 - 180.0), 3600.0 * dec]
    fraction = 0.045 if camera == "hsc" else 0.01
    assert np.hypot(*(np.array(found) - [east, north])) < max(15.0, fraction * np.hypot(east, north))


@pytest.mark.parametrize(
    ("name", "west", "north", "columns", "rows"),
    [("S29", 63.748, 185.592, "S", "E"), ("N31", -63.794, -185.55, "S", "E"), ("N4", 0.018, -16.908, "S", "E")],
)
def test_decam_has_the_places_of_its_camera_description(name, west, north, columns, rows):
    """obs_decam: its x axis runs south, its y axis east, and so do columns and rows of all CCDs. Places are in mm."""
    one = detectors.detector("decam", name, MISSION)
    scale = one.pixel_scale / 0.015
    assert (one.x / scale, one.y / scale) == pytest.approx((west, north), abs=0.1)
    assert directions("decam", name) == (columns, rows)


def directions(camera, name):
    """Return the directions, one of N, E, S and W, in which columns and rows of a detector increase."""
    words = []
    for east, north in system_of(camera, name).wcs.cd.T:
        words.append(("E" if east > 0.0 else "W") if abs(east) > abs(north) else ("N" if north > 0.0 else "S"))
    return tuple(words)


@pytest.mark.parametrize(
    ("camera", "name", "expected"),
    [
        # obs_subaru: a CCD of the half 0 is turned by 180 deg against one of the half 1.
        ("hsc", "0_05", ("N", "W")),
        ("hsc", "0_53", ("N", "W")),
        # obs_cfht: yaw 180 for ccd00 to ccd17, 0 for ccd18 to ccd35; the latter have the axes of the focal plane.
        ("megacam", "ccd17", ("E", "S")),
        ("megacam", "ccd20", ("W", "N")),
        # obs_lsst: no sensor of LSSTCam is mirrored (only LATISS is), and none is turned.
        ("lsstcam", "R22_S11", ("W", "N")),
        ("lsstcam", "R10_S02", ("W", "N")),
    ],
)
def test_columns_and_rows_run_as_camera_descriptions_say(camera, name, expected):
    assert directions(camera, name) == expected


def test_positions_of_lsstcam_are_those_of_its_camera_description():
    """obs_lsst: offsets of rafts (127.0 mm) and of sensors in a raft (42.25 mm); x runs west, y north."""
    for name, x, y in (("R10_S02", -254.0 + 42.25, -127.0 - 42.25), ("R34_S20", 254.0 - 42.25, 127.0 + 42.25)):
        one = detectors.detector("lsstcam", name, MISSION)
        scale = one.pixel_scale / 0.01
        assert (one.x / scale, one.y / scale) == pytest.approx((x, y), abs=1e-3)


@pytest.mark.parametrize(
    ("name", "section"), [("ccd02", "[8394:6347,19353:14742]"), ("ccd14", "[14745:12698,14316:9705]")]
)
def test_sections_of_megaprime_in_the_mosaic_are_those_of_its_headers(name, section):
    """They differ by less than 10 pixels, since the headers have the gaps of the design."""
    one = detectors.detector("megacam", name, MISSION)
    found = to_mosaic_section(one, Section(0, 0, one.nx, one.ny), detectors.detectors("megacam", MISSION))
    numbers = [np.array([int(end) for end in re.findall(r"\d+", text)]) for text in (found, section)]
    shift = numbers[0] - numbers[1]
    # The four CCDs that were added later lie to the left of and to the right of the others.
    np.testing.assert_array_equal(np.sign(np.diff(numbers[0])[[0, 2]]), [-1, -1])
    assert np.ptp(shift[:2]) == np.ptp(shift[2:]) == 0
    assert np.abs(shift).max() < 10


@pytest.mark.parametrize(
    ("camera", "name", "serial"),
    [("megacam", "ccd02", "8352-15-3"), ("megacam", "ccd14", "8434-13-5"), ("lsstcam", "R22_S11", "E2V-CCD250-382")],
)
def test_serial_numbers_are_published_ones(camera, name, serial):
    assert detectors.detector(camera, name, MISSION).serial == serial
