"""Light beyond stamps is drawn as far as it matters, from sources on the frame and outside it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.truesky.render.fields import MISSION, aimed, galaxies, psf_of, small, stars
from truesky.fluxes import passbands
from truesky.render.camera import detectors
from truesky.render.camera.astrometry import sky_of_pixel, wcs
from truesky.render.camera.pointing import boresight_for
from truesky.render.drawing import settings, stamp_sizes, stamps
from truesky.render.exposure import visible_sources
from truesky.render.exposure.records import Rows
from truesky.render.psf import euclid
from truesky.render.sources import galaxy_shapes, selection, source_list
from truesky.request.accuracy import SURVEY

SIDE, NOISE = 256, 12.0
BAND = passbands.load("euclid_vis")
BULGE = {"bulge_fraction": 1.0, "bulge_sersic_index": 4.0, "bulge_half_light_radius": 4.0}
SETTINGS = settings.Settings(edge=0.01, aliased=1e-4, floor=3e-4, min_size_arcsec=6.4, positions=9)


@pytest.fixture(scope="module")
def vis():
    """Return the PSF of the telescope, whose planes have a limited size."""
    return euclid.vis_psf(detectors.detector("vis", "3-4", MISSION), BAND, MISSION, 1)


def found(psf, galaxy=None, star=None):
    """Return (sources, sizes, image, drawn) of a small detector with a galaxy and a star on given pixels.

    The galaxy has 1e6 electrons, and the star 1e5.
    """
    detector = small("vis", "3-4", SIDE)
    system = wcs(detector, *boresight_for(detector, 10.0, 20.0, 33.0))
    body, points = (
        np.zeros((2, 0)) if at is None else sky_of_pixel(system, *np.array(at)[:, None]) for at in (galaxy, star)
    )
    rows = galaxies(*body, **BULGE), stars(*points)
    some, sizes = visible_sources.select_sources(
        Rows(rows[0], None, rows[1], None), (np.full(len(rows[0]), 1e6), np.full(len(rows[1]), 1e5)),
        aimed(detector, system, BAND), psf, NOISE, SETTINGS,
    )  # fmt: skip
    drawn = np.zeros(len(some))
    neglected = stamp_sizes.neglected_flux(some.electrons, NOISE, SETTINGS)
    image = stamps.draw(some, sizes, psf, SIDE, SIDE, None, neglected, stamps.Tally(drawn))
    return some, sizes, image, drawn


def test_light_of_a_galaxy_outside_the_frame_reaches_the_frame():
    """The light neither jumps nor ends when the stamp leaves the frame."""
    light, on_stamp = [], []
    for column in (-382.0, -383.0, -384.0, -385.0, -386.0, -387.0, -388.0):
        _, sizes, image, drawn = found(psf_of("vis"), (column, 100.0))
        assert sizes.tolist() == [768]
        light.append(image.sum())
        on_stamp.append(drawn[0])
    assert on_stamp[0] > 0
    assert on_stamp[-1] == 0
    np.testing.assert_allclose(np.array(light[1:]) / light[:-1], 1.0, atol=0.03)
    far = [found(psf_of("vis"), (column, 100.0))[2].sum() for column in (-500.0, -900.0, -1300.0)]
    assert light[-1] > far[0] > far[1] > far[2] > 1.0


def test_a_star_s_wings_come_from_beside_the_frame(vis):
    for column in (-40.0, -60.0, -120.0, -250.0):
        _, sizes, image, drawn = found(vis, star=(column, 100.0))
        assert image.sum() > (100.0 if column > -100 else 0.1)
        assert (drawn > 0) == (column > -0.5 * sizes)
    assert len(found(vis, star=(-300.0, 100.0))[0]) == 0
    # Behind an atmosphere, the stamp contains all wings.
    assert len(found(psf_of("vis"), star=(-60.0, 100.0))[0]) == 0


def crowd(n, seed, margin):
    """Return galaxies and stars on and around a frame."""
    rng = np.random.default_rng(seed)
    shapes = galaxy_shapes.shapes(
        galaxies(
            np.zeros(n), np.zeros(n), bulge_fraction=rng.random(n), bulge_sersic_index=rng.uniform(0.5, 6.0, n),
            bulge_half_light_radius=10 ** rng.uniform(-1, 0.7, n), disk_half_light_radius=10 ** rng.uniform(-1, 0.7, n),
            bulge_axis_ratio=rng.uniform(0.3, 1.0, n), inclination=90 * rng.random(n),
            position_angle=180 * rng.random(n),
        )
    )  # fmt: skip
    column, row = rng.uniform(-margin, SIDE + margin, (2, n))
    shape = np.where(rng.random(n) < 0.4, -1, np.arange(n))
    jacobian = np.tile(0.1 * np.eye(2), (n, 1, 1))
    return source_list.Sources(np.arange(n), column, row, jacobian, 10 ** rng.uniform(2, 5, n), shape, shapes)


def touching_frame(some, sizes, psf):
    return stamp_sizes.touching_frame(some, sizes, psf, NOISE, SIDE, SIDE)


@given(st.integers(0, 1000), st.sampled_from(["vis", "seeing"]))
def test_whom_nobody_names_brings_no_light(vis, seed, kind):
    """Sources that are not selected may be left out, bit by bit: neither galaxies nor wings of points add light."""
    some, psf = crowd(40, seed, 1200.0), vis if kind == "vis" else psf_of("vis")
    sizes = stamp_sizes.stamp_sizes(some.electrons, some.shape, some.shapes, psf, NOISE, SETTINGS)
    here = touching_frame(some, sizes, psf)
    assert not stamps.draw(some.take(~here), sizes[~here], psf, SIDE, SIDE).any()


@pytest.mark.nightly
def test_the_border_of_a_crowded_field_is_as_bright_as_its_middle(vis):
    """A frame agrees with the same part of a larger frame, within the promised accuracy."""
    margin = 304
    some = crowd(500, 3, 300.0)
    some.electrons[some.shape < 0] = 2e5
    sizes = stamp_sizes.stamp_sizes(some.electrons, some.shape, some.shapes, vis, NOISE, SETTINGS)
    here = touching_frame(some, sizes, vis)
    ours = stamps.draw(some.take(here), sizes[here], vis, SIDE, SIDE)
    wide = replace(some, column=some.column + margin, row=some.row + margin)
    whole = stamps.draw(wide, sizes, vis, SIDE + 2 * margin, SIDE + 2 * margin)
    missing = whole[margin:-margin, margin:-margin] - ours
    for border in (missing[:8], missing[-8:], missing[:, :8], missing[:, -8:]):
        assert abs(border.mean()) < 0.1 * SURVEY.background * NOISE
    assert np.abs(missing).max() < SURVEY.background * NOISE
    # Stamps alone would miss more light than that.
    touching = selection.overlaps_frame(some.column, some.row, sizes, SIDE, SIDE)
    less = ours - stamps.draw(some.take(touching), sizes[touching], vis, SIDE, SIDE)
    assert less[:8].mean() > 0.1 * SURVEY.background * NOISE
