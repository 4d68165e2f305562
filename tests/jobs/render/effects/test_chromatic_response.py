"""Chromatic response of infrared pixels: maps, colours, and three planes against a plane for each wavelength."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import _scenes as scenes
from jobs.fluxes import passbands
from jobs.render.camera.detectors import detector
from jobs.render.drawing import stamps
from jobs.render.effects.light import chromatic_response
from jobs.render.effects.scene import NOTICEABLE
from jobs.render.psf import euclid
from jobs.render.psf.sub_bands import PARTS, sub_bands
from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import resolve

MISSION = resolve()
Y = passbands.load("euclid_y")
SLOPE, CURVATURE = (MISSION.value(f"nisp.response.{key}", "") for key in ("slope", "curvature"))
TABLE = chromatic_response.table("nisp", Y, MISSION)
# rms of a signal without a source.
NOISE = 12.0


def drawn_maps(shape=(400, 300), slope=SLOPE, curvature=CURVATURE, seed=3):
    return chromatic_response.maps(shape, slope, curvature, np.random.default_rng(seed))


def test_maps_have_the_mission_s_rms():
    found = drawn_maps((1020, 1020))
    assert found.std(axis=(1, 2)) == pytest.approx([SLOPE, CURVATURE], rel=0.2)
    # Half of the variance is smooth: that of means over 20 x 20 pixels.
    smooth = found.reshape(2, 51, 20, 51, 20).mean(axis=(2, 4))
    assert smooth.var(axis=(1, 2)) == pytest.approx(0.5 * np.array([SLOPE, CURVATURE]) ** 2, rel=0.5)
    assert np.corrcoef(found[0].ravel(), found[1].ravel())[0, 1] == pytest.approx(0.0, abs=0.25)
    np.testing.assert_array_equal(found, drawn_maps((1020, 1020)))
    assert (drawn_maps(slope=0.0, curvature=0.0) == 0.0).all()


@pytest.mark.parametrize(("slope", "curvature"), [(-0.1, 0.0), (0.0, 0.6), (np.nan, 0.0)])
def test_impossible_maps_are_refused(slope, curvature):
    with pytest.raises(OutOfRange, match="chromatic response"):
        drawn_maps(slope=slope, curvature=curvature)


def test_there_are_forty_wavelengths_over_the_range():
    rows = np.array(MISSION.numbers("nisp.response.components"))
    assert rows.shape == (40, 3)
    assert rows[[0, -1], 0].tolist() == [0.6, 2.55]
    assert (np.diff(rows[:, 0]) > 0).all()


@given(st.lists(st.floats(0.01, 1.0), min_size=PARTS, max_size=PARTS))
def test_colours_are_means_of_the_components(weights):
    """And flat f_nu is where they are told from."""
    shares = np.array([weights]) / np.sum(weights)
    own = chromatic_response.colours(shares, TABLE)
    assert np.abs(own).max() <= np.abs(TABLE).max()
    np.testing.assert_allclose(chromatic_response.colours(np.full((1, PARTS), 1 / PARTS), TABLE), 0.0, atol=1e-15)
    parts = sub_bands(Y)
    photons = np.concatenate(
        [
            w * p.response / p.wavelength / np.sum(p.response / p.wavelength)
            for w, p in zip(shares[0], parts, strict=True)
        ]
    )
    lines = chromatic_response.of_lines("nisp", Y, np.concatenate([p.wavelength for p in parts]), photons, MISSION)
    np.testing.assert_allclose(own[0], lines, atol=1e-12)


def test_a_lamp_at_the_band_s_edge_has_a_colour_of_its_own():
    """1.19 um in Y: 0.1 um from the middle, of which the slope changes by 1 in 0.95."""
    own = chromatic_response.of_lines("nisp", Y, np.array([11900.0]), np.ones(1), MISSION)
    middle = np.average(Y.wavelength, weights=Y.response / Y.wavelength)
    assert own[0] == pytest.approx((1.19 - 1e-4 * middle) / 0.95, abs=5e-3)
    # Noticed in a flat of 30 000 e-.
    assert 3e4 * np.hypot(*(own * [SLOPE, CURVATURE])) > NOTICEABLE * np.hypot(NOISE, np.sqrt(3e4))


@pytest.fixture(scope="module")
def field():
    """Forty sources of different colours on 200 x 200 pixels, and how they are drawn."""
    psf = euclid.nisp_psf(detector("nisp", "DET23", MISSION), Y, MISSION, 1)
    scene = scenes.Scene("nisp", 200, 200, 0.3, 87.24, 25.0, NOISE, 0, 0)
    some = scenes.sources(scene, 21, galaxies=30, stars=10)
    sizes = np.full(len(some), 64)

    def draw(electrons, photons=some.photons):
        one = replace(some, electrons=electrons, photons=photons)
        return stamps.draw(one, sizes, psf, 200, 200)

    return some, draw


def test_three_planes_are_a_plane_for_each_wavelength(field):
    """The slow way: every part of the band drawn by itself, times what pixels see of it."""
    some, draw = field
    response = drawn_maps((200, 200))
    light = chromatic_response.planes(draw(some.electrons), some.electrons, some.photons, TABLE, draw)
    found = chromatic_response.seen(light, response)
    each = 0.0
    for part in range(PARTS):
        alone = np.zeros((len(some), PARTS))
        alone[:, part] = 1.0
        factor = 1.0 + response[0] * TABLE[part, 0] + response[1] * TABLE[part, 1]
        each = each + factor * draw(some.electrons * some.photons[:, part], alone)
    change = np.abs(found - light[0])
    np.testing.assert_allclose(found, each, atol=1e-3 * change.max())
    # The colours of whole sources are not all of it: blue light is in the middle of the PSF.
    own = chromatic_response.colours(some.photons, TABLE)
    whole = sum(response[k] * draw(some.electrons * (own[:, k] + 1.0)) - response[k] * light[0] for k in (0, 1))
    assert np.abs(light[0] + whole - each).max() > 0.02 * change.max()
    assert np.abs(light[0] + whole - each).max() < change.max()


def test_ordinary_sources_do_not_need_it():
    """Fainter than 18 mag, of the colours of galaxies and stars: less than a tenth of the noise in a pixel."""
    shares = scenes.colours(400, np.random.default_rng(1))
    own = chromatic_response.colours(shares / shares.sum(axis=1, keepdims=True), TABLE)
    for magnitude, needed in ((18.0, False), (14.0, True)):
        peak = np.full(400, 0.3 * 87.24 * 10 ** (0.4 * (25.0 - magnitude)))
        change = chromatic_response.largest(peak, own, SLOPE, CURVATURE)
        noise = np.hypot(NOISE, np.sqrt(peak[0]))
        print(magnitude, f"{change:.2f} e- in a pixel of {peak[0]:.0f}, noise {noise:.1f}")
        assert (change > NOTICEABLE * noise) == needed
