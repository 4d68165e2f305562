"""Drawing at the edges of what a catalogue may hold: finite, bounded, and with the flux that was asked for."""

import time

import numpy as np
import pytest

from jobs.accuracy import SURVEY
from jobs.render import profiles, stamps
from jobs.render.focal_plane import boresight_for, wcs
from tests.jobs.render.fields import galaxies, one_source, small, spread

NOISE = 12.0
SIDE = 256
SHAPES = {
    "n 0.3": {"bulge_fraction": 1.0, "bulge_sersic_index": 0.3},
    "n 6.2": {"bulge_fraction": 1.0, "bulge_sersic_index": 6.2},
    "tiny": {"bulge_fraction": 0.5, "bulge_half_light_radius": 1e-4, "disk_half_light_radius": 1e-4},
    "no size": {"bulge_fraction": 0.5, "bulge_half_light_radius": 0.0, "disk_half_light_radius": 0.0},
    "slim": {"bulge_fraction": 1.0, "bulge_axis_ratio": 0.02},
    "face-on": {"inclination": 0.0},
    "edge-on": {"inclination": 90.0},
    "sheared": {"gamma1": 0.63, "gamma2": -0.63, "disk_half_light_radius": 0.1},
    "magnified": {"kappa": 0.9, "disk_half_light_radius": 0.1},
}
HUGE = {
    "bulge": {"bulge_fraction": 1.0, "bulge_half_light_radius": 60.0, "bulge_sersic_index": 6.2},
    "disc": {"disk_half_light_radius": 60.0, "inclination": 90.0},
}


def drawn(source, psf, side=SIDE, accuracy=SURVEY):
    settings = stamps.settings_for(accuracy)
    sizes = stamps.stamp_sizes(source.electrons, source.shape, source.shapes, psf, NOISE, settings)
    floors = stamps.floors(source.electrons, NOISE, settings)
    return stamps.draw(source, sizes, psf, side, side, floors=floors), int(sizes[0])


def source_of(camera, electrons, **where_and_shape):
    detector = small(camera, "3-4" if camera == "vis" else "R22_S11", SIDE)
    return one_source(detector, wcs(detector, *boresight_for(detector, 10.0, 20.0, 33.0)), electrons, **where_and_shape)


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize("camera", ["vis", "lsstcam"])
def test_flux_is_right_and_nothing_rings(camera, kind):
    image, _ = drawn(source_of(camera, 1e4, **SHAPES[kind]), spread(camera))
    assert np.isfinite(image).all()
    # What lies beyond the frame (n = 6.2) is not on it.
    assert image.sum() == pytest.approx(1e4, rel=1e-3 if kind != "n 6.2" else 0.03)
    assert image.min() > -max(1e-3 * image.max(), SURVEY.background * NOISE)


@pytest.mark.parametrize("kind", HUGE)
def test_the_largest_are_bounded_in_time(kind):
    start = time.process_time()
    image, size = drawn(source_of("vis", 1e6, **HUGE[kind]), spread("vis"))
    assert size <= stamps.SIZES[-1]
    assert time.process_time() - start < 20
    assert np.isfinite(image).all()
    assert 0 < image.sum() <= 1e6 * (1 + 1e-4)


@pytest.mark.parametrize("electrons", [1e-6, 1.0, 1e7 - 1, 1e7 + 1, 1e11])
def test_linear_in_flux(electrons):
    """Single and double precision alike."""
    whole, _ = drawn(source_of("lsstcam", electrons), spread("lsstcam"))
    settings = stamps.settings_for(SURVEY)
    one = source_of("lsstcam", 1e5)
    sizes = stamps.stamp_sizes(np.array([electrons]), one.shape, one.shapes, spread("lsstcam"), NOISE, settings)
    unit = stamps.draw(one, sizes, spread("lsstcam"), SIDE, SIDE) / 1e5
    np.testing.assert_allclose(whole, electrons * unit, atol=3e-6 * electrons * unit.max() + 1e-6)


@pytest.mark.parametrize(("x", "y"), [(-0.5, 100.0), (255.5, 255.5), (0.0, 0.0), (300.0, 100.0), (-1e5, 3.0)])
def test_edges_and_corners(x, y):
    image, _ = drawn(source_of("vis", 1e4, column=x, row=y, inclination=40.0), spread("vis"))
    assert np.isfinite(image).all()
    assert 0 <= image.sum() <= 1e4 * (1 + 1e-4)


@pytest.mark.parametrize(("dx", "dy"), [(3, 0), (-7, 20)])
def test_whole_pixels_move_the_image(dx, dy):
    args = {"inclination": 50.0, "bulge_fraction": 0.3}
    base, _ = drawn(source_of("vis", 1e4, column=120.3, row=125.8, **args), spread("vis"))
    source = source_of("vis", 1e4, column=120.3, row=125.8, **args)
    other = stamps.Sources(
        source.ids, source.column + dx, source.row + dy, source.jacobian, source.electrons, source.shape, source.shapes
    )
    np.testing.assert_allclose(drawn(other, spread("vis"))[0], np.roll(base, (dy, dx), (0, 1)), atol=1e-5 * base.max())


def test_a_face_on_disc_is_symmetric():
    image, _ = drawn(source_of("vis", 1e4, column=128.0, row=128.0, inclination=0.0), spread("vis"))
    core = image[98:159, 98:159]
    np.testing.assert_allclose(core, core[::-1, ::-1], atol=1e-5 * core.max())


@pytest.mark.parametrize("seed", [1, 2])
def test_any_order_gives_the_same_bits(seed):
    rng = np.random.default_rng(seed)
    n = 60
    form = profiles.shapes(
        galaxies(rng.random(n), rng.random(n), bulge_fraction=rng.random(n), gamma1=0.1 * rng.random(n))
    )
    source = stamps.Sources(
        np.arange(n), SIDE * rng.random(n), SIDE * rng.random(n), np.tile(0.1 * np.eye(2), (n, 1, 1)),
        10 ** rng.uniform(1, 7.5, n), np.where(rng.random(n) < 0.3, -1, np.arange(n)), form,
    )  # fmt: skip
    sizes = np.full(n, 64)
    sizes[::7] = 96
    base = stamps.draw(source, sizes, spread("vis"), SIDE, SIDE)
    order = rng.permutation(n)
    np.testing.assert_array_equal(base, stamps.draw(source.take(order), sizes[order], spread("vis"), SIDE, SIDE))
    halves = [
        stamps.draw(source.take(part), sizes[part], spread("vis"), SIDE, SIDE) for part in np.array_split(order, 2)
    ]
    np.testing.assert_array_equal(base, sum(halves))
