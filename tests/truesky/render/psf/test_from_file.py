"""PSF files of the user are drawn as by galsim and read as by galsim.des. Errors name the file."""

from dataclasses import replace

import galsim
import galsim.des
import numpy as np
import pytest
from astropy.io import fits
from scipy.special import ndtr

from lake_schema.errors import BadInput, LakeError
from lake_schema.mission.configuration import resolve
from tests.truesky import nightly
from tests.truesky.render.exposure.test_render import field, render
from tests.truesky.render.fields import moments, one_source, small
from truesky.api.sky_images import PsfImage
from truesky.fluxes import passbands
from truesky.render import plan_exposures
from truesky.render.camera import detectors
from truesky.render.camera.astrometry import wcs
from truesky.render.camera.pointing import boresight_for
from truesky.render.drawing import reference, stamps
from truesky.render.planning import survey
from truesky.render.psf import from_file
from truesky.request.accuracy import REFERENCE
from truesky.request.from_toml import from_table

BAND, GROUND = passbands.load("euclid_vis"), passbands.load("lsst_r")
# Sample spacing of the cubes, arcsec.
STEP = 0.05
CARDS = {"PSFFRAME": "SKY", "CDELT1": STEP, "CDELT2": STEP, "CUNIT1": "arcsec"}
# The same spacing in pixels of VIS.
PIXELS = {"PSFFRAME": "PIXELS", "CDELT1": 0.5, "CDELT2": 0.5, "CUNIT1": "pixel"}
COLOURS = {"CRVAL3": 500.0, "CDELT3": 100.0, "CUNIT3": "nm"}


def cube(path, planes, **cards):
    unit = fits.PrimaryHDU(np.asarray(planes, np.float32))
    unit.header.update({**CARDS, **cards})
    unit.writeto(path, overwrite=True)
    return path


def gaussian(*sigmas, side=161, x=0.0, y=0.0, stretch=1.0):
    """Return planes of unit flux with Gaussians, sigma in arcsec, at (x, y) arcsec from the middle."""
    v, u = (np.mgrid[:side, :side] - (side - 1) / 2) * STEP
    planes = [np.exp(-0.5 * (((u - x) / s) ** 2 + ((v - y) / s / stretch) ** 2)) for s in sigmas]
    return np.array([plane / plane.sum() for plane in planes])


def read(path, detector, band):
    return from_file.read(path, detector, band, wcs(detector, *boresight_for(detector, 10.0, 20.0, 33.0)))


def star(psf, detector, column=80.3, row=77.6, photons=None, side=128):
    system = wcs(detector, *boresight_for(detector, 10.0, 20.0, 33.0))
    one = one_source(detector, system, 1e5, column, row)
    return stamps.draw(replace(one, photons=photons), np.array([side]), psf, 160, 160)


def test_a_cube_of_one_plane(tmp_path):
    detector = small("vis", "2-3")
    psf = read(cube(tmp_path / "a.fits", gaussian(0.12, stretch=1.4, x=0.03)[0], **PIXELS), detector, BAND)
    # The fraction of a Gaussian in a pixel is known.
    edges = np.arange(161) - 0.5
    x, y = (np.diff(ndtr((edges - middle) / sigma)) for middle, sigma in ((80.3 + 0.3, 1.2), (77.6, 1.2 * 1.4)))
    theirs = 1e5 * y[:, None] * x
    np.testing.assert_allclose(star(psf, detector), theirs, atol=2e-4 * theirs.max())
    one = one_source(detector, wcs(detector, 10.0, 20.0, 0.0), 1e5, 80.3, 77.6, inclination=50.0)
    ours, theirs = stamps.draw(one, np.array([128]), psf, 160, 160), reference.draw_reference(one, 0, psf, 160)
    theirs = np.roll(theirs, (78 - 80, 80 - 80), (0, 1))
    assert np.abs(ours - theirs)[10:-10, 10:-10].max() < 2e-4 * theirs.max()


def test_the_pixel_may_be_in_it(tmp_path):
    detector = small("vis", "2-3")
    psf = read(cube(tmp_path / "a.fits", gaussian(0.15), **PIXELS, PIXEL=True), detector, BAND)
    _, second = moments(star(psf, detector)[60:96, 62:98])
    np.testing.assert_allclose(second * 0.01, 0.15**2 * np.eye(2), atol=2e-4)


@pytest.mark.parametrize("how", ["axis", "cards"])
def test_colours_are_interpolated_between_planes(tmp_path, how):
    """sigma^2 is linear in wavelength, and so is the second moment of any colour."""
    waves = np.array([500.0, 600.0, 700.0, 800.0, 900.0, 1000.0])
    variance = 0.01 + 1e-5 * (waves - 500)
    cards = COLOURS if how == "axis" else {"CUNIT3": "nm", **{f"WAVE{i + 1}": w for i, w in enumerate(waves)}}
    detector = small("vis", "2-3")
    psf = read(cube(tmp_path / "a.fits", gaussian(*np.sqrt(variance)), **cards, **PIXELS), detector, BAND)
    n = len(psf.planes.wavelength)
    for k in (0, n - 1):
        _, second = moments(star(psf, detector, photons=np.eye(n)[k : k + 1])[50:106, 52:108])
        sigma2 = 0.01 + 1e-6 * (psf.planes.wavelength[k] - 5000)
        assert np.trace(second) / 2 * 0.01 == pytest.approx(sigma2 + 0.01 / 12, rel=2e-3)


def test_psf_is_rotated_for_a_detector_that_is_mounted_rotated(tmp_path):
    path = cube(tmp_path / "a.fits", gaussian(0.15, x=0.3, y=0.1), PSFFRAME="CAMERA")
    upright, turned = (read(path, small("vis", name), BAND) for name in ("2-3", "2-4"))
    centre, _ = moments(star(upright, small("vis", "2-3")))
    other, _ = moments(star(turned, small("vis", "2-4")))
    np.testing.assert_allclose(centre - (80.3, 77.6), (3.0, 1.0), atol=0.01)
    np.testing.assert_allclose(other - (80.3, 77.6), (-3.0, -1.0), atol=0.01)
    # The widths are the same as for a centred PSF: sigma and pixel.
    width = 2.3548 * np.hypot(0.15, 0.1 / 12**0.5)
    assert (upright.fwhm, turned.fwhm) == pytest.approx((width, width), rel=0.02)
    # The file may contain the position of the chief ray.
    centred = cube(tmp_path / "b.fits", gaussian(0.15, x=0.3, y=0.1), CRPIX1=87.0, CRPIX2=83.0)
    found, _ = moments(star(read(centred, small("vis", "2-3"), BAND), small("vis", "2-3")))
    np.testing.assert_allclose(found, (80.3, 77.6), atol=0.01)


# ------------------------------------------------------------------------------------------------ the sky

# Corner detectors, bands, and sample spacings (arcsec). The changes of ellipticity by the distortion of the camera,
# which a PSF on nominal pixels lacks, are above these numbers.
CORNERS = [
    ("vis", "1-6", "euclid_vis", 0.05, 1e-3),
    ("decam", "S31", "des_r", 0.13, 2e-4),
    ("hsc", "1_35", "hsc_r", 0.08, 1e-2),
]


def ellipticity(image):
    """Return (e1, e2) of an image, weighted by a Gaussian of three pixels about its centroid, and its light."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]].astype(float)
    dx, dy = x - (image * x).sum() / image.sum(), y - (image * y).sum() / image.sum()
    weighted = image * np.exp(-(dx**2 + dy**2) / 18.0)
    xx, yy, xy = ((weighted * term).sum() for term in (dx * dx, dy * dy, dx * dy))
    return np.array([(xx - yy) / (xx + yy), 2.0 * xy / (xx + yy)]), image.sum()


def star_near(psf, detector, system, column, row, side=129):
    """Draw a star of 1e5 electrons on a square of pixels that begins at the column and row that are returned."""
    first = int(column) - side // 2, int(row) - side // 2
    near = replace(psf, planes=replace(psf.planes, origin=first))
    source = one_source(detector, system, 1e5, column, row)
    source = replace(source, column=source.column - first[0], row=source.row - first[1])
    return stamps.draw(source, np.array([128]), near, side, side), first


@pytest.mark.parametrize(("camera", "name", "band", "step", "wrong"), CORNERS)
def test_a_psf_on_the_sky_is_what_galsim_draws_through_the_wcs(tmp_path, camera, name, band, step, wrong):
    """Ellipticities agree within 1e-4 in the middle of a detector and in its corners, light within 1e-4."""
    detector = detectors.detector(camera, name, resolve())
    system = wcs(detector, 10.0, -30.0, 33.0)
    plane = (0.7 * gaussian(0.12, stretch=1.2) + 0.3 * gaussian(0.25, stretch=0.9, x=0.05, y=-0.03))[0]
    path = cube(tmp_path / "a.fits", plane, CDELT1=step, CDELT2=step)
    psf = from_file.read(path, detector, passbands.load(band), system)
    model = galsim.InterpolatedImage(
        galsim.Image(fits.getdata(path).astype(float), scale=step), x_interpolant="lanczos15", flux=1e5,
        gsparams=galsim.GSParams(folding_threshold=1e-4, maxk_threshold=1e-5, kvalue_accuracy=1e-7),
    )  # fmt: skip
    for x, y in ((0.5, 0.5), (0.02, 0.03), (0.98, 0.97), (0.02, 0.97)):
        column, row = round(x * detector.nx) + 0.3, round(y * detector.ny) - 0.2
        ours, first = star_near(psf, detector, system, column, row)
        local = galsim.AstropyWCS(wcs=system).local(galsim.PositionD(column + 1, row + 1))
        image = galsim.ImageD(*ours.shape, wcs=local)
        place = galsim.PositionD(column - first[0] + 1, row - first[1] + 1)
        theirs = model.drawImage(image, center=place).array
        (shape, light), (expected, total) = ellipticity(ours), ellipticity(theirs)
        np.testing.assert_allclose(shape, expected, atol=1e-4)
        assert light == pytest.approx(total, rel=1e-4)
        np.testing.assert_allclose(ours, theirs, atol=1e-4 * theirs.max())
    # A PSF on nominal pixels would fail: the same star through the rotation alone.
    matrix = local.getMatrix()
    u, _, v = np.linalg.svd(matrix)
    nominal = galsim.JacobianWCS(*np.ravel(detector.pixel_scale * u @ v))
    image = galsim.ImageD(*ours.shape, wcs=nominal)
    assert np.abs(ellipticity(model.drawImage(image, center=place).array)[0] - expected).max() > wrong


def test_axes_of_the_camera_are_those_of_the_sky_without_a_position_angle(tmp_path):
    detector, plane = small("vis", "3-3"), gaussian(0.15, x=0.3, y=0.1)
    sky, camera = (cube(tmp_path / f"{frame}.fits", plane, PSFFRAME=frame) for frame in ("SKY", "CAMERA"))
    upright, turned = (wcs(detector, 0.0, 0.0, angle) for angle in (0.0, 90.0))
    images = [
        from_file.read(file, detector, BAND, system).planes.images[0]
        for file, system in ((sky, upright), (camera, turned), (sky, turned))
    ]
    np.testing.assert_array_equal(images[0], images[1])
    # The y axis of the focal plane points east, so its x axis points north.
    np.testing.assert_allclose(np.rot90(images[2], -1), images[0], atol=5e-3 * images[0].max())


@pytest.mark.parametrize("camera", ["vis", "lsstcam"])
def test_planes_that_we_write_give_the_same_stars(tmp_path, camera):
    """The samples of a PSF are written with their axes, and read without interpolation."""
    detector, band = small(camera, "1-6" if camera == "vis" else "R22_S11"), BAND if camera == "vis" else GROUND
    first = read(cube(tmp_path / "a.fits", gaussian(0.12, stretch=1.3, x=0.02)[0]), detector, band)
    image = first.planes.images[0]
    written = PsfImage(image.astype(float), first.planes.samples, float(image.sum())).write(tmp_path / "b.fits")
    again = read(written, detector, band)
    margin = (len(again.planes.images[0]) - len(image)) // 2
    np.testing.assert_allclose(again.planes.images[0], np.pad(image, margin), rtol=1e-6, atol=1e-9 * image.max())
    alone = replace(first, planes=replace(first.planes, drift=first.planes.drift[:0], powers=()))
    expected = star(alone, detector)
    np.testing.assert_allclose(star(again, detector), expected, atol=1e-6 * expected.max())


# ------------------------------------------------------------------------------------------------ PSFEx


LIGHT = {"PSFLIGHT": 0.9}


def psfex(path, degree=2, samples=0.65, side=33, **cards):
    """Write a PSFEx file of a Moffat profile that changes across a detector of 160 pixels."""
    y, x = np.mgrid[:side, :side] - side // 2
    terms = [(i, j) for j in range(degree + 1) for i in range(degree + 1 - j)]
    basis = []
    for i, j in terms:
        wide = (1 + ((x * samples) ** 2 + (1 + 0.1 * (i > j)) * (y * samples) ** 2) / (3.0 + i + 0.5 * j)) ** -3
        basis.append(
            (1.0 if i + j == 0 else 0.04 / (1 + i + j)) * (wide / wide.sum() - (i + j > 0) * (x * x < 40) * 1e-3)
        )
    mask = np.array(basis, np.float32)[None]
    column = fits.Column("PSF_MASK", f"{mask.size}E", dim=f"({side},{side},{len(terms)})", array=mask)
    unit = fits.BinTableHDU.from_columns([column], name="PSF_DATA")
    unit.header.update(
        {
            "POLNAXIS": 2, "POLGRP1": 1, "POLNAME1": "X_IMAGE", "POLZERO1": 70.0, "POLSCAL1": 150.0, "POLGRP2": 1,
            "POLNAME2": "Y_IMAGE", "POLZERO2": 90.0, "POLSCAL2": 140.0, "POLNGRP": 1, "POLDEG1": degree, "PSFNAXIS": 3,
            "PSFAXIS1": side, "PSFAXIS2": side, "PSFAXIS3": len(terms), "PSF_SAMP": samples, **cards,
        }
    )  # fmt: skip
    fits.HDUList([fits.PrimaryHDU(), unit]).writeto(path, overwrite=True)
    return path


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@nightly.parametrize(("column", "row"), [(80.3, 77.6), (30.1, 120.4), (131.7, 25.2)], (1, 2))
def test_a_psfex_file_is_what_galsim_reads(tmp_path, degree, column, row):
    """A small body and a star agree with galsim at each position, without an additional pixel."""
    path, detector = psfex(tmp_path / "a.psf", degree), small("lsstcam", "R22_S11")
    psf, sigma = read(path, detector, GROUND), 0.6
    source = one_source(
        detector, wcs(detector, 10.0, 20.0, 0.0), 1e5, column, row, bulge_fraction=1.0, bulge_sersic_index=0.5,
        bulge_half_light_radius=sigma * np.sqrt(2 * np.log(2)) * detector.pixel_scale,
    )  # fmt: skip
    ours = stamps.draw(source, np.array([128]), psf, 160, 160)
    # galsim counts pixels from 1.
    place = galsim.PositionD(column + 1, row + 1)
    whole = galsim.Convolve(galsim.des.DES_PSFEx(str(path)).getPSF(place), galsim.Gaussian(sigma=sigma))
    image = galsim.ImageD(160, 160, scale=1.0)
    theirs = 1e5 * whole.drawImage(image, method="no_pixel", center=place).array
    np.testing.assert_allclose(ours, theirs, atol=1e-3 * theirs.max())
    assert ours.sum() == pytest.approx(1e5, rel=2e-3)
    sharp = 1e5 * galsim.des.DES_PSFEx(str(path)).getPSF(place).drawImage(image, method="no_pixel", center=place).array
    drawn = star(psf, detector, column, row, side=psf.side)
    np.testing.assert_allclose(drawn, sharp, atol=1e-3 * sharp.max())
    assert drawn.sum() == pytest.approx(sharp.sum(), rel=1e-4)


def test_the_light_of_a_psfex_file(tmp_path):
    """The card PSFLIGHT is the fraction of a star's light in the images; without it they contain all light."""
    detector = small("lsstcam", "R22_S11")
    whole, most = (read(psfex(tmp_path / "a.psf", 1, **card), detector, GROUND) for card in ({}, LIGHT))
    assert (whole.profile.flux, most.profile.flux) == pytest.approx((1.0, 0.9), rel=1e-6)
    np.testing.assert_allclose(star(most, detector), 0.9 * star(whole, detector), atol=0.1)


@pytest.mark.parametrize(
    ("spacing", "shape", "samples"),
    [(0.65, (6, 33, 33), 8), (1 / 3, (15, 49, 49), 10), (0.1, (3, 101, 101), 15), (0.65, (10, 601, 601), 4)],
)
def test_samples_of_a_psfex_file(spacing, shape, samples):
    """A star has more than twice the frequencies of the file, unless the resampled images would be too large."""
    assert from_file._psfex_samples(spacing, shape) == samples


def test_galaxies_through_a_psfex_file(tmp_path):
    """The reference is a convolution by galsim without an additional pixel."""
    path, detector = psfex(tmp_path / "a.psf", 1), small("lsstcam", "R22_S11")
    psf = read(path, detector, GROUND)
    system = wcs(detector, *boresight_for(detector, 10.0, 20.0, 33.0))
    source = one_source(detector, system, 1e5, 80.3, 77.6, inclination=50.0, disk_half_light_radius=1.2)
    ours = stamps.draw(source, np.array([128]), psf, 160, 160)
    theirs = np.roll(reference.draw_reference(source, 0, psf, 160), (78 - 80, 80 - 80), (0, 1))
    assert np.abs(ours - theirs)[10:-10, 10:-10].max() < 2e-4 * theirs.max()


# ------------------------------------------------------------------------------------------------ refusals


BAD = {
    "sum": (lambda p: cube(p, 7 * gaussian(0.1, 0.1), **COLOURS), r"plane 1 sums to 7, but 0.5 to 1.001 is allowed"),
    "nan": (lambda p: cube(p, gaussian(0.1) * np.nan), "contains values that are not finite numbers"),
    "no frame": (
        lambda p: cube(p, gaussian(0.1), PSFFRAME=""),
        "PSFFRAME = '' is not known: set it to the axes of its planes",
    ),
    "unit of pixels": (lambda p: cube(p, gaussian(0.1), PSFFRAME="PIXELS"), "'arcsec' is not one of pixel, pix"),
    "unit": (lambda p: cube(p, gaussian(0.1), CUNIT1="furlong"), "CUNIT1 = 'furlong' is not one of arcsec, mas, deg"),
    "step": (lambda p: cube(p, gaussian(0.1), CDELT2=0.06), "CDELT1 and CDELT2 must be equal and positive"),
    "coarse": (lambda p: cube(p, gaussian(0.1), CUNIT1="deg"), "samples are 1800 pixels apart"),
    "text": (lambda p: cube(p, gaussian(0.1), CDELT1="x"), "CDELT1 = 'x' is not a number"),
    "colour": (lambda p: cube(p, gaussian(0.1, 0.1), **{**COLOURS, "CDELT3": -1.0}), "wavelengths must increase"),
    "reach": (lambda p: cube(p, gaussian(0.1, 0.1), **COLOURS), "planes reach from 5000 to 6000 A, but band"),
    "no colour": (lambda p: cube(p, gaussian(0.1, 0.1)), "CUNIT3 = '' is not one of Angstrom"),
    "pixel": (lambda p: cube(p, gaussian(0.1), PIXEL="yes"), "PIXEL = 'yes' is not T or F"),
    "degree": (lambda p: psfex(p, 2, POLDEG1=3), r"PSF_MASK has \[6, 33, 33\] samples, but degree 3 requires 10"),
    "places": (lambda p: psfex(p, 1, POLNAME1="MAG_AUTO"), "polynomials are of MAG_AUTO, Y_IMAGE"),
    "light": (lambda p: psfex(p, 1, PSFLIGHT=1.2), r"PSFLIGHT = 1.2, but 0.5 to 1.001 is allowed"),
    "scale": (lambda p: psfex(p, 1, POLSCAL1=0.0), "POLSCAL1 and POLSCAL2 must not be 0"),
    "four axes": (lambda p: cube(p, gaussian(0.1)[None]), "no image of two or three axes and no table with a column"),
    "no file": (lambda p: None, "no such file"),
    "no FITS": (lambda p: p.write_text("hello"), "a.fits: "),
}


def test_a_cube_without_its_frame_is_refused(tmp_path):
    """The message says what to add."""
    path = cube(tmp_path / "a.fits", gaussian(0.1))
    fits.delval(path, "PSFFRAME")
    with pytest.raises(BadInput) as refused:
        from_file.check(path, small("vis", "2-3"), BAND)
    assert str(refused.value) == (
        f"{path}: has no card PSFFRAME: set it to the axes of its planes, one of 'PIXELS' (columns and rows of the "
        "detector), 'SKY' (x west, y north), 'CAMERA' (axes of the focal plane, on the sky)"
    )


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_refused_by_name(tmp_path, case):
    make, said = BAD[case]
    make(tmp_path / "a.fits")
    with pytest.raises(LakeError, match=said) as refused:
        read(tmp_path / "a.fits", small("vis", "2-3"), BAND)
    assert str(refused.value).startswith(f"{tmp_path / 'a.fits'}: ")
    assert "\n" not in str(refused.value)


# ------------------------------------------------------------------------------------------------ requests

POINTING = {
    "channel": "EXT", "camera": "lsstcam", "band": "lsst_r", "ra": 53.117, "dec": -27.808, "mjd": 60905.0,
    "detectors": ["R22_S11", "R22_S12"], "centre_on": "R22_S11",
}  # fmt: skip


def asked(folder, **psf):
    table = {"name": "x", "seed": 1, "area": {"cone": {"ra": 53.117, "dec": -27.808, "radius": 0.1}}}
    return from_table({**table, "pointing": [POINTING], "psf": psf}, folder)


def test_a_request_names_it_by_band_and_detector(lake, tmp_path):
    for name in ("R22_S11", "R22_S12"):
        psfex(tmp_path / f"{name}.psf")
    _, exposures, _ = plan_exposures.plan(lake, asked(tmp_path, lsst_r="{detector}.psf"))
    (row,) = exposures.to_pylist()
    assert from_file.path_for_detector(row["psf"], "R22_S12") == tmp_path / "R22_S12.psf"
    (tmp_path / "R22_S12.psf").unlink()
    with pytest.raises(BadInput, match=r"R22_S12.psf: no such file"):
        plan_exposures.plan(lake, asked(tmp_path, lsst_r="{detector}.psf"))
    with pytest.raises(
        BadInput, match=r"psf.lsst_i: no exposure is taken in a band of this name: allowed with lsst: lsst_r"
    ):
        plan_exposures.plan(lake, asked(tmp_path, lsst_i="R22_S11.psf"))
    with pytest.raises(BadInput, match=r"psf.lsst_r must be text in quotes, got 3"):
        asked(tmp_path, lsst_r=3)


def test_of_a_set_each_exposure_has_one(tmp_path):
    """The choice is random, and does not depend on other exposures."""
    names = [f"{i}_{{detector}}.psf" for i in range(3)]
    table = {"name": "x", "seed": 1, "area": {"cone": {"ra": 53.117, "dec": -27.808, "radius": 0.1}}}
    pointings = [{**POINTING, "mjd": 60905.0 + 0.1 * i} for i in range(60)]
    mission = resolve()

    def drawn(some, seed=1):
        request = from_table({**table, "seed": seed, "pointing": some, "psf": {"lsst_r": names}}, tmp_path)
        return [exposure.psf for exposure, _ in survey.exposures(request, mission)]

    found = drawn(pointings)
    counts = [found.count(str(tmp_path / name)) for name in names]
    assert sum(counts) == 60
    assert min(counts) > 8
    assert drawn(pointings[::-1]) == found[::-1]
    assert drawn(pointings, 2) != found
    with pytest.raises(BadInput, match=r"psf.lsst_r names no file"):
        asked(tmp_path, lsst_r=[])
    with pytest.raises(BadInput, match=r"psf.lsst_r must be a list of texts"):
        asked(tmp_path, lsst_r=[3])


@pytest.mark.parametrize("channel", ["VIS", "EXT"])
def test_an_exposure_is_drawn_through_it(tmp_path, monkeypatch, channel):
    """The PSF of the request's file is wider than the default PSF."""
    path = cube(tmp_path / "a.fits", gaussian(0.5)[0])
    task, exposed, body, points = field(channel)
    monkeypatch.setattr(
        "tests.truesky.render.exposure.test_render.field",
        lambda channel: (task, {**exposed, "psf": str(path)}, body, points),
    )
    found = render(channel, body.slice(0, 0), points.slice(20, 20), accuracy=REFERENCE)
    pixel = found.detector.pixel_scale
    assert found.psf.fwhm == pytest.approx(2.355 * np.hypot(0.5, pixel / 12**0.5), rel=0.01)
    assert found.sources.electrons.sum() > 0
