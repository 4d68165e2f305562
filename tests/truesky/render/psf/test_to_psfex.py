"""The PSF file that is written with an image: galsim reads the PSF that was drawn."""

from dataclasses import replace
from functools import cache

import galsim
import galsim.des
import numpy as np
import pytest
from astropy.io import fits

from lake_schema.errors import BadInput
from lake_schema.fits import psfex
from lake_schema.mission.configuration import resolve
from tests.truesky import nightly
from tests.truesky.render.fields import moments, one_source
from truesky.fluxes import passbands
from truesky.render.camera import detectors
from truesky.render.camera.astrometry import wcs
from truesky.render.drawing import stamps
from truesky.render.psf import euclid, from_file, ground, seeing, to_psfex

MISSION = resolve()


def shape_of(image, column, row):
    """Return (size, e1, e2) of the pixels of a star around its position."""
    x, y = round(column), round(row)
    _, second = moments(image[y - 8 : y + 9, x - 8 : x + 9])
    (xx, xy), (_, yy) = second
    return np.array([xx + yy, (xx - yy) / (xx + yy), 2 * xy / (xx + yy)])


def read(path, detector, band):
    return from_file.read(path, detector, band, wcs(detector, 10.0, 20.0, 0.0))


def cut(camera, name, n=300):
    """Return the middle of a detector."""
    return replace(detectors.detector(camera, name, MISSION), nx=n, ny=n)


@pytest.mark.parametrize(
    ("camera", "name", "band", "strength"),
    [
        ("lsstcam", "R43_S21", "lsst_r", 1.0),
        pytest.param("hsc", "0_03", "hsc_z", 2.0, marks=pytest.mark.nightly),
        pytest.param("decam", "N4", "des_g", 1.0, marks=pytest.mark.nightly),
    ],
)
def test_galsim_opens_it_and_sees_the_same_stars(tmp_path, camera, name, band, strength):
    """Sizes agree within 1 % and ellipticities within 0.005, everywhere on a detector with a variable PSF."""
    mission = resolve(overrides={f"ext.{camera}.psf.wavefront_scale": (strength, "")})
    whole = detectors.detector(camera, name, mission)
    air = ground.Air(0.7, (0.02, -0.01), -0.3)
    psf = ground.atmospheric_psf(air, whole, passbands.load(band), mission, 9)
    path = tmp_path / "a.psf"
    to_psfex.write(psf, whole, path)
    model, found = galsim.des.DES_PSFEx(str(path)), []
    for column, row in ((60.3, 80.6), ((whole.nx - 1) / 2, (whole.ny - 1) / 2), (whole.nx - 50.2, whole.ny - 70.9)):
        star = one_source(whole, wcs(whole, 10.0, 20.0, 0.0), 1e6, column, row)
        ours = stamps.draw(star, np.array([128]), psf, whole.nx, whole.ny)
        place = galsim.PositionD(column + 1, row + 1)
        image = galsim.ImageD(galsim.BoundsI(round(column) - 20, round(column) + 22, round(row) - 20, round(row) + 22))
        model.getPSF(place).withFlux(1e6).drawImage(image, scale=1.0, method="no_pixel", center=place)
        theirs = np.zeros_like(ours)
        theirs[image.bounds.ymin - 1 : image.bounds.ymax, image.bounds.xmin - 1 : image.bounds.xmax] = image.array
        mine, written = shape_of(ours, column, row), shape_of(theirs, column, row)
        assert written[0] == pytest.approx(mine[0], rel=0.01)
        np.testing.assert_allclose(written[1:], mine[1:], atol=0.005)
        assert theirs.max() == pytest.approx(ours.max(), rel=0.03)
        found.append(mine)
    assert np.abs(np.ptp(found, axis=0)).max() > 1e-4
    # The file can also be used as a PSF file of the user.
    back = read(path, whole, passbands.load(band))
    assert back.fwhm == pytest.approx(psf.fwhm, rel=0.01)


def test_a_profile_without_planes_is_written_too(tmp_path):
    detector = cut("jpcam", detectors.detectors("jpcam", MISSION)[0].name)
    psf, path = seeing.moffat_psf(1.1, 3.0, detector.pixel_scale), tmp_path / "a.psf"
    to_psfex.write(psf, detector, path)
    star = one_source(detector, wcs(detector, 10.0, 20.0, 0.0), 1e6, 150.2, 149.7)
    ours = stamps.draw(star, np.array([256]), psf, 300, 300)
    place = galsim.PositionD(151.2, 150.7)
    model = galsim.des.DES_PSFEx(str(path)).getPSF(place).withFlux(1e6)
    theirs = model.drawImage(galsim.ImageD(300, 300, scale=1.0), method="no_pixel", center=place).array
    assert np.abs(ours - theirs).max() < 0.02 * ours.max()
    assert shape_of(theirs, 150.2, 149.7)[0] == pytest.approx(shape_of(ours, 150.2, 149.7)[0], rel=0.01)
    with fits.open(path, checksum=True) as units:
        assert units[1].header["PSF_FWHM"] == pytest.approx(psf.fwhm / detector.pixel_scale)
    first = path.read_bytes()
    to_psfex.write(psf, detector, path)
    assert path.read_bytes() == first


# Side of the stamps of stars, pixels. They contain the images of the files.
SIDE = 64
CAMERAS = [("lsstcam", "R22_S11", "lsst_r"), ("vis", "3-4", "euclid_vis"), ("nisp", "DET22", "euclid_j")]


@cache
def model_of(camera, name, band):
    """Return the PSF of a whole detector at several positions, the detector and the passband."""
    detector, curve = detectors.detector(camera, name, MISSION), passbands.load(band)
    if camera == "vis":
        return euclid.vis_psf(detector, curve, MISSION, 4), detector, curve
    if camera == "nisp":
        return euclid.nisp_psf(detector, curve, MISSION, 4), detector, curve
    return ground.atmospheric_psf(ground.Air(0.7, (0.02, -0.01), -0.3), detector, curve, MISSION, 9), detector, curve


def star(psf, detector, column, row, side=SIDE):
    """Draw a star with flux 1 at a position on the detector; return its pixels, and the first column and row."""
    first = round(column) - side // 2, round(row) - side // 2
    moved = replace(psf, planes=replace(psf.planes, origin=first))
    source = one_source(detector, wcs(detector, 10.0, 20.0, 0.0), 1.0, column - first[0], row - first[1])
    return stamps.draw(source, np.array([side]), moved, side, side), first


def star_of_galsim(path, column, row, first, side=SIDE):
    """Return the same star, drawn by galsim from the file; its flux is 1."""
    place = galsim.PositionD(column + 1, row + 1)
    image = galsim.ImageD(galsim.BoundsI(first[0] + 1, first[0] + side, first[1] + 1, first[1] + side))
    model = galsim.des.DES_PSFEx(str(path)).getPSF(place)
    return model.drawImage(image, scale=1.0, method="no_pixel", center=place).array


def positions(detector):
    """Return positions of stars with different subpixel phases: centre of the detector, near a corner and an edge."""
    middle = (detector.nx - 1) / 2, (detector.ny - 1) / 2
    return [(middle[0] + 0.3, middle[1] - 0.4), (160.2, 180.9), (detector.nx - 201.5, middle[1] - 512.8)]


@nightly.parametrize("of", CAMERAS, (1,))
def test_a_star_of_the_file_is_that_of_galsim(tmp_path, of):
    """Light in the stamp, pixels and position agree everywhere on the detector."""
    (psf, detector, band), path = model_of(*of), tmp_path / "a.psf"
    to_psfex.write(psf, detector, path)
    light, back = fits.getheader(path, 1)["PSFLIGHT"], read(path, detector, band)
    for column, row in positions(detector):
        ours, first = star(back, detector, column, row)
        theirs = light * star_of_galsim(path, column, row, first)
        assert ours.sum() == pytest.approx(theirs.sum(), rel=1e-4)
        assert np.abs(ours - theirs).max() < 1e-3 * theirs.max()
        np.testing.assert_allclose(moments(ours)[0], moments(theirs)[0], atol=5e-3)


@nightly.parametrize(("of", "share"), list(zip(CAMERAS, (0.977, 0.943, 0.949), strict=True)), (1,))
def test_the_file_has_the_light_of_a_star(tmp_path, of, share):
    """PSFLIGHT is the fraction of a star's light in the image, so that stars have the same light as in the simulation.

    Without it, their pixels are too bright by several per cent. The kernel of PSFEx changes a pixel by up to 0.8 %.
    """
    (psf, detector, band), path = model_of(*of), tmp_path / "a.psf"
    if of[0] == "vis":
        # The response varies inside a pixel, which makes the brightest pixel of a star brighter by 2 %.
        psf = replace(psf, intra_pixel=0.3)
    to_psfex.write(psf, detector, path)
    with fits.open(path) as units:
        header = units[1].header
        half = (header["PSFAXIS1"] * header["PSF_SAMP"] - 1) / 2
    light = header["PSFLIGHT"]
    assert light == pytest.approx(share, abs=3e-3)
    column, row = positions(detector)[0]
    drawn, first = star(psf, detector, column, row)
    y, x = np.mgrid[:SIDE, :SIDE]
    inside = np.maximum(np.abs(x + first[0] - column), np.abs(y + first[1] - row)) < half
    assert drawn[inside].sum() == pytest.approx(light, abs=5e-3)
    for image in (star(read(path, detector, band), detector, column, row)[0],
                  light * star_of_galsim(path, column, row, first)):  # fmt: skip
        assert image.sum() == pytest.approx(light, rel=3e-3)
        assert np.abs(image - drawn)[inside].max() < 8e-3 * drawn.max()


def test_a_psf_from_a_file_is_written_with_fewer_samples(tmp_path):
    """The PSF of a user's file has many samples per pixel; what is written with the image has the same light."""
    (psf, detector, band), path, again = model_of(*CAMERAS[1]), tmp_path / "a.psf", tmp_path / "b.psf"
    to_psfex.write(psf, detector, path)
    back = read(path, detector, band)
    to_psfex.write(back, detector, again)
    first, second = (fits.getheader(file, 1) for file in (path, again))
    assert (back.planes.samples, second["PSF_SAMP"]) == (10, pytest.approx(0.3))
    assert second["PSFLIGHT"] == pytest.approx(first["PSFLIGHT"], rel=5e-3)
    assert second["PSF_FWHM"] == pytest.approx(first["PSF_FWHM"], rel=0.01)
    column, row = positions(detector)[0]
    drawn, corner = star(psf, detector, column, row)
    found = second["PSFLIGHT"] * star_of_galsim(again, column, row, corner)
    # The kernel of PSFEx was applied twice.
    assert np.abs(found - drawn).max() < 0.01 * drawn.max()


def test_planes_of_no_degree_are_refused(tmp_path):
    with pytest.raises(BadInput, match="4 planes do not fit a polynomial"):
        psfex.write(tmp_path / "a.psf", np.zeros((4, 5, 5), np.float32), 0.5, 3.0, (1.0, 1.0), (1.0, 1.0), 1.0)
    assert not list(tmp_path.iterdir())
