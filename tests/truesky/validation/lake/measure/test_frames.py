"""Frames are opened by their headers: amplifiers in the order of their readout are the same detector as one array."""

import numpy as np
import pytest
from astropy.wcs import WCS

from tests.truesky.render.fields import MISSION, small
from tests.truesky.render.products import test_tools as tools
from truesky.render.camera.sections import Section, steps_of_text
from truesky.render.products import read_back
from truesky.validation.lake.measure import frames

# Sensors of LSSTCam by e2v and ITL, of which ITL reads all columns from the right; DECam, whose raw headers have a
# pointing error and whose southern CCDs are read from the top; HSC, which has overscan between the pixels.
SIDE = 256
DETECTORS = {"lsstcam": ("R22_S11", "R10_S02"), "decam": ("N4", "S4"), "hsc": ("1_12", "0_05")}


@pytest.mark.parametrize(("camera", "name"), [(camera, name) for camera, names in DETECTORS.items() for name in names])
def test_amplifiers_in_readout_order_are_the_detector_of_one_array(camera, name, tmp_path):
    files, electrons, systems = {}, {}, {}
    for way in ("raw", "amplifiers"):
        (tmp_path / way).mkdir()
        one = tools.stars_on(camera, 30.0, small(camera, name, SIDE), mission=MISSION, way=way)
        files[way] = tools.put(one, tmp_path / way).path
        opened = frames.open_frame(files[way])
        electrons[way], systems[way] = opened.electrons, opened.wcs
        image = read_back.frame(files[way])
        np.testing.assert_array_equal(image.data, one.science)
        values = {key: value for key, value, _ in image.cards}
        true = one.wcs.wcs
        assert [values["CRPIX1"], values["CRPIX2"]] == pytest.approx(true.crpix, abs=1e-6)
        cd = [[values[f"CD{i}_{j}"] for j in (1, 2)] for i in (1, 2)]
        np.testing.assert_allclose(cd, true.cd, rtol=1e-9, atol=1e-12)
    # Mean bias levels differ slightly, because only arrays of single amplifiers contain the overscan rows.
    np.testing.assert_allclose(electrons["amplifiers"], electrons["raw"], atol=3.0)
    columns, rows = np.array([3.0, 100.0, 200.0]), np.array([7.0, 90.0, 150.0])
    np.testing.assert_allclose(
        systems["amplifiers"].all_pix2world(columns, rows, 0), one.wcs.all_pix2world(columns, rows, 0), atol=1e-8
    )
    np.testing.assert_allclose(
        systems["raw"].all_pix2world(columns, rows, 0), one.wcs.all_pix2world(columns, rows, 0), atol=1e-8
    )
    # The header of each array has the position of its pixels, apart from the pointing error of raw headers.
    for header, _ in tools.arrays(files["amplifiers"]):
        data, place = (Section.from_text(header[key]) for key in ("DATASEC", "CCDSEC"))
        column_step, row_step = steps_of_text(header["CCDSEC"])
        x = place.x + (10 if column_step > 0 else place.nx - 11)
        y = place.y + (20 if row_step > 0 else place.ny - 21)
        found = WCS(header).all_pix2world(data.x + 10, data.y + 20, 0)
        true = one.wcs.all_pix2world(x, y, 0)
        np.testing.assert_allclose(found, true, atol=1e-8 if camera == "lsstcam" else 20.0 / 3600.0)
