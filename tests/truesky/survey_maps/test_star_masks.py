"""Masks of bright stars: their radii, spikes, ghosts and saturated pixels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lake_schema import sky
from lake_schema.mission import ghost_offsets
from lake_schema.mission.configuration import resolve
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.survey.depth import BRIGHT_STAR, GHOST, ORDER, SATURATED, SPIKE
from truesky.fluxes import passbands
from truesky.render.camera import astrometry, detectors, pointing
from truesky.render.channels import registry
from truesky.survey_maps import star_masks
from truesky.survey_maps.pixel_overlap import PixelGrid
from truesky.survey_maps.star_masks import MaskExposures, Stars

from . import planned


@pytest.fixture(scope="module")
def seen_by(tmp_path_factory):
    """Return the exposures of a plan by channel."""
    from truesky.render.plan_exposures import plan

    _, rows, _ = plan(tmp_path_factory.mktemp("none"), planned.request())
    exposures = [ExposureRow.from_row(row) for row in rows.to_pylist()]
    return {
        channel: MaskExposures(
            [e for e in exposures if e.channel == channel][:1], passbands.load(band), resolve(), area
        )
        for channel, band, area in (("VIS", "euclid_vis", 0.13), ("EXT", "lsst_r", 3.0))
    }


@pytest.fixture(scope="module")
def grid():
    return PixelGrid.from_cell(7, int(sky.cell_at([planned.RA], [planned.DEC], 7)[0]), ORDER)


def star(magnitude, grid):
    ra, dec = sky.cell_centre(grid.order, grid.cell)
    return Stars(np.array([ra]), np.array([dec]), np.array([float(magnitude)]))


def test_the_radius_of_a_halo_is_published():
    """Coupon et al. 2018: 694.7 exp(-G / 4.04) arcsec for faint stars, 708.9 exp(-G / 8.41) for bright ones."""
    radius = star_masks.halo_radius(np.array([16.0, 5.0]), False)
    assert radius == pytest.approx([13.24, 391.2], rel=1e-3)
    assert star_masks.halo_radius(np.array([16.0]), True) == pytest.approx(radius[:1] / 2)


@pytest.mark.parametrize("magnitude", [10.0, 13.0])
def test_a_halo_is_a_disc(magnitude, seen_by, grid):
    one = star(magnitude, grid)
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
    euclid = np.degrees(star_masks.spike_angles(seen_by["VIS"]))
    steps = np.diff([*euclid, euclid[0] + 180.0])
    assert len(euclid) == 3
    assert 50.0 < steps.min() < steps.max() < 70.0
    lsst = np.degrees(star_masks.spike_angles(seen_by["EXT"]))
    zenith = seen_by["EXT"].exposures[0].zenith
    assert np.sort((lsst - zenith) % 180.0) == pytest.approx([45.0, 135.0], abs=1.0)


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
    spikes = np.degrees(star_masks.spike_angles(seen_by["VIS"]))
    for spike in spikes:
        near = np.arange(round(spike) - 3, round(spike) + 4) % 180
        assert light[near].max() > 2.0 * np.median(light)


def test_a_faint_star_has_only_a_halo(seen_by, grid):
    bits = star_masks.predict(star(17.9, grid), seen_by["VIS"], grid)
    assert set(bits.tolist()) == {0, BRIGHT_STAR}


def test_the_star_that_saturates_vis(seen_by):
    """It has the magnitude 17.8, as published."""
    assert star_masks._saturation(seen_by["VIS"]) == pytest.approx(17.8, abs=0.1)


@given(east=st.floats(-10.0, 10.0), north=st.floats(-10.0, 10.0))
@settings(max_examples=20, deadline=None)
def test_the_pixel_of_a_saturated_star_is_masked(east, north, seen_by, grid):
    one = star(12.0, grid)
    ra, dec = sky.offset_positions(one.ra, one.dec, np.radians([east / 3600.0]), np.radians([north / 3600.0]))
    bits = star_masks.predict(Stars(ra, dec, one.magnitude), seen_by["VIS"], grid)
    assert bits[int(sky.cell_at(ra, dec, ORDER)[0]) - grid.first_pixel] & SATURATED


def test_a_ghost_is_where_the_renderer_puts_it(seen_by, grid):
    """The ghost of a star of magnitude 5 in VIS is displaced by the offset of the mission database."""
    exposure, mission = seen_by["VIS"].exposures[0], resolve()
    detector = detectors.detector("vis", "3-4", mission)
    system = astrometry.wcs(detector, exposure.ra, exposure.dec, exposure.position_angle)
    ra, dec = astrometry.sky_of_pixel(system, [2000.0], [1200.0])
    (ghost_ra, ghost_dec, size), *_ = star_masks._ghosts(Stars(ra, dec, np.array([5.0])), exposure, mission)
    x, y = detector.focal_plane_place(np.array([2000.0]), np.array([1200.0]))
    dx, dy = ghost_offsets.offset(mission, ("vis", "ghost"), 1, x / 3600.0, y / 3600.0)
    expected = pointing.sky_of_plane(x + 0.1 * dx, y + 0.1 * dy, exposure.ra, exposure.dec, exposure.position_angle)
    assert sky.separation(ghost_ra, ghost_dec, *expected).max() * 3600.0 < 0.5
    assert size == pytest.approx(5.6, rel=0.01)
    bits = star_masks.predict(star(2.0, grid), seen_by["VIS"], grid)
    assert (bits & GHOST).any()


def test_a_star_outside_the_field_has_no_ghost(seen_by):
    """Its ghost would lie at a place that only other exposures observe."""
    exposure, mission = seen_by["VIS"].exposures[0], resolve()
    stars = Stars(np.full(2, exposure.ra), exposure.dec + np.array([0.1, 0.6]), np.full(2, 5.0))
    (ra, dec, _), *_ = star_masks._ghosts(stars, exposure, mission)
    assert sky.separation(ra, dec, stars.ra[0], stars.dec[0]) == pytest.approx([93.0 / 3600.0], abs=0.01)


@pytest.mark.parametrize("magnitude", [-1.5, 5.0, 15.0])
def test_no_star_masks_pixels_beyond_the_reach(magnitude):
    """A cell reads stars up to `REACH` around it, so that masks continue across the edges of cells."""
    length = star_masks._SPIKE_LENGTH * star_masks.halo_radius(np.array([magnitude]), False) / 3600.0
    assert length[0] < star_masks.REACH
