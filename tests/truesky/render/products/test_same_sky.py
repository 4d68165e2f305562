"""Pictures of the same sky by several cameras with different pixel scales and position angles."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread

from lake_schema.fits import images
from lake_schema.mission.configuration import resolve
from lake_schema.sky import offset_positions
from tests.truesky import nightly
from truesky.render.camera import astrometry, detectors
from truesky.render.products import same_sky

MISSION = resolve()
# Camera, detector, channel, band, position angle; the pixels have 0.1, 0.3 and 0.2 arcsec.
CAMERAS = (
    ("vis", "3-4", "VIS", "euclid_vis", 25.0),
    ("nisp", "DET22", "NISP-P", "euclid_y", 25.0),
    ("nisp", "DET22", "NISP-P", "euclid_h", 25.0),
    ("lsstcam", "R22_S11", "EXT", "lsst_z", 0.0),
)
PLACE = 150.0, 2.0
# Offsets of three stars to the east and north, arcsec, and their electrons.
STARS = ((0.0, 0.0, 4e4), (30.0, 0.0, 3e4), (0.0, 40.0, 2e4))


def _middle(detector):
    """Return the part of a detector that contains the patch, wherever the position lies in the patch."""
    side = round((same_sky.SIDE + 60.0) / detector.pixel_scale)
    return replace(detector, nx=side, ny=side, injection_rows=0)


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    """Return an image of each camera with the stars; the position lies a few arcsec from its centre."""
    folder, found = tmp_path_factory.mktemp("images"), []
    rng = np.random.default_rng(5)
    for number, (camera, name, channel, band, angle) in enumerate(CAMERAS):
        detector = _middle(detectors.detector(camera, name, MISSION))
        about = astrometry.wcs(detector, *PLACE, angle)
        # The boresight that places the centre of the detector near the position.
        ra, dec = astrometry.centre(detector, about)
        boresight = 2 * PLACE[0] - ra, 2 * PLACE[1] - dec
        system = astrometry.wcs(detector, *boresight, angle)
        data = rng.normal(100.0, 10.0, (detector.ny, detector.nx)).astype(np.float32)
        for east, north, electrons in STARS:
            step = np.radians(np.array([[east], [north]]) / 3600.0)
            at = offset_positions(np.array([PLACE[0]]), np.array([PLACE[1]]), *step)
            column, row = (round(float(v[0])) for v in astrometry.pixel_of_sky(system, *at))
            data[row - 3 : row + 4, column - 3 : column + 4] += electrons / 49
        file = folder / f"{number}.fits"
        cards = (("BUNIT", "electron", ""), *astrometry.cards(system))
        images.write_images(file, [images.Image(data, cards)])
        own_ra, own_dec = astrometry.centre(detector, system)
        found.append(
            {
                "channel": channel, "camera": camera, "band": band, "exposure_id": number, "exposure_time_s": 100.0,
                "zero_point": 25.0, "ra": own_ra, "dec": own_dec, "radius": 0.2, "file": file,
                "s_region": astrometry.s_region(detector, system),
            }
        )  # fmt: skip
    return found


@nightly.parametrize("number", range(len(CAMERAS)), (1,))
def test_north_is_up_and_east_is_left(rows, number):
    found = same_sky.patch(rows[number]["file"], PLACE, 500, order=0)
    scale = same_sky.SIDE / 500
    assert np.isfinite(found).all()
    for east, north, _ in STARS:
        column, row = 249.5 - east / scale, 249.5 + north / scale
        near = found[round(row) - 12 : round(row) + 13, round(column) - 12 : round(column) + 13] - 100.0
        y, x = np.mgrid[-12:13, -12:13]
        bright = near > 100.0
        assert bright.any()
        # Tolerances: the pixel of the coarsest camera and the rounding of the star's position.
        assert abs(x[bright].mean()) * scale < 0.35
        assert abs(y[bright].mean()) * scale < 0.35


def test_pictures_of_the_shared_patch(rows, tmp_path, monkeypatch):
    monkeypatch.setattr(same_sky, "_rows", lambda root, request: rows)
    panels, colour = same_sky.draw(tmp_path, tmp_path / "out")
    assert (panels.name, colour.name) == ("same_sky.png", "colour.png")
    assert imread(panels).std() > 0.1
    drawn = imread(colour)
    assert drawn.shape[:2] == (1000, 1000)
    # The sky is dark, and the number of bright stars is correct.
    assert np.median(drawn[..., :3]) < 0.3
    assert drawn[..., :3].max() > 0.9


def test_two_cameras_are_not_enough_for_a_picture(rows, tmp_path, monkeypatch):
    monkeypatch.setattr(same_sky, "_rows", lambda root, request: rows[:3])
    assert same_sky.draw(tmp_path, tmp_path / "out") == []
    assert not (tmp_path / "out").exists()


def test_patch_outside_an_image_is_nan(rows):
    beyond = PLACE[0] + 0.5 * (rows[0]["radius"] + 0.1), PLACE[1]
    assert np.isnan(same_sky.patch(rows[0]["file"], beyond, 50, order=1)).any()
