"""Masks of bright stars: their radii, spikes, ghosts and saturated pixels."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lake_schema import sky, units
from lake_schema.mission import ghost_offsets
from lake_schema.mission.configuration import resolve
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.survey.depth import BRIGHT_STAR, GHOST, ORDER, SATURATED, SPIKE
from truesky.fluxes import passbands
from truesky.render.camera import astrometry, detectors, pointing
from truesky.render.channels import registry
from truesky.render.channels.aim import electron_rate
from truesky.render.effects.charge import bleeding
from truesky.render.effects.light import ground_ghosts
from truesky.render.effects.scene import Lights
from truesky.render.exposure import scene_factory
from truesky.request.accuracy import SURVEY
from truesky.survey_maps import planned_footprints, star_ghosts, star_masks
from truesky.survey_maps.pixel_overlap import PixelGrid, side_normals
from truesky.survey_maps.planned_footprints import VALUES, Footprints
from truesky.survey_maps.star_places import MaskExposures, Stars, pairs

from . import planned


def footprints_of(tasks, exposures):
    """Return the footprints of a plan's detectors in some exposures, without values."""
    numbers = [exposure.exposure_id for exposure in exposures]
    rows = tasks.filter([number in numbers for number in tasks["exposure_id"].to_pylist()])
    names = np.array(rows["detector"].to_pylist(), object)
    return Footprints(
        np.full(len(names), exposures[0].band, object), np.full(len(names), exposures[0].camera, object),
        rows["exposure_id"].to_numpy(), names, sky.unit_vectors(rows["ra"].to_numpy(), rows["dec"].to_numpy()),
        np.radians(rows["radius"].to_numpy()),
        side_normals(planned_footprints._corners(rows["s_region"])), np.ones((len(names), len(VALUES))),
        np.full(len(names), None),
    )  # fmt: skip


@pytest.fixture(scope="module")
def seen_by(tmp_path_factory):
    """Return the exposures of a plan by channel."""
    from truesky.render.plan_exposures import plan

    _, rows, tasks = plan(tmp_path_factory.mktemp("none"), planned.request())
    exposures = [ExposureRow.from_row(row) for row in rows.to_pylist()]
    return {
        channel: MaskExposures(of_channel, passbands.load(band), resolve(), area, footprints_of(tasks, of_channel))
        for channel, band, area, of_channel in (
            (channel, band, area, [e for e in exposures if e.channel == channel][:1])
            for channel, band, area in (("VIS", "euclid_vis", 0.13), ("EXT", "lsst_r", 3.0))
        )
    }


@pytest.fixture(scope="module")
def grid():
    return PixelGrid.from_cell(7, int(sky.cell_at([planned.RA], [planned.DEC], 7)[0]), ORDER)


def star(magnitude):
    """Return one star, which the exposures see."""
    return Stars(np.array([planned.RA]), np.array([planned.DEC]), np.array([float(magnitude)]))


def test_the_radius_of_a_halo_is_published():
    """Coupon et al. 2018: 694.7 exp(-G / 4.04) arcsec for faint stars, 708.9 exp(-G / 8.41) for bright ones."""
    radius = star_masks.halo_radius(np.array([16.0, 5.0]), False)
    assert radius == pytest.approx([13.24, 391.2], rel=1e-3)
    assert star_masks.halo_radius(np.array([16.0]), True) == pytest.approx(radius[:1] / 2)


@pytest.mark.parametrize("magnitude", [13.0, 14.0])
def test_a_halo_is_a_disc(magnitude, seen_by, grid):
    one = star(magnitude)
    bits = star_masks.predict(one, seen_by["EXT"], grid)
    distance = sky.separation(*sky.cell_centres(ORDER, grid.first_pixel + np.arange(len(bits))), one.ra, one.dec) * 3600
    radius = float(star_masks.halo_radius(one.magnitude, False)[0])
    halo = (bits & BRIGHT_STAR) > 0
    assert halo[distance < radius].all()
    assert not halo[distance > radius + 10.0].any()
    spikes = (bits & SPIKE) > 0
    assert radius < distance[spikes].max() < 2 * radius + 10.0
    assert halo.sum() > 10


def test_spikes_have_the_directions_of_the_vanes(seen_by):
    """Euclid's three arms cause six spikes. LSST's four vanes cause four spikes, 45 deg from the zenith."""
    (euclid,) = star_masks.spike_angles(seen_by["VIS"]).values()
    steps = np.diff([*euclid, euclid[0] + 180.0])
    assert len(euclid) == 3
    assert 50.0 < steps.min() < steps.max() < 70.0
    (lsst,) = star_masks.spike_angles(seen_by["EXT"]).values()
    zenith = seen_by["EXT"].exposures[0].zenith
    assert np.sort((np.array(lsst) - zenith) % 180.0) == pytest.approx([45.0, 135.0], abs=1.0)


def test_spikes_of_euclid_follow_the_renderer(seen_by):
    """The PSF of VIS is brightest along the spikes: its light at 6 to 9 arcsec, as seen on the sky."""
    exposure = seen_by["VIS"].exposures[0]
    mission = seen_by["VIS"].mission
    detector = detectors.detectors("vis", mission)[0]
    psf = registry.CHANNELS["VIS"].psf(exposure, detector, passbands.load("euclid_vis"), mission, 1)
    image = psf.planes.images.mean(axis=0)
    up, along = np.indices(image.shape) - len(image) // 2
    x, y = (detector.axes[i, 0] * along + detector.axes[i, 1] * up for i in (0, 1))
    angle = (np.degrees(np.arctan2(-x, y)) + exposure.position_angle) % 180.0
    ring = (np.hypot(along, up) > 180) & (np.hypot(along, up) < 270)
    light = np.bincount(angle[ring].astype(int), image[ring], 180) / np.bincount(angle[ring].astype(int), minlength=180)
    (spikes,) = star_masks.spike_angles(seen_by["VIS"]).values()
    for spike in spikes:
        near = np.arange(round(spike) - 3, round(spike) + 4) % 180
        assert light[near].max() > 2.0 * np.median(light)


def test_a_faint_star_has_only_a_halo(seen_by, grid):
    bits = star_masks.predict(star(17.9), seen_by["VIS"], grid)
    assert set(bits.tolist()) == {0, BRIGHT_STAR}


def test_the_star_that_saturates_vis(seen_by):
    """It has the magnitude 17.8, as published."""
    assert star_masks._saturation(seen_by["VIS"]) == pytest.approx(17.8, abs=0.1)


@given(east=st.floats(-10.0, 10.0), north=st.floats(-10.0, 10.0))
@settings(max_examples=20, deadline=None)
def test_the_pixel_of_a_saturated_star_is_masked(east, north, seen_by, grid):
    one = star(12.0)
    ra, dec = sky.offset_positions(one.ra, one.dec, np.radians([east / 3600.0]), np.radians([north / 3600.0]))
    bits = star_masks.predict(Stars(ra, dec, one.magnitude), seen_by["VIS"], grid)
    assert bits[int(sky.cell_at(ra, dec, ORDER)[0]) - grid.first_pixel] & SATURATED


def test_a_ghost_is_where_the_renderer_puts_it(seen_by, grid):
    """The ghost of a star of magnitude 5 in VIS is displaced by the offset of the mission database."""
    exposure, mission = seen_by["VIS"].exposures[0], resolve()
    detector = detectors.detector("vis", "3-4", mission)
    system = astrometry.wcs(detector, exposure.ra, exposure.dec, exposure.position_angle)
    ra, dec = astrometry.sky_of_pixel(system, [2000.0], [1200.0])
    (ghost_ra, ghost_dec, size), *_ = star_ghosts.circles(Stars(ra, dec, np.array([5.0])), exposure, seen_by["VIS"])
    x, y = detector.focal_plane_place(np.array([2000.0]), np.array([1200.0]))
    dx, dy = ghost_offsets.offset(mission, ("vis", "ghost"), 1, x / 3600.0, y / 3600.0)
    expected = pointing.sky_of_plane(x + 0.1 * dx, y + 0.1 * dy, exposure.ra, exposure.dec, exposure.position_angle)
    assert sky.separation(ghost_ra, ghost_dec, *expected).max() * 3600.0 < 0.5
    assert size == pytest.approx(5.6, rel=0.01)
    bits = star_masks.predict(star(2.0), seen_by["VIS"], grid)
    assert (bits & GHOST).any()


def test_a_star_outside_the_field_has_no_ghost(seen_by):
    """Its ghost would lie at a place that only other exposures observe."""
    exposure = seen_by["VIS"].exposures[0]
    stars = Stars(np.full(2, exposure.ra), exposure.dec + np.array([0.1, 0.6]), np.full(2, 5.0))
    (ra, dec, _), *_ = star_ghosts.circles(stars, exposure, seen_by["VIS"])
    assert sky.separation(ra, dec, stars.ra[0], stars.dec[0]) == pytest.approx([93.0 / 3600.0], abs=0.01)


def test_only_exposures_that_see_the_star_have_its_spikes(seen_by, grid):
    """The footprint of one of two exposures with different angles is shifted away: its spikes are left out."""
    one, own = star(12.0), seen_by["VIS"]
    other = replace(own.exposures[0], exposure_id=99, position_angle=own.exposures[0].position_angle + 30.0)
    both = own.footprints._replace(exposure=np.full(len(own.footprints.exposure), 99))
    joined = Footprints(*(np.concatenate(columns) for columns in zip(own.footprints, both, strict=True)))
    far = both._replace(centre=-both.centre, normals=-both.normals)
    apart = Footprints(*(np.concatenate(columns) for columns in zip(own.footprints, far, strict=True)))
    bits = {
        name: star_masks.predict(one, replace(own, exposures=exposures, footprints=footprints), grid) & SPIKE
        for name, exposures, footprints in (
            ("own", own.exposures, own.footprints), ("both", [*own.exposures, other], joined),
            ("apart", [*own.exposures, other], apart),
        )
    }  # fmt: skip
    np.testing.assert_array_equal(bits["apart"], bits["own"])
    assert (bits["both"] > 0).sum() > (bits["own"] > 0).sum() > 0


def test_pairs_are_those_of_all_sides(seen_by):
    rng = np.random.default_rng(2)
    stars = Stars(
        planned.RA + rng.uniform(-0.3, 0.3, 300), planned.DEC + rng.uniform(-0.3, 0.3, 300), np.full(300, 9.0)
    )
    margin = rng.uniform(0.0, 200.0, 300)
    for own in seen_by.values():
        star_numbers, footprints = pairs(stars, own.footprints, margin)
        depth = (
            (sky.unit_vectors(stars.ra, stars.dec)[:, None, None] * own.footprints.normals).sum(axis=-1).min(axis=-1)
        )
        expected = np.argwhere((depth >= -np.radians(margin / 3600.0)[:, None]).T)
        np.testing.assert_array_equal(np.stack([footprints, star_numbers], axis=1), expected)
        assert 0 < len(footprints) < depth.size


def test_the_lengths_of_trails_are_those_of_the_renderer():
    """A Gaussian star whose columns bleed as in the renderer: trails of its middle column, within 10 % and 2 pixels.

    The stars are in the middle of a column, near the end at which charge turns back, and near the serial register.
    """
    segments, sigma, full = ((0, 1000, False), (1000, 2000, True)), 2.5, 1e5
    size = 4.0 * np.pi * sigma**2
    y, x = np.mgrid[:2000, -20:21]
    for row in (500.0, 950.0, 990.0, 30.0, 1500.0, 1010.0, 1970.0):
        electrons = 4e7
        light = np.exp(-0.5 * ((y - row) ** 2 + x**2) / sigma**2) / (2.0 * np.pi * sigma**2)
        frame, _ = bleeding.bleed(np.floor(light * electrons), full, segments)
        rows = np.flatnonzero(frame[:, 20] >= 0.99 * full)
        below, above, width = star_masks.trails(np.array([row]), np.array([electrons]), (full, size), segments)
        assert below[0] == pytest.approx(row - rows[0], rel=0.1, abs=2.0)
        assert above[0] == pytest.approx(rows[-1] - row, rel=0.1, abs=2.0)
        wide = np.flatnonzero(frame[int(row)] >= 0.99 * full)
        assert width[0] == pytest.approx(np.ptp(wide) / 2, abs=2.0)
    assert np.max(star_masks.trails(np.array([500.0]), np.array([1e4]), (full, size), segments)) == 0.0


@pytest.mark.parametrize("channel", ["VIS", "EXT"])
def test_a_trail_follows_the_columns(channel, seen_by, grid):
    """The trail of a star of magnitude 8 in VIS and LSST follows the columns of its detector on the sky."""
    own = seen_by[channel]
    bits = np.zeros(len(grid.centres), np.int64)
    star_masks._add_trails(bits, star_masks.PixelTree(grid), star(8.0), own)
    ra, dec = sky.cell_centres(ORDER, grid.first_pixel + np.flatnonzero(bits))
    x, y = (ra - planned.RA) * np.cos(np.radians(planned.DEC)) * 3600.0, (dec - planned.DEC) * 3600.0
    exposure = own.exposures[0]
    detector = detectors.detector(exposure.camera, own.footprints.detector[0], own.mission)
    up = detector.axes[:, 1]
    angle = np.arctan2(-up[0], up[1]) + np.radians(exposure.position_angle)
    along, across = x * np.sin(angle) + y * np.cos(angle), x * np.cos(angle) - y * np.sin(angle)
    assert np.ptp(along) > 100.0
    assert np.abs(across).max() < 20.0


def test_ghosts_of_a_ground_camera_are_those_of_the_renderer(seen_by):
    """Circles on the sky, against the annuli in the pixels of the detector with the star."""
    own = seen_by["EXT"]
    exposure, mission = own.exposures[0], own.mission
    detector = detectors.detector("lsstcam", "R22_S11", mission)
    system = astrometry.wcs(detector, exposure.ra, exposure.dec, exposure.position_angle)
    ra, dec = astrometry.sky_of_pixel(system, [2500.0], [1200.0])
    found = [c for c in star_ghosts.circles(Stars(ra, dec, np.array([4.0])), exposure, own) if len(c[0])]
    electrons = electron_rate(exposure) * exposure.exposure_time_s * 10.0 ** (0.4 * (units.AB_UJY - 4.0))
    lights = Lights(np.array([2500.0]), np.array([1200.0]), np.array([electrons]))
    scene = scene_factory.from_exposure(exposure, detector, mission, SURVEY)
    annuli, _ = ground_ghosts.parameters(replace(scene, band=own.band, lights=lights))
    bright = annuli.level > 0.1 * scene.pixel_noise
    assert len(found) == bright.sum() > 0
    places = astrometry.sky_of_pixel(system, annuli.column[bright], annuli.row[bright])
    circles = np.concatenate([np.stack(c, axis=1) for c in found])
    order, expected = np.argsort(circles[:, 2]), np.argsort(annuli.radius[bright])
    assert circles[order, 2] == pytest.approx(0.2 * annuli.radius[bright][expected], rel=1e-3)
    apart = sky.separation(*circles[order, :2].T, *(axis[expected] for axis in places))
    assert apart.max() * 3600.0 < 2.0


@pytest.mark.parametrize("magnitude", [-1.5, 5.0, 15.0])
def test_no_star_masks_pixels_beyond_the_reach(magnitude):
    """A cell reads stars up to `REACH` around it, so that masks continue across the edges of cells."""
    length = star_masks._SPIKE_LENGTH * star_masks.halo_radius(np.array([magnitude]), False) / 3600.0
    assert length[0] < star_masks.REACH
