"""Windows have the light of the same pixels of the whole detector, and plausible noise."""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema.errors import BadInput
from tests.truesky import nightly
from tests.truesky.render import fields
from tests.truesky.render.fields import MISSION, fluxes, galaxies, stars
from truesky.reduction import amplifiers
from truesky.render.camera import astrometry, detectors
from truesky.render.camera.pointing import boresight_for
from truesky.render.camera.windows import Window
from truesky.render.channels.aim import Aim
from truesky.render.drawing import stamps
from truesky.render.exposure import scene_factory, visible_sources
from truesky.render.exposure.records import Rows, Variant
from truesky.render.planning import planned_exposures
from truesky.render.windows import image
from truesky.request.accuracy import DRAFT, SURVEY

SEED, MJD = 1, 60905.0
# Channel, camera, detector and band of the tested images.
CAMERAS = {
    "vis": ("VIS", "3-4", "euclid_vis"),
    "nisp": ("NISP-P", "DET22", "euclid_h"),
    "lsstcam": ("EXT", "R22_S11", "lsst_r"),
}
# Largest difference between a window and the image of the detector, in units of the noise of a pixel.
LARGEST = 1.0 / 320.0


@pytest.fixture(scope="module", params=nightly.params(CAMERAS, (1, 2)))
def field(request):
    """An exposure of a part of a detector with stars and galaxies, and the image of all its pixels."""
    camera = request.param
    _, name, band = CAMERAS[camera]
    detector = replace(detectors.detector(camera, name, MISSION), nx=480, ny=440, injection_rows=0)
    aim, variant, rng = aim_at(camera, detector), Variant(MISSION, SURVEY, {}), rand()
    x, y = rng.uniform(-100.0, 580.0, (2, 450))
    bodies = galaxies(
        *astrometry.sky_of_pixel(aim.wcs, x[:350], y[:350]), inclination=80.0 * rng.random(350),
        position_angle=180.0 * rng.random(350), bulge_fraction=rng.random(350),
        disk_half_light_radius=0.2 + rng.random(350),
    )  # fmt: skip
    points = stars(*astrometry.sky_of_pixel(aim.wcs, x[350:], y[350:]))
    tables = (
        bodies, fluxes(bodies, band, 10 ** rng.uniform(-1.0, 2.5, 350)),
        points, fluxes(points, band, 10 ** rng.uniform(-1.0, 4.5, 100)),
    )  # fmt: skip
    rows = Rows(*tables)
    scene = scene_factory.from_aim(aim, variant)
    if aim.channel.transfer_effect is not None:
        scene = replace(scene, forced={aim.channel.transfer_effect.name: True})
    light = visible_sources.visible_light(aim, rows, scene, SEED)
    return aim, rows, variant, light, draw(light, np.arange(len(light.sources)), detector)


def aim_at(camera, detector):
    channel, _, band = CAMERAS[camera]
    ra, dec, angle = boresight_for(detector, 53.1, -27.8, 12.0)
    exposed = fields.exposure(
        channel=channel, camera=camera, band=band, ra=ra, dec=dec, position_angle=angle, mjd=MJD, sky=0.5, seeing=0.7,
        exposure_time_s=planned_exposures.exposure_time(channel, camera, band, MISSION),
        zero_point=planned_exposures.zero_point_of(camera, band, MISSION),
    )  # fmt: skip
    return Aim.from_exposure(exposed, detector, None, SEED)


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_amplifier_of_a_window_reads_its_middle(camera):
    """It is the same as in an image of the numbers of all amplifiers."""
    detector = detectors.detector(camera, CAMERAS[camera][1], MISSION)
    aim = aim_at(camera, detector)
    scene = scene_factory.from_aim(aim, Variant(MISSION, SURVEY, {}))
    count = {"vis": 4, "nisp": 1, "lsstcam": 16}[camera]
    numbers = np.broadcast_to(amplifiers.to_pixels(np.arange(count) if count > 1 else 0.0, scene), (scene.ny, scene.nx))
    first, end = scene.unread_rows
    for column, row in rand().integers(0, (scene.nx, scene.ny), (200, 2)).tolist():
        if not (camera == "vis" and first <= row < end):
            assert image.amplifier_at(aim, scene, Window(column, row, 1, 1)) == numbers[row, column]
    if camera == "vis":
        # Rows that are not read count to the nearer half.
        for row, read in ((scene.ny // 2 - 1, first - 1), (scene.ny // 2, end)):
            assert image.amplifier_at(aim, scene, Window(5, row, 1, 1)) == numbers[read, 5]


def rand():
    return np.random.default_rng(5)


def draw(light, chosen, detector):
    return stamps.draw(
        light.sources.take(chosen), light.sizes[chosen], light.psf, detector.nx, detector.ny, None,
        light.neglected[chosen],
    )  # fmt: skip


def window_of(field, window, **options):
    aim, rows, variant, *_ = field
    return image.draw_window(replace(aim, window=window), rows, variant, SEED, **options)


def test_how_a_source_is_drawn_does_not_depend_on_the_others(field):
    aim, _, _, light, whole = field
    half = rand().random(len(light.sources)) < 0.5
    parts = [draw(light, np.flatnonzero(mask), aim.detector) for mask in (half, ~half)]
    assert np.array_equal(parts[0] + parts[1], whole)
    brightest = int(np.argmax(light.sources.electrons))
    others = draw(light, np.delete(np.arange(len(light.sources)), brightest), aim.detector)
    assert np.array_equal(others + draw(light, np.array([brightest]), aim.detector), whole)


@pytest.mark.parametrize(
    "window", [Window(203, 250, 128, 128), Window(0, 0, 65, 33), Window(360, 331, 120, 109), Window(350, 350, 1, 1)]
)
def test_a_window_is_a_part_of_the_image(field, window):
    *_, light, whole = field
    drawn = window_of(field, window, with_noise=False)
    expected = whole[window.row : window.row + window.ny, window.column : window.column + window.nx]
    assert drawn.raw is None
    assert np.abs(drawn.electrons - expected).max() <= LARGEST * light.scene.pixel_noise
    inside = (np.abs(drawn.sources.column - (window.nx - 1) / 2) < window.nx / 2) & (
        np.abs(drawn.sources.row - (window.ny - 1) / 2) < window.ny / 2
    )
    assert set(drawn.sources.ids[inside]) <= set(light.sources.ids)
    assert (drawn.drawn_electrons > 0.0).all()


def test_rows_that_are_not_read_are_dark():
    detector = replace(detectors.detector("vis", "3-4", MISSION), nx=160, ny=164)
    ra, dec, angle = boresight_for(detector, 53.1, -27.8, 0.0)
    aim = Aim.from_exposure(fields.exposure(ra=ra, dec=dec, position_angle=angle, mjd=MJD, sky=0.2), detector)
    points = stars(*astrometry.sky_of_pixel(aim.wcs, [80.0], [81.5]))
    none = galaxies([], [])
    rows = Rows(none, fluxes(none, "euclid_vis", 0.0), points, fluxes(points, "euclid_vis", 100.0))
    window = Window(60, 75, 40, 20)
    drawn = image.draw_window(replace(aim, window=window), rows, Variant(MISSION, SURVEY, {}), SEED)
    dark = np.flatnonzero((drawn.electrons == 0.0).all(axis=1)) + window.row
    assert dark.tolist() == list(range(80, 84))
    assert (drawn.raw[dark - window.row] == 0).all()


def test_the_noise_of_a_window(field):
    """The sky has the expected level and the noise of the scene: 128^2 pixels, 5 sigma."""
    aim, rows, variant, *_ = field
    empty = Rows(*(table.slice(0, 0) for table in (rows.galaxies, rows.galaxy_fluxes, rows.stars, rows.star_fluxes)))
    window = Window(100, 100, 128, 128)
    effects = ["background", "poisson", "dark_current", "dark_map", "read_noise", "group_noise", "reset_level"]
    names = {effect.name for effect in aim.effects}
    drawn = image.draw_window(
        replace(aim, window=window), empty, variant, SEED, effects=[name for name in effects if name in names]
    )
    scene = drawn.scene
    gain, bias = (
        float(scene.amplifier_values(key, unit)) for key, unit in (("gain", "electron / adu"), ("bias", "adu"))
    )
    electrons = (drawn.raw - bias) * gain
    level = scene.sky_electrons + scene.dark_electrons
    assert drawn.raw.shape == (128, 128)
    assert np.median(electrons) == pytest.approx(level, abs=0.1 * level + 2.0 * gain)
    # Half of the interval with 68 % of the pixels, to which the few hot pixels do not contribute.
    noise = 0.5 * float(np.diff(np.percentile(electrons, [15.87, 84.13]))[0])
    assert noise == pytest.approx(np.hypot(scene.pixel_noise, gain / np.sqrt(12.0)), rel=0.3)


@pytest.mark.parametrize("camera", ["vis", "lsstcam"])
def test_windows_and_exposures_have_the_same_fixed_pattern(camera):
    detector = replace(detectors.detector(camera, CAMERAS[camera][1], MISSION), injection_rows=0)
    aim, variant, none = aim_at(camera, detector), Variant(MISSION, SURVEY, {}), galaxies([], [])
    empty = fluxes(none, aim.exposure.band, 0.0)
    rows, effects = Rows(none, empty, stars([], []), empty), ["background", "pixel_response", "hot_pixels"]
    # The second window begins 30 columns and 20 rows after the first one, and belongs to another exposure.
    first, second = (
        image.draw_window(
            replace(aim, window=window, exposure=replace(aim.exposure, mjd=mjd)), rows, variant, SEED, effects=effects
        ).raw.astype(int)
        for window, mjd in ((Window(300, 700, 300, 240), MJD), (Window(330, 720, 300, 240), MJD + 1.0))
    )
    both, same = first[20:, 30:], second[:-20, :-30]
    assert np.array_equal(both, same)
    # The pattern is noticeable: neighbouring pixels differ.
    assert not np.array_equal(first, second)


def test_noise_depends_on_the_seed_of_the_noise_alone(field):
    window = Window(203, 250, 64, 64)
    one, same, other = (window_of(field, window, noise_seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(one.raw, same.raw)
    assert not np.array_equal(one.raw, other.raw)
    assert np.array_equal(one.electrons, other.electrons)


def test_accuracy_changes_the_light_by_less_than_the_noise(field):
    aim, rows, variant, light, _ = field
    window = Window(203, 250, 128, 128)
    rough = image.draw_window(
        replace(aim, window=window), rows, replace(variant, accuracy=DRAFT), SEED, with_noise=False
    )
    fine = window_of(field, window, with_noise=False)
    assert 0.0 < np.abs(rough.electrons - fine.electrons).max() < light.scene.pixel_noise


def test_unknown_effects_and_slitless_images_are_refused(field):
    aim, rows, variant, *_ = field
    window = Window(203, 250, 64, 64)
    with pytest.raises(BadInput, match=r"effects: 'ghosts' cannot be applied to a window; allowed here: background, "):
        window_of(field, window, effects=["ghosts"])
    dark = replace(aim, window=window, exposure=replace(aim.exposure, image_type="dark"))
    with pytest.raises(BadInput, match="exposure 1: windows are drawn in direct images of the sky only"):
        image.draw_window(dark, rows, variant, SEED)
