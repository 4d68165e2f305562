"""The Euclid PSF agrees with published optics and galsim's diffraction; the seeing disc agrees with its formula."""

from dataclasses import replace

import galsim
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import uniform_filter

from lake_schema.mission.configuration import resolve
from tests.truesky import nightly
from truesky.fluxes import passbands
from truesky.render.camera.detectors import detector
from truesky.render.psf import diffraction, euclid, sub_bands
from truesky.render.psf.seeing import moffat_psf

# The published widths are for 25 mas of jitter on each axis.
MISSION = resolve(overrides={f"svm.aocs.jitter_{axis}": (25.0, "mas") for axis in "xy"})
BAND = passbands.load("euclid_vis")
SAMPLING = 0.1 / 3


@pytest.fixture(scope="module")
def vis():
    return euclid.vis_psf(detector("vis", "3-4", MISSION), BAND, MISSION)


def test_the_pupil_has_the_published_area():
    """The area is 9926 cm2, which is 0.8776 of a disc of 1.2 m."""
    step = 1.0
    axis = np.arange(-605, 606, step)
    x, y = np.meshgrid(axis, axis)
    clear = diffraction.pupil(x, y, step, MISSION)
    assert clear.min() == 0.0
    assert clear.max() == 1.0
    area = clear.sum() * step**2 / 100
    assert area == pytest.approx(9926, abs=5)
    assert area == pytest.approx(MISSION.value("plm.collecting_area", "cm2"), rel=1e-3)


def test_the_pupil_is_decentred():
    x = np.array([0.0, 0.0, 0.0, 0.0])
    y = np.array([51.0, 51 + 190.0, 51 - 190.0, -160.0])
    np.testing.assert_array_equal(diffraction.pupil(x, y, 1.0, MISSION), [0, 0, 0, 1])


@given(st.floats(-1, 1), st.floats(-1, 1))
def test_the_wavefront_is_small_and_low(x, y):
    nm = euclid.wavefront(x, y, "vis", MISSION)
    assert len(nm) == 12
    # No piston, tip or tilt: the plane is centred on the chief ray.
    assert (nm[:4] == 0).all()
    assert np.linalg.norm(nm) < 90


def test_wavefront_error_over_the_field():
    """The published errors on a 3 x 3 grid are 34 to 51 nm rms."""
    grid = [np.linalg.norm(euclid.wavefront(x, y, "vis", MISSION)) for x in (-0.7, 0, 0.7) for y in (-0.7, 0, 0.7)]
    assert 25 < min(grid) < max(grid) < 65


def plane(nm, wavelength):
    return diffraction.diffraction_image(nm, diffraction.optics_of(wavelength, SAMPLING, MISSION, 2048), 513)


def test_diffraction_is_galsims():
    """galsim.OpticalPSF has the same pupil and aberrations, and an independent transform."""
    n, nm, wavelength = 1024, euclid.wavefront(0.5, -0.3, "vis", MISSION), 700.0
    step = 1200.0 / n
    axis = (np.arange(n) - n / 2 + 0.5) * step
    clear = diffraction.pupil(*np.meshgrid(axis, axis), step, MISSION) > 0.5
    theirs = galsim.OpticalPSF(
        lam=wavelength,
        diam=1.2,
        aberrations=list(nm / wavelength),
        pupil_plane_im=galsim.Image(clear.astype(float), scale=1.2 / n),
        gsparams=galsim.GSParams(maximum_fft_size=8192),
    )
    theirs = theirs.drawImage(nx=513, ny=513, scale=SAMPLING, method="no_pixel", dtype=float).array
    ours = plane(nm, 10 * wavelength)
    inner = slice(256 - 40, 256 + 41)
    assert np.abs(ours - theirs)[inner, inner].max() < 0.01 * theirs.max()
    # galsim folds the far wings back, and treats samples at the edge of the pupil as clear.
    assert ours[inner, inner].sum() == pytest.approx(theirs[inner, inner].sum(), rel=1e-2)


@nightly.parametrize("wavelength", [5500.0, 7000.0, 9000.0], (1,))
def test_wings_hold_what_edges_diffract(wavelength):
    """The light beyond a large angle is lambda P / (2 pi^2 A angle), with perimeter P and area A of the pupil.

    The perimeter consists of the stop, the central stop, and both sides of three bars, which the stops shorten.
    """
    axis = np.arange(-605, 606, 1.0)
    x, y = np.meshgrid(axis, axis)
    clear = diffraction.pupil(x, y, 1.0, MISSION)
    perimeter = np.hypot(*np.gradient(clear)).sum()
    optics = diffraction.optics_of(wavelength, SAMPLING, MISSION, 2048)
    image = diffraction.diffraction_image(np.zeros(12), optics).astype(float)
    grid = (np.arange(len(image)) - len(image) // 2) * SAMPLING
    radius = np.hypot(*np.meshgrid(grid, grid))
    for angle in (5.0, 10.0, 25.0):
        lost = wavelength * 1e-7 * perimeter / (2 * np.pi**2 * clear.sum() * angle * np.pi / 648000)
        assert 1 - image[radius < angle].sum() == pytest.approx(lost, rel=0.15)


def test_a_part_of_the_light_is_a_part_of_the_whole():
    nm, optics = euclid.wavefront(-0.4, 0.8, "vis", MISSION), diffraction.optics_of(6000.0, SAMPLING, MISSION, 768)
    whole, part = diffraction.diffraction_image(nm, optics), diffraction.diffraction_image(nm, optics, 201)
    np.testing.assert_allclose(part, whole[284:485, 284:485], rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("blur", [(0.0, 0.0), (0.01**2, 0.02**2), (0.04**2, 0.045**2), (0.2**2, 0.1**2)])
def test_blur_is_a_gaussian_in_fourier_space(blur):
    """The blur (arcsec2 along x and y) multiplies the transform of the diffracted light."""
    nm, n = euclid.wavefront(0.6, 0.3, "vis", MISSION), 768
    optics, weights = diffraction.optics_of(5500.0, SAMPLING, MISSION, n), euclid._blur_weights(blur, SAMPLING)
    found = euclid._blur_image(diffraction.diffraction_image(nm, optics, 301 + 2 * euclid._margin(weights)), weights)
    k = 2 * np.pi * np.fft.fftfreq(n, SAMPLING)
    passed = np.exp(-0.5 * (blur[0] * k**2 + blur[1] * k[:, None] ** 2))
    sky = np.fft.fft2(diffraction.diffraction_image(nm, optics).astype(float)) * passed
    expected = np.fft.ifft2(sky).real[n // 2 - 150 : n // 2 + 151, n // 2 - 150 : n // 2 + 151]
    assert found.sum() == pytest.approx(expected.sum(), rel=1e-6)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6 * expected.max())


@pytest.mark.parametrize(
    ("wavelength", "optics", "diffused", "pixelated", "peak"),
    [(5500, 0.108, 0.132, 0.153, 0.28), (7000, 0.129, 0.147, 0.164, 0.23), (9000, 0.160, 0.173, 0.186, 0.17)],
)
def test_widths_by_wavelength(wavelength, optics, diffused, pixelated, peak):
    """Check the FWHM of optics and jitter, then with diffusion, then with the pixel; and light in the central pixel."""
    image = galsim.Image(plane(np.zeros(12), wavelength), scale=SAMPLING)
    focal = galsim.InterpolatedImage(image, pad_factor=2)
    steps = [focal, galsim.Gaussian(sigma=0.025)]
    for width, more in (
        (optics, None),
        (diffused, galsim.Gaussian(sigma=0.032)),
        (pixelated, galsim.Pixel(0.1)),
    ):
        steps += [more] if more else []
        image = galsim.Convolve(steps).drawImage(nx=96, ny=96, scale=0.0125, method="no_pixel")
        assert image.calculateFWHM() == pytest.approx(width, abs=0.003)
    centre = galsim.Convolve(steps).drawImage(nx=3, ny=3, scale=0.1, method="no_pixel").array[1, 1]
    assert centre == pytest.approx(peak, abs=0.01)


def test_the_psf_is_as_wide_as_measured(vis):
    assert vis.fwhm == pytest.approx(0.164, abs=0.005)
    # 92 % of the light is within a diameter of 1.3", and 4.5 % is outside 2.6".
    at = np.interp(0.65 / 0.1, np.arange(len(vis.outside)), vis.outside)
    assert 1 - at == pytest.approx(0.93, abs=0.015)
    assert 1 - at == pytest.approx(MISSION.value("vis.psf.encircled_1arcsec3"), abs=0.015)
    assert vis.outside[13] == pytest.approx(0.04, abs=0.01)


def test_blue_light_spreads_wider_in_the_silicon(vis):
    """Diffusion is a Gaussian of 0.32 pixel at 800 nm. Its width is proportional to lambda^-0.35.

    The reference has the same diffusion at all wavelengths.
    """
    even = euclid.vis_psf(
        detector("vis", "3-4", MISSION), BAND, MISSION.with_overrides({"vis.diffusion_slope": (0.0, "")})
    )
    for wavelength, image, less in zip(vis.planes.wavelength, vis.planes.images, even.planes.images, strict=True):
        sigma = np.array([0.32 * (wavelength / 8000) ** -0.35, 0.32]) * 3
        passed = [np.abs(np.fft.rfft2(each)[0, 50:301:50]) for each in (image, less)]
        k = 2 * np.pi * np.arange(50, 301, 50) / image.shape[1]
        expected = np.exp(-0.5 * (sigma[0] ** 2 - sigma[1] ** 2) * k**2)
        np.testing.assert_allclose(passed[0] / passed[1], expected, rtol=2e-3)


def test_detectors_are_not_equally_thick():
    """The width of charge diffusion, by which the planes are blurred, differs between detectors."""
    names = [f"{row}-{column}" for row in range(1, 7) for column in range(1, 7)]
    # This detector has the diffusion length of the mission.
    assert euclid._blur_variances(detector("vis", "3-4", MISSION), 8000.0, MISSION)[0] == pytest.approx(
        0.032**2 + 0.025**2
    )
    lengths = []
    for name in names:
        across, along = euclid._blur_variances(detector("vis", name, MISSION), 8000.0, MISSION)
        jitter = [MISSION.value(f"svm.aocs.jitter_{axis}", "arcsec") ** 2 for axis in "xy"]
        assert across - jitter[0] == pytest.approx(along - jitter[1])
        lengths.append(np.sqrt(across - jitter[0]) / 0.032)
    spread = MISSION.value("vis.diffusion_spread", "")
    assert np.std(lengths) == pytest.approx(spread, rel=0.02)
    assert np.mean(lengths) == pytest.approx(1.0, abs=spread / 3)


def test_little_is_lost(vis):
    assert 0.9975 < vis.profile.flux < 0.9985
    assert (np.diff(vis.outside) <= 1e-12).all()
    assert (vis.surface >= 0).all()


def test_ellipticity_is_small(vis):
    corner = euclid.vis_psf(detector("vis", "1-1", MISSION), BAND, MISSION)
    for one in (vis, corner):
        core = one.profile.drawImage(nx=161, ny=161, scale=0.025, method="no_pixel", dtype=float)
        drawn = galsim.Image(uniform_filter(core.array, 5), scale=0.025)
        assert drawn.FindAdaptiveMom().observed_shape.e < 0.8 * MISSION.value("vis.psf.ellipticity")


def test_a_detector_upside_down_sees_the_psf_turned(vis):
    """The optics do not rotate with the detector."""
    upright = euclid.vis_psf(replace(detector("vis", "3-4", MISSION), rotation=0.0), BAND, MISSION)
    draw = {"nx": 65, "ny": 65, "scale": 0.05, "method": "no_pixel", "dtype": float}
    turned, straight = (p.profile.drawImage(**draw).array for p in (vis, upright))
    peak = straight.max()
    assert np.abs(straight - turned).max() > 0.02 * peak
    np.testing.assert_allclose(straight[::-1, ::-1], turned, atol=1e-6 * peak)


def test_planes_carry_equal_photons():
    parts = sub_bands.sub_bands(BAND)
    waves = [np.average(part.wavelength, weights=part.response / part.wavelength) for part in parts]
    assert waves == sorted(waves)
    photons = BAND.response / BAND.wavelength
    mean = np.average(BAND.wavelength, weights=photons)
    assert np.mean(waves) == pytest.approx(mean, rel=2e-3)
    spread = np.sqrt(np.average((BAND.wavelength - mean) ** 2, weights=photons))
    assert np.std(waves) == pytest.approx(spread, rel=0.02)


@pytest.mark.parametrize(("seeing", "beta", "pixel"), [(0.73, 3.0, 0.2), (1.2, 3.5, 0.26)])
def test_the_seeing_disc(seeing, beta, pixel):
    disc = moffat_psf(seeing, beta, pixel)
    assert disc.fwhm == pytest.approx(np.hypot(seeing, 0.6 * pixel), rel=0.02)
    scale = seeing / (2 * np.sqrt(2 ** (1 / beta) - 1))
    for r in (5, 10, 20):
        assert disc.outside[r] == pytest.approx((1 + ((r + 0.5) * pixel / scale) ** 2) ** (1 - beta), rel=0.05)
    assert disc.profile.flux == 1.0
