"""Headers have the keywords that tools need in every array, with correct values."""

import re

import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time

from tests.truesky.render import fields, nominal
from tests.truesky.render.exposure.test_render import render
from tests.truesky.render.fields import MISSION, small
from truesky.render.camera import detectors, pointing
from truesky.render.products import fits_files, truth_table
from truesky.request.accuracy import SURVEY

IN_EACH = {
    "EXPTIME", "FILTER", "DATE-OBS", "MJD-OBS", "TIMESYS", "GAIN", "RDNOISE", "RDNDRAWN", "SATURATE", "BUNIT",
    "DATASEC", "TRIMSEC", "CCDSEC", "DETSEC",
}  # fmt: skip
FIRST = {
    "TELESCOP",
    "INSTRUME",
    "OBJECT",
    "RA",
    "DEC",
    "DATE-OBS",
    "MJD-OBS",
    "TIMESYS",
    "EXPTIME",
    "FILTER",
    "DETSIZE",
}


def science(one, tmp_path, **options):
    rows, writers = fits_files.products(one, (), **options)
    path = tmp_path / "science.fits"
    writers[rows["path"][0].as_py()](path)
    return fits.open(path)


def window(text):
    """Return a section as slices of an array."""
    x0, x1, y0, y1 = (int(n) for n in re.fullmatch(r"\[(\d+):(\d+),(\d+):(\d+)\]", text).groups())
    return slice(y0 - 1, y1), slice(x0 - 1, x1)


@pytest.mark.parametrize("rice", [False, True])
@pytest.mark.parametrize("channel", ["VIS", "EXT"])
def test_every_array_has_the_keywords_that_tools_need(channel, rice, tmp_path):
    one = render(channel, exposed={"airmass": None if channel == "VIS" else 1.2})
    with science(one, tmp_path, rice=rice) as units:
        arrays = [unit.header for unit in units if unit.header["NAXIS"]]
        assert len(arrays) == (4 if channel == "VIS" else 1)
        gains = np.broadcast_to(one.scene.amplifier_values("gain", "electron / adu"), 4 if channel == "VIS" else 16)
        for header, gain in zip(arrays, gains[::-1] if channel == "VIS" else [np.mean(gains)], strict=True):
            assert set(header) >= IN_EACH
            assert (header["EXPTIME"], header["BUNIT"]) == (100.0, "adu")
            assert header["GAIN"] == pytest.approx(gain)
            if channel == "VIS":
                assert header["INHERIT"] is True
        first = units[0].header if channel == "VIS" else arrays[0]
        assert set(first) >= FIRST
        assert (first["RA"], first["DEC"], first["OBJECT"]) == (one.exposure.ra, one.exposure.dec, "test")
        assert first["INSTRUME"] == {"VIS": "VIS", "EXT": "LSSTCam"}[channel]
        assert first.get("AIRMASS") == one.exposure.airmass
        assert {first["PSFWIN"]} == set(truth_table.truth(one)["psf_window"].to_pylist())


def test_sections_of_quadrants_form_the_detector(tmp_path):
    """The sections do not include pixels of the bias."""
    one = render("VIS")
    found = np.zeros_like(one.science)
    with science(one, tmp_path) as units:
        for unit in units[1:]:
            data, bias = (window(unit.header[key]) for key in ("DATASEC", "BIASSEC"))
            found[window(unit.header["CCDSEC"])] = unit.data[data]
            assert unit.header["TRIMSEC"] == unit.header["DATASEC"]
            light = np.zeros(unit.data.shape, bool)
            light[data] = True
            assert not light[bias].any()
            assert unit.data[bias].shape == (len(unit.data), 14)
            assert np.median(unit.data[bias]) == pytest.approx(unit.header["BIAS"], abs=10.0)
    np.testing.assert_array_equal(found, one.science)


def test_times_of_lsst_are_tai(tmp_path):
    one = render("EXT")
    with science(one, tmp_path) as units:
        header = units[0].header
    start = Time(one.exposure.mjd, format="mjd", scale="utc").tai
    assert header["TIMESYS"] == "TAI"
    assert header["MJD-OBS"] == pytest.approx(start.mjd, abs=1e-9)
    assert abs(Time(header["DATE-OBS"], scale="tai") - start).sec < 1e-3
    assert start.mjd - one.exposure.mjd > 30.0 / 86400.0


def test_rdnoise_is_given_if_read_noise_is_not_drawn(tmp_path):
    """For example if the request forces the effect off."""
    for forced, drawn in (({}, 1.0), (nominal.off("read_noise"), 0.0)):
        one = render("EXT", forced=forced, exposed={"sky": 0.0})
        of_detector = np.mean(one.scene.amplifier_values("read_noise", "electron"))
        with science(one, tmp_path) as units:
            assert 4.0 < units[0].header["RDNOISE"] == pytest.approx(of_detector)
            assert units[0].header["RDNDRAWN"] == pytest.approx(drawn * of_detector, abs=1e-9)


def test_rdnoise_under_a_bright_sky(tmp_path):
    """HSC in z: read noise is not drawn, but RDNOISE has the value of the detector."""
    detector = small("hsc", detectors.detectors("hsc", MISSION)[50].name, 128)
    none = fields.galaxies([], []), fields.stars([], [])
    exposed = {"channel": "EXT", "camera": "hsc", "band": "hsc_z", "exposure_time_s": 200.0, "sky": 34.0, "seeing": 0.7}
    tables = none[0], fields.fluxes(none[0], "hsc_z", []), none[1], fields.fluxes(none[1], "hsc_z", [])
    one = fields.rendered(exposed, detector, tables, MISSION, SURVEY)
    assert "read_noise" not in {decision.name for decision in one.decisions if decision.applied}
    with science(one, tmp_path) as units:
        of_detector = np.mean(one.scene.amplifier_values("read_noise", "electron"))
        assert 4.0 < units[0].header["RDNOISE"] == pytest.approx(of_detector)
        assert units[0].header["RDNDRAWN"] == 0.0


def test_clouds_and_the_sky_of_twilight_are_in_the_file(tmp_path):
    """The truth image of the sky has its gradient; the rate in the header is its mean."""
    detector = small("lsstcam", "R34_S21", 128)
    none = fields.galaxies([], []), fields.stars([], [])
    exposed = {
        "channel": "EXT", "camera": "lsstcam", "band": "lsst_r", "exposure_time_s": 200.0, "sky": 34.0, "seeing": 0.7,
        "clouds": 0.25, "sky_slope_x": 0.2, "sky_slope_y": -0.1,
    }  # fmt: skip
    tables = none[0], fields.fluxes(none[0], "lsst_r", []), none[1], fields.fluxes(none[1], "lsst_r", [])
    one = fields.rendered(exposed, detector, tables, MISSION, SURVEY, truth=("sky",))
    x, y = (axis[0] / 3600.0 for axis in pointing.outline((detector,)))
    middle, lower_left, lower_right, upper_right, upper_left = 34.0 * (1.0 + 0.2 * x - 0.1 * y)
    sky = np.asarray(one.maps["sky"], float) / 200.0
    with science(one, tmp_path) as units:
        assert units[0].header["CLOUDS"] == 0.25
        assert units[0].header["SKYRATE"] == pytest.approx(sky.mean(), rel=3e-3)
    # At this distance from the boresight, distortion makes pixels smaller by 0.4 %.
    assert sky.mean() == pytest.approx(middle, rel=6e-3)
    across = sky[:, 64:].mean() - sky[:, :64].mean(), sky[64:].mean() - sky[:64].mean()
    edges = lower_right + upper_right - lower_left - upper_left, upper_left + upper_right - lower_left - lower_right
    assert across == pytest.approx([edge / 4.0 for edge in edges], rel=0.05)
