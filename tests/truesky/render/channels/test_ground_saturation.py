"""Bright stars in files of ground cameras: values of full pixels, length of bleed trails, keyword and mask."""

from functools import cache

import numpy as np
import pytest
from astropy.io import fits

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from tests.truesky import nightly
from tests.truesky.render import fields
from tests.truesky.render.channels.test_readout import put
from tests.truesky.render.fields import MISSION
from truesky.reduction import calibration
from truesky.render.camera import astrometry, detectors
from truesky.render.products import read_back
from truesky.request.accuracy import SURVEY

SIDE, SECONDS, ZERO_POINT = 512, 30.0, 28.0
BANDS = {"lsstcam": "lsst_r", "decam": "des_r"}
LARGEST = {"lsstcam": 2**18 - 1, "decam": 2**16 - 1}


@cache
def star(camera, electrons=3e7, largest=None, way="raw", full_well=None):
    """Render a star in the middle of a part of a detector."""
    given = {"adc_max": (largest, "adu"), "full_well": (full_well, "electron")}
    overrides = {f"ext.{camera}.{key}": value for key, value in given.items() if value[0] is not None}
    mission = resolve(overrides=overrides) if overrides else MISSION
    one = fields.small(camera, detectors.detectors(camera, MISSION)[0].name, SIDE)
    exposed = {
        "channel": "EXT", "camera": camera, "band": BANDS[camera], "exposure_time_s": SECONDS, "sky": 10.0,
        "seeing": 0.8, "zero_point": ZERO_POINT,
    }  # fmt: skip
    system = astrometry.wcs(one, 0.0, 0.0, 0.0)
    body, points = fields.galaxies([], []), fields.stars(*astrometry.sky_of_pixel(system, [100.0], [256.0]))
    f_nu = 10 ** (-0.4 * (ZERO_POINT - 2.5 * np.log10(electrons / SECONDS) - 23.9))
    tables = body, fields.fluxes(body, BANDS[camera], []), points, fields.fluxes(points, BANDS[camera], f_nu)
    quiet = {"cosmic_rays": False, "hot_pixels": False}
    truth = ("noise_free", "saturation")
    return fields.rendered(exposed, one, tables, mission, SURVEY, forced=quiet, truth=truth, way=way)


@nightly.parametrize("camera", [*BANDS], (0,))
def test_a_full_pixel_reads_what_its_well_holds_and_bleeds_along_its_column(camera, tmp_path):
    one = star(camera)
    files = put(one, tmp_path, ("saturation",))
    header, full = fits.getheader(files["science"]), one.scene.value("full_well", "electron")
    electrons, raw = read_back.electrons(files["science"]).data, read_back.frame(files["science"]).data
    # The converter has a higher limit, so the full well limits the charge.
    gains, biases = (one.scene.amplifier_values(*of) for of in (("gain", "electron / adu"), ("bias", "adu")))
    # The level is the lowest one that bias levels with five times their scatter give.
    scatter = one.scene.value("bias_offset", "adu")
    assert header["SATURATE"] == pytest.approx(np.min(0.985 * full / gains + biases - 5.0 * scatter), rel=0.02)
    assert header["SATURATE"] < raw.max() < 1.02 * np.max(full / gains + biases + 4.0 * scatter) < LARGEST[camera]
    truth = fits.getdata(files["saturation"]) > 0
    # The amplifiers are not linear near the full well.
    assert 0.97 * full < np.median(electrons[truth]) < 1.005 * full
    np.testing.assert_array_equal((raw >= header["SATURATE"]) & truth, truth)
    rows, columns = np.nonzero(truth)
    assert np.ptp(rows) > 3 * np.ptp(columns) > 0
    # No charge is lost. The illumination map is the fraction of the light that the optics transmit.
    shown = calibration.illumination_map(one.scene, ["illumination"])
    (tmp_path / "faint").mkdir()
    sky = read_back.electrons(put(star(camera, 1.0), tmp_path / "faint")["science"]).data
    assert (electrons - sky).sum() == pytest.approx((one.noise_free * shown).sum(), rel=0.02)


def test_more_than_sixteen_bits_are_stored_in_thirty_two(tmp_path):
    """Pixels of 18 bits are stored in 32 bits, compressed or not, in one array or in one per amplifier.

    Files of pixels with 16 bits have 16 bits.
    """
    one, few = star("lsstcam"), star("lsstcam", largest=2.0**16 - 1)
    assert (one.raw.dtype, few.raw.dtype) == (np.int32, np.uint16)
    for name, rice, way in (("plain", False, "raw"), ("rice", True, "raw"), ("apart", True, "amplifiers")):
        (tmp_path / name).mkdir()
        path = put(star("lsstcam", way=way), tmp_path / name, rice=rice)["science"]
        with fits.open(path) as units:
            assert {unit.header["BITPIX"] for unit in units if unit.data is not None} == {32}
            assert "BZERO" not in units[-1].header
        np.testing.assert_array_equal(read_back.frame(path).data, one.science)
    # A converter of 18 bits reaches its highest number if the full well is larger.
    (tmp_path / "full").mkdir()
    deep = star("lsstcam", full_well=1e6)
    path = put(deep, tmp_path / "full", rice=True)["science"]
    assert read_back.frame(path).data.max() == 2**18 - 1 == fits.getheader(path, 1)["SATURATE"]
    # If the limit of the converter is below the full well, it limits the charge.
    header = fits.getheader(put(few, tmp_path)["science"])
    assert header["BITPIX"] == 16
    assert header["SATURATE"] == few.raw.max() == 65_535
    assert np.all((few.science == 65_535) <= few.maps["saturation"])


def test_a_converter_has_as_many_bits_as_a_file_can_hold():
    for key, most in (("vis.adc_max", 2**16), ("nisp.adc_max", 2**16), ("ext.decam.adc_max", 2**24)):
        resolve(overrides={key: (most - 1, "adu")})
        with pytest.raises(BadInput, match="adc_max"):
            resolve(overrides={key: (most, "adu")})
