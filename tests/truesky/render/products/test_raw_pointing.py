"""Pointing errors in raw headers: their size, their recovery, and the files with the true WCS."""

import re
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS
from hypothesis import given
from hypothesis import strategies as st

from tests.truesky import nightly
from tests.truesky.render import fields
from tests.truesky.render.fields import MISSION, small
from tests.truesky.render.products import test_tools as tools
from truesky.render.camera import astrometry
from truesky.render.camera.detectors import detector, detectors
from truesky.render.products import raw_pointing, read_back

POINTED = (53.1, -27.8, 12.0)
SEED = 1


def believed(place, number=None, camera="decam", seed=SEED, own=MISSION):
    ra, dec, angle = place
    exposed = fields.exposure(
        channel="EXT", camera=camera, band="des_r", ra=ra, dec=dec, position_angle=angle, realisation=number
    )
    return raw_pointing.commanded_pointing(exposed, detectors(camera, own)[0], own, seed)


def apart(one, other):
    """East and north offset, and rotation, between two boresights, arcsec."""
    here, there = (SkyCoord(*place[:2], unit="deg") for place in (one, other))
    east, north = here.spherical_offsets_to(there)
    turned = there.position_angle(here).deg - here.position_angle(there).deg - 180.0
    turn = (other[2] - one[2] - turned + 540.0) % 360.0 - 180.0
    return east.arcsec, north.arcsec, 3600.0 * turn


def test_rms_errors_are_those_of_the_mission():
    found = np.array([apart((ra, -30.0, 5.0), believed((ra, -30.0, 5.0))) for ra in np.linspace(0.0, 90.0, 150)])
    np.testing.assert_allclose(found.std(axis=0), (3.0, 3.0, 30.0), rtol=0.2)
    assert (np.abs(found.mean(axis=0)) < 0.3 * found.std(axis=0)).all()


def test_errors_depend_on_pointing_and_seed():
    """The errors do not depend on the noise or on the detector."""
    assert believed(POINTED) == believed(POINTED, 2)
    assert believed(POINTED) != believed(POINTED, seed=2)
    assert believed(POINTED) != believed((53.1, -27.8, 13.0))


def test_a_camera_without_errors_has_the_true_pointing():
    assert believed(POINTED, camera="lsstcam") == POINTED
    own = MISSION.with_overrides({"ext.lsstcam.header.offset": (5.0, "arcsec")})
    east, north, turn = apart(POINTED, believed(POINTED, camera="lsstcam", own=own))
    assert 0.0 < np.hypot(east, north) < 25.0
    assert abs(turn) < 1e-3


@given(dec=st.floats(-90.0, 90.0), ra=st.floats(0.0, 359.0))
def test_errors_are_not_larger_at_the_poles(dec, ra):
    """At the poles, too, the position of each pixel moves by a few sigma at most."""
    one = detector("decam", "N4", MISSION)
    exposed = fields.exposure(channel="EXT", camera="decam", band="des_r", ra=ra, dec=dec)
    systems = [
        astrometry.wcs(one, *place)
        for place in ((ra, dec, 0.0), raw_pointing.commanded_pointing(exposed, one, MISSION, SEED))
    ]
    true, told = (SkyCoord(*astrometry.sky_of_pixel(s, [0.0, 2000.0], [0.0, 4000.0]), unit="deg") for s in systems)
    assert (true.separation(told).arcsec < 6.0 * np.hypot(3.0, 3.0) + 1.0).all()


@pytest.fixture(scope="module")
def chips(tmp_path_factory):
    """Files of two detectors of one exposure, at opposite ends of the field."""
    folder = tmp_path_factory.mktemp("chips")
    out = []
    for name in ("S29", "N31"):
        (folder / name).mkdir()
        one = tools.stars_on("decam", 0.05, small("decam", name, tools.SIDE), POINTED, MISSION)
        out.append(tools.put(one, folder / name))
    return out


def test_a_linear_fit_finds_offset_and_rotation(chips):
    """Fit sources detected in both files; residuals are below 15 mas."""
    told, true = [], []
    for field in chips:
        ((header, pixels),) = tools.arrays(field.path)
        assert header["CSYER1"] == header["CSYER2"] == pytest.approx(3.0 / 3600.0)
        data = tools.window(header["DATASEC"])
        x, y = tools.measured(pixels[data])
        found = SkyCoord(*WCS(header).all_pix2world(x + data[1].start, y + data[0].start, 0), unit="deg")
        nearest, distance, _ = found.match_to_catalog_sky(field.stars)
        assert len(set(nearest)) == tools.STARS
        assert 1.0 < distance.to_value("arcsec").mean() < 15.0
        told.append(found)
        true.append(field.stars[nearest])
    place = believed(POINTED)
    system = WCS(naxis=2)
    system.wcs.ctype, system.wcs.crval, system.wcs.cdelt = ["RA---TAN", "DEC--TAN"], POINTED[:2], [1 / 3600.0] * 2
    (u, v), (x, y) = (
        np.concatenate([system.all_world2pix(c.ra.deg, c.dec.deg, 0) for c in some], axis=1) for some in (told, true)
    )
    # Shift and linear map from the positions in the headers to the true positions.
    terms = np.stack([np.ones_like(u), u, v], axis=1)
    (fit_x, *_), (fit_y, *_) = (np.linalg.lstsq(terms, axis, rcond=None) for axis in (x, y))
    left = np.stack([x - terms @ fit_x, y - terms @ fit_y])
    assert 1e3 * left.std() < 15.0
    east, north, turn = apart(POINTED, place)
    # The commanded boresight maps to the true one.
    at = np.array([1.0, east, north])
    np.testing.assert_allclose((at @ fit_x, at @ fit_y), (0.0, 0.0), atol=0.05)
    assert np.hypot(east, north) > 1.0
    # The angle increases from north through east, so that the rotation has the opposite sign in the tangent plane.
    measured = np.degrees(0.5 * (fit_x[2] - fit_y[1])) * 3600.0
    assert measured == pytest.approx(-turn, abs=1.0)
    assert abs(turn) > 3.0


def test_head_file_and_read_back_have_the_true_wcs(chips):
    for field in chips:
        ((header, _),) = tools.arrays(field.path)
        (true,) = tools.said(field.path)
        x, y = np.array([0.0, 300.0, 511.0]), np.array([511.0, 10.0, 200.0])
        data = tools.window(header["DATASEC"])
        expected = SkyCoord(*field.one.wcs.all_pix2world(x, y, 0), unit="deg")
        of_text = SkyCoord(*WCS(true).all_pix2world(x + data[1].start, y + data[0].start, 0), unit="deg")
        system = astrometry.from_cards(read_back.frame(field.path).cards)
        of_file = SkyCoord(*astrometry.sky_of_pixel(system, x, y), unit="deg")
        assert expected.separation(of_text).to_value("mas").max() < 0.01
        assert expected.separation(of_file).to_value("mas").max() < 0.01
        told = SkyCoord(*WCS(header).all_pix2world(x + data[1].start, y + data[0].start, 0), unit="deg")
        assert expected.separation(told).to_value("arcsec").min() > 1.0
        assert (header["RA"], header["DEC"]) == pytest.approx(believed(POINTED)[:2], abs=1e-9)
        cards = {key: value for key, value, _ in read_back.frame(field.path).cards}
        assert (cards["RA"], cards["DEC"]) == pytest.approx(POINTED[:2], abs=1e-9)
        assert "CSYER1" not in cards


@nightly.parametrize("way", ["amplifiers", "electrons"], (1,))
def test_all_forms_of_a_raw_frame_have_the_error(way, tmp_path):
    """All forms of a raw frame have the error in their headers; read_back returns the true WCS."""
    one = tools.stars_on("decam", 0.05, small("decam", "N31", tools.SIDE), POINTED, MISSION, way=way)
    path = tools.put(one, tmp_path).path
    with tools.fits.open(path) as units:
        headers = [unit.header for unit in units]
    assert len(headers) == (3 if way == "amplifiers" else 1)
    for header in headers:
        assert (header["CRVAL1"], header["CRVAL2"]) == pytest.approx(believed(POINTED)[:2], abs=1e-9)
        assert header["CSYER1"] > 0.0
    for cards in (read_back.frame(path).cards, read_back.electrons(path).cards):
        found = {key: value for key, value, _ in cards}
        assert (found["CRVAL1"], found["CRVAL2"]) == pytest.approx(POINTED[:2], abs=1e-9)
        np.testing.assert_allclose(astrometry.from_cards(cards).wcs.crpix, one.wcs.wcs.crpix, rtol=1e-12)


def test_scamp_recovers_the_pointing_of_four_dithered_frames(tmp_path):
    """SCAMP starts from the raw headers and a catalogue of the stars."""
    command = tools.tool("scamp")
    tools.tool("source-extractor")
    one = small("decam", "N4", 1024)
    bent = tools.farthest("decam").distortion_terms
    one = replace(one, distortion_terms=one.distortion_terms or bent)
    middle = astrometry.wcs(one, *POINTED)
    spread = np.random.default_rng(5)
    stars = astrometry.sky_of_pixel(middle, *spread.uniform(-200.0, 1224.0, (2, 70)))
    catalogues, frames = [], []
    for number, (east, north) in enumerate(((0.0, 0.0), (40.0, 10.0), (-15.0, 35.0), (25.0, -30.0))):
        folder = tmp_path / str(number)
        folder.mkdir()
        place = SkyCoord(*POINTED[:2], unit="deg").spherical_offsets_by(east * units.arcsec, north * units.arcsec)
        field = tools.put(
            tools.stars_on("decam", 0.05, one, (place.ra.deg, place.dec.deg, POINTED[2]), MISSION, stars), folder
        )
        # SExtractor would use the head file instead of the header.
        field.path.with_suffix(".head").rename(folder / "true")
        found = tools.extracted(field.path, "FITS_LDAC")
        found.rename(tmp_path / f"{number}.cat")
        catalogues.append(f"{number}.cat")
        frames.append(field)
    tools.reference(tmp_path / "reference.cat", SkyCoord(*stars, unit="deg"))
    subprocess.run(
        [command, *catalogues, "-c", "none", "-ASTREF_CATALOG", "FILE", "-ASTREFCAT_NAME", "reference.cat",
         "-MATCH_RESOL", "0.5", "-POSITION_MAXERR", "0.5", "-POSANGLE_MAXERR", "0.5", "-PIXSCALE_MAXERR", "1.01",
         "-MOSAIC_TYPE", "LOOSE", "-CROSSID_RADIUS", "15", "-SN_THRESHOLDS", "10,50", "-FWHM_THRESHOLDS", "0,100",
         "-DISTORT_DEGREES", "3", "-DISTORT_KEYS", "XWIN_IMAGE,YWIN_IMAGE", "-CENTROID_KEYS", "XWIN_IMAGE,YWIN_IMAGE",
         "-CENTROIDERR_KEYS", "ERRAWIN_IMAGE,ERRBWIN_IMAGE,ERRTHETAWIN_IMAGE", "-SOLVE_PHOTOM", "N",
         "-HEADER_SUFFIX", ".solved", "-CHECKPLOT_TYPE", "NONE", "-WRITE_XML", "N", "-VERBOSE_TYPE", "QUIET"],
        cwd=tmp_path, check=True, capture_output=True, timeout=120,
    )  # fmt: skip
    print([off_stars(field, tools.arrays(field.path)[0][0]) for field in frames])
    for number, field in enumerate(frames):
        solved = (tmp_path / f"{number}.solved").read_text(errors="replace")
        header = tools.fits.Header.fromstring(re.sub(r"(?m)^(HISTORY|COMMENT).*\n", "", solved), sep="\n")
        left = off_stars(field, header)
        assert left < 15.0 < 1e3 < off_stars(field, tools.arrays(field.path)[0][0])


def off_stars(field, header):
    """rms offset in mas along each axis of the stars' positions in a header."""
    data = tools.window(tools.arrays(field.path)[0][0]["DATASEC"])
    x, y = (
        axis + data[1 - i].start
        for i, axis in enumerate(astrometry.pixel_of_sky(field.one.wcs, field.stars.ra.deg, field.stars.dec.deg))
    )
    found = SkyCoord(*WCS(header).all_pix2world(x, y, 0), unit="deg")
    return float(np.sqrt(np.mean(found.separation(field.stars).to_value("mas") ** 2) / 2.0))
