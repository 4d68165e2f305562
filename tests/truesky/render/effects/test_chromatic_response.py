"""Chromatic response of infrared pixels: maps, colours, and three planes against a plane for each wavelength."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import _scenes as scenes
from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import resolve
from tests.truesky.render import fields, infrared
from truesky.fluxes import passbands
from truesky.randomness import rng
from truesky.render.camera.detectors import detector
from truesky.render.channels.aim import Aim
from truesky.render.drawing import stamp_sizes, stamps
from truesky.render.drawing.settings import settings_for
from truesky.render.effects.light import calibration_lamp, chromatic_response
from truesky.render.effects.scene import NOTICEABLE
from truesky.render.exposure import chromatic_response_map, scene_factory, visible_sources
from truesky.render.exposure.records import Variant
from truesky.render.exposure.visible_sources import Light
from truesky.render.psf import euclid
from truesky.render.psf.sub_bands import N_SUB_BANDS, sub_bands
from truesky.render.sky import diffuse_light, thermal
from truesky.request.accuracy import SURVEY

MISSION = resolve()
Y = passbands.load("euclid_y")
SLOPE, CURVATURE = (MISSION.value(f"nisp.response.{key}", "") for key in ("slope", "curvature"))
TABLE = chromatic_response.sub_band_components("nisp", Y, MISSION)
EVEN = chromatic_response.band_means("nisp", Y, MISSION)
# rms of a signal without a source.
NOISE = 12.0


def drawn_maps(shape=(400, 300), slope=SLOPE, curvature=CURVATURE, seed=3):
    return chromatic_response.draw_maps(shape, slope, curvature, np.random.default_rng(seed))


def test_maps_have_the_mission_s_rms():
    found = drawn_maps((1020, 1020))
    assert found.std(axis=(1, 2)) == pytest.approx([SLOPE, CURVATURE], rel=0.2)
    # Half of the variance is smooth: it is the variance of means over 20 x 20 pixels.
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


@given(st.lists(st.floats(0.01, 1.0), min_size=N_SUB_BANDS, max_size=N_SUB_BANDS))
def test_colours_are_means_of_the_components(weights):
    """Colours are relative to flat f_nu."""
    shares = np.array([weights]) / np.sum(weights)
    own = chromatic_response.source_colours(shares, TABLE)
    assert np.abs(own).max() <= np.abs(TABLE).max()
    np.testing.assert_allclose(
        chromatic_response.source_colours(np.full((1, N_SUB_BANDS), 1 / N_SUB_BANDS), TABLE), 0.0, atol=1e-15
    )
    parts = sub_bands(Y)
    photons = np.concatenate(
        [
            w * p.response / p.wavelength / np.sum(p.response / p.wavelength)
            for w, p in zip(shares[0], parts, strict=True)
        ]
    )
    lines = chromatic_response.colour_of_lines(
        "nisp", Y, np.concatenate([p.wavelength for p in parts]), photons, MISSION
    )
    np.testing.assert_allclose(own[0], lines, atol=1e-12)


def test_a_lamp_at_the_band_s_edge_has_a_colour_of_its_own():
    """1.19 um in Y: 0.1 um from the middle, of which the slope changes by 1 in 0.95."""
    own = chromatic_response.colour_of_lines("nisp", Y, np.array([11900.0]), np.ones(1), MISSION)
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


def slowly(some, response, draw):
    """Draw every sub-band separately, and multiply it by the response of the pixels."""
    each = 0.0
    for part in range(N_SUB_BANDS):
        alone = np.zeros((len(some), N_SUB_BANDS))
        alone[:, part] = 1.0
        f = TABLE[part] + EVEN
        factor = 1.0 + response[0] * f[0] + response[1] * f[1]
        each = each + factor * draw(some.electrons * some.photons[:, part], alone)
    return each


def test_three_drawings_are_one_for_each_wavelength(field):
    some, draw = field
    response = drawn_maps((200, 200))
    light = draw(some.electrons)
    lit = chromatic_response.weighted_light(some.electrons, some.photons, TABLE, draw)
    found = chromatic_response.apply(light, lit, EVEN, SLOPE, CURVATURE, np.random.default_rng(3))
    each = slowly(some, response, draw)
    # Told from what all light of the band meets.
    change = np.abs(each - light * (1.0 + response[0] * EVEN[0] + response[1] * EVEN[1]))
    np.testing.assert_allclose(found, each, atol=1e-3 * change.max())
    # The colours of whole sources are not sufficient, because blue light is concentrated in the core of the PSF.
    own = chromatic_response.source_colours(some.photons, TABLE)
    whole = sum(response[k] * (draw(some.electrons * (own[:, k] + 1.0)) + (EVEN[k] - 1.0) * light) for k in (0, 1))
    assert np.abs(light + whole - each).max() > 0.02 * change.max()
    assert np.abs(light + whole - each).max() < change.max()


def test_ordinary_sources_do_not_need_it():
    """Fainter than 18.2 mag, of the colours of galaxies and stars: less than a tenth of the noise in a pixel."""
    shares = scenes.colours(400, np.random.default_rng(1))
    own = chromatic_response.source_colours(shares / shares.sum(axis=1, keepdims=True), TABLE)
    for magnitude, needed in ((18.2, False), (14.0, True)):
        peak = np.full(400, 0.3 * 87.24 * 10 ** (0.4 * (25.0 - magnitude)))
        change = chromatic_response.colour_changes(peak, own, TABLE, (SLOPE, CURVATURE)).max()
        noise = np.hypot(NOISE, np.sqrt(peak[0]))
        print(magnitude, f"{change:.2f} e- in a pixel of {peak[0]:.0f}, noise {noise:.1f}")
        assert (change > NOTICEABLE * noise) == needed


# ------------------------------------------------------------------------------------------------ in an exposure


@pytest.mark.nightly
def test_an_exposure_draws_noticeable_colours_again():
    """A few of its sources, on small stamps; pixel by pixel within a tenth of the noise of all of them drawn slowly."""
    side = 256
    small_one = fields.small("nisp", "DET22", side)
    row = infrared.exposed(small_one, band="euclid_y")
    aim = Aim.from_exposure(fields.exposure(**row), small_one)
    psf = euclid.nisp_psf(small_one, Y, MISSION, 4)
    some = scenes.stratified_sample(scenes.Scene("nisp", side, side, 0.3, 87.24, 25.0, NOISE, 0, 0), 5, 12)
    settings, mission = settings_for(SURVEY), resolve(overrides={"nisp.response.slope": (0.05, "")})
    scene = replace(scene_factory.from_aim(aim, Variant(mission, SURVEY, {})))
    sizes = stamp_sizes.stamp_sizes(some.electrons, some.shape, some.shapes, psf, scene.pixel_noise, settings)
    neglected = stamp_sizes.neglected_flux(some.electrons, scene.pixel_noise, settings)
    light = Light(some, sizes, neglected, psf, scene)

    def draw(electrons, photons=some.photons):
        return stamps.draw(replace(some, electrons=electrons, photons=photons), sizes, psf, side, side, None, neglected)

    with pytest.MonkeyPatch.context() as patch:
        counted = []
        patch.setattr(stamps, "draw", lambda *args, kept=stamps.draw: counted.append(len(args[0])) or kept(*args))
        found = chromatic_response_map.with_chromatic_light(scene, aim, light)
    assert len(counted) == 3
    assert 5 < counted[0] < 0.8 * len(some)
    response = drawn_maps((side, side), slope=0.05)
    frame = draw(some.electrons)
    change = slowly(some, response, draw) - frame * (1.0 + response[0] * EVEN[0] + response[1] * EVEN[1])
    fast = response[0] * found.chromatic_light[0] + response[1] * found.chromatic_light[1]
    noise = np.sqrt(scene.pixel_noise**2 + frame)
    wrong = np.abs((fast - change) / noise).max()
    print(f"change {np.abs(change / noise).max():.2f} sigma, wrong by {wrong:.3f}")
    assert np.abs(change / noise).max() > 0.8
    assert wrong < NOTICEABLE
    assert np.abs(fast - change).max() < 0.03 * np.abs(change).max()
    # The predicted largest change is close to the actual one, for maps with 5 sigma.
    assert found.chromatic_electrons < 5 * np.abs(change).max() < 25 * found.chromatic_electrons
    assert (
        chromatic_response_map.with_chromatic_light(
            replace(scene, forced={"chromatic_response": False}), aim, light
        ).chromatic_light
        is None
    )


def test_a_flat_has_the_colour_of_its_lamp():
    """With an LED at the band's edge, the response of pixels to its colour changes the noise-free frame."""
    quiet = dict.fromkeys(
        ("ramp_cosmic_rays", "drift", "group_noise", "dark_map", "pixel_response", "ramp_nonlinearity", "ipc"), False
    )
    both = [
        infrared.rendered(kind="flat", lamp=2, band="euclid_y", sky=0.0, forced={**quiet, "lamp_response": on})
        for on in (False, True)
    ]
    before, after = (infrared.electrons(one) for one in both)
    led = calibration_lamp.detected_photons(Y, 2, "nisp", MISSION)
    own = chromatic_response.colour_of_lines("nisp", Y, Y.wavelength, led, MISSION)
    maps = chromatic_response.draw_maps(
        (96, 96), SLOPE, CURVATURE, rng.stream(infrared.SEED, "nisp", "DET22", "chromatic_response")
    )
    own = own + EVEN
    expected = own[0] * maps[0] + own[1] * maps[1]
    change = after / before - 1.0
    # The noise differs by half a per cent of itself if the light differs, and values are rounded.
    assert np.corrcoef(change.ravel(), expected.ravel())[0, 1] > 0.95
    assert (change * expected).sum() / (expected**2).sum() == pytest.approx(1.0, abs=0.05)
    assert {d.name: d.applied for d in infrared.rendered(kind="flat", lamp=2, band="euclid_y", sky=0.0).decisions}[
        "lamp_response"
    ]
    # Where no LED of the band shines there is nothing to see.
    dark = infrared.rendered(kind="flat", lamp=1, band="euclid_h", sky=0.0)
    assert not {d.name: d.applied for d in dark.decisions}["lamp_response"]


BRIGHT = {"nisp.flat.signal": (9e4, "electron")}
# Effects that would hide the response of pixels.
NOISY = dict.fromkeys(
    ("ramp_cosmic_rays", "drift", "group_noise", "dark_map", "output_gain", "ramp_nonlinearity", "ipc"), False
)


def flat(band, lamp, mission=MISSION):
    """Light of a flat, told from its lamp's pattern."""
    one = infrared.rendered(kind="flat", lamp=lamp, band=band, sky=0.0, forced=NOISY, mission=mission)
    return infrared.electrons(one) / calibration_lamp.apply(
        np.zeros((96, 96)), *calibration_lamp.EFFECT.parameters(one.scene)
    )


def met(band, lamp):
    """[2] f1 and f2 that the light of a lamp meets."""
    curve = passbands.load(band)
    light = calibration_lamp.detected_photons(curve, lamp, "nisp", MISSION)
    return chromatic_response.colour_of_lines(
        "nisp", curve, curve.wavelength, light, MISSION
    ) + chromatic_response.band_means("nisp", curve, MISSION)


def test_flats_of_two_bands_differ_by_the_response_to_their_light():
    """By half a part in a hundred from pixel to pixel: LED 1 in Y and LED 5 in H; counted with many electrons."""
    bright = resolve(overrides={"nisp.response.slope": (0.02, ""), **BRIGHT})
    ratio = flat("euclid_y", 1, bright) / flat("euclid_h", 5, bright) - 1.0
    maps = chromatic_response.draw_maps(
        (96, 96), 0.02, CURVATURE, rng.stream(infrared.SEED, "nisp", "DET22", "chromatic_response")
    )
    y, h = ((own[:, None, None] * maps).sum(axis=0) for own in (met("euclid_y", 1), met("euclid_h", 5)))
    # Pixels that are dead, or whose charge is too much for the mean.
    good = np.abs(ratio - np.median(ratio)) < 0.08
    expected = (1.0 + y) / (1.0 + h) - 1.0
    assert good.mean() > 0.98
    assert expected.std() > 0.01
    found, expected = (part[good] - part[good].mean() for part in (ratio, expected))
    assert (found * expected).sum() / (expected**2).sum() == pytest.approx(1.0, abs=0.05)


def test_a_flat_of_the_band_flattens_the_sky():
    """The response to the sky and to a lamp is the same except for the difference of their colours."""
    strong = resolve(overrides={"nisp.response.slope": (0.1, "")})
    level = 9e4 / infrared.TIME
    sky = infrared.electrons(infrared.rendered(sky=level, band="euclid_y", mission=strong, forced=NOISY))
    parts = {}
    for band, lamp in (("euclid_y", 1), ("euclid_h", 5)):
        ratio = sky / flat(band, lamp, resolve(overrides={"nisp.response.slope": (0.1, ""), **BRIGHT}))
        ratio /= np.median(ratio)
        parts[band] = ratio[np.abs(ratio - 1.0) < 0.5].std()
    print(parts)
    assert parts["euclid_y"] < 0.3 * parts["euclid_h"]


def test_a_dark_has_no_colour():
    names = {d.name for d in infrared.rendered(kind="dark", sky=0.0).decisions}
    assert not names & {"chromatic_response", "lamp_response", "pixel_response"}


def test_stars_have_their_colours_in_an_image():
    """A bright red star: what is drawn again of it is its colour times its light."""
    one = infrared.rendered([20.0], [48.0], [48.0], band="euclid_y")
    assert {d.name: d.applied for d in one.decisions}["chromatic_response"]
    assert one.scene.chromatic_light is None
    shares = np.linspace(0.5, 1.5, N_SUB_BANDS)[None] / N_SUB_BANDS
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(visible_sources, "_photon_fractions", lambda kept, *_: np.tile(shares, (len(kept), 1)))
        red = infrared.rendered([14.0], [48.0], [48.0], band="euclid_y")
    assert {d.name: d.applied for d in red.decisions}["chromatic_response"]
    middle = np.s_[46:51, 46:51]
    seen, light = red.scene.chromatic_light[0][middle].sum(), red.noise_free[middle].sum()
    assert seen / light == pytest.approx(chromatic_response.source_colours(shares, TABLE)[0, 0], rel=0.3)


def test_pixels_that_see_nothing_are_dark():
    """A sensitivity that differs from pixel to pixel by as much as it is leaves every sixth without any."""
    mission = resolve(overrides={"nisp.prnu": (1.0, ""), "nisp.response.slope": (0.5, "")})
    one = infrared.rendered(
        kind="flat", lamp=2, band="euclid_y", sky=0.0, mission=mission,
        forced={"ramp_cosmic_rays": False, "dark_map": False, "ipc": False},
    )  # fmt: skip
    signal = infrared.electrons(one)
    assert 0.1 < np.mean(signal < 50.0) < 0.2
    assert signal.min() > -50.0
    assert np.median(signal) > 1e4


def test_the_sky_has_the_colour_of_its_light():
    """Sunlight is bluer than flat f_nu in H; light of a warm telescope is redder."""
    h = passbands.load("euclid_h")
    warm = resolve(overrides={"nisp.thermal.telescope_temperature": (170.0, "K")})
    for band, mission, red in ((h, MISSION, False), (h, warm, True)):
        rate = 1.0 + thermal.rate("nisp", band.name, band, mission)
        photons = diffuse_light.photons("nisp", rate, band, mission)
        assert photons.sum() == pytest.approx(rate)
        assert (photons >= 0).all()
        own = chromatic_response.colour_of_lines("nisp", band, band.wavelength, photons, mission)
        assert (own[0] > 0) == red
