"""Drawing: galsim's own drawImage is the reference; angles, fluxes and positions are measured on frames."""

import time
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import gammaincc, gammaincinv

from tests.truesky import nightly
from tests.truesky.render.fields import galaxies, moments, one_source, psf_of, small
from truesky.render.camera import astrometry
from truesky.render.camera.astrometry import sky_of_pixel, wcs
from truesky.render.camera.pointing import boresight_for
from truesky.render.drawing import cost, reference, stamp_sizes, stamps, transfer
from truesky.render.drawing.settings import settings_for
from truesky.render.psf import model
from truesky.render.psf.model import Planes
from truesky.render.sources import galaxy_shapes, source_list
from truesky.request.accuracy import DRAFT, REFERENCE, SURVEY

NOISE = 12.0
KINDS = {
    "point": {},
    "disc": {"inclination": 60.0, "position_angle": 30.0, "gamma1": 0.05, "kappa": 0.02},
    "edge-on": {"inclination": 90.0, "position_angle": 100.0},
    "bulge": {"bulge_fraction": 1.0, "bulge_sersic_index": 4.0, "bulge_axis_ratio": 0.6, "gamma2": 0.1},
    "both": {"bulge_fraction": 0.4, "inclination": 30.0, "position_angle": 170.0},
    "tiny": {"disk_half_light_radius": 0.01},
}


def scene(camera, name, angle=20.0, n=160):
    detector = small(camera, name, n)
    return detector, wcs(detector, *boresight_for(detector, 10.0, 20.0, angle)), psf_of(camera, name)


def drawn(sources, psf, n=160, accuracy=SURVEY):
    settings = settings_for(accuracy)
    sizes = stamp_sizes.stamp_sizes(sources.electrons, sources.shape, sources.shapes, psf, NOISE, settings)
    return stamps.draw(
        sources, sizes, psf, n, n, neglected=stamp_sizes.neglected_flux(sources.electrons, NOISE, settings)
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("camera", "name"), [("vis", "3-4"), ("lsstcam", "R22_S11")])
def test_a_stamp_is_what_galsim_draws(camera, name, kind):
    detector, system, psf = scene(camera, name)
    source = one_source(detector, system, 2e4, 80.3, 77.6, **KINDS[kind])
    image = drawn(source, psf)
    theirs = reference.draw_reference(source, 0, psf, 160)
    # The reference's lower left pixel is at round(position) - 80.
    theirs = np.roll(theirs, (78 - 80, 80 - 80), (0, 1))[8:-8, 8:-8]
    ours = image[8:-8, 8:-8]
    assert np.abs(ours - theirs).max() < max(SURVEY.background * NOISE, 1e-4 * theirs.max())
    y, x = np.mgrid[8:152, 8:152]
    size = 1.0 if kind in ("point", "tiny") else 1.6
    aperture = np.hypot(x - 80.3, y - 77.6) * detector.pixel_scale < size
    assert ours[aperture].sum() == pytest.approx(theirs[aperture].sum(), rel=SURVEY.flux)


@pytest.mark.parametrize(("camera", "name"), [("vis", "2-3"), ("vis", "2-4"), ("lsstcam", "R01_S20")])
@pytest.mark.parametrize("angle", [10.0, 60.0, 125.0])
def test_position_angle_from_end_to_end(camera, name, angle):
    """The header alone converts the axis of a thin galaxy, measured on the frame, to the sky."""
    detector, system, psf = scene(camera, name, angle=-35.0)
    source = one_source(detector, system, 1e6, inclination=80.0, position_angle=angle, disk_half_light_radius=0.7)
    image = drawn(source, psf, accuracy=REFERENCE)
    centre, second = moments(image)
    along = np.linalg.eigh(second)[1][:, 1] * 5
    ends = SkyCoord(*sky_of_pixel(system, *np.transpose([centre - along, centre + along])), unit="deg")
    measured = ends[0].position_angle(ends[1]).deg
    assert (measured - angle + 90) % 180 - 90 == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize(("camera", "name"), [("vis", "2-3"), ("vis", "2-4"), ("lsstcam", "R22_S11")])
def test_shear_from_end_to_end(camera, name):
    """A round galaxy behind a mass to its north-east is stretched along north-west."""
    detector, system, psf = scene(camera, name, angle=110.0)
    image = drawn(one_source(detector, system, 1e6, gamma2=-0.1, disk_half_light_radius=0.5), psf, accuracy=REFERENCE)
    centre, second = moments(image)
    along = np.linalg.eigh(second)[1][:, 1] * 5
    ends = SkyCoord(*sky_of_pixel(system, *np.transpose([centre - along, centre + along])), unit="deg")
    assert ends[0].position_angle(ends[1]).deg % 180 == pytest.approx(135.0, abs=0.3)


def test_neighbouring_orientations_show_the_same_sky():
    """Two VIS detectors, one upside down, show the same galaxy. One image is rotated by 180 deg."""
    images = []
    for name in ("2-3", "2-4"):
        detector = small("vis", name)
        system = wcs(detector, *boresight_for(detector, 10.0, 0.0, 0.0))
        images.append(drawn(one_source(detector, system, 1e5, **KINDS["both"]), psf_of("vis"), accuracy=REFERENCE))
    np.testing.assert_allclose(images[0], images[1][::-1, ::-1], atol=2e-3 * images[0].max())


@given(
    st.sampled_from(sorted(KINDS)),
    st.floats(70, 90),
    st.floats(70, 90),
    st.floats(1, 1e5),
    st.sampled_from([DRAFT, SURVEY]),
)
def test_no_light_is_lost(kind, x, y, electrons, accuracy):
    # The frame also contains the light that is drawn beyond the stamps.
    detector, system, psf = scene("lsstcam", "R22_S11", n=640)
    source = one_source(detector, system, electrons, x + 240, y + 240, **KINDS[kind])
    image = drawn(source, psf, n=640, accuracy=accuracy)
    # Each pixel is rounded to 2^-20 electrons, so the faintest sources vanish.
    assert image.sum() == pytest.approx(electrons, rel=2e-6, abs=image.size * 2.0**-21)
    assert image.min() > -1e-3 * image.max()


# A flat profile and a steep one, each in one of the cameras.
QUICK_FAR = (((6.2, 0.2), "lsstcam"),)


@pytest.mark.parametrize(
    ("index", "radius", "camera", "sizes"),
    [
        pytest.param(*profile, *frame, marks=[] if (profile, frame[0]) in QUICK_FAR else [pytest.mark.nightly])
        for profile in ((2.5, 0.5), (4.0, 0.4), (6.2, 0.2))
        for frame in (("vis", (64, 96, 160)), ("lsstcam", (48, 64, 96)))
    ],
)
def test_light_beyond_the_stamp_is_where_it_belongs(camera, sizes, index, radius):
    """The light inside circles is the same as with a stamp larger than the frame.

    Beyond the stamp, where the PSF does not matter, it agrees with the closed form.
    """
    detector, system, psf = scene(camera, {"vis": "3-4", "lsstcam": "R22_S11"}[camera], n=512)
    shape = {"bulge_fraction": 1.0, "bulge_sersic_index": index, "bulge_half_light_radius": radius}
    source = one_source(detector, system, 1e6, 255.7, 256.4, **shape, bulge_axis_ratio=1.0)
    y, x = np.mgrid[:512, :512]
    far = np.hypot(x - 255.7, y - 256.4) * detector.pixel_scale
    circles = np.array([1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 20.0])

    def inside(size):
        image = stamps.draw(source, np.array([size]), psf, 512, 512)
        return np.array([image[far < circle].sum() for circle in circles]) / 1e6

    whole = inside(2048)
    beyond = gammaincc(2 * index, gammaincinv(2 * index, 0.5) * (circles / radius) ** (1 / index))
    for size in sizes:
        found = inside(size)
        assert np.abs(found - whole).max() < 3e-3
        assert abs(found[0] - whole[0]) < 1e-4
        outside = circles >= 0.75 * size * detector.pixel_scale
        np.testing.assert_allclose(1 - found[outside], beyond[outside], rtol=0.15, atol=5e-4)


@given(st.floats(75, 85), st.floats(75, 85))
def test_a_source_is_where_it_should_be(x, y):
    detector, system, psf = scene("vis", "2-3")
    image = drawn(one_source(detector, system, 1e5, x, y, inclination=40.0), psf, accuracy=REFERENCE)
    iy, ix = np.mgrid[:160, :160]
    window = np.exp(-0.5 * ((ix - x) ** 2 + (iy - y) ** 2) / 5**2) * image
    assert (window * (ix - x)).sum() / window.sum() == pytest.approx(0.0, abs=1e-3)
    assert (window * (iy - y)).sum() / window.sum() == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(("x", "y"), [(-3.0, 50.0), (170.0, 170.0), (80.0, -20.0), (-500.0, 80.0)])
def test_the_part_on_the_frame_is_the_whole_stamp_cut(x, y):
    detector, system, psf = scene("vis", "2-3")
    source = one_source(detector, system, 1e5, x, y, inclination=40.0)
    sizes = np.array([96])
    cut = stamps.draw(source, sizes, psf, 160, 160)
    moved = one_source(detector, system, 1e5, x + 600, y + 600, inclination=40.0)
    moved = source_list.Sources(
        moved.ids, moved.column, moved.row, source.jacobian, moved.electrons, moved.shape, moved.shapes
    )
    whole = stamps.draw(moved, sizes, psf, 1400, 1400)
    np.testing.assert_allclose(cut, whole[600:760, 600:760], atol=1e-9 * max(whole.max(), 1))


def many(n, seed=5):
    rng = np.random.default_rng(seed)
    form = galaxy_shapes.shapes(
        galaxies(
            rng.random(n), rng.random(n),
            bulge_fraction=rng.random(n), bulge_sersic_index=rng.choice([1.0, 2.0], n),
            inclination=90 * rng.random(n), position_angle=180 * rng.random(n),
        )
    )  # fmt: skip
    jacobian = np.tile(np.array([[0.2, 0.01], [-0.01, 0.2]]), (n, 1, 1))
    shape = np.where(np.arange(n) % 4 == 0, -1, np.arange(n))
    return source_list.Sources(
        np.arange(n),
        160 * rng.random(n),
        160 * rng.random(n),
        jacobian,
        10 ** rng.uniform(1, 5, n),
        shape,
        form,
    )


def test_a_frame_is_the_sum_of_its_sources_and_the_same_every_time():
    sources, psf = many(40), psf_of("lsstcam")
    whole = drawn(sources, psf)
    np.testing.assert_array_equal(whole, drawn(sources, psf))
    parts = sum(drawn(sources.take(np.arange(40) % 2 == i), psf) for i in (0, 1))
    np.testing.assert_array_equal(whole, parts)


def test_progress_is_told():
    told = []
    sources = many(3)
    stamps.draw(sources, np.full(3, 32), psf_of("lsstcam"), 160, 160, told.append)
    assert told[-1] == 3


def test_sizes_follow_flux_noise_and_accuracy():
    sources, psf = many(200), psf_of("lsstcam")

    def sizes(factor=1.0, noise=NOISE, accuracy=SURVEY):
        settings = settings_for(accuracy)
        return stamp_sizes.stamp_sizes(factor * sources.electrons, sources.shape, sources.shapes, psf, noise, settings)

    base = sizes()
    assert set(base) <= set(stamp_sizes.SIZES)
    assert (sizes(100.0) >= base).all()
    assert (sizes(100.0) > base).any()
    assert (sizes(noise=100 * NOISE) <= base).all()
    assert (sizes(accuracy=REFERENCE) >= base).all()
    assert (sizes(accuracy=DRAFT) <= base).all()
    assert (sizes(1e12) <= stamp_sizes.SIZES[-1]).all()
    # A Moffat profile extends as far as it is visible. A point never needs more than the planes of the PSF.
    assert (sizes(1e12)[sources.shape < 0] > model.SIDE).any()
    # (The values of the planes do not matter here.)
    nothing = np.zeros((1, 3, 3), np.float32)
    psf = replace(psf, planes=Planes(np.array([7000.0]), nothing, nothing[:0], (1.0, 1.0)))
    assert (sizes(1e12)[sources.shape < 0] <= model.SIDE).all()


@pytest.mark.parametrize(
    "shape",
    [
        {"disk_half_light_radius": 1e-8},
        {"disk_half_light_radius": 0.0},
        {"disk_half_light_radius": 15.0, "inclination": 90.0},
        {"bulge_fraction": 1.0, "bulge_half_light_radius": 10.0, "bulge_sersic_index": 6.0},
        {"bulge_fraction": 1.0, "bulge_sersic_index": 0.3, "bulge_axis_ratio": 0.02},
        {"kappa": 0.999, "gamma1": 0.001},
        {"gamma1": 0.9, "gamma2": 0.9},
    ],
)
@pytest.mark.parametrize("electrons", [1e-6, 1e6])
def test_extremes_stay_finite(shape, electrons):
    detector, system, psf = scene("lsstcam", "R22_S11")
    source = one_source(detector, system, electrons, **shape)
    image = drawn(source, psf)
    assert np.isfinite(image).all()
    assert image.min() >= -1e-3 * image.max()
    assert image.sum() <= electrons * (1 + 1e-4)


def test_the_jacobian_of_the_place_is_used():
    """A source drawn with a stretched Jacobian is stretched the other way in pixels; the PSF is not."""
    detector, system, psf = scene("vis", "2-3")
    source = one_source(detector, system, 1e6, disk_half_light_radius=0.6)
    jacobian = np.array([[[0.1, 0.0], [0.0, 0.05]]])
    source = source_list.Sources(
        source.ids, source.column, source.row, jacobian, source.electrons, source.shape, source.shapes
    )
    point = one_source(detector, system, 1e6)
    _, second = moments(drawn(source, psf, accuracy=REFERENCE))
    _, psf = moments(drawn(point, psf, accuracy=REFERENCE))
    body = second - psf
    assert np.sqrt(body[1, 1] / body[0, 0]) == pytest.approx(2.0, rel=0.05)


def test_focal_plane_jacobian_has_the_sign_used_by_stamps():
    """On an upright detector with north up, u (west) grows with the column and v (north) with the row."""
    detector = small("lsstcam", "R22_S11")
    system = wcs(detector, *boresight_for(detector, 10.0, 20.0, 0.0))
    j = astrometry.jacobian(system, [80.0], [80.0])[0]
    np.testing.assert_allclose(j, np.eye(2) * detector.pixel_scale, atol=1e-5)


@nightly.parametrize(
    ("size", "electrons", "side"),
    [(64, 1e3, 1024), pytest.param(2048, 1e3, 256, marks=pytest.mark.nightly), (2048, 1e9, 256)],
    (0,),
)
def test_memory_is_what_was_predicted(size, electrons, side):
    """Buffers of compiled code are not measured, but they are not larger than the stamps."""
    detector = small("vis", "3-4")
    system = wcs(detector, *boresight_for(detector, 10.0, 20.0, 0.0))
    source = one_source(detector, system, electrons, disk_half_light_radius=1.0)
    psf, sizes = psf_of("vis"), np.array([size])
    stamps.draw(source, np.array([32]), psf, 64, 64)
    tracemalloc.start()
    try:
        stamps.draw(source, sizes, psf, side, side)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    predicted = cost.memory(source.electrons, sizes, side, side)
    assert peak < predicted, peak
    assert predicted < 2.0 * peak + 5e7


def test_every_scene_that_a_task_takes_has_room():
    """A whole detector with 5,000 sources fits in memory, with the largest stamp in double precision and all else."""
    for nx, ny in ((4096, 4132), (4072, 4000)):
        electrons = np.full(5000, 1e3)
        electrons[0] = 1e11
        sizes = np.where(electrons > 1e10, stamp_sizes.SIZES[-1], 64)
        assert 0.6e9 + cost.memory(electrons, sizes, nx, ny) < 2e9


def test_what_is_drawn_through_was_counted_before(monkeypatch):
    """Pixels of stamps and of PSF planes on their grids are counted, with large and small stamps and bright sources."""
    sources, psf = many(60), psf_of("lsstcam")
    sources.electrons[:3] = 1e9
    sizes = np.where(np.arange(60) % 7 == 0, 96, 48)
    counted = {"stamps": 0, "planes": 0}

    def watched(function, kind, pixels):
        def call(*args):
            found = function(*args)
            counted[kind] += pixels(found, *args)
            return found

        return call

    add = stamps._draw_batch
    monkeypatch.setattr(
        stamps, "_draw_batch", watched(add, "stamps", lambda _, one, chosen, p, *a: chosen.size * p.grid.size**2)
    )
    for name in ("transfer", "source_transfer"):
        made = watched(getattr(transfer, name), "planes", lambda t, *a: len(t.planes) * t.grid.size**2)
        monkeypatch.setattr(transfer, name, made)
    stamps.draw(sources, sizes, psf, 160, 160)
    assert cost.count_work(sources, sizes, psf) == (counted["stamps"], counted["planes"])


def test_seconds_follow_the_stamps():
    """Stamps have nine times more pixels, and take proportionally more time on any machine.

    The time for planes, which have one size each, is the rest.
    """
    sources, psf = many(400), psf_of("lsstcam")
    spent, predicted = [], []
    for size in (64, 192):
        sizes = np.full(400, size)
        predicted.append(cost.seconds(sources, sizes, psf, 160, 160))
        stamps.draw(sources, sizes, psf, 160, 160)
        best = np.inf
        for _ in range(3):
            start = time.process_time()
            stamps.draw(sources, sizes, psf, 160, 160)
            best = min(best, time.process_time() - start)
        spent.append(best)
    assert 4 < predicted[1] / predicted[0] < 10
    # Other processes disturb the times, so only a wrong power of the size would be detected.
    assert spent[1] / spent[0] == pytest.approx(predicted[1] / predicted[0], rel=0.6)
