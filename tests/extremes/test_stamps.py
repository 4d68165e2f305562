"""Drawings of extreme sources are finite, take bounded time and have the requested flux.

Photons that are shot one by one are the independent reference: positions drawn from the profile's own distribution,
lensed, spread by the seeing disc, counted in pixels.
"""

import time
from dataclasses import fields, replace
from functools import cache
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import gammaincinv

from lake_schema.tables.galaxies import DISK_SCALE_HEIGHT
from tests.truesky.render.fields import aimed, galaxies, moments, one_source, psf_of, small, stars
from truesky.fluxes import passbands
from truesky.render.camera.astrometry import sky_of_pixel, wcs
from truesky.render.camera.pointing import boresight_for
from truesky.render.drawing import cost, stamp_sizes, stamps
from truesky.render.drawing.kernels import frame
from truesky.render.drawing.settings import settings_for
from truesky.render.exposure import visible_sources
from truesky.render.exposure.records import Rows
from truesky.render.sources import galaxy_shapes, source_list
from truesky.render.sources.galaxy_shapes import EXPONENTIAL_RADIUS
from truesky.request.accuracy import DRAFT, SURVEY

NOISE = 12.0
# Seconds of processor time: a large galaxy takes 1, what does not end takes for ever.
HANGS = 120.0
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
    "magnified bulge": {
        "kappa": 0.9, "bulge_fraction": 1.0, "bulge_half_light_radius": 0.05, "bulge_sersic_index": 4.0,
    },
    "disc and bulge": {
        "bulge_fraction": 0.5, "bulge_sersic_index": 3.0, "bulge_axis_ratio": 0.3, "inclination": 70.0, "gamma1": 0.3,
    },
}  # fmt: skip
HUGE = {
    "bulge": {"bulge_fraction": 1.0, "bulge_half_light_radius": 60.0, "bulge_sersic_index": 6.2},
    "disc": {"disk_half_light_radius": 60.0, "inclination": 90.0},
}


def drawn(source, psf, side=SIDE, accuracy=SURVEY):
    settings = settings_for(accuracy)
    sizes = stamp_sizes.stamp_sizes(source.electrons, source.shape, source.shapes, psf, NOISE, settings)
    neglected = stamp_sizes.neglected_flux(source.electrons, NOISE, settings)
    return stamps.draw(source, sizes, psf, side, side, neglected=neglected), int(sizes[0])


@cache
def compiled():
    """Draw once in both precisions, so that compilation is not timed."""
    for electrons in (1e4, 1e8):
        drawn(source_of("vis", electrons, bulge_fraction=0.5), psf_of("vis"))


def source_of(camera, electrons, **where_and_shape):
    detector = small(camera, "3-4" if camera == "vis" else "R22_S11", SIDE)
    return one_source(detector, wcs(detector, *boresight_for(detector, 10.0, 20.0, 33.0)), electrons, **where_and_shape)


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize("camera", ["vis", "lsstcam"])
def test_flux_is_right_without_ringing(camera, kind):
    # A frame for the largest stamp and the light drawn outside it.
    side = 4 * SIDE
    source = source_of(camera, 1e4, column=side / 2 + 0.3, row=side / 2 - 0.4, **SHAPES[kind])
    image, size = drawn(source, psf_of(camera), side)
    assert size < side
    assert np.isfinite(image).all()
    assert image.sum() == pytest.approx(1e4, rel=2e-6 if kind != "n 6.2" else 2e-4)
    assert image.min() > -max(1e-3 * image.max(), SURVEY.background * NOISE)


@pytest.mark.parametrize("kind", ["bulge", pytest.param("disc", marks=pytest.mark.nightly)])
def test_largest_sources_are_drawn_in_bounded_time(kind):
    compiled()
    start = time.process_time()
    image, size = drawn(source_of("vis", 1e6, **HUGE[kind]), psf_of("vis"))
    assert size <= stamp_sizes.SIZES[-1]
    assert time.process_time() - start < HANGS
    assert np.isfinite(image).all()
    assert 0 < image.sum() <= 1e6 * (1 + 1e-4)


@pytest.mark.parametrize("electrons", [1e-6, 1.0, 1e7 - 1, 1e7 + 1, 1e11])
def test_linear_in_flux(electrons):
    """Check single and double precision."""
    whole, _ = drawn(source_of("lsstcam", electrons), psf_of("lsstcam"))
    settings = settings_for(SURVEY)
    one = source_of("lsstcam", 1e5)
    sizes = stamp_sizes.stamp_sizes(np.array([electrons]), one.shape, one.shapes, psf_of("lsstcam"), NOISE, settings)
    unit = stamps.draw(one, sizes, psf_of("lsstcam"), SIDE, SIDE) / 1e5
    np.testing.assert_allclose(whole, electrons * unit, atol=3e-6 * electrons * unit.max() + 1e-6)


@pytest.mark.parametrize("electrons", [1e8, 1e10])
def test_wings_of_bright_stars_are_complete(electrons):
    """With an atmosphere, the light at any distance is that of a Moffat profile sampled on pixels."""
    image, size = drawn(source_of("lsstcam", electrons, column=500.0, row=500.0), psf_of("lsstcam"), 1000)
    assert size >= (128 if electrons == 1e8 else 256)
    profile = psf_of("lsstcam").profile
    for radius in (30, 60, 100, 140, 300):
        expected = electrons * profile.xValue(0.2 * radius, 0.0) * 0.2**2
        assert image[500, 500 + radius] == pytest.approx(expected, rel=0.02, abs=1.5 * SURVEY.background * NOISE)


@pytest.mark.parametrize(
    ("x", "y", "least", "most"),
    [
        (-0.5, 100.0, 0.499, 0.501),
        (255.5, 255.5, 0.1, 0.4),
        (0.0, 0.0, 0.25, 0.5),
        (260.0, 100.0, 0.01, 0.4),
        (-1e5, 3.0, 0.0, 0.0),
    ],
)
def test_edges_and_corners(x, y, least, most):
    """The image is a cutout of a larger image; a detector receives half of a source on its edge."""
    source = source_of("vis", 1e4, inclination=40.0)
    image, _ = drawn(replace(source, column=np.array([x]), row=np.array([y])), psf_of("vis"))
    moved = replace(source, column=np.array([x + SIDE]), row=np.array([y + SIDE]))
    larger, _ = drawn(moved, psf_of("vis"), 3 * SIDE)
    np.testing.assert_allclose(image, larger[SIDE : 2 * SIDE, SIDE : 2 * SIDE], atol=2e-6 * 1e4)
    assert least * 1e4 <= image.sum() <= most * 1e4
    assert larger.sum() == pytest.approx(1e4 * (x > -SIDE), rel=2e-4, abs=1e-3)


@pytest.mark.parametrize(("dx", "dy"), [(3, 0), (-7, 20)])
def test_whole_pixels_move_the_image(dx, dy):
    args = {"inclination": 50.0, "bulge_fraction": 0.3}
    base, _ = drawn(source_of("vis", 1e4, column=120.3, row=125.8, **args), psf_of("vis"))
    source = source_of("vis", 1e4, column=120.3, row=125.8, **args)
    other = source_list.Sources(
        source.ids, source.column + dx, source.row + dy, source.jacobian, source.electrons, source.shape, source.shapes
    )
    np.testing.assert_allclose(drawn(other, psf_of("vis"))[0], np.roll(base, (dy, dx), (0, 1)), atol=1e-5 * base.max())


def test_a_face_on_disc_is_symmetric():
    image, _ = drawn(source_of("vis", 1e4, column=128.0, row=128.0, inclination=0.0), psf_of("vis"))
    core = image[98:159, 98:159]
    np.testing.assert_allclose(core, core[::-1, ::-1], atol=1e-5 * core.max())


@pytest.mark.parametrize("seed", [1, 2])
def test_any_order_gives_the_same_bits(seed):
    rng = np.random.default_rng(seed)
    n = 60
    form = galaxy_shapes.shapes(
        galaxies(rng.random(n), rng.random(n), bulge_fraction=rng.random(n), gamma1=0.1 * rng.random(n))
    )
    source = source_list.Sources(
        np.arange(n), SIDE * rng.random(n), SIDE * rng.random(n), np.tile(0.1 * np.eye(2), (n, 1, 1)),
        10 ** rng.uniform(1, 7.5, n), np.where(rng.random(n) < 0.3, -1, np.arange(n)), form,
    )  # fmt: skip
    sizes = np.full(n, 64)
    sizes[::7] = 96
    base = stamps.draw(source, sizes, psf_of("vis"), SIDE, SIDE)
    order = rng.permutation(n)
    np.testing.assert_array_equal(base, stamps.draw(source.take(order), sizes[order], psf_of("vis"), SIDE, SIDE))
    halves = [
        stamps.draw(source.take(part), sizes[part], psf_of("vis"), SIDE, SIDE) for part in np.array_split(order, 2)
    ]
    np.testing.assert_array_equal(base, sum(halves))


# ------------------------------------------------------------------------------------------------ the whole of the box


@st.composite
def anything(draw):
    """Return any allowed galaxy or point source and its electrons."""
    size = st.floats(-4, np.log10(60)).map(lambda x: 10**x)
    g, angle = draw(st.floats(0, 0.9)), draw(st.floats(0, np.pi))
    kappa = draw(st.sampled_from([0.0, -0.2, 0.5, 0.9]))
    shape = {
        "bulge_fraction": draw(st.sampled_from([0.0, 1.0]) | st.floats(0, 1)),
        "bulge_sersic_index": draw(st.floats(0.3, 6.2)),
        "bulge_half_light_radius": draw(size),
        "disk_half_light_radius": draw(size),
        "bulge_axis_ratio": draw(st.floats(0.02, 1)),
        "inclination": draw(st.sampled_from([0.0, 90.0]) | st.floats(0, 90)),
        "position_angle": draw(st.floats(0, 179.9)),
        "kappa": kappa,
        "gamma1": (1 - kappa) * g * np.cos(angle),
        "gamma2": (1 - kappa) * g * np.sin(angle),
    }
    electrons = draw(st.sampled_from([0.0, 1e-6, 1e11]) | st.floats(-3, 9).map(lambda x: 10**x))
    return draw(st.sampled_from([{}, shape, shape, shape])), electrons


@given(anything(), st.sampled_from(["vis", "lsstcam"]), st.sampled_from([DRAFT, SURVEY]))
def test_any_source_is_finite_and_has_its_flux(what, camera, accuracy):
    """On a frame as large as the stamp nothing is lost but what the profile has outside; memory and seconds are bounded
    before anything is drawn."""
    shape, electrons = what
    source, psf = source_of(camera, electrons, **shape), psf_of(camera)
    settings = settings_for(accuracy)
    sizes = stamp_sizes.stamp_sizes(source.electrons, source.shape, source.shapes, psf, NOISE, settings)
    assert cost.memory(source.electrons, sizes, 4096, 4132) < 1.4e9
    # Separate tests draw the largest sources.
    if sizes[0] > 1024:
        return
    side = int(sizes[0])
    source.column[:], source.row[:] = side // 2, side // 2
    compiled()
    neglected = stamp_sizes.neglected_flux(source.electrons, NOISE, settings)
    start = time.process_time()
    image = stamps.draw(source, sizes, psf, side, side, neglected=neglected)
    assert time.process_time() - start < HANGS
    assert np.isfinite(image).all()
    # A pixel is rounded to 2^-20 electrons; single precision sums to 1e-6.
    least, rounding = 1.0, image.size * 2.0**-21 + 2e-6 * electrons
    if len(source.shapes):
        least -= galaxy_shapes.flux_outside(source.shapes, np.array([0.5 * side * psf.pixel_scale]))[0]
    assert least * electrons - rounding <= image.sum() <= electrons + rounding
    assert image.min() >= -max(2e-3 * image.max(), accuracy.background * NOISE)
    # Where nothing is taken off the stamp all of its light is on it.
    with mock.patch.object(stamp_sizes, "_OUTSIDE", 2.0):
        image = stamps.draw(source, sizes, psf, side, side, neglected=neglected)
    assert image.sum() == pytest.approx(electrons, rel=2e-6, abs=image.size * 2.0**-21)
    assert image.min() >= -max(2e-3 * image.max(), accuracy.background * NOISE)


@given(st.floats(1e-3, 1e10), st.sampled_from(sorted(SHAPES)))
def test_half_the_flux_is_half_the_image(electrons, kind):
    source, psf, sizes = source_of("lsstcam", electrons, **SHAPES[kind]), psf_of("lsstcam"), np.array([64])
    half = source_of("lsstcam", 0.5 * electrons, **SHAPES[kind])
    whole, less = (stamps.draw(one, sizes, psf, 64, 64) for one in (centred(source), centred(half)))
    np.testing.assert_allclose(less, 0.5 * whole, atol=3e-6 * whole.max() + 2.0**-20)


def centred(source, at=32.0):
    source.column[:], source.row[:] = at, at
    return source


@given(st.sampled_from(sorted(SHAPES)), st.integers(-9, 9), st.integers(-9, 9), st.floats(92, 100), st.floats(92, 100))
def test_any_shift_by_whole_pixels_moves_the_image(kind, dx, dy, x, y):
    source = source_of("vis", 1e4, column=x, row=y, **SHAPES[kind])
    base = stamps.draw(source, np.array([128]), psf_of("vis"), 192, 192)
    source.column[:] += dx
    source.row[:] += dy
    moved = stamps.draw(source, np.array([128]), psf_of("vis"), 192, 192)
    # Near a half pixel, the stamp may be shifted by one more pixel; light outside it is drawn on blocks of the frame.
    middle = slice(76, 116)
    expected = np.roll(base, (dy, dx), (0, 1))[middle, middle]
    np.testing.assert_allclose(moved[middle, middle], expected, atol=2e-4 * base.max() + 2.0**-20)
    # Repeat with a stamp of half the size, which is not corrected.
    source.column[:] -= 32.0
    source.row[:] -= 32.0
    with mock.patch.object(stamp_sizes, "_OUTSIDE", 2.0):
        moved = stamps.draw(source, np.array([64]), psf_of("vis"), 128, 128)
        source.column[:] -= dx
        source.row[:] -= dy
        base = stamps.draw(source, np.array([64]), psf_of("vis"), 128, 128)
    middle = slice(44, 84)
    expected = np.roll(base, (dy, dx), (0, 1))[middle, middle]
    np.testing.assert_allclose(moved[middle, middle], expected, atol=2e-4 * base.max() + 2.0**-20)


@given(st.sampled_from([kind for kind in SHAPES if "gamma1" not in SHAPES[kind]]), st.floats(0, 180))
def test_a_galaxy_is_symmetric_under_half_a_turn(kind, angle):
    source = centred(source_of("vis", 1e4, position_angle=angle, **SHAPES[kind]), 48.0)
    image = stamps.draw(source, np.array([96]), psf_of("vis"), 97, 97)
    # Light outside the stamp is drawn on blocks, which have another centre.
    inside = image[17:80, 17:80]
    np.testing.assert_allclose(inside, inside[::-1, ::-1], atol=2e-6 * image.max() + 2.0**-20)
    # A stamp that nothing is taken off is so to its edges.
    with mock.patch.object(stamp_sizes, "_OUTSIDE", 2.0):
        image = stamps.draw(centred(source), np.array([64]), psf_of("vis"), 65, 65)
    inside = image[1:64, 1:64]
    np.testing.assert_allclose(inside, inside[::-1, ::-1], atol=2e-6 * image.max() + 2.0**-20)


@given(
    st.lists(st.tuples(st.sampled_from(sorted(SHAPES)), st.floats(-20, 84), st.floats(0, 9)), min_size=2, max_size=6),
    st.randoms(),
)
def test_any_sources_in_any_order_give_the_same_bits(several, shuffled):
    some = [source_of("vis", 10.0**e, column=x, row=84 - x, **SHAPES[kind]) for kind, x, e in several]
    many = galaxy_shapes.Shapes(
        *(np.concatenate([getattr(one.shapes, f.name) for one in some]) for f in fields(galaxy_shapes.Shapes))
    )
    names = ("column", "row", "jacobian", "electrons")
    one_by_one = (np.concatenate([getattr(one, name) for one in some]) for name in names)
    together = source_list.Sources(np.arange(len(some)), *one_by_one, np.arange(len(some)), many)
    order = np.arange(len(some))
    shuffled.shuffle(order)
    sizes = np.array([56, 64])[np.arange(len(some)) % 2]
    base, other = (stamps.draw(together.take(o), sizes[o], psf_of("vis"), 64, 64) for o in (slice(None), order))
    np.testing.assert_array_equal(base, other)
    alone = [stamps.draw(one, sizes[i : i + 1], psf_of("vis"), 64, 64) for i, one in enumerate(some)]
    np.testing.assert_allclose(sum(alone), base, atol=1e-5 + 1e-6 * base.max())


SLIM = {
    "sheared": {"bulge_sersic_index": 2.4, "bulge_half_light_radius": 37.0, "bulge_axis_ratio": 0.02, "gamma1": 0.78},
    "on edge": {
        "bulge_sersic_index": 1.3,
        "bulge_half_light_radius": 49.0,
        "bulge_axis_ratio": 0.02,
        "position_angle": 0.5,
    },
    "steep": {
        "bulge_sersic_index": 4.9,
        "bulge_half_light_radius": 3.6,
        "bulge_axis_ratio": 0.1,
        "bulge_fraction": 0.5,
        "position_angle": 1.0,
    },
    "small": {"bulge_sersic_index": 5.9, "bulge_half_light_radius": 0.65, "bulge_axis_ratio": 0.1, "kappa": -0.2},
    "aslant": {
        "bulge_sersic_index": 3.0,
        "bulge_half_light_radius": 1.0,
        "bulge_axis_ratio": 0.2,
        "position_angle": 45.0,
    },
    "turned a little": {
        "bulge_sersic_index": 3.0,
        "bulge_half_light_radius": 60.0,
        "bulge_axis_ratio": 0.2,
        "position_angle": 2.0,
    },
}


# Large sources that only nightly tests draw.
LARGE = ("on edge", "turned a little")


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.nightly] if kind in LARGE else []) for kind in SLIM]
)
@pytest.mark.parametrize(
    "accuracy", [pytest.param(DRAFT, id="draft", marks=pytest.mark.nightly), pytest.param(SURVEY, id="survey")]
)
def test_correction_of_slim_galaxies_removes_only_their_light(kind, accuracy):
    """In a frame of twice the stamp size, no light is counted twice and no pixel is too dark."""
    shape = {"bulge_fraction": 1.0} | SLIM[kind]
    size = drawn(source_of("vis", 1e5, **shape), psf_of("vis"), accuracy=accuracy)[1]
    side = 2 * size
    source = source_of("vis", 1e5, column=side / 2 + 0.3, row=side / 2 - 0.4, **shape)
    image, _ = drawn(source, psf_of("vis"), side, accuracy)
    least = 1.0 - galaxy_shapes.flux_outside(source.shapes, np.array([0.5 * side * 0.1]))[0]
    assert 1e5 * (least - 1e-3) < image.sum() < 1e5 * (1 + 2e-6)
    assert image.min() > -accuracy.background * NOISE


def test_light_of_an_edge_on_disc_leaves_its_stamp():
    """The light that leaves a small stamp equals the light that a large stamp has there."""
    source = source_of("vis", 1e6, inclination=90.0, disk_half_light_radius=0.8, position_angle=33.0)
    centred(source, 128.0)
    small, large = (stamps.draw(source, np.array([size]), psf_of("vis"), SIDE, SIDE) for size in (48, 512))
    y, x = np.abs(np.mgrid[:SIDE, :SIDE] - 128)
    outside = np.maximum(x, y) > 24
    assert large[outside].sum() > 1e4
    assert small[outside].sum() == pytest.approx(large[outside].sum(), rel=0.15)


@pytest.mark.parametrize("index", [1.4, 2.0, 3.0, 4.0])
def test_correction_is_at_most_the_light_outside_the_stamp(index):
    """The quadratic model of the aliased light of a slim galaxy may exceed the light outside."""
    shape = {"bulge_fraction": 1.0, "bulge_sersic_index": index, "bulge_half_light_radius": 3.0}
    light = 0.0
    # The stamp is outside the frame, to the left and to the right: the frame receives only the light that leaves it.
    for column in (-26.0, 2078.0):
        source = source_of("vis", 1e6, column=column, row=1023.5, bulge_axis_ratio=0.02, position_angle=80.0, **shape)
        light += stamps.draw(source, np.array([48]), psf_of("vis"), 2048, 2048).sum()
    outside = 1e6 * galaxy_shapes.flux_outside(source.shapes, np.array([2.4]))[0]
    assert 0.1 * outside < light < outside


@cache
def response(size, q):
    """Return the response of the weighted ellipticity to shear for a galaxy with aliased light on small stamps."""
    shape = {"bulge_fraction": 1.0, "bulge_sersic_index": 3.0, "bulge_half_light_radius": 1.0, "bulge_axis_ratio": q}
    y, x = np.mgrid[:128, :128] - 64
    found = []
    for g in (-0.01, 0.01):
        source = centred(source_of("vis", 1e5, position_angle=45.0, gamma1=g, **shape), 64.0)
        light = np.exp(-0.5 * (x**2 + y**2) / 8.0**2) * stamps.draw(source, np.array([size]), psf_of("vis"), 128, 128)
        found.append((light * (x**2 - y**2)).sum() / (light * (x**2 + y**2)).sum())
    return (found[1] - found[0]) / 0.02


@pytest.mark.parametrize("q", [0.08, 0.1, 0.12])
def test_steep_profiles_are_not_corrected(q):
    """A galaxy too slim for a quadratic is drawn as well as on a stamp that keeps all of its light."""
    wrong = abs(response(64, q) - response(512, q))
    with mock.patch.object(stamp_sizes, "_OUTSIDE", 2.0):
        kept = abs(response.__wrapped__(64, q) - response(512, q))
    assert wrong < 1.05 * kept + 1e-3


def test_correction_fades_smoothly_with_axis_ratio():
    """There is no step between slim and round galaxies that would bias the shear of a pair."""
    wrong = [abs(response(64, q) - response(512, q)) for q in np.arange(0.14, 0.22, 0.01).round(2).tolist()]
    assert max(wrong) < 0.6


def test_correction_fades_smoothly_if_terms_cancel():
    """Along the axes of the stamp, the terms x^2 and y^2 may cancel if both are small."""
    taken = []
    for q in np.arange(0.2, 0.3, 0.002):
        one = source_of("vis", 1e5, bulge_fraction=1.0, bulge_axis_ratio=q, bulge_half_light_radius=1.0)
        one = replace(centred(one, 64.0), jacobian=0.1 * np.eye(2)[None])
        outside = stamps._light_outside(one, *stamps._forms(one), np.array([64]), 0.1)
        taken.append(frame.aliased_light(np.array([64]), *np.full((2, 1), 32.0), outside[0], outside[2])[0])
    level, light = np.array(taken)[:, 0], np.array(taken)[:, -1]
    assert light[0] < 1.0 < 500.0 < light[-1]
    assert np.abs(np.diff(level)).max() < 0.15 * level.max()


@pytest.mark.parametrize("camera", ["vis", pytest.param("lsstcam", marks=pytest.mark.nightly)])
@pytest.mark.parametrize("kind", SHAPES)
def test_single_precision_is_as_good_as_double(camera, kind, monkeypatch):
    source, sizes = source_of(camera, 9e6, **SHAPES[kind]), np.array([96])
    single = stamps.draw(source, sizes, psf_of(camera), SIDE, SIDE)
    monkeypatch.setattr(stamp_sizes, "BRIGHT", 0.0)
    double = stamps.draw(source, sizes, psf_of(camera), SIDE, SIDE)
    assert np.abs(single - double).max() < 5e-7 * double.max()


# ------------------------------------------------------------------------------------------------ photons


def photons(source, shape, n, rng, seeing, beta):
    """Return the pixels (column, row) of n photons of a galaxy."""
    row = {**{k: v[0] for k, v in galaxies(0.0, 0.0, **shape).to_pydict().items()}}
    in_bulge = rng.random(n) < row["bulge_fraction"]
    index, angle = row["bulge_sersic_index"], 2 * np.pi * rng.random(n)
    b = gammaincinv(2 * index, 0.5)
    radius = row["bulge_half_light_radius"] * (gammaincinv(2 * index, rng.random(n)) / b) ** index
    bulge = np.stack([radius * np.cos(angle), row["bulge_axis_ratio"] * radius * np.sin(angle)])
    tilt, scale = np.radians(row["inclination"]), row["disk_half_light_radius"] / EXPONENTIAL_RADIUS
    radius = scale * rng.gamma(2.0, size=n)
    height = DISK_SCALE_HEIGHT * scale * np.arctanh(np.clip(2 * rng.random(n) - 1, -1 + 1e-15, 1 - 1e-15))
    disk = np.stack([radius * np.cos(angle), radius * np.sin(angle) * np.cos(tilt) + height * np.sin(tilt)])
    along, across = np.where(in_bulge, bulge, disk)
    # To (east, north); position angle from north through east. The image's distortion is (1 - kappa - gamma)^-1.
    pa = np.radians(row["position_angle"])
    east, north = along * np.sin(pa) + across * np.cos(pa), along * np.cos(pa) - across * np.sin(pa)
    kappa, g1, g2 = row["kappa"], row["gamma1"], row["gamma2"]
    east, north = np.linalg.solve([[1 - kappa - g1, -g2], [-g2, 1 - kappa + g1]], np.stack([east, north]))
    moffat = seeing / (2 * np.sqrt(2 ** (1 / beta) - 1)) * np.sqrt(rng.random(n) ** (1 / (1 - beta)) - 1)
    angle = 2 * np.pi * rng.random(n)
    x, y = np.linalg.solve(source.jacobian[0], np.stack([-east, north]))
    x, y = x + source.column[0] + moffat * np.cos(angle), y + source.row[0] + moffat * np.sin(angle)
    return np.rint(x).astype(int), np.rint(y).astype(int)


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize("camera", ["vis", pytest.param("lsstcam", marks=pytest.mark.nightly)])
def test_photons_fall_where_the_image_is_bright(camera, kind):
    """Sample of 100,000 photons; significance 6e-7 of the scatter and of the rest (5 standard errors)."""
    n, seeing, beta = 100_000, *((0.16, 3.5) if camera == "vis" else (0.73, 3.0))
    where = {"column": 125.3, "row": 130.6, "position_angle": 40.0}
    source = source_of(camera, float(n), **where, **SHAPES[kind])
    scale = 0.1 if camera == "vis" else 0.2
    x, y = photons(source, {"position_angle": 40.0, **SHAPES[kind]}, n, np.random.default_rng(8), seeing / scale, beta)
    inside = (x >= 0) & (x < SIDE) & (y >= 0) & (y < SIDE)
    counted = np.bincount(y[inside] * SIDE + x[inside], minlength=SIDE**2).reshape(SIDE, SIDE)
    image, _ = drawn(source, psf_of(camera))
    bright = image > 20
    pull = (counted - image)[bright] / np.sqrt(image[bright])
    assert bright.sum() > 20
    assert (pull**2).mean() == pytest.approx(1.0, abs=5 * np.sqrt(2 / bright.sum()))
    assert abs(pull).max() < 6
    # Pixels farther out are summed.
    outside = ~bright
    assert counted[outside].sum() == pytest.approx(image[outside].sum(), abs=5 * np.sqrt(image[outside].sum() + 25))


# ------------------------------------------------------------------------------------------------ anywhere on the sky


@pytest.mark.parametrize("camera", ["vis", "lsstcam"])
@pytest.mark.parametrize(
    ("ra", "dec"), [(0.0, 90.0), (123.0, -90.0), (77.0, 89.9999), (0.0, 0.0), (359.99999, -45.0), (180.0, 60.0)]
)
def test_sources_at_poles_and_at_zero_right_ascension(camera, ra, dec):
    """A galaxy and a star at given sky positions have the right pixels and fluxes."""
    detector = small(camera, "3-4" if camera == "vis" else "R22_S11", 128)
    system = wcs(detector, *boresight_for(detector, ra, dec, 33.0))
    places = np.array([[40.2, 90.7], [88.4, 31.9]])
    lon, lat = sky_of_pixel(system, *places.T)
    settings, band = settings_for(SURVEY), passbands.load("euclid_vis" if camera == "vis" else "lsst_r")
    body = galaxies(lon[:1], lat[:1], inclination=75.0, disk_half_light_radius=0.3)
    found, sizes = visible_sources.select_sources(
        Rows(body, None, stars(lon[1:], lat[1:]), None), (np.array([1e5]), np.array([1e5])),
        aimed(detector, system, band), psf_of(camera), NOISE, settings,
    )  # fmt: skip
    np.testing.assert_allclose(np.stack([found.column, found.row], 1), places, atol=2e-6)
    # The telescope's distortion aside.
    np.testing.assert_allclose(np.linalg.det(found.jacobian), detector.pixel_scale**2, rtol=0.02)
    image = stamps.draw(
        found, sizes, psf_of(camera), 128, 128, neglected=stamp_sizes.neglected_flux(found.electrons, NOISE, settings)
    )
    assert np.isfinite(image).all()
    assert image.sum() == pytest.approx(2e5, rel=1e-3)
    cut = image[60:121, 10:71]
    centre, _ = moments(np.where(cut > 0.02 * cut.max(), cut, 0))
    np.testing.assert_allclose(centre, places[0] - (10, 60), atol=0.05)


def test_sources_without_flux_are_not_drawn():
    image, _ = drawn(source_of("vis", 0.0, **SHAPES["slim"]), psf_of("vis"))
    assert not image.any()
