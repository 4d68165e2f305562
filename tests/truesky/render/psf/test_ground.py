"""The PSF of air and optics agrees with galsim, across detectors, with colour, and far from bright stars."""

from dataclasses import replace
from functools import cache

import galsim
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import resolve
from lake_schema.tables.exposures import ExposureRow
from tests.truesky.render.fields import one_source, small
from truesky.fluxes import passbands
from truesky.render.camera import astrometry, detectors
from truesky.render.camera.astrometry import wcs
from truesky.render.drawing import stamps, transfer
from truesky.render.psf import aberrations, atmosphere, ground, seeing, spikes, to_psfex

MISSION = resolve()
AIR = ground.Air(0.7)
CASES = {
    "lsstcam": ("R43_S21", "lsst_r"),
    "decam": ("N4", "des_g"),
    "hsc": ("0_03", "hsc_z"),
    "megacam": ("ccd04", "cfis_r"),
}


def bare(camera, **overrides):
    """Return a mission without aureole and spider."""
    own = {"psf.aureole": (0.0, ""), "pupil.vane_width": (0.0, "mm"), **overrides}
    return resolve(overrides={f"ext.{camera}.{key}": value for key, value in own.items()})


@cache
def detector_of(camera):
    found = detectors.detectors(camera, MISSION)
    return next((d for d in found if d.name == CASES[camera][0]), found[0])


@cache
def psf_of(camera="lsstcam", positions=9, mission=None, air=AIR):
    band = passbands.load(CASES[camera][1])
    return ground.atmospheric_psf(air, detector_of(camera), band, mission or MISSION, positions)


def shape_of(image, step, width=0.5):
    """Return (size, e1, e2, x, y) under a Gaussian window, arcsec."""
    y, x = (np.mgrid[: len(image), : len(image)] - len(image) // 2) * step
    light = image * np.exp(-0.5 * (x**2 + y**2) / width**2)
    light = light / light.sum()
    at = (light * x).sum(), (light * y).sum()
    xx, yy, xy = (
        (light * a * b).sum() for a, b in ((x - at[0], x - at[0]), (y - at[1], y - at[1]), (x - at[0], y - at[1]))
    )
    return np.array([xx + yy, (xx - yy) / (xx + yy), 2 * xy / (xx + yy), *at])


@pytest.mark.parametrize(("wave", "fried"), [(6220.0, 0.15), (4000.0, 0.1), (9000.0, 0.4)])
def test_the_air_passes_what_galsim_says(wave, fried):
    theirs, k = galsim.VonKarman(lam=wave / 10, r0=fried, L0=25.0), np.linspace(0.1, 20.0, 40)
    ours = atmosphere.transfer(k / spikes.ARCSEC * wave * 1e-10 / (2 * np.pi), fried, 25.0)
    np.testing.assert_allclose(ours, [theirs.kValue(float(one), 0.0).real for one in k], atol=1e-9)
    wide = theirs.drawImage(nx=601, ny=601, scale=0.004, method="no_pixel").calculateFWHM()
    assert atmosphere.fwhm(wave, fried, 25.0) == pytest.approx(wide, rel=2e-4)


@given(st.floats(0.2, 9.0), st.floats(3200.0, 11000.0), st.floats(10.0, 500.0))
@settings(max_examples=15)
def test_a_seeing_has_its_fried_length(wide, wave, outer):
    assert atmosphere.fwhm(wave, atmosphere.fried_length(wide, wave, outer), outer) == pytest.approx(wide, rel=1e-5)


@pytest.mark.parametrize(("wave", "outer"), [(3500.0, 20.0), (9000.0, 30.0)])
def test_the_finest_seeing_is_that_of_the_longest_fried_length(wave, outer):
    """The constant saves the import of scipy.optimize."""
    expected = atmosphere.fwhm(wave, 0.05 * outer, outer)
    assert atmosphere.finest_seeing(wave, outer) == pytest.approx(expected, rel=1e-15, abs=0.0)
    assert atmosphere.fried_length(1.000001 * expected, wave, outer) == pytest.approx(0.05 * outer, rel=1e-4)


def test_air_refracts_as_published():
    """The reference is Filippenko 1982, Table 1, sec z = 2: 4000 A against 5000 A, 2 km up at 600 mm Hg."""
    height = 8400.0 * np.log(760.0 / 600.0)
    blue, green = np.sqrt(3.0) * atmosphere.refraction(np.array([4000.0, 5000.0]), height)
    assert blue - green == pytest.approx(1.10, abs=0.01)


@pytest.mark.parametrize(
    "camera", ["hsc", *(pytest.param(one, marks=pytest.mark.nightly) for one in ("decam", "lsstcam", "megacam"))]
)
def test_the_whole_of_it_is_galsim_s(camera):
    """Atmosphere, obscured pupil and aberrations of one wavelength agree, except for the place of the centroid."""
    detector, telescope = detector_of(camera), aberrations.Telescope.from_mission(f"ext.{camera}", MISSION)
    wave, nm = 6200.0, ground._wavefront(detector, CASES[camera][1], 0.5, -0.8, MISSION)
    fried = atmosphere.fried_length(0.7, wave, telescope.outer)
    samples, step = 3, detector.pixel_scale / 3
    grid = ground._Grid.from_pixels(128, samples, detector.pixel_scale)
    ratio = aberrations.TransferRatio.from_wavefront(nm, telescope, wave, fried, np.eye(2))
    ours = grid.image(grid.transfer(wave, fried, telescope, AIR) * grid.interpolate_ratio(ratio, wave))
    middle, half = len(ours) // 2, 60
    ours = ours[middle - half : middle + half + 1, middle - half : middle + half + 1]
    optics = galsim.OpticalPSF(
        lam=wave / 10, diam=2 * telescope.radius, obscuration=telescope.inner / telescope.radius,
        aberrations=list(nm / (wave / 10)), oversampling=2, pad_factor=3.0,
        gsparams=galsim.GSParams(maximum_fft_size=16384),
    )  # fmt: skip
    both = galsim.Convolve(galsim.VonKarman(lam=wave / 10, r0=fried, L0=telescope.outer), optics)

    def drawn(x, y):
        return both.shift(x, y).drawImage(nx=121, ny=121, scale=step, method="no_pixel", dtype=float).array

    at = np.zeros(2)
    for _ in range(3):
        here = drawn(*at)
        slopes = [(drawn(*(at + off)) - here).ravel() / 0.01 for off in ((0.01, 0.0), (0.0, 0.01))]
        at = at + np.linalg.lstsq(np.stack(slopes, axis=1), (ours - here).ravel(), rcond=None)[0]
    theirs = drawn(*at)
    assert np.abs(ours - theirs).max() < 3e-4 * theirs.max()
    found, wanted = shape_of(ours, step), shape_of(theirs, step)
    assert found[0] == pytest.approx(wanted[0], rel=5e-4)
    # A few thousandths of the ellipticity that the optics cause.
    np.testing.assert_allclose(found[1:3], wanted[1:3], atol=4e-5)
    # The centroid of the light is at the position of the source, also with coma.
    assert np.hypot(*found[3:]) < 2e-3
    assert np.hypot(*at) > 2e-3


@pytest.mark.parametrize(("positions", "size", "ellipticity"), [(1, 0.02, 0.01), (4, 3e-4, 2e-4), (9, 5e-5, 2e-5)])
def test_it_changes_across_a_detector_as_the_optics_do(positions, size, ellipticity):
    """The reference is the PSF of a detector with its centre at this position."""
    mission, whole = bare("lsstcam"), detector_of("lsstcam")
    psf = psf_of(positions=positions, mission=mission)
    there = replace(whole, x=whole.x + 0.6 * whole.nx * 0.1, y=whole.y - 0.8 * whole.ny * 0.1)
    wanted = ground.atmospheric_psf(AIR, there, passbands.load("lsst_r"), mission, 1)
    column, row = ((n - 1) / 2 + 0.5 * part * n for n, part in ((whole.nx, 0.6), (whole.ny, -0.8)))
    weights = transfer.basis_weights(psf, None, np.array([column]), np.array([row]))[0]
    step = whole.pixel_scale / psf.planes.samples
    ours, theirs = (
        shape_of(transfer.image_of(psf.planes, weights), step),
        shape_of(wanted.planes.images.mean(axis=0), step),
    )
    assert ours[0] == pytest.approx(theirs[0], rel=size)
    np.testing.assert_allclose(ours[1:3], theirs[1:3], atol=ellipticity)
    if positions > 1:
        still = shape_of(psf.planes.images.mean(axis=0), step)
        assert abs(still[0] / theirs[0] - 1.0) > 3 * size or np.abs(still[1:3] - theirs[1:3]).max() > 3 * ellipticity


def test_blue_light_is_wider_and_lifted_towards_the_zenith():
    """The FWHM is proportional to lambda^-0.3. Refraction displaces the centroids relative to their mean."""
    air = replace(AIR, slope=-0.3, tan_zenith_distance=0.66, zenith=np.radians(30.0), height=2700.0)
    psf = psf_of("decam", 1, bare("decam", **{"psf.wavefront_scale": (0.0, "")}), air)
    waves, step = psf.planes.wavelength, 0.2637 / psf.planes.samples
    assert len(waves) == 8
    found = np.array([shape_of(plane.astype(float), step, 5.0) for plane in psf.planes.images])
    lifted = 0.66 * atmosphere.refraction(waves, 2700.0)
    along = found[:, 3] * np.cos(air.zenith) + found[:, 4] * np.sin(air.zenith)
    np.testing.assert_allclose(along, lifted - lifted.mean(), rtol=0.02)
    assert np.ptp(along) > 0.3
    np.testing.assert_allclose(found[:, 4] * np.cos(air.zenith), found[:, 3] * np.sin(air.zenith), atol=1e-3)
    middles = 1.0 + psf.planes.images.shape[1] // 2 + found[:, 3:] / step
    wide = [
        galsim.Image(plane.astype(float), scale=step).calculateFWHM(center=galsim.PositionD(*at))
        for plane, at in zip(psf.planes.images, middles, strict=True)
    ]
    slope = np.polyfit(np.log(waves), np.log(wide), 1)[0]
    assert slope == pytest.approx(-0.3, abs=0.02)
    # Red bands need fewer wavelengths.
    assert len(psf_of("lsstcam", air=replace(AIR, slope=-0.3)).planes.wavelength) == 4
    assert len(psf_of("lsstcam").planes.wavelength) == 1


def test_the_air_s_ellipticity_is_the_exposure_s():
    """The ellipticity is the same on all detectors of an exposure. It varies between exposures as in the mission."""

    def row(mjd):
        return ExposureRow(1, "EXT", "lsstcam", "lsst_r", "science", 10.0, -20.0, 0.0, mjd, 30.0, 1.0, 0.7, 28.0, "x")

    first = detector_of("lsstcam")
    turned = replace(first, rotation=90.0)
    band = passbands.load("lsst_r")
    airs = [ground.exposure_air(row(60000.0 + 0.01 * i), first, band, MISSION).shear for i in range(400)]
    assert np.std(airs, axis=0) == pytest.approx([0.01, 0.01], rel=0.12)
    assert np.abs(np.mean(airs, axis=0)).max() < 0.002
    np.testing.assert_allclose(
        ground.exposure_air(row(60000.0), turned, band, MISSION).shear, -np.array(airs[0]), atol=1e-12
    )
    plain = bare("lsstcam", **{"psf.wavefront_scale": (0.0, "")})
    psf = psf_of("lsstcam", 1, plain, replace(AIR, shear=(0.03, -0.02)))
    step, wave = 0.2000587 / psf.planes.samples, float(psf.planes.wavelength[0])
    values, vectors = np.linalg.eigh([[1.03, -0.02], [-0.02, 0.97]])
    root = vectors @ np.diag(np.sqrt(values)) @ vectors.T
    body = galsim.VonKarman(lam=wave / 10, r0=atmosphere.fried_length(0.7, wave, 25.0), L0=25.0)
    theirs = body.transform(*root.ravel()).drawImage(nx=127, ny=127, scale=step, method="no_pixel", dtype=float).array
    found, wanted = shape_of(psf.planes.images[0].astype(float), step), shape_of(theirs, step)
    np.testing.assert_allclose(found[1:3], wanted[1:3], atol=3e-4)
    assert found[1] > 0.01
    assert found[2] < -0.007


def test_a_profile_is_chosen_by_a_number():
    detector, band = small("lsstcam", "R22_S11"), passbands.load("lsst_r")
    row = ExposureRow(1, "EXT", "lsstcam", "lsst_r", "science", 10.0, -20.0, 0.0, 6e4, 30.0, 1.0, 0.9, 28.0, "x")
    missions = [resolve(overrides={"ext.lsstcam.psf.profile": (float(i), "")}) for i in (0, 1, 2)]
    round_, moffat, air = (seeing.exposure_psf(row, detector, band, mission, 4) for mission in missions)
    assert [psf.planes is None for psf in (round_, moffat, air)] == [True, True, False]
    for psf in (round_, moffat, air):
        # 0.9 arcsec at 500 nm, in the red, with telescope and pixel.
        assert psf.fwhm == pytest.approx(np.hypot(seeing.image_fwhm(row, detector, band, MISSION), 0.6 * 0.2), rel=0.04)
    # Light beyond 3": none, a Moffat profile, and air with an aureole.
    beyond = [float(psf.outside[15]) for psf in (round_, moffat, air)]
    assert beyond[0] < 1e-9
    assert 0.002 < beyond[1] < 0.01 < beyond[2] < 0.04
    assert [seeing.typical_edges(detector, band, mission) is None for mission in missions] == [True, True, False]


def test_a_seeing_finer_than_a_pixel_is_refused():
    with pytest.raises(OutOfRange, match=r"seeing of ext\.lsstcam .*0.15 is outside"):
        psf_of(air=ground.Air(0.15))


def test_seeing_that_turbulence_cannot_cause_is_refused_before_rendering():
    """With an outer scale of two metres, no air causes a seeing of half an arcsec."""
    calm = resolve(overrides={"ext.lsstcam.psf.outer_scale": (2.0, "m")})
    detector, band = small("lsstcam", "R22_S11"), passbands.load("lsst_r")
    with pytest.raises(OutOfRange, match=r"seeing of ext\.lsstcam in lsst_r .*0.5 is outside"):
        ground.atmospheric_psf(ground.Air(0.5), detector, band, calm, 1)
    # The seeing at 500 nm is higher than in the band, and that at the zenith lower than at another airmass.
    with pytest.raises(OutOfRange, match=r"seeing of ext\.lsstcam in lsst_r .*0.47\d+ is outside"):
        seeing.check(0.51, 1.0, detector, band, calm)
    seeing.check(1.1, 1.0, detector, band, calm)
    assert ground.atmospheric_psf(ground.Air(1.1), detector, band, calm, 1).fwhm == pytest.approx(1.1, rel=0.05)


@pytest.mark.parametrize("wide", [4.0, 9.5])
def test_the_worst_seeing_has_its_width(wide):
    """The FWHM is correct although the star is wider than the core in which the FWHM is searched.

    Its PSFEx model has more than one sample.
    """
    detector, band = small("lsstcam", "R22_S11"), passbands.load("lsst_r")
    psf = ground.atmospheric_psf(ground.Air(wide), detector, band, MISSION, 1)
    assert psf.fwhm == pytest.approx(psf.profile.calculateFWHM(), rel=5e-3)
    # Spikes have the same width in any seeing, so the FWHM agrees only roughly.
    assert psf.fwhm == pytest.approx(wide, rel=0.04)
    planes, *_ = to_psfex.psfex_planes(psf)
    assert planes.shape[-1] > 100


def test_the_brightest_star_has_no_seam_and_no_hole():
    """Rings, aureole and spikes of Sirius in LSST continue beyond the plane, and no pixel is negative."""
    detector = replace(small("lsstcam", "R22_S11"), nx=700, ny=700)
    band, electrons = passbands.load("lsst_r"), 30.0 * 10 ** (0.4 * (28.36 + 1.0))
    psf = ground.atmospheric_psf(AIR, detector, band, MISSION, 1)
    star = one_source(detector, wcs(detector, 10.0, -20.0, 0.0), electrons, 350.3, 349.6)
    image = stamps.draw(star, np.array([256]), psf, 700, 700)
    assert image.min() > 0.0
    y, x = np.mgrid[:700, :700]
    x, y = x - 350.3, y - 349.6
    amplitude, core = psf.edges.aureole
    r2 = x**2 + y**2
    law = electrons * (amplitude / (r2 + core) + spikes.ring_light(psf.edges, np.full(8, 1 / 8)) / r2**1.5)
    # These pixels are away from the spikes, which run along the diagonals.
    off = (np.abs(np.abs(x) - np.abs(y)) > 60) & (r2 > 60**2)
    ratio = image[off] / law[off]
    far = np.sqrt(r2[off])
    for near, wide in ((60, 100), (100, 128), (128, 180), (180, 340)):
        some = (far >= near) & (far < wide)
        assert np.median(ratio[some]) == pytest.approx(1.0, abs=0.05 if near >= 100 else 0.2)
    # Spikes are brighter than the aureole, and there is no step where the plane ends.
    diagonal = image[350 + np.arange(60, 340), 350 + np.arange(60, 340)]
    assert (diagonal > 1.02 * law[350 + np.arange(60, 340), 350 + np.arange(60, 340)]).mean() > 0.9
    across = image[340:360, 350:].mean(axis=0)[100:200]
    assert np.abs(np.diff(np.log(across)) + 2.0 / (100 + np.arange(99))).max() < 0.02


@pytest.mark.parametrize(
    ("camera", "name"),
    [("decam", "N4"), ("decam", "S29"), ("lsstcam", "R22_S11"), ("megacam", "ccd04"), ("hsc", "1_12"), ("hsc", "0_14")],
)
def test_refraction_lifts_towards_the_zenith_on_the_sky(camera, name):
    """The direction is correct for any rotation of camera and detector, and for mirrored detectors (DECam, HSC).

    The spider of an altazimuth mount rotates with the zenith.
    """
    detector = detectors.detector(camera, name, MISSION)
    found = []
    for zenith in (-40.0, 75.0):
        row = ExposureRow(
            1, "EXT", camera, "x", "science", 10.0, -20.0, 33.0, 6e4, 30.0, 1.0, 0.7, 28.0, "x",
            airmass=1.4, zenith=zenith,
        )  # fmt: skip
        band = passbands.load(CASES[camera][1])
        air = ground.exposure_air(row, detector, band, MISSION)
        assert air.tan_zenith_distance == pytest.approx(np.sqrt(1.4**2 - 1.0))
        system = wcs(detector, 10.0, -20.0, 33.0)
        middle = (detector.nx - 1) / 2, (detector.ny - 1) / 2
        turns = np.cos(air.zenith), np.sin(air.zenith)
        places = [np.array([at, at + 20.0 * turn]) for at, turn in zip(middle, turns, strict=True)]
        ra, dec = astrometry.sky_of_pixel(system, *places)
        east = (ra[1] - ra[0]) * np.cos(np.radians(dec[0]))
        assert np.degrees(np.arctan2(east, dec[1] - dec[0])) == pytest.approx(zenith, abs=1.5)
        found.append(ground.edges(air, detector, band, MISSION).bars[0, 0] - air.zenith)
    assert (found[0] == pytest.approx(found[1])) == (camera in ("lsstcam", "hsc"))
    without = resolve(overrides={f"ext.{camera}.psf.refraction": (0.0, "")})
    assert ground.exposure_air(row, detector, band, without).tan_zenith_distance == 0.0
