"""Exposures of any length that a request allows are rendered with finite pixels, or refused."""

import re

import numpy as np
import pytest

from lake_schema.errors import BadInput
from tests.truesky import nightly
from tests.truesky.render import fields
from tests.truesky.render.fields import MISSION, fluxes, galaxies, small, stars
from truesky.render.camera import astrometry, detectors
from truesky.render.camera.pointing import boresight_for
from truesky.render.channels.aim import Aim
from truesky.render.exposure import board_neighbours
from truesky.render.exposure.records import Variant
from truesky.request.accuracy import SURVEY

# Camera, detector and band of each channel.
CHANNELS = {
    "VIS": ("vis", "3-4", "euclid_vis"),
    "NISP-P": ("nisp", "DET22", "euclid_h"),
    "NISP-S": ("nisp", "DET22", "nisp_red"),
    "EXT": ("lsstcam", "R22_S11", "lsst_r"),
}
SECONDS = (0.0, 1e-9, 1e-3, 1e6)
CASES = [(channel, seconds) for channel in CHANNELS for seconds in SECONDS]


def exposed_for(channel, detector, seconds):
    camera, _, band = CHANNELS[channel]
    ra, dec, angle = boresight_for(detector, 53.1, -27.8, 12.0)
    grism = {"grism": "RGS000", "grism_angle": 0.0} if channel == "NISP-S" else {}
    return {
        "channel": channel, "camera": camera, "band": band, "ra": ra, "dec": dec, "position_angle": angle, "sky": 0.5,
        "seeing": 0.7 if channel == "EXT" else 0.0, "exposure_time_s": seconds, "zero_point": 25.0, **grism,
    }  # fmt: skip


# The longest exposure of VIS, whose cosmic rays hit every pixel, is nightly.
@nightly.parametrize(("channel", "seconds"), CASES, [i for i, case in enumerate(CASES) if case != ("VIS", SECONDS[-1])])
def test_every_pixel_is_finite_or_the_exposure_is_refused(channel, seconds):
    camera, name, band = CHANNELS[channel]
    detector = small(camera, name, 128)
    exposed, rng = exposed_for(channel, detector, seconds), np.random.default_rng(1)
    aim = Aim.from_exposure(fields.exposure(**exposed), detector)
    x, y = rng.uniform(0.0, 128.0, (2, 40))
    bodies = galaxies(*astrometry.sky_of_pixel(aim.wcs, x[:30], y[:30]))
    points = stars(*astrometry.sky_of_pixel(aim.wcs, x[30:], y[30:]))
    tables = bodies, fluxes(bodies, band, 10.0), points, fluxes(points, band, 1e3)
    if camera == "nisp":
        # The reads of these exposures do not fit into the time, or more than 1000 of them would be dropped.
        with pytest.raises(BadInput, match=re.escape(f"exposure time {seconds:g} s: MACC")):
            fields.rendered(exposed, detector, tables, MISSION, SURVEY)
        return
    drawn = fields.rendered(exposed, detector, tables, MISSION, SURVEY, truth=("noise_free", "sky"))
    highest = 65535 if channel == "VIS" else 2**18 - 1
    assert drawn.raw.min() > 0
    assert drawn.raw.max() <= highest
    for name in ("noise_free", "sky"):
        assert np.isfinite(drawn.maps[name]).all()
    brightest = drawn.maps["noise_free"].max()
    assert brightest == 0.0 if seconds == 0.0 else brightest > 1.0 or seconds < 1.0


@pytest.mark.parametrize("channel", ["VIS", "EXT"])
def test_stars_on_other_detectors_leave_nothing_without_light(channel):
    camera, name, _ = CHANNELS[channel]
    detector = detectors.detector(camera, name, MISSION)
    aim = Aim.from_exposure(fields.exposure(**exposed_for(channel, detector, 0.0)), detector)
    # No table is read.
    assert board_neighbours.bright_stars({}, aim, Variant(MISSION, SURVEY, {})) == ()
