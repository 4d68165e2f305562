"""Effects of the optics: ghosts, stray light, illumination, shutter, lamp, and the response of pixels."""

from dataclasses import replace

import galsim
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import optimize, stats

from lake_schema.errors import BadInput, OutOfRange
from lake_schema.mission.configuration import resolve
from lake_schema.mission.parameter import CAMERAS
from tests.truesky.render.fields import exposure
from truesky.fluxes import passbands
from truesky.randomness import rng
from truesky.render.camera import astrometry, detectors
from truesky.render.effects.charge import pixel_response
from truesky.render.effects.effect import apply_all
from truesky.render.effects.light import calibration_lamp, ghosts, illumination, intra_pixel, pixel_area, straylight
from truesky.render.effects.readout import readout_trail
from truesky.render.effects.scene import NOTICEABLE, STACK_SIZE, Lights, Scene
from truesky.render.exposure import rendered_detector
from truesky.render.psf import diffraction

MISSION = resolve()
PLACES = ("1-1", "3-4", "6-2")
EMPTY = np.zeros((400, 300))
CLEAN = (0.0, 3.0, 0.2)


def scene(name="3-4", **more):
    return Scene(MISSION, "vis", 560.53, 0.25, 1e4, detectors.detector("vis", name, MISSION), **more)


def light(column, row, electrons=1e8):
    return Lights(np.array([float(column)]), np.array([float(row)]), np.array([electrons]))


# ------------------------------------------------------------------------------------------------ ghosts


def with_ghosts(frame, *order):
    """Return a frame with the ghosts of one order: lights, flux ratio, offset and shape."""
    return ghosts.apply(frame, [ghosts.Order(*order)])


def test_a_ghost_is_an_annulus_of_the_right_light():
    image = with_ghosts(EMPTY, light(150.3, 100.6), 1e-4, (0.0, 100.0), ghosts.Pupil(56.0, 0.33, (), 0.0))
    assert image.sum() == pytest.approx(1e4, rel=1e-6)
    y, x = np.mgrid[:400, :300]
    radius = np.hypot(x - 150.3, y - 200.6)
    lit = (radius > 0.33 * 56 + 2) & (radius < 54)
    assert image[radius > 58].max() == 0
    assert image[radius < 0.33 * 56 - 2].max() == 0
    np.testing.assert_allclose(image[lit], 1e4 / (np.pi * 56**2 * (1 - 0.33**2)), rtol=0.02)
    assert (image * x).sum() / image.sum() == pytest.approx(150.3, abs=1e-3)
    assert (image * y).sum() / image.sum() == pytest.approx(200.6, abs=1e-3)


def test_arms_of_the_ghost():
    """Three dark bars, where the arms are."""
    arms = tuple(
        (40 * np.cos(np.radians(angle)), 40 * np.sin(np.radians(angle)), angle, 20.0) for angle in (0.0, 90.0, 225.0)
    )
    image = with_ghosts(EMPTY, light(150.0, 100.0), 1e-4, (0.0, 100.0), ghosts.Pupil(56.0, 0.33, arms, 4.0))
    along = {
        angle: (150 + 40 * np.cos(np.radians(angle)), 200 + 40 * np.sin(np.radians(angle)))
        for angle in range(0, 360, 15)
    }
    dark = [angle for angle, (x, y) in along.items() if image[round(y), round(x)] == 0]
    assert dark == [0, 90, 225]


def from_samples(pupil, side):
    """Return the part of each pixel that the ghost of a star in the middle of a frame covers, from 4 x 4 samples."""
    at = (np.arange(4 * side) + 0.5) / 4.0 - 0.5 - side // 2
    x, y = np.meshgrid(at, at)
    distance = np.hypot(x, y)
    lit = (distance >= pupil.hole * pupil.radius) & (distance <= pupil.radius)
    for column, row, angle, half_length in pupil.arms:
        dx, dy, turn = x - column, y - row, np.radians(angle)
        across = np.abs(dy * np.cos(turn) - dx * np.sin(turn))
        lit &= (np.hypot(dx, dy) > half_length) | (across >= 0.5 * pupil.width)
    return lit.reshape(side, 4, side, 4).mean(axis=(1, 3))


_ARMS = st.tuples(st.floats(-20.0, 20.0), st.floats(-20.0, 20.0), st.floats(0.0, 360.0), st.floats(0.0, 30.0))


@given(st.floats(3.0, 28.0), st.floats(0.0, 0.9), st.lists(_ARMS, max_size=3), st.floats(0.0, 0.3))
def test_pixels_far_from_all_borders_need_no_samples(radius, hole, arms, width):
    pupil, side = ghosts.Pupil(radius, hole, tuple(arms), width * radius), 61
    image = with_ghosts(np.zeros((side, side)), light(side // 2, side // 2, 1.0), 1.0, (0.0, 0.0), pupil)
    expected = from_samples(pupil, side)
    # Rounding may move one sample of 16 to the other side of a border.
    np.testing.assert_allclose(image * expected.sum(), expected, rtol=1e-3, atol=1.01 / 16.0)


@pytest.mark.parametrize("name", PLACES)
def test_the_ghost_s_arms_are_the_pupil_s(name):
    """Pixel by pixel what the pupil of the PSF lets through, in whatever way the detector is mounted."""
    shown = scene(name, lights=light(150, 100, 1e12))
    pupil = ghosts.parameters(shown)[0][0].pupil
    image = with_ghosts(EMPTY, light(150, 200), 1.0, (0.0, 0.0), pupil._replace(hole=0.0))
    y, x = np.mgrid[:400, :300] - np.array([200.0, 150.0])[:, None, None]
    turn, mm = np.radians(shown.detector.rotation), 600.0 / pupil.radius
    place = mm * (x * np.cos(turn) - y * np.sin(turn)), mm * (x * np.sin(turn) + y * np.cos(turn))
    clear = diffraction.pupil(*place, mm, MISSION)
    # Outside the central stop, which the ghost has in its own size and place, and inside the edge.
    seen = (np.hypot(*place) > 270.0) & (np.hypot(*place) < 580.0)
    np.testing.assert_allclose(image[seen] / image.max(), clear[seen], atol=0.25)
    assert (image[seen] < 0.1 * image.max()).sum() > 20


def test_stars_outside_send_their_ghosts_in():
    """A star below the frame; the ghost is the one of a larger frame."""
    pupil = ghosts.Pupil(56.0, 0.33, ((20.0, 6.0, 16.8, 30.0),), 1.0)
    large = with_ghosts(np.zeros((1000, 300)), light(100, 200), 1e-4, (0.0, 700.0), pupil)
    inside = with_ghosts(np.zeros((400, 300)), light(100, -400), 1e-4, (0.0, 700.0), pupil)
    np.testing.assert_array_equal(large[600:], inside)
    assert inside.sum() == pytest.approx(1e4, rel=1e-6)
    far = with_ghosts(np.zeros((400, 300)), light(100, 250), 1e-4, (0.0, 700.0), pupil)
    assert (far == 0).all()


def test_ghosts_add_up():
    one, two = light(100, 50), light(150, 180, 3e7)
    both = Lights(*(np.concatenate([getattr(one, k), getattr(two, k)]) for k in ("column", "row", "electrons")))
    args = (1e-4, (0.0, 60.0), ghosts.Pupil(20.0, 0.33, (), 0.0))
    together = with_ghosts(EMPTY, both, *args)
    np.testing.assert_allclose(together, with_ghosts(EMPTY, one, *args) + with_ghosts(EMPTY, two, *args), atol=1e-9)


def traced(x, y, tilt, order):
    """Trace a ray of a ghost surface by surface, and return where it and the direct ray meet the focal plane, mm.

    The plate is 19.897 mm thick (a ghost of 56 pixels at f/20.42 and an index of 1.45), 2 m before the focal plane. The
    light to (x, y) comes from the middle of the plate's front.
    """
    normal = np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    direct = np.array([x, y, 2000.0]) / np.hypot(np.hypot(x, y), 2000.0)
    incoming = direct - 2.0 * (direct @ normal) * normal
    # Snell's law for a ray against the normal, into glass.
    cosine = -incoming @ normal
    root = np.sqrt(1.0 - (1.0 - cosine**2) / 1.45**2)
    inside = incoming / 1.45 + (cosine / 1.45 - root) * normal
    place = np.zeros(3)
    for _ in range(order):
        place = place + inside * (19.897 / (-inside @ normal))
        up = inside - 2.0 * (inside @ normal) * normal
        place = place + up * (19.897 / (up @ normal))
    # It leaves the front parallel to the direct ray.
    ends = [at + direct * (2000.0 - at[2]) / direct[2] for at in (place, np.zeros(3))]
    return ends[0][:2] - ends[1][:2]


@pytest.mark.parametrize("name", PLACES)
def test_offsets_of_two_orders_are_those_of_traced_rays(name):
    """Everywhere on a detector, also one that is mounted upside down, within a tenth of a pixel."""
    tilt = optimize.brentq(lambda a: traced(0.0, 0.0, a, 1)[1] - 750.0 * 0.012, 0.1, 0.5)
    places = Lights(np.array([10.0, 4000.0, 2000.0]), np.array([20.0, 100.0, 4100.0]), np.full(3, 1e12))
    shown = scene(name, lights=places)
    (orders,) = ghosts.parameters(shown)
    assert [len(order.lights.electrons) for order in orders] == [3, 3]
    assert [order.ratio for order in orders] == [pytest.approx(1e-6, abs=0.0), pytest.approx(1e-7, abs=0.0)]
    assert [(order.pupil.radius, order.pupil.hole) for order in orders] == [(56.0, 0.33), (112.0, 0.33)]
    assert [order.pupil.width for order in orders] == [pytest.approx(n * 56 * 12 / 600) for n in (1, 2)]
    assert all(len(order.pupil.arms) == 3 for order in orders)
    turn, own = np.radians(shown.detector.rotation), shown.detector
    to_plane = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    for number, order in enumerate(orders, start=1):
        assert ((order.offset[1] < 0) == own.upside_down).all()
        for column, row, *moved in zip(places.column, places.row, *order.offset, strict=True):
            centred = np.array([column - (own.nx - 1) / 2, row - (own.ny - 1) / 2])
            x, y = 0.12 * np.array([own.x, own.y]) + 0.012 * to_plane @ centred
            np.testing.assert_allclose(to_plane @ moved, traced(x, y, tilt, number) / 0.012, atol=0.1)


def test_the_second_order_is_fainter_and_wider():
    """A tenth of the light in four times the area, twice as far; with a ratio of 0 there is none."""
    one = scene(lights=light(2000, 2000, 1e12))
    image = ghosts.apply(np.zeros((4136, 4096)), *ghosts.parameters(one))
    far = ghosts.parameters(one)[0][1]
    y, x = (slice(int(n - 113), int(n + 114)) for n in (2000 + far.offset[1][0], 2000 + far.offset[0][0]))
    assert image[y, x].sum() == pytest.approx(1e5, rel=1e-6)
    assert image.sum() == pytest.approx(1.1e6, rel=1e-6)
    # Light is even over the annulus, of which arms of 12 mm before a mirror of 600 mm cover 1.4 %.
    even = image[y, x].sum() ** 2 / (image[y, x] ** 2).sum()
    assert even == pytest.approx(np.pi * 112**2 * (1 - 0.33**2) * 0.986, rel=0.02)
    without = replace(one, mission=resolve(overrides={"vis.ghost.order_ratio": (0.0, "")}))
    image = ghosts.apply(np.zeros((4136, 4096)), *ghosts.parameters(without))
    assert image.sum() == pytest.approx(1e6, rel=1e-6)
    assert (image[y, x] == 0).all()


def test_stars_without_a_noticeable_ghost_are_left_out():
    """On either side of the threshold the ghost, as a whole, is 0.1 of the noise under it."""
    noise = scene().pixel_noise
    edge = NOTICEABLE * noise * np.sqrt(np.pi) * 56 / 1e-6
    for factor, shown in ((0.9, False), (1.1, True)):
        one = scene(lights=light(100, 100, factor * edge))
        assert ghosts.EFFECT.is_needed(one) == shown
        assert len(ghosts.parameters(one)[0][0].lights.electrons) == shown
        image = with_ghosts(EMPTY, one.lights, 1e-6, (0.0, 100.0), ghosts.Pupil(56.0, 0.33, (), 0.0))
        if not shown:
            assert image.max() < NOTICEABLE * noise
            assert image.sum() < NOTICEABLE * noise * np.sqrt((image > 0).sum()) * 1.1


def infrared(lights):
    """NISP's DET11 or, where it is upside down, DET33, in Y."""
    return [
        Scene(MISSION, "nisp", 87.24, 1.15, 1e4, detectors.detector("nisp", name, MISSION), lights=lights)
        for name in ("DET11", "DET33")
    ]


@pytest.mark.parametrize(("effect", "radius", "offset"), [(ghosts.EFFECT, 19.0, 250.0), (ghosts.FILTER, 30.0, -60.0)])
def test_ghosts_of_plates_before_the_infrared_detectors(effect, radius, offset):
    """The ghost of a star of 10 mag in Y is some five times the noise; a star of 14 mag has none."""
    for magnitude, shown in ((MISSION.value("nisp.ghost.star_limit", "mag"), True), (14.5, False)):
        star = light(150, 130, 10 ** (0.4 * (25.0 - magnitude)) * 87.24)
        for one in infrared(star):
            assert effect.is_needed(one) == shown
            image = effect.apply(EMPTY, *effect.parameters(one))
            noise = one.pixel_noise * np.sqrt(np.pi) * radius
            if not shown:
                assert image.sum() == 0.0
                continue
            sign = -1.0 if one.detector.upside_down else 1.0
            y, x = np.indices(image.shape)
            inside = np.hypot(x - 150, y - (130 + sign * offset)) < radius + 2.5
            assert image[~inside].sum() <= 1e-6 * image.sum()
            if inside.sum() > 0.9 * np.pi * radius**2:
                assert 3.0 < image.sum() / noise < 8.0
    # Within the masks, and about stars as faint as these.
    assert radius <= MISSION.value("nisp.ghost.radius", "pix")


def test_the_halo_of_a_star_before_an_infrared_detector():
    """1e-3 of a star of 8 mag in a halo of 60 arcsec: f / (2 pi s^2) of it in the pixel under it."""
    star = light(150, 200, 10 ** (0.4 * (25.0 - 8.0)) * 87.24)
    for one in infrared(star):
        assert straylight.EFFECT.is_needed(one)
        image = straylight.EFFECT.apply(EMPTY, *straylight.EFFECT.parameters(one))
        assert image[200, 150] == pytest.approx(1e-3 * star.electrons[0] / (2 * np.pi * 200.0**2), rel=5e-3)
        assert image[200, 150 + 140] / image[200, 150] == pytest.approx((1 + 0.7**2) ** -1.5, rel=5e-3)


@pytest.mark.parametrize("wrong", [(-1.0, 56.0, 0.3), (1e-4, 0.0, 0.3), (1e-4, 56.0, 1.0), (np.nan, 56.0, 0.3)])
def test_impossible_ghosts_are_refused(wrong):
    with pytest.raises(OutOfRange, match="ghost"):
        with_ghosts(EMPTY, light(1, 1), wrong[0], (0.0, 0.0), ghosts.Pupil(*wrong[1:], (), 0.0))


# ------------------------------------------------------------------------------------------------ straylight


def test_a_halo_has_its_form():
    image = straylight.apply(EMPTY, light(150.4, 190.2, 1e9), 5e-4, 40.0)
    y, x = np.mgrid[:400, :300]
    u = 1 + ((x - 150.4) ** 2 + (y - 190.2) ** 2) / 40.0**2
    wanted = 1e9 * 5e-4 / (2 * np.pi * 40.0**2) * u**-1.5
    np.testing.assert_allclose(image, wanted, atol=2e-3 * wanted.max())
    total = 1 - 1 / np.sqrt(1 + (140 / 40.0) ** 2)
    assert image[np.hypot(x - 150, y - 190) < 140].sum() == pytest.approx(5e5 * total, rel=0.01)


def test_halos_come_from_outside_too():
    image = straylight.apply(EMPTY, light(-50.0, 200.0, 1e9), 5e-4, 40.0)
    assert image[200, 0] > image[200, 50] > image[200, 299] > 0


def test_faint_stars_have_no_halo():
    many = Lights(np.full(3, 10.0), np.full(3, 10.0), np.array([1e3, 1e6, 1e11]))
    chosen, fraction, scale = straylight.EFFECT.parameters(scene(lights=many))
    assert (fraction, scale) == (5e-4, 400.0)
    np.testing.assert_array_equal(chosen.electrons, [1e11])


# ------------------------------------------------------------------------------------------------ pixel area


@pytest.mark.parametrize("name", PLACES)
def test_a_pixel_sees_of_the_sky_what_the_jacobian_says(name):
    """Corners and middle, against differences of the header's world coordinates; at the boresight nothing changes."""
    one = scene(name)
    electrons, u, v, stretch = pixel_area.parameters(one)
    assert electrons == one.sky_electrons
    column, row = (np.array(at) for at in ((0, 4095, 2000, 0, 4095), (0, 0, 2000, 4131, 4131)))
    found = np.diag(pixel_area.area_change(u[column], v[row], stretch))
    system = astrometry.wcs(one.detector, 150.0, 2.0, 33.0)
    area = np.abs(np.linalg.det(astrometry.jacobian(system, column, row))) / 0.1**2
    # The tangent plane is 1.2e-4 larger than the sky at the corners of the field.
    np.testing.assert_allclose(found, area - 1.0, atol=1e-5)
    assert np.abs(pixel_area.area_change(np.zeros(1), np.zeros(1), stretch)).max() == 0
    # In a mean of many pixels, everywhere in the field; in one pixel, in its corner.
    assert pixel_area.EFFECT.is_needed(one)
    assert (pixel_area.EFFECT.margin(one) > np.sqrt(STACK_SIZE)) == (name == "1-1")
    assert not pixel_area.EFFECT.is_needed(replace(one, sky_rate=1e-4))


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_pixel_of_a_ground_camera_too(camera):
    """On its outermost detector, against differences of the header's world coordinates."""
    d = max(detectors.detectors(camera, resolve()), key=lambda d: np.hypot(d.x, d.y))
    one = replace(scene(), section=d.section, detector=d, sky_rate=10.0)
    _, u, v, stretch = pixel_area.parameters(one)
    column, row = (np.array(at) for at in ((0, d.nx - 1, 0, d.nx - 1), (0, 0, d.ny - 1, d.ny - 1)))
    system = astrometry.wcs(d, 150.0, 2.0, 33.0)
    area = np.abs(np.linalg.det(astrometry.jacobian(system, column, row))) / d.pixel_scale**2
    found = np.diag(pixel_area.area_change(u[column], v[row], stretch))
    np.testing.assert_allclose(found, area - 1.0, atol=1e-4)
    # Pixels near the corner receive less light of the sky.
    assert found.max() < -2e-3
    assert pixel_area.EFFECT.is_needed(one)


def test_without_distortion_only_the_projection_is_left():
    straight = replace(scene(), detector=replace(scene().detector, distortion_terms=()))
    assert 0.0 < pixel_area.EFFECT.contribution(straight) < 2e-4 * straight.sky_electrons
    assert pixel_area.EFFECT.contribution(replace(straight, detector=None)) == 0.0


# ------------------------------------------------------------------------------------------------ illumination


@pytest.mark.parametrize("name", PLACES)
def test_illumination_is_one_map_over_the_focal_plane(name):
    """Pixel by pixel what the formula says at its place, in whatever way the detector is turned."""
    turned = replace(scene(name).detector, nx=60, ny=40, pixel_scale=7.0)
    one = replace(scene(name), detector=turned)
    columns, rows = illumination.pattern(one, 60, 40, 0.02, (0.003, -0.01))
    everything = detectors.detectors("vis", MISSION)
    half_x = max(d.x for d in everything) + 204.8
    half_y = max(d.y for d in everything) + 206.8
    for c, r in ((0, 0), (59, 39), (17, 30)):
        turn = np.radians(turned.rotation)
        dx, dy = 7.0 * (c - 29.5), 7.0 * (r - 19.5)
        x = turned.x + dx * np.cos(turn) - dy * np.sin(turn)
        y = turned.y + dx * np.sin(turn) + dy * np.cos(turn)
        wanted = 1 - 0.02 * (x**2 + y**2) / (half_x**2 + half_y**2) + 0.003 * x / half_x - 0.01 * y / half_y
        assert 1 + columns[c] + rows[r] == pytest.approx(wanted, abs=1e-12)


def test_vignetting_and_shutter_are_per_cents():
    """The shutter's blades take as long in a short exposure, of which that is more."""
    corner = illumination.apply(np.ones((4136, 4096)), *illumination.EFFECT.parameters(scene("1-1")))
    assert corner[-1, 0] == pytest.approx(0.98, abs=1e-5)
    shutter = [
        illumination.apply(np.ones((4136, 4096)), *illumination.SHUTTER.parameters(one))
        for one in (scene("1-1"), scene("6-1"), replace(scene("1-1"), exposure_time_s=89.52))
    ]
    assert shutter[0].max() == pytest.approx(1 + 1.68 / 560.53, abs=1e-6)
    assert shutter[1].min() == pytest.approx(1 - 1.68 / 560.53, abs=1e-6)
    assert shutter[2].max() == pytest.approx(1 + 1.68 / 89.52, abs=1e-5)
    # Nobody is exposed for less than nothing, or at all in no time.
    for time, most in ((1.0, 2.0), (0.0, 1.0)):
        columns, rows = illumination.SHUTTER.parameters(replace(scene("1-1"), exposure_time_s=time))
        assert 1 + columns.max() + rows.max() == pytest.approx(most, abs=1e-3)
        assert 1 + columns.min() + rows.min() >= 0.0


def test_lamps_differ_in_where_they_shine():
    ones = np.ones((40, 60))
    maps = [
        1 + ones * 0 + rows[:, None] + columns
        for columns, rows in (calibration_lamp.pattern(scene(), led, 60, 40) for led in range(1, 7))
    ]
    for i in range(6):
        for other in maps[:i]:
            assert np.abs(maps[i] - other).max() > 1e-4
    with pytest.raises(OutOfRange, match="LED"):
        calibration_lamp.pattern(scene(), 7, 60, 40)
    with pytest.raises(OutOfRange, match="LED"):
        calibration_lamp.efficiency_of_scene(scene(), 0)
    with pytest.raises(OutOfRange, match="lamp"):
        calibration_lamp.apply(ones, -1.0, np.zeros(60), np.zeros(40))


def test_lamps_differ_in_what_is_seen_of_them():
    """Each LED's line through the band, by quadrature of another kind; a narrow band sees its own lamp alone."""
    band = passbands.load("euclid_vis")
    for led, centre in enumerate((5500, 6200, 6900, 7600, 8300, 9000), start=1):
        line = stats.norm(centre, 400 / (2 * np.sqrt(2 * np.log(2))))
        edges = np.append(band.wavelength - 0.5, band.wavelength[-1] + 0.5)
        wanted = np.diff(line.cdf(edges)) @ band.response / band.response.max()
        assert calibration_lamp.efficiency_of_scene(scene(), led) == pytest.approx(wanted, rel=1e-5)
        level, *_ = calibration_lamp.EFFECT.parameters(scene(lamp=led))
        assert level == pytest.approx(MISSION.value("vis.flat.signal", "electron") * wanted, rel=1e-5)
    # Half of the bluest shines where the band has not begun.
    assert calibration_lamp.efficiency_of_scene(scene(), 1) < 0.75 * calibration_lamp.efficiency_of_scene(scene(), 2)
    red = passbands.Passband("red", np.arange(8800.0, 9201.0), np.full(401, 0.8), "vacuum")
    own = [calibration_lamp.efficiency_of_scene(scene(band=red), led) for led in range(1, 7)]
    assert own[5] > 0.5
    assert max(own[:4]) < 1e-6


def test_a_map_of_other_size_is_refused():
    with pytest.raises(BadInput, match="illumination"):
        illumination.apply(EMPTY, np.zeros(3), np.zeros(400))
    with pytest.raises(OutOfRange, match="illumination"):
        illumination.apply(EMPTY, np.full(300, -3.0), np.zeros(400))


def halves(ny):
    """Return the segments of columns with a register at both ends."""
    return (0, ny // 2, False), (ny // 2, ny, True)


def test_columns_of_one_register_are_blind_to_their_far_end():
    pieces = [(0, 40, False)], [(0, 40, True)], [(0, 10, False), (12, 40, False)]
    maps = [
        pixel_response.response((40, 300), 0.0, (0.0, 90.0), CLEAN, runs, np.random.default_rng(3)) == 0
        for runs in pieces
    ]
    assert (np.diff(maps[0].astype(int), axis=0) >= 0).all()
    assert (np.diff(maps[1].astype(int), axis=0) <= 0).all()
    assert maps[0].any(axis=0).sum() == maps[1].any(axis=0).sum() > 50
    assert not maps[2][10:12].any()
    assert (np.diff(maps[2][:10].astype(int), axis=0) >= 0).all()


def test_the_response_of_pixels():
    response = pixel_response.response((600, 500), 0.01, (1e-3, 3.0), CLEAN, halves(600), np.random.default_rng(2))
    good = response > 0.6
    assert response[good].std() == pytest.approx(0.01, rel=0.02)
    assert response[good].mean() == pytest.approx(1.0, abs=1e-4)
    dark = (response == 0).sum(axis=0)
    assert 1 <= (dark > 2).sum() <= 9
    assert ((response > 0) & ~good).sum() == pytest.approx(300, abs=80)
    assert pixel_response.EFFECT.fixed
    # A defect hides what lies behind it, as seen from its own register: up to the middle, and no farther.
    many = pixel_response.response((40, 500), 0.0, (0.0, 200.0), CLEAN, halves(40), np.random.default_rng(3)) == 0
    below, above = many[:20], many[20:][::-1]
    assert below.any()
    assert above.any()
    for half in (below, above):
        assert (np.diff(half.astype(int), axis=0) >= 0).all()
    assert (below.any(axis=0) != above.any(axis=0)).sum() > 50


def test_dust_casts_shadows():
    """Shadows have the stated number, depth and mean width."""
    grains, radius, depth = 2e-4, 2.0, 0.3
    dust = (grains, radius, depth)
    dusty = pixel_response.response((1000, 900), 0.0, (0.0, 0.0), dust, halves(1000), np.random.default_rng(4))
    # Two may lie on each other.
    assert (1 - depth) ** 2 * 0.99 < dusty.min() < 1 - 0.95 * depth
    # A Gaussian shadow lacks 2 pi size^2 of the light; the mean of size^2 is twice the square of the mean size.
    missing = grains * dusty.size * depth * 2 * np.pi * 2 * radius**2
    assert (1 - dusty).sum() == pytest.approx(missing, rel=0.25)
    # The other defects are where they are without.
    defects = (0.01, (1e-3, 3.0))
    clean, same = (
        pixel_response.response((300, 200), *defects, dust, halves(300), np.random.default_rng(2))
        for dust in (CLEAN, (1e-4, radius, depth))
    )
    assert 0 < (clean != same).sum() < 6000
    np.testing.assert_array_equal(clean == 0, same == 0)
    # They are on the detector, in every exposure.
    assert MISSION.value("vis.dust") * 4096 * 4132 == pytest.approx(17, abs=1)


@pytest.mark.parametrize(
    "wrong",
    [
        (-1.0, (0.0, 0.0), CLEAN), (0.0, (2.0, 0.0), CLEAN), (0.0, (0.0, -1.0), CLEAN), (np.nan, (0.0, 0.0), CLEAN),
        (0.0, (0.0, 0.0), (-1.0, 1.0, 0.1)), (0.0, (0.0, 0.0), (0.0, np.inf, 0.1)), (0.0, (0.0, 0.0), (0.0, 1.0, 1.1)),
    ],
)  # fmt: skip
def test_impossible_responses_are_refused(wrong):
    with pytest.raises(OutOfRange, match=r"pixel|dark|dust"):
        pixel_response.response((3, 3), *wrong, halves(3), np.random.default_rng(1))


# ------------------------------------------------------------------------------------------------ intra-pixel, trail


def test_intra_pixel_response_against_the_integral_over_pixels():
    """The transform of the response, sampled finely; unity at k = 0; the plain pixel without it."""
    u = (np.arange(400) + 0.5) / 200 - 1
    response = 1 - 0.05 * (u[:, None] ** 2 + u**2)
    response /= response.mean()
    for x, y in ((0.0, 0.0), (1e-3, 0.0), (0.04, 0.05), (0.3, -0.2), (0.5, 0.5), (1.0, 0.7)):
        wanted = (response * np.cos(np.pi * x * u) * np.cos(np.pi * y * u[:, None])).mean()
        assert intra_pixel.EFFECT.apply(x, y, 0.05) == pytest.approx(wanted, abs=1e-5)
    assert intra_pixel.EFFECT.apply(0.0, 0.0, 0.3) == 1.0
    x, y = np.mgrid[-1:1:9j, -1:1:9j]
    np.testing.assert_allclose(intra_pixel.EFFECT.apply(x, y, 0.0), np.sinc(x) * np.sinc(y), atol=1e-15)
    # Series and closed form meet.
    edge = 0.15 / np.pi
    below, above = (intra_pixel.EFFECT.apply(edge * (1 + step), 0.0, 0.5) for step in (-1e-9, 1e-9))
    assert below == pytest.approx(above, abs=1e-10)
    with pytest.raises(OutOfRange, match="intra-pixel"):
        intra_pixel.EFFECT.apply(0.0, 0.0, 0.7)


def test_intra_pixel_response_changes_a_star_as_stated():
    """Through GalSim: a star of VIS's width loses 0.3 % of its wings to its centre."""
    star = galsim.Convolve(galsim.Airy(lam=700, diam=1.2, obscuration=0.35), galsim.Gaussian(sigma=0.033))
    fine = star.drawImage(nx=41 * 15, ny=41 * 15, scale=0.1 / 15, method="no_pixel").array.astype(float)
    blocks = fine.reshape(41, 15, 41, 15)
    u = (np.arange(15) + 0.5) / 7.5 - 1
    response = 1 - 0.05 * (u[:, None] ** 2 + u**2)
    plain, changed = blocks.sum(axis=(1, 3)), np.einsum("aibj,ij->ab", blocks, response / response.mean())
    most = np.abs(changed - plain).max() / plain.max()
    one = scene()
    assert intra_pixel.EFFECT.contribution(one) == pytest.approx(most * one.peak_electrons, rel=0.15)


def test_open_shutter_draws_a_trail():
    frame = np.zeros((20, 3))
    frame[4, 1] = frame[13, 2] = 1000.0
    out = readout_trail.apply(frame, 1e-3, 2)
    # Rows read after the star pass over it: away from the register, up to the middle.
    np.testing.assert_allclose(out[5:10, 1], 1.0)
    np.testing.assert_allclose(out[10:13, 2], 1.0)
    assert out[:, 0].max() == 0
    assert (out[:4, 1] == 0).all()
    assert (out[14:, 2] == 0).all()
    share, halves, response = readout_trail.EFFECT.parameters(scene())
    assert share == pytest.approx(72 / 2086 / 560.53)
    # Compare with the dwell time of traps: the time that a row stays in a pixel.
    assert share * 560.53 == pytest.approx(scene().value("cti.dwell_time", "s"), rel=0.03)
    assert halves == 2
    assert response == pixel_response.EFFECT.parameters(scene())
    with pytest.raises(OutOfRange, match="trail"):
        readout_trail.apply(frame, -1.0, 2)
    with pytest.raises(OutOfRange, match="halves"):
        readout_trail.apply(frame, 1.0, 4)


def test_light_of_a_trail_is_seen_by_the_pixels_that_it_falls_on():
    """Each row collects its light, and then light of the rows that it passes, with the response of their pixels."""
    # Old pixels, some dead.
    worn = resolve(overrides={"vis.prnu": (0.2, ""), "vis.dead_pixels": (0.05, "")})
    ny, nx = 40, 30
    detector = replace(detectors.detector("vis", "3-4", worn), nx=nx, ny=ny, injection_rows=4)
    one = Scene(worn, "vis", 10.0, 0.25, 1e5, detector)
    row = {"exposure_id": 1, "channel": "VIS", "camera": "vis", "image_type": "flat"}
    frame = np.random.default_rng(2).uniform(0.0, 1e5, (ny, nx))

    def stream(effect):
        return rng.stream(*rendered_detector.random_identity(effect, exposure(**row), "3-4", 1))

    both = (readout_trail.EFFECT, pixel_response.EFFECT)
    found, _ = apply_all(frame, both, replace(one, forced={"readout_trail": True, "pixel_response": True}), stream)
    seen = pixel_response.response((ny, nx), *pixel_response.parameters(one), stream(pixel_response.EFFECT))
    assert (seen < 0.5).sum() > 20
    share = one.value("readout_time", "s") / 2086 / 10.0
    expected = frame * seen
    for r in range(ny):
        passed = range(r) if r < ny // 2 else range(r + 1, ny)
        expected[r] += sum((share * frame[p] * seen[p] for p in passed), np.zeros(nx)) * (seen[r] > 0)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    # Without a response all pixels are equal, whatever the random numbers.
    alike, _ = apply_all(frame, both, replace(one, forced={"readout_trail": True, "pixel_response": False}), stream)
    np.testing.assert_array_equal(alike, readout_trail.apply(frame, share, 2))
