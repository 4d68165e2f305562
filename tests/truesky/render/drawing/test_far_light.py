"""Wings of bright stars beyond the PSF's plane agree with the Airy pattern and the pupil, and keep the light."""

from dataclasses import replace
from unittest import mock

import galsim
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from lake_schema.mission.configuration import resolve
from tests.truesky.render.fields import one_source, small
from tests.truesky.render.nominal import COSMIC_RAYS, TIME, off, psf_of, rendered
from truesky.fluxes import passbands
from truesky.render.camera.astrometry import wcs
from truesky.render.camera.pointing import boresight_for
from truesky.render.drawing import cost, far_light, stamp_sizes, stamps
from truesky.render.drawing.kernels.far_light import fading_compiled, remove_aliased_compiled
from truesky.render.drawing.kernels.frame import FIXED_POINT
from truesky.render.drawing.settings import settings_for
from truesky.render.psf import diffraction, spikes, sub_bands
from truesky.render.psf.model import SIDE
from truesky.request.accuracy import SURVEY

MISSION = resolve()
PARTS = sub_bands.sub_bands(passbands.load("euclid_vis"))
EQUAL = np.full(len(PARTS), 1.0 / len(PARTS))
NOISE = 12.7
ARCSEC = np.pi / 648000
# Electrons of a star of 6 mag in a nominal exposure.
BRIGHT = 5e10


def of_pupil(blur=0.034, pixel_scale=0.1, parts=PARTS):
    return spikes.from_euclid_pupil(parts, blur, pixel_scale, 2048 / 3, MISSION)


@pytest.fixture(scope="module")
def vis():
    # Other tests use the same detector, so that they share the planes.
    return psf_of(small("vis", "3-4", 256))


def shone(psf, side, column, row, electrons=BRIGHT, least=0.0):
    """Return the electrons that `add` adds to an empty frame."""
    frame = np.zeros((side, side), np.int64)
    far_light.add(frame, far_light.Star(column, row, electrons, None, SIDE, least, psf.edges))
    return frame / FIXED_POINT


def off_spikes(psf, dx, dy, clear):
    """Return a mask of pixels more than `clear` from the middle of every spike."""
    along = [np.abs(dx * np.cos(a) + dy * np.sin(a)) for a in psf.edges.bars[:, 0]]
    return np.min(along, axis=0) > clear


@pytest.mark.parametrize("wavelength", [5500.0, 9000.0])
def test_the_ring_is_airy_s(wavelength):
    """The light of the two circles is the mean of an obscured Airy pattern over its rings."""
    own = replace(of_pupil(), wavelength=np.array([[wavelength]]))
    clear = np.pi * (600.0**2 - 197.5**2)
    airy = galsim.Airy(lam=wavelength / 10, diam=1.2, obscuration=197.5 / 600.0)
    radius = np.linspace(20.0, 60.0, 40001)
    mean = np.mean([airy.xValue(r, 0.0) * r**3 for r in radius])
    # The factor 0.1 converts pixels to arcsec. The bars reduce the area of the pupil, but not the edges of the circles.
    ours = spikes.ring_light(own, np.ones(1)) * own.area / clear * 0.1
    assert ours == pytest.approx(mean, rel=0.01)


@pytest.mark.nightly
@pytest.mark.parametrize("bar", [0, 1, 2])
def test_a_spike_is_the_pupil_s_transform(bar):
    """Along a spike, the transform of the pupil is the transform of its projection.

    Neighbouring edges interfere, so the light is averaged.
    """
    own = of_pupil(blur=0.0, pixel_scale=0.02)
    turn, step, along = own.bars[bar, 0], 0.25, 1.0
    axis, other = np.arange(-602.0, 602.1, step), np.arange(-602.0, 602.1, along)
    u, v = np.meshgrid(other, axis)
    clear = diffraction.pupil(u * np.cos(turn) - v * np.sin(turn), u * np.sin(turn) + v * np.cos(turn), step, MISSION)
    projected = clear.sum(axis=1) * along
    radius = np.linspace(30.0, 60.0, 61)
    found = np.zeros(len(radius))
    for wavelength in own.wavelength[:, 1::3].ravel() * 1e-7:
        turns = np.exp(-2j * np.pi * np.outer(radius * ARCSEC / wavelength, axis))
        found += np.abs(turns @ projected * step) ** 2 / (wavelength**2 * projected.sum() * step)
    theirs = found / own.wavelength[:, 1::3].size * (0.02 * ARCSEC) ** 2
    line = spikes.spike_light(own, EQUAL, 70.0 / 0.02)[bar, :, 0]
    ours = (
        np.interp(radius / 0.02, 8.0 * np.arange(len(line)), line)
        + spikes.ring_light(own, EQUAL) / (radius / 0.02) ** 3
    )
    assert (ours * radius**2).mean() == pytest.approx((theirs * radius**2).mean(), rel=0.05)


def test_spikes_of_several_stars_are_those_of_each_star_alone():
    """Stars share the profiles across the spikes, but not those of a pupil with another blur, scale or passband."""
    own = of_pupil()
    others = [own, *(replace(own, **{key: 1.5 * getattr(own, key)}) for key in ("blur", "pixel_scale", "wavelength"))]
    red = np.arange(len(EQUAL)) / np.arange(len(EQUAL)).sum()
    cases = [(edges, photons, reach) for edges in others for photons in (EQUAL, red) for reach in (300.0, 2000.0)]
    spikes._blurred_profiles.cache_clear()
    together = [spikes.spike_light(*case) for case in cases]
    assert spikes._blurred_profiles.cache_info().misses < spikes._blurred_profiles.cache_info().hits
    for case, expected in zip(cases, together, strict=True):
        spikes._blurred_profiles.cache_clear()
        np.testing.assert_array_equal(spikes.spike_light(*case), expected)
    assert len({table.tobytes() for table in together}) == len(cases)


def test_wings_are_those_of_the_mission_database(vis):
    """The azimuthal mean of the embedded pupil at 1" agrees with the database.

    There, bars contribute as much light as circles of the same length.
    """
    own = of_pupil()
    circles = (
        2 * np.pi * (MISSION.value("plm.aperture_diameter", "mm") / 2 + MISSION.value("plm.pupil.stop_radius", "mm"))
    )
    bars = 2 * own.bars[:, 2].sum()
    # Fraction of the light per square arcsec, ten pixels from the star.
    strength = spikes.ring_light(own, EQUAL) / 10.0**3 / 0.1**2 * (circles + bars) / circles
    assert strength == pytest.approx(MISSION.value("vis.psf.wing_strength"), rel=0.03)
    frame = shone(vis, 1401, 700.0, 700.0)
    y, x = np.mgrid[-700:701, -700:701].astype(float)
    radius, clear = np.hypot(x, y), off_spikes(vis, x, y, 60.0)
    far = np.array([400.0, 500.0, 600.0])
    light = [frame[clear & (np.abs(radius - r) < 3.0)].mean() for r in far]
    slope = np.polyfit(np.log(far), np.log(light), 1)[0]
    assert slope == pytest.approx(MISSION.value("vis.psf.wing_slope"), abs=0.05)


def test_no_light_is_lost_beyond_the_plane(vis):
    """The plane contains the light that the pupil sends there, and the rest of the light is outside."""
    side = 3000
    light = shone(vis, side, side / 2, side / 2).sum() / BRIGHT
    # Light outside the frame: r^-3 outside a square, and the spikes, whose fringes leave half of r^-2.
    beyond = spikes.ring_light(vis.edges, EQUAL) * 4 * np.sqrt(2) / (side / 2)
    wavelength = vis.edges.wavelength.mean() * 1e-7
    for turn, _, length in vis.edges.bars:
        border = side / 2 / max(abs(np.cos(turn)), abs(np.sin(turn)))
        beyond += 2 * length * wavelength / (2 * np.pi**2 * vis.edges.area * 0.1 * ARCSEC * border)
    left = far_light.fading_window(SIDE, 3, vis.planes.images.shape[1])
    kept = (vis.planes.images.mean(axis=0, dtype=float) * left[:, None] * left).sum()
    assert 0.997 < kept < 0.998
    assert light + beyond == pytest.approx(1 - kept, rel=0.05)


def test_the_frame_has_no_seam(vis):
    """Between spikes, the mean light of a 6 mag star falls as r^-3 across the border of its plane."""
    field = replace(small("vis", "3-4", 1200), nx=1200, ny=1200)
    source = one_source(field, wcs(field, *boresight_for(field, 10.0, 0.0, 0.0)), BRIGHT, 600.3, 599.8)
    image = stamps.draw(source, np.array([SIDE]), vis, 1200, 1200)
    y, x = np.mgrid[:1200, :1200]
    dx, dy = x - 600.3, y - 599.8
    radius, clear = np.hypot(dx, dy), off_spikes(vis, dx, dy, 40.0)
    law = spikes.ring_light(vis.edges, EQUAL) * BRIGHT
    for inner, outer in ((150, 200), (200, 250), (250, 300), (300, 360), (360, 420), (420, 560)):
        here = clear & (radius >= inner) & (radius < outer)
        assert (image * radius**3)[here].mean() == pytest.approx(law, rel=0.06)
    # There are no holes in the sky where the plane ends, or where aliased light was removed.
    assert image.min() > -1e-3 * NOISE
    # A spike continues across the border.
    turn = vis.edges.bars[2, 0]
    out = np.arange(225, 285)
    along = [image[round(599.8 + r * np.cos(turn)), round(600.3 - r * np.sin(turn))] for r in out]
    smooth = np.convolve(np.array(along) * out**2.0, np.ones(9) / 9, "valid")
    assert smooth.max() / smooth.min() < 2.0


@pytest.mark.parametrize("length", [pytest.param(30.0, marks=pytest.mark.nightly), 94.0])
def test_the_frame_of_a_trail_has_no_seam(vis, length):
    """A moving body has the light of stars along its trail, without holes where the planes of its pieces end."""
    side, middle, angle = 1000, (500.3, 499.8), 0.4
    field = replace(small("vis", "3-4", side), nx=side, ny=side)
    source = one_source(field, wcs(field, *boresight_for(field, 10.0, 0.0, 0.0)), BRIGHT, *middle)
    trail = length * np.array([np.cos(angle), np.sin(angle)])
    moving = replace(source, trail=trail[None])
    size = stamp_sizes.stamp_sizes(
        moving.electrons, moving.shape, moving.shapes, vis, NOISE, settings_for(SURVEY),
        stamp_sizes.piece_length(moving.trail_length),
    )  # fmt: skip
    assert size[0] > SIDE
    image = stamps.draw(moving, size, vis, side, side)
    assert image.min() > -1e-3 * NOISE
    # The reference has no pieces: it consists of stars at rest with equal shares.
    along = np.arange(-0.5, 0.5, 1 / 16) + 1 / 32
    y, x = np.mgrid[:side, :side]
    law, clear = np.zeros((side, side)), np.ones((side, side), bool)
    for a in along:
        dx, dy = x - middle[0] - a * trail[0], y - middle[1] - a * trail[1]
        law += spikes.ring_light(vis.edges, EQUAL) * BRIGHT / len(along) / np.maximum(np.hypot(dx, dy), 1.0) ** 3
        clear &= off_spikes(vis, dx, dy, 40.0)
    radius = np.hypot(x - middle[0], y - middle[1])
    for inner, outer in ((150, 200), (200, 230), (230, 260), (260, 290), (290, 330), (330, 400), (400, 500)):
        here = clear & (radius >= inner) & (radius < outer)
        assert image[here].sum() == pytest.approx(law[here].sum(), rel=0.06)


def test_a_trail_s_spikes_are_no_comb(vis):
    """A spike smeared along a trail is smooth, and equals the sum of many points."""
    side, x, y, trail, points = 300, 150.3, -290.2, np.array([60.0, 10.0]), 100
    even, many = np.zeros((side, side), np.int64), np.zeros((side, side), np.int64)
    far_light.add(even, far_light.Star(x, y, BRIGHT, None, SIDE, 0.0, vis.edges, trail))
    for a in (np.arange(points) + 0.5) / points - 0.5:
        far_light.add(
            many, far_light.Star(x + a * trail[0], y + a * trail[1], BRIGHT / points, None, SIDE, 0.0, vis.edges)
        )
    # The table of a spike ends 40 pixels from its middle. There, one point more or less makes a step.
    wrong = np.abs(even / many - 1.0)
    assert np.quantile(wrong, 0.99) < 0.03
    assert wrong.max() < 0.1


@pytest.mark.parametrize(
    ("x", "y", "trail"),
    [
        (150.3, -290.2, (60.0, 10.0)),
        (150.3, 150.2, (40.0, 25.0)),
        pytest.param(-500.0, 40.0, (600.0, 3.0), marks=pytest.mark.nightly),
        (60.0, 700.0, (0.0, 400.0)),
    ],
)
def test_a_line_of_light_is_many_points(vis, x, y, trail):
    """A trail equals points that are closer than any fringe, in borders of squares, outside, and on its line."""
    side, points = 200, int(np.hypot(*trail))
    line, many = np.zeros((side, side), np.int64), np.zeros((side, side), np.int64)
    far_light.add(line, far_light.Star(x, y, BRIGHT, None, SIDE, 0.0, vis.edges, np.array(trail)))
    for a in (np.arange(points) + 0.5) / points - 0.5:
        far_light.add(
            many, far_light.Star(x + a * trail[0], y + a * trail[1], BRIGHT / points, None, SIDE, 0.0, vis.edges)
        )
    level = BRIGHT * spikes.ring_light(vis.edges, EQUAL) / 400.0**3 * FIXED_POINT
    wrong = np.abs(line - many) / np.maximum(many, level)
    assert np.quantile(wrong, 0.99) < 0.02
    assert wrong.max() < 0.06
    assert line.sum() == pytest.approx(many.sum(), rel=2e-3)


def test_a_trail_is_unfolded_as_its_points_are(vis):
    """The aliased light of a piece is the same from lines as from points that are closer than any fringe."""
    size, corner, trail, points = 640, 160, np.array([50.0, 30.0]), 60
    along, inner = (np.arange(points) + 0.5) / points - 0.5, SIDE / 2 - 2.0
    # The corner contains most of the aliased light.
    x, y = 260.2 + along * trail[0], 259.7 + along * trail[1]
    level = BRIGHT / points * spikes.ring_light(vis.edges, EQUAL)
    pixels = np.arange(corner)
    light = np.zeros((corner, corner))
    for px, py in zip(x, y, strict=True):
        faded = [[fading_compiled(float(abs(p - at)), inner) for p in pixels] for at in (px, py)]
        light += np.outer(faded[1], faded[0]) * level / np.hypot(pixels - px, pixels[:, None] - py) ** 3
    fast, slow = np.ones((size, size)), light.copy()
    fast[60 : 60 + corner, 60 : 60 + corner] = light
    star = far_light.Star(320.2, 319.7, BRIGHT, None, SIDE, 0.0, vis.edges, trail)
    far_light.remove_aliased(star, fast, 0, 0, size, size)
    turned = np.stack([np.cos(vis.edges.bars[:, 0]), np.sin(vis.edges.bars[:, 0])], axis=1)
    lines = BRIGHT / points * spikes.spike_light(vis.edges, EQUAL, vis.edges.period)
    remove_aliased_compiled(slow, x, y, inner, level, turned, lines, vis.edges.period)
    whole = points * level / np.hypot(pixels - 260.2, pixels[:, None] - 259.7) ** 3
    assert ((light - slow) / whole).max() > 0.05
    wrong = np.abs(fast[60 : 60 + corner, 60 : 60 + corner] - slow) / whole
    assert wrong.max() < 0.04
    assert wrong.mean() < 3e-3


def test_the_time_a_bright_trail_takes_is_foreseen(vis):
    """The time depends on the frame, the trail, and the stamps of its pieces.

    Exposures that would take hours are refused because of this prediction.
    """
    field = replace(small("vis", "3-4"), nx=4096, ny=4096)
    source = one_source(field, wcs(field, *boresight_for(field, 10.0, 0.0, 0.0)), 1e10, 2048.0, 2048.0)
    sizes = np.array([640])
    # CPU times (s) that were measured on a full detector.
    for length, took in ((94.0, 3.3), (470.0, 16.3), (1880.0, 63.6)):
        moving = replace(source, trail=length * np.array([[1.0, 0.3]]))
        assert took / 2 < cost.seconds(moving, sizes, vis, 4096, 4096) < 2 * took
    faint = replace(moving, electrons=np.array([1e6]))
    assert cost.seconds(faint, sizes, vis, 4096, 4096) < 0.5 * took


@given(
    st.tuples(st.integers(-2500, 2500), st.integers(-2500, 2500)),
    st.sampled_from([1e8, 1e10]),
    st.sampled_from([None, (40.0, -25.0)]),
)
@example((400, 390), 1e8, None)
def test_a_window_has_the_light_of_its_pixels(vis, first, electrons, trail):
    """A window that neither circle nor spikes reach is skipped; every other window has its part of the light."""
    star = far_light.Star(0.3, 0.6, electrons, None, SIDE, 0.3, vis.edges, None if trail is None else np.array(trail))
    wide, window = np.zeros((192, 192), np.int64), np.zeros((64, 64), np.int64)
    for frame, margin in ((wide, 64), (window, 0)):
        far_light.add(frame, replace(star, column=margin - first[0] + 0.3, row=margin - first[1] + 0.6))
    # A trail is drawn up to a length that depends on the frame.
    assert np.abs(wide[64:128, 64:128] - window).max() <= (0 if trail is None else 1)


@pytest.mark.parametrize("trail", [None, np.array([30.0, 10.0])])
@pytest.mark.parametrize(("electrons", "least"), [(1e5, 1.0), (1e7, 2.0), (1e9, 5.0), (1e9, 0.01)])
def test_short_tables_of_spikes_give_the_same_light(vis, electrons, least, trail):
    """Compare with tables that reach the farthest corner of the frame."""
    star = far_light.Star(40.3, 900.6, electrons, np.linspace(0.2, 0.05, 8), SIDE, least, vis.edges, trail)
    found, expected = np.zeros((2, 1000, 1200), np.int64)
    with mock.patch.object(far_light.spikes, "spike_light", wraps=spikes.spike_light) as made:
        far_light.add(found, star)
    with mock.patch.object(far_light.spikes, "max_reach", return_value=np.inf):
        far_light.add(expected, star)
    np.testing.assert_array_equal(found, expected)
    if electrons < 1e6:
        assert made.call_args.args[2] < 700.0


def test_most_windows_far_from_a_star_are_skipped(vis):
    star = far_light.Star(0.0, 0.0, 1e8, None, SIDE, 0.3, vis.edges)
    with mock.patch.object(far_light.spikes, "spike_light", wraps=spikes.spike_light) as made:
        for column, row in np.random.default_rng(3).uniform(-2500.0, 2500.0, (100, 2)):
            far_light.add(np.zeros((64, 64), np.int64), replace(star, column=column, row=row))
    assert 0 < made.call_count < 50


def test_colours_differ(vis):
    """The ring is proportional to the wavelength, so a red star has a brighter ring."""
    red, blue = np.zeros(len(PARTS)), np.zeros(len(PARTS))
    red[-1], blue[0] = 1.0, 1.0
    ratio = spikes.ring_light(vis.edges, red) / spikes.ring_light(vis.edges, blue)
    assert ratio == pytest.approx(vis.planes.wavelength[-1] / vis.planes.wavelength[0], rel=0.01)


def stars(column, row, electrons, side):
    field = replace(small("vis", "3-4"), nx=side, ny=side)
    system = wcs(field, *boresight_for(field, 10.0, 0.0, 0.0))
    some = [one_source(field, system, e, x, y) for x, y, e in zip(column, row, electrons, strict=True)]
    together = {n: np.concatenate([getattr(s, n) for s in some]) for n in ("column", "row", "jacobian", "electrons")}
    return replace(some[0], **together, ids=np.arange(len(some)), shape=np.full(len(some), -1))


def drawn(sources, psf, side):
    settings = settings_for(SURVEY)
    sizes = stamp_sizes.stamp_sizes(sources.electrons, sources.shape, sources.shapes, psf, NOISE, settings)
    neglected = stamp_sizes.neglected_flux(sources.electrons, NOISE, settings)
    return stamps.draw(sources, sizes, psf, side, side, None, neglected)


def test_only_bright_points_shine_so_far(vis):
    """Fainter stars are drawn bit by bit as without far light."""
    faint = stars([200.0, 90.0, 310.5], [200.0, 400.0, 11.0], [1e3, 1e5, 5e6], 512)
    np.testing.assert_array_equal(drawn(faint, vis, 512), drawn(faint, replace(vis, edges=None), 512))
    sizes, shape = np.array([SIDE, SIDE, 384, SIDE]), np.array([-1, 0, -1, -1])
    found = stamp_sizes.has_far_light(np.array([1e9, 1e9, 1e9, 1e6]), sizes, shape, None, vis)
    np.testing.assert_array_equal(found, [True, False, False, False])


def test_a_frame_is_the_sum_of_its_stars_in_any_order(vis):
    column, row, electrons = [100.2, 500.0, 900.7], [300.0, 800.4, -700.0], [3e8, 2e9, 4e10]
    whole = drawn(stars(column, row, electrons, 1000), vis, 1000)
    turned = drawn(stars(column[::-1], row[::-1], electrons[::-1], 1000), vis, 1000)
    np.testing.assert_array_equal(whole, turned)
    parts = [drawn(stars([x], [y], [e], 1000), vis, 1000) for x, y, e in zip(column, row, electrons, strict=True)]
    np.testing.assert_allclose(whole, sum(parts), rtol=1e-12, atol=1e-5)
    # The stamp of the last star is outside the frame, but its far light reaches it.
    assert parts[2][:200].min() > 1.0


def test_light_is_drawn_down_to_the_noise(vis):
    """With less accuracy the circle is smaller, and the missing light is below the limit."""
    least = 0.1 * NOISE
    whole, cut = (shone(vis, 2000, 300.0, 300.0, 1e9, part) for part in (0.0, least))
    assert np.count_nonzero(cut) < 0.5 * np.count_nonzero(whole)
    assert 0.0 < (whole - cut).max() < least


def test_the_farthest_pixel_of_a_frame_is_lit(vis):
    """Light reaches the farthest corner, however the distance is rounded."""
    for x, y in ((132.7667590299948, 168.83949347535636), (-40.3, -70.2), (108.82925776227592, 122.95520170604388)):
        frame = np.zeros((100, 100), np.int64)
        far_light.add(frame, far_light.Star(x, y, 1e13, None, 32, 0.0, vis.edges))
        assert frame.min() > 0


def spike(away, bar=2, middle=128.0):
    """Return a position `away` pixels from the middle of a frame, from which a spike passes through the middle."""
    turn = of_pupil().bars[bar, 0]
    return middle + away * np.sin(turn), middle - away * np.cos(turn)


def test_spikes_reach_as_far_as_they_are_noticed(vis):
    """At the predicted distance, the brightest spike of a star has the given level."""
    least = 0.1 * NOISE
    electrons = np.array([1e8, 1e9, 1e11])
    far = spikes.reach(vis.edges, electrons, least)
    np.testing.assert_allclose(far[:2], far[0] * np.sqrt(electrons[:2] / 1e8), rtol=1e-12)
    assert far[2] == spikes.FARTHEST / 0.1
    for bright, away in zip(electrons[:2], far[:2], strict=True):
        middle = bright * spikes.spike_light(vis.edges, EQUAL, 5000.0)[:, :, 0]
        here = round(away / 8.0)
        # The mean covers several fringes.
        assert middle[:, here - 25 : here + 26].mean(axis=1).max() == pytest.approx(least, rel=0.15)


def test_spikes_of_a_star_far_from_the_detector_show(vis):
    """Bright stars are drawn from farther away than others, until their spikes are lost in the noise."""
    field, away = small("vis", "3-4", 256), 4000.0
    bright = 25.93 - 2.5 * np.log10(2e10 / TIME)
    places = np.array([spike(away), spike(away, 1)]).T
    one = rendered(field, [bright, bright + 6.0], *places, forced=off(*COSMIC_RAYS))
    assert one.sources.electrons == pytest.approx([2e10], rel=0.01)
    x, y = one.sources.column[0], one.sources.row[0]
    law = shone(vis, 256, x, y, one.sources.electrons[0])
    assert law.max() > 0.5 * NOISE
    assert law[:, 100:156].max(axis=0).min() > 0.5 * NOISE
    np.testing.assert_allclose(one.noise_free, law, atol=0.1 * NOISE)
    # A star whose spikes miss the detector adds no noticeable light.
    beside = rendered(field, [bright], [128.0 + away], [128.0], forced=off(*COSMIC_RAYS))
    assert beside.noise_free.max() < 0.1 * NOISE


@pytest.mark.parametrize("away", [500.0, 1400.0])
def test_a_star_beside_the_detector_shines_in(away):
    """The stamp of 51" ends outside the frame, but an exposure draws light of stars up to 145" away."""
    field = small("vis", "3-4", 256)
    found = rendered(field, [5.0], [-away], [200.0], forced=off(*COSMIC_RAYS))
    law = 10 ** (0.4 * (found.zero_point - 5.0)) * TIME * spikes.ring_light(found.psf.edges, EQUAL)
    assert found.noise_free[190:211, 0].mean() == pytest.approx(law / away**3, rel=0.3)
    assert found.noise_free.min() > 0.5 * law / (away + 330.0) ** 3
