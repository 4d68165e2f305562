"""The PSF file that is written with an image: galsim reads the PSF that was drawn."""

from dataclasses import replace

import galsim
import galsim.des
import numpy as np
import pytest
from astropy.io import fits

from lake_schema.errors import BadInput
from lake_schema.fits import psfex
from lake_schema.mission.configuration import resolve
from tests.truesky.render.fields import moments, one_source
from truesky.fluxes import passbands
from truesky.render.camera import detectors
from truesky.render.camera.astrometry import wcs
from truesky.render.drawing import stamps
from truesky.render.psf import from_file, ground, seeing, to_psfex

MISSION = resolve()


def shape_of(image, column, row):
    """Return (size, e1, e2) of the pixels of a star around its position."""
    x, y = round(column), round(row)
    _, second = moments(image[y - 8 : y + 9, x - 8 : x + 9])
    (xx, xy), (_, yy) = second
    return np.array([xx + yy, (xx - yy) / (xx + yy), 2 * xy / (xx + yy)])


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
    back = from_file.read(path, whole, passbands.load(band))
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


def test_planes_of_no_degree_are_refused(tmp_path):
    with pytest.raises(BadInput, match="4 planes do not fit a polynomial"):
        psfex.write(tmp_path / "a.psf", np.zeros((4, 5, 5), np.float32), 0.5, 3.0, (1.0, 1.0), (1.0, 1.0))
    assert not list(tmp_path.iterdir())
