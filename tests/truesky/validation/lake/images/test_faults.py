"""Each check of images passes for a correct frame and fails for the fault that it must detect."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats

from tests.truesky import nightly
from tests.truesky.validation.lake import made
from truesky.validation.lake.images.astrometry import ASTROMETRY
from truesky.validation.lake.images.background import BACKGROUND
from truesky.validation.lake.images.cosmic_rays import COSMIC_RAYS
from truesky.validation.lake.images.depth import DEPTH
from truesky.validation.lake.images.noise import NOISE
from truesky.validation.lake.images.photometry import PHOTOMETRY
from truesky.validation.lake.images.psf import PSF
from truesky.validation.lake.images.quality import QUALITY
from truesky.validation.lake.images.saturation import SATURATION
from truesky.validation.lake.measure import frame_context
from truesky.validation.lake.measure.frames import Instrument
from truesky.validation.lake.measure.rows import Place
from truesky.validation.verdicts import FAIL, NOT_APPLICABLE, PASS, UNDECIDED

CHECKS = (ASTROMETRY, PHOTOMETRY, BACKGROUND, NOISE, PSF, COSMIC_RAYS, SATURATION)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("frames")


@pytest.fixture(scope="module")
def good(folder):
    """A correct frame of VIS."""
    return made.vis(folder)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_a_good_frame_passes(good, check):
    found = made.verdicts(check, good[0])
    assert found
    assert set(found.values()) == {PASS}


def test_measurements_agree_with_input(good):
    """The frame's arithmetic is known: half-light radius and width of points, level and noise of the sky."""
    of, _ = good
    # A Gaussian averaged over pixels is not exactly a Gaussian.
    assert of.measurements.fwhm == pytest.approx(made.FWHM / made.SCALE, rel=0.05)
    assert of.tiles.level.mean() == pytest.approx(made.SKY * made.SECONDS, rel=2e-3)
    assert np.abs(np.median(of.measurements.stars.dx)) < 0.01
    rows = {row.quantity: row for row in ASTROMETRY.run(of)}
    assert abs(rows["offset_x"].value) < 5.0 * rows["offset_x"].error


def turned(check, of, quantity):
    return made.verdicts(check, of)[quantity] == FAIL


def test_a_wcs_off_by_a_tenth_of_a_pixel(folder, good):
    of, _ = made.vis(folder, of=good[1], shift=(0.1, 0.0))
    assert turned(ASTROMETRY, of, "offset_x")
    assert made.verdicts(ASTROMETRY, of)["offset_y"] == PASS


def test_a_scale_that_is_wrong(good):
    """The scale is off by 0.2 pixels at the edge."""
    of, stars = good
    frame = replace(of.frame, wcs=made.system(stretch=1.0 + 4e-4))
    wrong = replace(of, frame=frame, measurements=frame_context.stars.measure_stars(frame, stars, of.noise), series={})
    assert turned(ASTROMETRY, wrong, "stretch_x")


def test_a_gain_that_is_three_percent_off(folder, good):
    of, _ = made.vis(folder, of=good[1], told=1.03 * made.GAIN)
    assert made.verdicts(NOISE, of)["ratio"] == FAIL


def test_a_gain_that_is_five_percent_off_passes_in_no_quadrant(folder, good):
    of, _ = made.vis(folder, of=good[1], told=1.05 * made.GAIN)
    found = made.verdicts(NOISE, of)
    assert PASS not in {found[f"ratio_{quadrant}"] for quadrant in "EFGH"}


def test_a_read_noise_that_is_a_fifth_off(folder, good):
    of, _ = made.vis(folder, of=good[1], noise=1.2 * made.NOISE)
    assert turned(NOISE, of, "overscan_E")


def test_a_band_whose_flux_is_shifted(good):
    of, stars = good
    measured = frame_context.stars.measure_stars(of.frame, replace(stars, mag=stars.mag + 0.05), of.noise)
    for quantity in ("offset", "psf_offset"):
        assert turned(PHOTOMETRY, replace(of, measurements=measured, series={}), quantity)


def test_vignetting(folder, good):
    """Vignetting of a tenth changes magnitudes by 0.03 to 0.05 on average, unless it is known."""
    axis = np.linspace(-1.0, 1.0, 2 * made.SIDE)
    bowl = 1.0 - 0.05 * (axis**2 + axis[:, None] ** 2)
    of, stars = made.vis(folder, of=good[1], bright=bowl)
    assert made.verdicts(PHOTOMETRY, of)["offset"] != PASS
    header = {**of.frame.header, "DETSIZE": f"[1:{2 * made.SIDE},1:{2 * made.SIDE}]"}
    told = replace(of.frame, instrument=Instrument(vignetting=0.1), header=header)
    known = replace(of, frame=told, measurements=frame_context.stars.measure_stars(told, stars, of.noise), series={})
    assert made.verdicts(PHOTOMETRY, known)["offset"] == PASS


def test_magnitudes_that_are_not_linear(good):
    of, stars = good
    measured = frame_context.stars.measure_stars(
        of.frame, replace(stars, mag=20.0 + 1.05 * (stars.mag - 20.0)), of.noise
    )
    for quantity in ("slope", "psf_slope"):
        assert turned(PHOTOMETRY, replace(of, measurements=measured, series={}), quantity)


def test_a_sky_that_is_too_bright(folder, good):
    of, _ = made.vis(folder, of=good[1], sky=1.1 * made.SKY)
    assert turned(BACKGROUND, of, "level")


def test_extended_points_fail(folder, good):
    of, _ = made.vis(folder, of=good[1], stretched=2.0)
    found = made.verdicts(PSF, of)
    assert found["ellipticity"] == FAIL
    assert found["fwhm"] != PASS


def test_points_that_are_wider_than_the_header_says(good):
    of, _ = good
    header = {**of.frame.header, "PSFFWHM": 0.85 * made.FWHM}
    assert turned(PSF, replace(of, frame=replace(of.frame, header=header), series={}), "fwhm")


@nightly.parametrize("hits", [0.0, 2.5 * made.HITS], (1,))
def test_cosmic_rays_that_are_off_or_too_many(folder, good, hits):
    of, _ = made.vis(folder, of=good[1], hits=hits)
    assert turned(COSMIC_RAYS, of, "cover")


def test_one_missing_cosmic_ray_is_undecided(folder, good):
    of, _ = made.vis(folder, of=good[1], hits=0.0)
    few = np.arange(len(of.tiles.row)) < 2
    short = replace(
        of, tiles=of.tiles.select(few), frame=replace(of.frame, header={**of.frame.header, "EXPTIME": 20.0})
    )
    assert made.verdicts(COSMIC_RAYS, short) == {"cover": UNDECIDED}


def test_stars_that_do_not_saturate(good):
    """One header has a saturation level that no star reaches, another one below the sky."""
    of, _ = good
    for factor, quantity in ((1.5, "bright_full"), (0.2, "faint_full")):
        amplifiers = tuple(replace(a, saturation_level=a.saturation_level * factor) for a in of.frame.amplifiers)
        frame = replace(of.frame, amplifiers=amplifiers)
        wrong = replace(of, frame=frame)
        if factor < 1.0:
            # The verdict uses the expected flux of the stars.
            wrong.frame = replace(of.frame, electrons=of.frame.electrons * np.float32(8.0))
        assert turned(SATURATION, wrong, quantity)


def ramps(folder, chi2, channel="NISP-S"):
    path = made.ramp_file(folder / "ramp.fits", np.clip(np.rint(chi2), 0, 255), channel)
    nobody = made.known(np.zeros(0), np.zeros(0), np.zeros(0))
    return frame_context.measure_frame(path, Place(channel, "nisp_red", 1, "DET11"), nobody)


def test_ramps_that_fit_and_others(folder):
    chi2 = scipy.stats.chi2(13).rvs((400, 400), random_state=1)
    assert set(made.verdicts(QUALITY, ramps(folder, chi2)).values()) == {PASS}
    assert turned(QUALITY, ramps(folder, 1.15 * chi2), "median")
    # These ramps have noise other than photon noise.
    assert turned(QUALITY, ramps(folder, scipy.stats.chi2(15).rvs((400, 400), random_state=1)), "median")
    # These ramps were not fitted.
    assert set(made.verdicts(QUALITY, ramps(folder, 0.0 * chi2)).values()) == {FAIL, PASS}
    assert turned(QUALITY, ramps(folder, 0.0 * chi2), "median")
    chi2[:40] = 255
    assert turned(QUALITY, ramps(folder, chi2), "not_fitting")


def test_frame_without_stars_is_not_applicable(folder):
    of, _ = made.vis(folder, of=made.known(np.zeros(0), np.zeros(0), np.zeros(0)))
    for check in (ASTROMETRY, PHOTOMETRY, PSF, SATURATION, QUALITY):
        (row,) = check.run(of)
        assert row.verdict == NOT_APPLICABLE
        assert row.note


def test_a_stack_that_is_not_deep_enough(folder, good):
    """The sky hides a galaxy of magnitude 24.5, or the zero point of the band is off."""
    assert made.verdicts(DEPTH, good[0]) == {"vis_snr_24.5": PASS}
    of, _ = made.vis(folder, of=good[1], sky=10.0 * made.SKY)
    assert turned(DEPTH, of, "vis_snr_24.5")
    of, _ = made.vis(folder, of=good[1], zero_point=made.ZERO_POINT - 1.5)
    assert turned(DEPTH, of, "vis_snr_24.5")
