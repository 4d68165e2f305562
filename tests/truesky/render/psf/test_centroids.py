"""Centroids of PSFs agree with shifted Gaussians, and with measurements of drawn stars."""

from dataclasses import replace

import numpy as np
import pytest
import sep

from lake_schema.mission.bounds import bounds_of_parameter
from lake_schema.mission.configuration import resolve
from tests.truesky import nightly
from tests.truesky.render import nominal
from tests.truesky.render.fields import one_source, small
from truesky.fluxes import passbands
from truesky.render.camera import detectors
from truesky.render.camera.astrometry import wcs
from truesky.render.camera.pointing import boresight_for
from truesky.render.drawing import stamps, transfer
from truesky.render.products import truth_table
from truesky.render.psf import centroids, euclid, model, seeing
from truesky.render.psf.centroids import offsets
from truesky.render.psf.sub_bands import sub_bands

MISSION = resolve()
# Stars per row and column of a lattice, and their distance in pixels.
N, PITCH = 39, 48


def shifted(x, y, sigma=0.9, samples=3, side=24):
    """Return a Gaussian at an offset (pixels) from the middle."""
    axis = (np.arange(side * samples + 1) - side * samples // 2) / samples
    one = np.exp(-0.5 * ((axis - x) ** 2 + (axis[:, None] - y) ** 2) / sigma**2)
    return (one / one.sum()).astype(np.float32)


def psf_of(*planes, drift=(), samples=3):
    images, more = np.stack(planes), np.stack(drift) if drift else np.zeros((0, *planes[0].shape), np.float32)
    waves = 6000.0 + 1000.0 * np.arange(len(planes))
    return model.from_planes(
        model.Planes(waves, images, more, (50.0, 50.0), ((1, 0, 0),) * len(drift), samples), 0.1, False, 24
    )


@pytest.mark.parametrize(("samples", "error"), [(3, 0.014), (5, 0.005)])
def test_half_of_the_light_of_a_gaussian(samples, error):
    """The diameter is correct for any width, not only for multiples of the sample spacing."""
    for sigma in np.linspace(0.5, 1.5, 23):
        found = centroids._half_light_diameter(shifted(0.0, 0.0, sigma, samples=samples), samples)
        assert found == pytest.approx(2.0 * sigma * np.sqrt(2.0 * np.log(2.0)), rel=error)


@pytest.mark.parametrize("samples", [1, 2, 3, 4])
def test_of_a_shifted_gaussian_it_is_the_shift(samples):
    found = np.stack(offsets(psf_of(shifted(0.1, -0.05, samples=samples), samples=samples), np.ones((1, 1))))
    assert found[:, 0] == pytest.approx((0.1, -0.05), rel=0.03)


def test_centroid_with_an_even_number_of_samples_is_the_shift():
    waves, none = np.array([6000.0]), np.zeros((0, 49, 49), np.float32)
    planes = model.Planes(waves, shifted(0.1, -0.05, samples=2)[None], none, (50.0, 50.0), (), 2)
    x, y = offsets(model.from_planes(planes, 0.1, False, 24), np.ones((1, 1)))
    assert (x[0], y[0]) == pytest.approx((0.1, -0.05), rel=0.05)


def test_of_colours_and_places_it_is_between():
    """Two wavelengths have different centroids, and the PSF changes across the detector."""
    drift = shifted(0.05, 0.0) - shifted(0.0, 0.0)
    psf = psf_of(shifted(0.1, 0.0), shifted(-0.1, 0.0), drift=(drift,))
    weights = transfer.basis_weights(
        psf, np.array([[1.0, 0.0], [0.0, 1.0], [0.5, 0.5], [0.5, 0.5]]), np.array([50, 50, 50, 100.0]), np.full(4, 50.0)
    )
    x, y = offsets(psf, weights)
    assert x == pytest.approx((0.1, -0.1, 0.0, 0.05), abs=0.004)
    assert y == pytest.approx((0.0,) * 4, abs=1e-4)


def test_of_a_round_disc_it_is_nothing():
    psf = seeing.moffat_psf(0.73, 3.0, 0.2)
    assert np.abs(offsets(psf, np.ones((3, 1)))).max() < 1e-6


@pytest.mark.parametrize(("key", "pixel"), [("vis.psf.window", 0.1), ("nisp.euclid_y.psf.window", 0.3)])
def test_in_the_narrowest_window_the_centroid_follows_the_light(key, pixel):
    """In narrower windows the centroid stays at the brightest pixel."""
    narrowest = max(low for low, *_ in bounds_of_parameter(key)) / pixel
    axis = (np.arange(161) - 80) / 5.0

    def star(x, y):
        return np.outer(np.exp(-0.5 * ((axis - y) / 0.6) ** 2), np.exp(-0.5 * ((axis - x) / 0.6) ** 2))

    np.testing.assert_allclose(centroids.mean_centroid(star(0.12, -0.06), 5, narrowest), (0.12, -0.06), atol=1e-3)


def core_of_psf(section, name, band):
    """Return a detector and its PSF at the centre, without light far from the core."""
    detector, curve = detectors.detector(section, name, MISSION), passbands.load(band)
    camera = {"vis": euclid.VIS, "nisp": euclid.NISP}[section]
    camera = replace(camera, transform=camera.core_transform, side=camera.core_side)
    waves = np.array(
        [np.sqrt(np.average(p.wavelength**2, weights=p.response / p.wavelength)) for p in sub_bands(curve)]
    )
    window, scale = euclid.centroid_window(section, band, MISSION), detector.pixel_scale / camera.samples
    blurs = [euclid._blur_variances(detector, float(wave), MISSION) for wave in waves]
    nm = euclid.wavefront(*euclid._field_position(detector, 0.0, 0.0, MISSION), section, MISSION)
    nm = euclid.centre_wavefront(nm, waves, camera, (scale, window), tuple(np.mean(blurs, axis=0).tolist()), MISSION)
    images = [
        euclid._plane(nm, float(wave), camera, scale, blur, MISSION) for wave, blur in zip(waves, blurs, strict=True)
    ]
    none = np.zeros((0, *images[0].shape), np.float32)
    half = ((detector.nx - 1) / 2, (detector.ny - 1) / 2)
    planes = model.Planes(waves, np.stack(images), none, half, samples=camera.samples)
    return detector, replace(model.from_planes(planes, detector.pixel_scale, False, camera.side), window=window)


def balanced(image, x, y, sigma):
    """Return the positions about which the light of stars in Gaussian windows is balanced."""
    out = []
    for column, row in zip(x, y, strict=True):
        i, j = round(column), round(row)
        reach = int(6 * sigma) + 2
        cut = image[j - reach : j + reach + 1, i - reach : i + reach + 1]
        across, up = i + np.arange(-reach, reach + 1.0), j + np.arange(-reach, reach + 1.0)[:, None]
        for _ in range(200):
            weighted = cut * np.exp(-0.5 * ((across - column) ** 2 + (up - row) ** 2) / sigma**2)
            shift = 2.0 * np.array([(weighted * (across - column)).sum(), (weighted * (up - row)).sum()])
            column, row = np.array([column, row]) + shift / weighted.sum()
            if np.abs(shift).max() < 1e-10 * weighted.sum():
                break
        out.append((column, row))
    return np.array(out).T


@nightly.parametrize(
    ("section", "name", "band"),
    [
        ("vis", "3-4", "euclid_vis"), ("vis", "1-1", "euclid_vis"), ("nisp", "DET22", "euclid_y"),
        ("nisp", "DET11", "euclid_y"), ("nisp", "DET22", "euclid_j"), ("nisp", "DET11", "euclid_h"),
    ],
    (0, 2),
)  # fmt: skip
def test_stars_of_a_lattice_are_at_their_position(section, name, band):
    """Noise-free stars at 39 x 39 positions within a pixel are at their positions within 0.2 mas in the mean.

    The lattice of positions averages over all harmonics below the 39th. They are found by the definition and by the
    winpos of sep, the algorithm of SourceExtractor. Stars differ by 1 mas (VIS) and 40 mas (NISP).
    """
    detector, psf = core_of_psf(section, name, band)
    at = PITCH * (np.arange(N) + 0.5) + (np.arange(N) + 0.5) / N
    x, y = (axis.ravel() for axis in np.meshgrid(at, at))
    star = one_source(detector, wcs(detector, *boresight_for(detector, 10.0, 20.0, 0.0)), 1e6, x[0], y[0])
    stars = replace(
        star, ids=np.arange(len(x)), column=x, row=y, jacobian=np.repeat(star.jacobian, len(x), axis=0),
        electrons=np.full(len(x), 1e6), shape=np.full(len(x), -1),
    )  # fmt: skip
    side = N * PITCH + 2
    image = np.ascontiguousarray(stamps.draw(stars, np.full(len(x), PITCH), psf, side, side), float)
    mas, sigma = 1000.0 * detector.pixel_scale, psf.window / detector.pixel_scale
    expected = np.ravel(offsets(psf, np.full((1, len(psf.planes.images)), 1.0 / len(psf.planes.images))))
    assert np.abs(mas * expected).max() < 0.1
    for column, row in (balanced(image, x, y, sigma), sep.winpos(image, x, y, sigma)[:2]):
        off = mas * (np.stack([column - x, row - y]).mean(axis=1) - expected)
        print(section, name, band, "mas", off, "of single stars", mas * (column - x).std())
        assert np.abs(off).max() < 0.05


@nightly.parametrize(("section", "name", "band"), [("vis", "1-1", "euclid_vis"), ("nisp", "DET11", "euclid_y")], (1,))
def test_colours_agree_with_the_iteration(section, name, band):
    """Centroids of sources with other spectra agree with their images within 0.1 mas, even at the edges of the band."""
    detector, psf = core_of_psf(section, name, band)
    count, samples, mas = len(psf.planes.images), psf.planes.samples, 1000.0 * detector.pixel_scale
    middle, reach = len(psf.planes.images[0]) // 2, 20 * samples
    core = psf.planes.images[:, middle - reach : middle + reach + 1, middle - reach : middle + reach + 1].astype(float)
    for weights in (np.eye(count)[0], np.eye(count)[-1], np.linspace(0.5, 1.5, count) / count):
        image = np.sum(weights[:, None, None] * core, axis=0)
        exact = mas * centroids.mean_centroid(image, samples, psf.window / detector.pixel_scale)
        assert mas * np.ravel(offsets(psf, weights[None])) == pytest.approx(exact, abs=0.1)
        assert np.abs(exact).max() > 0.3


def test_the_window_is_that_of_the_mission_or_half_of_the_light():
    round_psf = psf_of(shifted(0.0, 0.0, sigma=1.0))
    assert centroids.window_rms(round_psf) == pytest.approx(0.1 * np.sqrt(1.0 + 2 / 12), rel=0.01)
    assert centroids.window_rms(replace(round_psf, window=0.07)) == 0.07


def test_a_wider_window_moves_the_centroid_of_coma():
    """The light of a faint companion counts fully only in a wide window, whose centroid is the mean of the light."""
    psf = psf_of(shifted(0.0, 0.0, sigma=0.7) + np.float32(0.1) * shifted(2.5, 0.0, sigma=0.7))
    found = [offsets(replace(psf, window=window), np.ones((1, 1)))[0][0] for window in (0.1, 0.2, 1.0)]
    assert found[0] < 0.5 * found[1]
    assert found[2] == pytest.approx(0.25 / 1.1, rel=0.05)


def test_stars_are_found_where_truth_has_them():
    """Windowed centroids of noise-free VIS stars are at their positions within 0.3 mas in the mean.

    Pixels sample the light coarsely, so centroids scatter by 1 mas from star to star.
    """
    x, y = nominal.lattice(300, 100)
    quiet = nominal.off(*nominal.COSMIC_RAYS, *nominal.CHARGE)
    detector = replace(small("vis", "1-1", 300), injection_rows=0)
    one = nominal.rendered(detector, np.full(len(x), 19.0), x, y, forced=quiet)
    rows = truth_table.truth(one)
    assert set(rows["psf_window"].to_pylist()) == {0.1}
    data = np.array(one.noise_free, float)
    found = sep.extract(data, 50.0)
    assert len(found) == len(x)
    there = np.stack(sep.winpos(data, found["x"], found["y"], 1.0)[:2], axis=1)
    place = np.stack([rows["x"], rows["y"]], axis=1)
    offset = np.stack([rows["psf_x"], rows["psf_y"]], axis=1)
    nearest = np.argmin(np.hypot(*(there[None, :] - place[:, None]).T), axis=0)
    off = 100.0 * (there[nearest] - place - offset)
    assert np.abs(100.0 * offset).max() < 0.3
    assert np.abs(np.mean(off, axis=0)).max() < 0.6
    assert np.sqrt(np.mean(off**2)) < 1.5


def test_magnitudes_are_by_the_header():
    one = nominal.rendered(small("vis", "3-4", 160), [19.0, 22.5], [50.0, 110.0], [50.0, 110.0])
    assert sorted(truth_table.truth(one)["mag"].to_pylist()) == pytest.approx([19.0, 22.5], abs=1e-5)
