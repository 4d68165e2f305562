"""Darks after a bright flat, made by the jobs: persistence can be measured from the files alone."""

from itertools import pairwise

import numpy as np
from astropy.io import fits

from lake_schema.store import read
from tests import requests
from tests.truesky.render.test_render_exposures_calibration import small_detectors
from tests.truesky.render.test_render_exposures_infrared import BLOCK, made
from truesky.request.from_toml import parse

REQUEST = f"""
accuracy = "draft"
[sources]
only = "table"
band = "euclid_h"
stars = "stars.csv"
[effects]
off = ["ramp_cosmic_rays"]
{BLOCK}
image_type = "persistence"
bands = ["euclid_h"]
lamps = [5]
exposures = 1
intensities = [2.0, 0.2]
delays_s = [100, 300, 1200, 7000]
"""


def frames(root):
    """Return (image type, lamp level, start in s, exposure time in s, electrons) of each raw file, in order of time."""
    version, found = read.version(root, "products"), []
    for row in version.rows().to_pylist():
        if row["content"] == "science":
            with fits.open(version.sidecar_path(row["path"])) as units:
                header, border = units[0].header, units[0].header["REFPIX"]
                pixels = units[1].data[border:-border, border:-border].astype(float)
                start = header["MJD-OBS"] * 86400.0
                electrons = (pixels - header["BIAS"]) * header["GAIN"]
                found.append((header["IMAGETYP"], header.get("LAMPSIG"), start, header["ELAPTIME"], electrons))
    return sorted(found, key=lambda one: one[2])


def test_decay_and_trap_numbers_are_measured_from_the_files(lake, tmp_path):
    (tmp_path / "stars.csv").write_text("ra,dec,mag\n53.117,-27.808,18.0\n")
    wanted = parse(requests.written(tmp_path, REQUEST, requests.FIELD.format(0.7), seed=3))
    with small_detectors(128):
        made(lake, wanted)
    found = frames(lake)
    bright, faint = found[:5], found[5:]
    for flat, *darks in (bright, faint):
        assert (flat[0], [one[0] for one in darks]) == ("flat", ["persistence"] * 4)
        ends = flat[2] + flat[3]
        np.testing.assert_allclose([one[2] - ends for one in darks], [100, 300, 1200, 7000], atol=1.0)
    assert bright[0][1] / faint[0][1] == 10.0
    # Persistence decreases as a power of the time since the flat began; the dark current is 1.7 e-.
    since = np.array([one[2] - bright[0][2] for one in bright[1:]])
    left = np.array([np.mean(np.clip(one[4], -50.0, 400.0)) for one in bright[1:]]) - 1.7
    slope, level = np.polyfit(np.log(since[:3] / 100.0), np.log(left[:3]), 1)
    assert abs(slope + 0.9) < 0.06
    assert abs(np.exp(level) / 1.0 - usual(np.median(bright[0][4]))) < 0.1 * usual(np.median(bright[0][4]))
    assert 1.0 < left[3] < 6.0
    # A fainter flat leaves less, as the formula predicts.
    less = np.mean(np.clip(faint[1][4], -50.0, 400.0)) - 1.7
    assert abs(less / left[0] - usual(np.median(faint[0][4])) / usual(np.median(bright[0][4]))) < 0.05
    # A pixel with more persistence has more in every dark: its number of traps varies by 0.3 rms.
    own = [one[4] - np.median(one[4]) for one in bright[1:4]]
    for before, after in pairwise(own):
        good = (np.abs(before) < 300.0) & (np.abs(after) < 300.0)
        assert np.corrcoef(before[good], after[good])[0, 1] > 0.5
    # Without hot pixels.
    good = (np.abs(own[0]) < 300.0) & (np.abs(own[1]) < 300.0)
    common = np.mean((own[0] * own[1])[good]) / (left[0] * left[1])
    assert abs(np.sqrt(common) - 0.3) < 0.06


def usual(charge):
    """Return the electrons released after 100 s, by the published formula with the values of the mission."""
    return (120.0 + 1e-5 * 150.0 * charge) * (1.0 - np.exp(-charge / 2e4))
