"""Ground cameras from outside: from files alone, what a laboratory measures of a detector."""

from functools import cache

import numpy as np
import pytest
from astropy.io import fits as astropy_fits

from jobs.accuracy import SURVEY
from jobs.render.camera.amplifiers import Section
from jobs.render.camera import detectors
from jobs.render.channels import ground
from lake_schema.mission.parameter import CAMERAS
from tests.jobs.render import fields
from tests.jobs.render.channels.test_readout import put
from tests.jobs.render.fields import MISSION, fluxes, galaxies, stars

SECONDS = 100.0
BANDS = {"decam": "des_r", "lsstcam": "lsst_r", "megacam": "cfis_r", "jpcam": "jedis_g", "gpc1": "ps1_i", "hsc": "hsc_z"}
NOBODY = galaxies([], []), stars([], [])


def exposure(camera, side, sky, number=1, forced=None, truth=(), mission=MISSION):
    """Of the sky alone, e- in a pixel."""
    one = fields.small(camera, detectors.detectors(camera, MISSION)[0].name, side)
    band = BANDS[camera]
    exposed = {
        "exposure_id": number, "channel": "EXT", "camera": camera, "band": band, "exposure_time_s": SECONDS,
        "realisation": number, "sky": sky / SECONDS, "seeing": 0.8, "zero_point": 28.0,
    }  # fmt: skip
    body, points = NOBODY
    tables = body, fluxes(body, band, []), points, fluxes(points, band, [])
    return fields.rendered(exposed, one, tables, mission, SURVEY, 1, forced=forced, truth=truth)


@cache
def sections(path):
    """Pixels and bias columns [q] of a raw file, float, and its header."""
    with astropy_fits.open(path) as units:
        raw, header = units[0].data.astype(float), units[0].header
    numbers = range(1, header["NAMPS"] + 1)
    cut = [[raw[Section.of(header[f"{key}{n}"]).slices] for n in numbers] for key in ("DSEC", "BSEC")]
    return *cut, header


def check_photon_transfer(camera, side, folder):
    """Gain to 1 % and read noise to 2 % of each amplifier: from pairs of flats, and from overscans."""
    files = []
    for number, sky in enumerate((3000.0, 3000.0, 1000.0, 1000.0), 1):
        one = exposure(camera, side, sky, number, {"cosmic_rays": False, "read_noise": True})
        files.append(put(one, folder)["science"])
    read = [sections(path) for path in files]
    header = read[0][2]
    for q in range(header["NAMPS"]):
        levels, variances = [], []
        for first, second in ((0, 1), (2, 3)):
            a, b = (read[k][0][q] - read[k][1][q].mean() for k in (first, second))
            difference = a - b
            good = np.abs(difference - np.median(difference)) <= 6.0 * difference.std()
            levels.append(0.5 * (a[good].mean() + b[good].mean()))
            variances.append(0.5 * difference[good].var())
        noise = np.sqrt(np.mean([(read[k][1][q] - read[k][1][q].mean(axis=0)).var() for k in range(4)]) - 1.0 / 12.0)
        gain = levels[0] / (variances[0] - noise**2 - 1.0 / 12.0)
        assert gain == pytest.approx(header[f"GAIN{q + 1}"], rel=0.01)
        assert noise * gain == pytest.approx(header[f"RDN{q + 1}"], rel=0.02)
        assert levels[0] / levels[1] == pytest.approx(3.0, rel=0.01)
    gains = [header[f"GAIN{q + 1}"] for q in range(header["NAMPS"])]
    assert np.ptp(gains) > 0.005 * np.mean(gains)


def test_photon_transfer(tmp_path):
    check_photon_transfer("decam", 768, tmp_path)


@pytest.mark.nightly
@pytest.mark.parametrize("camera", [camera for camera in CAMERAS if camera != "decam"])
def test_photon_transfer_of_every_camera(camera, tmp_path):
    check_photon_transfer(camera, 4096 if camera in ("gpc1", "jpcam", "lsstcam") else 2048, tmp_path)


def test_levels_of_amplifiers_differ_and_their_overscans_tell(tmp_path):
    one = exposure("hsc", 256, 2000.0)
    pixels, bias, _ = sections(put(one, tmp_path)["science"])
    levels = [columns.mean() for columns in bias]
    assert np.ptp(levels) > 5.0
    for light, level in zip(pixels, levels, strict=True):
        assert np.median(light) - level == pytest.approx(2000.0 / 3.0, rel=0.1)


def test_no_image_is_read_in_another_way():
    for effects in ground.EFFECTS.values():
        names = [effect.name for effect in effects]
        assert names.index("bleeding") < names.index("amplifiers") < names.index("read_noise") < names.index("adc")
