"""Cosmic rays: how many, how long, how much; even over the frame; in the readout where they belong."""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import resolve
from lake_schema.mission.parameter import CAMERAS
from tests.truesky import nightly
from tests.truesky.render.effects.readout.test_charge_transfer import every_transfer
from truesky.render.camera import detectors
from truesky.render.effects.charge import cosmic_rays, ramp_cosmic_rays
from truesky.render.effects.charge.track_charge import THIN
from truesky.render.effects.readout import charge_transfer, readout_cosmic_rays
from truesky.render.effects.readout.traps import Traps
from truesky.render.effects.scene import Scene

MISSION = resolve()
TRACKS = np.array(MISSION.numbers("env.cosmic_rays.vis_tracks"))
SCENE = Scene(MISSION, "vis", 560.53, 0.25, 1e4, detectors.detector("vis", "3-4", MISSION))


def test_a_nominal_exposure_is_covered_to_two_or_three_per_cent():
    expected, quantiles, _ = cosmic_rays.EFFECT.parameters(SCENE)
    assert expected == pytest.approx(1.0 * 4096 * 4136 * (12e-4) ** 2 * 560.53)
    # A sixteenth of a detector, and of its tracks.
    image = cosmic_rays.draw_tracks((1033, 1024), expected / 16, quantiles, np.random.default_rng(5))
    assert 0.02 < (image > 0).mean() < MISSION.value("vis.cosmic_rays.covering")


def test_charge_and_number():
    """Whole electrons; the total is that of the tracks drawn, wherever they end."""
    image = cosmic_rays.draw_tracks((300, 200), 400.0, TRACKS, np.random.default_rng(5))
    np.testing.assert_array_equal(image, np.rint(image))
    assert image.min() == 0
    rng = np.random.default_rng(5)
    count = rng.poisson(400.0)
    *_, electrons = cosmic_rays.draw_events(count, 300, 200, TRACKS, rng)
    assert image.sum() == electrons.sum()


def test_quantiles():
    """Median length 10.6 pixels, median charge 12.2 ke-, the longest the most."""
    x, y, cosine, sine, length, electrons = cosmic_rays.draw_events(40_000, 100, 100, TRACKS, np.random.default_rng(1))
    assert np.median(length) == pytest.approx(10.56, rel=0.02)
    assert np.median(electrons) == pytest.approx(12_216, rel=0.03)
    assert np.percentile(length, 90) == pytest.approx(29.4, rel=0.05)
    assert (np.diff(electrons[np.argsort(length)]) >= 0).all()
    np.testing.assert_allclose(cosine**2 + sine**2, 1.0)
    assert 0 <= min(x.min(), y.min()) <= max(x.max(), y.max()) < 100


def test_a_track_is_one_pixel_thin_and_straight():
    one = tuple(np.array([value]) for value in (5.5, 8.5, np.cos(0.3), np.sin(0.3), 20.0, 10_001.0))
    event, columns, rows, charge = cosmic_rays.pixels_of_events(one)
    assert (event == 0).all()
    image = np.zeros((40, 40))
    image[rows, columns] = charge
    assert image.sum() == 10_001
    rows, columns = np.nonzero(image)
    assert columns.min() == 5
    assert columns.max() == 24
    # Every pixel that is hit lies on the line, and charge follows the path's length: 500 an entire pixel step.
    distance = np.abs((columns - 5) * np.sin(0.3) - (rows - 8) * np.cos(0.3))
    assert distance.max() < 0.75
    by_column = image.sum(axis=0)[6:24]
    np.testing.assert_allclose(by_column, 10_001 / 20 / np.cos(0.3), atol=2)


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.9, np.pi, 3.6, 5.2])
def test_a_pixel_holds_what_the_path_within_it_left(angle):
    """From anywhere in a pixel, in any direction: against the same path in a million steps."""
    x, y, length, electrons = 15.2, 18.7, 9.3, 1e6
    one = tuple(np.array([value]) for value in (x, y, np.cos(angle), np.sin(angle), length, electrons))
    _, columns, rows, charge = cosmic_rays.pixels_of_events(one)
    image = np.zeros((40, 40))
    np.add.at(image, (rows, columns), charge)
    along = length * (np.arange(1_000_000) + 0.5) / 1_000_000
    places = np.floor(y + along * np.sin(angle)).astype(int), np.floor(x + along * np.cos(angle)).astype(int)
    wanted = np.zeros((40, 40))
    np.add.at(wanted, places, 1.0)
    np.testing.assert_allclose(image, wanted, atol=3.0)


def test_even_over_the_frame():
    image = cosmic_rays.draw_tracks((200, 200), 40_000.0, TRACKS, np.random.default_rng(2)) > 0
    border = np.concatenate([image[:5].ravel(), image[-5:].ravel(), image[:, :5].ravel(), image[:, -5:].ravel()])
    assert border.mean() == pytest.approx(image.mean(), rel=0.02)


def test_readout_hits_lie_in_readout_coordinates():
    """Rows that are read later have been on the detector for longer; prescan and overscan columns have no silicon."""
    expected, _, (rows, prescan, columns), silicon, spread = readout_cosmic_rays.READOUT.parameters(SCENE)
    assert spread == THIN._replace(thickness=spread.thickness)
    assert silicon == charge_transfer.silicon_traps(SCENE, "parallel")
    assert readout_cosmic_rays.READOUT.parameters(replace(SCENE, forced={"parallel_cti": False}))[-2] is None
    assert (rows, prescan, columns) == (2066, 51, 2048)
    assert expected == pytest.approx(72 * 2066 * 2048 * (12e-4) ** 2)
    empty = np.zeros((40, 126, 90))
    out = readout_cosmic_rays.apply_readout(empty, 60.0, TRACKS, (120, 10, 64), None, THIN, np.random.default_rng(1))
    assert (out[:, :, :10] == 0).all()
    assert (out[:, :, 74:] == 0).all()
    hits = (out[:, :, 10:74] > 0).mean(axis=(0, 2))
    early, late = hits[:30].mean(), hits[90:120].mean()
    assert late > 3 * early
    # Overscan rows are hit, too.
    assert hits[120:].mean() > 0.8 * late


@nightly.parametrize(("rows", "charges"), [([12], [12_000.0]), ([30, 31, 32], [600.0] * 3)], (1,))
def test_a_readout_hit_passes_the_traps_from_its_row_on(rows, charges):
    """Pixel by pixel, with the charge put where it hits, 30 rows after the readout began, against its own trail."""
    before, pixels, silicon = 30, 80, Traps((0.02, 0.03, 0.95), (0.8, 3.5, 20.0), 2e5, 0.0, 0.58)
    sky = np.random.default_rng(1).poisson(140.0, 140).astype(float)
    hits = {row: (row + before, charge) for row, charge in zip(rows, charges, strict=True)}
    without, wanted = (every_transfer(sky, silicon, pixels, some, 1000)[0] for some in ({}, hits))
    found = without[:, None].copy()
    packet = np.array(rows) + before
    column = np.zeros(len(rows), int)
    readout_cosmic_rays._deposit(found, column, packet, np.array(rows), np.array(charges), silicon)
    # Effect of traps on the hit: its loss and its trail. It differs from no effect, and from the effect of all rows.
    hit = np.zeros(140)
    hit[packet] = charges
    true, ours = wanted - without - hit, found[:, 0] - without - hit
    assert np.abs(ours - true).max() < 0.1 * np.abs(true).max()
    assert ours[packet].sum() == pytest.approx(true[packet].sum(), rel=0.05)
    assert ours[packet[-1] + 1 :].sum() == pytest.approx(true[packet[-1] + 1 :].sum(), rel=0.1)
    late, _ = every_transfer(sky + hit, silicon, pixels, levels=1000)
    assert np.abs(late - without - hit - true).max() > 0.3 * np.abs(true).max()
    # Without traps all of it arrives.
    plain = without[:, None].copy()
    readout_cosmic_rays._deposit(plain, column, packet, np.array(rows), np.array(charges), None)
    np.testing.assert_array_equal(plain[:, 0], without + hit)


def apply_to_exposure(expected, rng):
    return cosmic_rays.draw_tracks((64, 64), expected, QUANTILES, rng)


def apply_to_ramp(expected, rng):
    return ramp_cosmic_rays.apply(np.zeros((64, 64)), expected, 0.1, 70.0, 0.1, rng)[1]


def apply_to_readout(expected, rng):
    # With one row of pixels and 63 rows of overscan, all charge is read.
    return readout_cosmic_rays.apply_readout(np.zeros((1, 64, 64)), expected, QUANTILES, (1, 0, 64), None, THIN, rng)


QUANTILES = np.array([[0.0, 0.01, 7.0], [1.0, 0.01, 7.0]])


@pytest.mark.parametrize("apply", [apply_to_exposure, apply_to_ramp, apply_to_readout])
def test_tracks_of_long_exposures_are_drawn_in_parts(monkeypatch, apply):
    """Memory does not grow with the exposure time, and no track is lost."""
    drawn, find_pixels = [], cosmic_rays.pixels_of_events
    monkeypatch.setattr(cosmic_rays, "pixels_of_events", lambda events: drawn.append(events) or find_pixels(events))
    image = apply(6e5, np.random.default_rng(1))
    counts = [len(events[0]) for events in drawn]
    assert max(counts) <= 300_000
    assert sum(counts) == pytest.approx(6e5, rel=0.01)
    # Float32 holds these whole numbers without rounding.
    assert image.sum(dtype=float) == sum(events[-1].sum() for events in drawn)


def test_too_many_are_refused():
    for wrong in (-1.0, np.nan, 1e12):
        with pytest.raises(OutOfRange, match="cosmic"):
            cosmic_rays.draw_tracks((3, 3), wrong, TRACKS, np.random.default_rng(1))


def test_muons_come_at_the_site_s_rate_through_the_silicon_s_thickness():
    """LSSTCam has 0.2 per second and detector. For an intensity cos^2, 1 - cos^4 of the zenith angle is uniform."""
    lsst = detectors.detector("lsstcam", "R22_S11", MISSION)
    scene = Scene(MISSION, "ext.lsstcam", 30.0, 30.0, 1e4, lsst)
    expected, quantiles, _ = cosmic_rays.EFFECT.parameters(scene)
    assert expected == pytest.approx(0.2 * 30.0)
    quarter = replace(scene, detector=replace(lsst, nx=lsst.nx // 2, ny=lsst.ny // 2))
    assert cosmic_rays.EFFECT.parameters(quarter)[0] == pytest.approx(0.25 * expected)
    *_, length, electrons = cosmic_rays.draw_events(100_000, 100, 100, quantiles, np.random.default_rng(1))
    thickness, pixel = 100.0, 10.0
    cosine = 80.0 * thickness / electrons
    across = thickness / pixel * np.sqrt(1 / cosine**2 - 1)
    np.testing.assert_allclose(length[length > 1.0], across[length > 1.0], rtol=0.05)
    # The mean of cos over a flux of cos^3: 4 / 5.
    assert cosine.mean() == pytest.approx(0.8, abs=0.01)


@pytest.mark.parametrize("camera", CAMERAS)
def test_muons_go_with_area_and_height(camera):
    """LSSTCam has 0.2 per second on 16.4 cm2; above 3000 m the rate is 1.5 times as high."""
    key, one = f"ext.{camera}", detectors.detectors(camera, MISSION)[0]
    area = one.nx * one.ny * MISSION.value(f"{key}.fpa.pixel_size", "cm / pix") ** 2
    high = 1.5 if MISSION.value(f"{key}.site.height", "m") > 3000.0 else 1.0
    assert MISSION.value(f"{key}.cosmic_rays.rate", "1 / s") == pytest.approx(0.0122 * area * high, rel=0.06)
