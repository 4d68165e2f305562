"""Sky, noise and bad pixels of single frames, and the estimators on arrays with known noise."""

import numpy as np
import pytest
from scipy import ndimage

from lake_schema import sky
from lake_schema.mission.configuration import resolve
from lake_schema.tables.survey.depth import ORDER
from truesky.reduction import calibration
from truesky.reduction.calibration import ReducedImage, SkyMesh
from truesky.reduction.ideal_masters import ideal_masters
from truesky.render.camera import astrometry
from truesky.survey_maps import exposure_noise, frame_noise

from . import frames

SIDE = 512


def noisy(scatter=11.0, level=120.0, step=3.5, side=SIDE):
    """Return pixels of Gaussian noise in steps of an ADU, with a gradient and the bias of columns."""
    rng = np.random.default_rng(4)
    values = level + rng.normal(0.0, scatter, (side, side)) + np.linspace(0.0, 5.0, side)[:, None]
    return (np.round(values / step) * step + rng.normal(0.0, 3.0, side)).astype(np.float32)


def test_variance_of_rounded_pixels_with_a_gradient_and_columns():
    """The variance is that of the noise and of rounding, within 4 standard errors of 1e5 differences.

    sample: 260,000 differences. significance: 4 sigma
    """
    found = frame_noise._difference_variance(noisy(), np.ones((SIDE, SIDE), bool))
    assert found == pytest.approx(11.0**2 + 3.5**2 / 12.0, rel=0.016)


def test_variance_without_outliers():
    """Cosmic rays in 1 % of the pixels change the variance by less than 3 %; unclipped it would be 100 times higher.

    sample: 260,000 differences. significance: 4 sigma
    """
    image = noisy()
    hit = np.random.default_rng(5).random(image.shape) < 0.01
    image[hit] += 2000.0
    found = frame_noise._difference_variance(image, np.ones(image.shape, bool))
    assert found == pytest.approx(11.0**2 + 3.5**2 / 12.0, rel=0.03)


def test_too_few_pixels_have_no_noise():
    image, few = noisy(side=64), np.zeros((64, 64), bool)
    few[:30] = True
    assert np.isnan(frame_noise._difference_variance(image, few))
    assert np.isnan(frame_noise._clipped_mean(image, few, SkyMesh.from_image(image, few)))


@pytest.mark.filterwarnings("error")
def test_an_image_without_noise_has_a_sky_but_no_variance():
    """Effects of a request may be off; a variance of 0 would be an infinite depth."""
    image, used = np.full((SIDE, SIDE), 120.0, np.float32), np.ones((SIDE, SIDE), bool)
    image[::100, 7] = 1e4
    image[4::100, 7] = 1e4
    assert np.isnan(frame_noise._difference_variance(np.full((SIDE, SIDE), 120.0, np.float32), used))
    assert np.isnan(frame_noise._difference_variance(image, used))
    assert frame_noise._clipped_mean(image, used, SkyMesh.from_image(image, used)) == pytest.approx(120.0)


def test_sources_are_found_in_strips_as_in_a_whole_image(monkeypatch):
    """The slow reference treats the image as one strip, and sources grow in steps of a pixel."""
    image, used = noisy(), np.ones((SIDE, SIDE), bool)
    for x, y in ((30, 100), (200, 255), (400, 300), (100, 511)):
        image[max(y - 2, 0) : y + 3, x - 2 : x + 3] += 60.0
    reduced = ReducedImage(image, np.full(image.shape, 1.0 / 121.0, np.float32), np.zeros(image.shape, np.uint8))
    mesh = SkyMesh.from_image(image, used)
    found = {}
    for rows in (64, SIDE):
        monkeypatch.setattr(frame_noise, "_ROWS", rows)
        found[rows] = frame_noise._find_sources(reduced, used, mesh)
    np.testing.assert_array_equal(found[64], found[SIDE])
    monkeypatch.setattr(frame_noise, "_SOURCE_REACH", 0)
    small = frame_noise._find_sources(reduced, used, mesh)
    np.testing.assert_array_equal(found[64], ndimage.binary_dilation(small, np.ones((3, 3), bool), iterations=5))
    assert found[64][255, 200]
    assert 0.001 < found[64].mean() < 0.02


@pytest.fixture(scope="module")
def ground(tmp_path_factory):
    """Return a frame of LSSTCam with many dark columns and a bright star, and its measurements."""
    folder = tmp_path_factory.mktemp("ground")
    mission = resolve(overrides={"ext.lsstcam.dark_columns": (30.0, "")})
    exposure = frames.exposures(folder / "plan")["EXT"]
    detector = frames.section("lsstcam", "R22_S11", SIDE, mission)
    stars = ((np.array([300.0]), np.array([200.0])), frames.magnitudes_to_flux([14.0]))
    frame, one = frames.rendered(folder, exposure, detector, stars, mission)
    return frame, one, frame_noise.measure(frame)


def test_noise_of_a_ground_frame_is_that_of_the_plan(ground):
    """Within 4 standard errors of the variance (0.6 %) and of the level of the sky, with 0.5 % for the star's light.

    sample: 200,000 differences. significance: 4 sigma
    """
    frame, _, found = ground
    (level,), (variance,) = exposure_noise.variances([frame.exposure], [frame.scene.detector], frame.scene.mission)
    assert found.sky == pytest.approx(level, rel=0.005)
    assert found.variance == pytest.approx(variance, rel=0.02)


def test_dark_columns_are_bad_pixels_of_the_map(ground):
    """A pixel of the map is 64 pixels wide, so that a dark column takes 1.6 % of it, or less near its ends."""
    frame, _, found = ground
    bad = calibration.is_bad_response(ideal_masters(frame, frame.scene.pixel_noise**2).flat.mean)
    y, x = np.nonzero(bad)
    system = astrometry.from_cards(frame.cards)
    place, number = np.unique(sky.cell_at(*astrometry.sky_of_pixel(system, x, y), ORDER), return_counts=True)
    area = sky.cell_area(ORDER) * 3600.0**2 / 0.2**2
    assert 0.005 < bad.mean() < 0.1
    np.testing.assert_array_equal(found.bad_pixels, place[number > 0.01 * area])
    assert len(found.bad_pixels) > 3
    assert found.good == pytest.approx(1.0 - bad.mean(), abs=0.005)


def test_dark_columns_of_the_response_are_dark_in_the_frame(ground):
    """The known response is that of the frame: pixels nearly without response have little of the sky."""
    frame, _, _ = ground
    response = ideal_masters(frame, frame.scene.pixel_noise**2).flat.mean
    electrons = frame.electrons()
    sky_electrons = np.median(electrons)
    dark = response < 0.1
    assert np.median(electrons[dark]) < 0.1 * sky_electrons
    assert dark.mean() > 0.003


def test_a_saturated_star_is_on_the_map(ground):
    _, one, found = ground
    ra, dec = astrometry.sky_of_pixel(one.wcs, [300.0], [200.0])
    assert sky.cell_at(ra, dec, ORDER)[0] in found.saturated
    assert len(found.saturated) < 0.5 * SIDE**2 / (64 * 64)


def test_hit_pixels_are_not_good(ground):
    frame, _, found = ground
    hits = np.zeros((SIDE, SIDE), bool)
    hits[:, :64] = True
    again = frame_noise.measure(frame, hits)
    assert again.good == pytest.approx(found.good - 64 / SIDE, abs=0.01)
    assert again.variance == pytest.approx(found.variance, rel=0.02)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("channel", "camera", "name"), [("VIS", "vis", "3-4"), ("NISP-P", "nisp", "DET22"), ("EXT", "lsstcam", "R22_S11")]
)
def test_noise_of_a_frame_is_that_of_the_plan(channel, camera, name, tmp_path):
    """The sky agrees within 0.3 %, and the variance within 1.5 %, of which 0.8 % is rounding to whole ADU in VIS.

    sample: 0.5 to 1 million differences. significance: 4 sigma
    """
    exposure = frames.exposures(tmp_path / "plan")[channel]
    detector = frames.section(camera, name, 1024)
    frame, _ = frames.rendered(tmp_path, exposure, detector)
    found = frame_noise.measure(frame)
    (level,), (variance,) = exposure_noise.variances([exposure], [detector], frames.MISSION)
    assert found.sky == pytest.approx(level, rel=0.003)
    assert found.variance == pytest.approx(variance, rel=0.015)


def test_a_frame_that_a_star_fills_has_no_noise(ground):
    """A frame without blank sky has no measured sky; its depth stays that of the plan."""
    frame, _, _ = ground
    hits = np.ones((SIDE, SIDE), bool)
    found = frame_noise.measure(frame, hits)
    assert np.isnan([found.sky, found.variance]).all()
    assert found.good == 0.0
    assert found.blank == 0
