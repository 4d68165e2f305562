"""Effective areas of PSFs, and their interpolation between seeings, airmasses and detectors."""

from dataclasses import replace

import galsim
import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from truesky.fluxes import passbands
from truesky.render.camera import detectors
from truesky.render.psf import model
from truesky.survey_maps import psf_sizes
from truesky.survey_maps.psf_sizes import AirRange

from . import planned


@pytest.fixture(scope="module")
def exposures(tmp_path_factory):
    """Return the planned exposures by channel."""
    from lake_schema.tables.exposures import ExposureRow
    from truesky.render.plan_exposures import plan

    _, rows, _ = plan(tmp_path_factory.mktemp("none"), planned.request())
    return {row["channel"]: ExposureRow.from_row(row) for row in rows.to_pylist()}


@pytest.mark.parametrize("fwhm", [0.5, 1.0])
def test_the_area_of_a_gaussian_is_known(fwhm):
    """It is 4 pi sigma^2 (King 1983)."""
    sigma = fwhm / np.sqrt(8 * np.log(2))
    assert psf_sizes.effective_area(model.gaussian(fwhm, 0.1)) == pytest.approx(4 * np.pi * sigma**2, rel=1e-3)


def test_the_area_includes_the_pixel():
    """The area agrees with the sum of squares of a finely sampled image that galsim averages over the pixel."""
    profile, step = galsim.Gaussian(fwhm=1.0), 0.1
    image = galsim.Convolve(profile, galsim.Pixel(1.0)).drawImage(nx=121, ny=121, scale=step, method="no_pixel").array
    expected = step**2 / float((image.astype(float) ** 2).sum())
    psf = model.from_profile(profile, 1.0)
    assert psf_sizes.effective_area(psf) == pytest.approx(expected, rel=2e-3)
    assert psf_sizes.effective_area(psf, 0.3) < psf_sizes.effective_area(psf)


def test_areas_between_the_nodes_of_seeing_and_airmass(exposures):
    """They agree with the PSF of the same seeing and airmass within 1 %, 0.005 mag of depth."""
    mission, band = resolve(), passbands.load("lsst_r")
    ranges = AirRange((0.55, 1.4), (1.0, 1.6))
    middle = detectors.detector("lsstcam", "R22_S11", mission)
    cases = [
        replace(exposures["EXT"], seeing=seeing, airmass=airmass, zenith=None)
        for seeing, airmass in ((0.62, 1.3), (0.95, 1.1))
    ]
    area, fwhm = psf_sizes.in_air(cases, ranges, band, mission)
    for i, case in enumerate(cases):
        expected = psf_sizes.sizes(case, middle, band, mission, 0)
        assert (area[i], fwhm[i]) == pytest.approx(expected, rel=0.01)


@pytest.mark.nightly
@pytest.mark.parametrize(("channel", "band"), [("VIS", "euclid_vis"), ("NISP-P", "euclid_j")])
def test_areas_of_detectors_between_the_corners(channel, band, exposures):
    """They agree with the PSF of the detector within 6 %, 0.03 mag of depth."""
    mission = resolve()
    found = psf_sizes.in_field(exposures[channel], passbands.load(band), mission, 3)
    for detector in detectors.detectors(exposures[channel].camera, mission)[2::5]:
        expected = psf_sizes.sizes(exposures[channel], detector, passbands.load(band), mission, 3)
        assert found[detector.name] == pytest.approx(expected, rel=0.06)


def test_one_seeing_needs_one_node(exposures):
    exposure = exposures["EXT"]
    ranges = AirRange(*((float(v[0]), float(v[0])) for v in psf_sizes.air_coordinates([exposure])))
    area, _ = psf_sizes.in_air([exposure], ranges, passbands.load("lsst_r"), resolve())
    # An effective area is 3.2 to 3.6 times the square of the FWHM in good to bad seeing, 2.27 for a Gaussian.
    assert 1.0 < area[0] < 6.0


def test_seeing_and_airmass_that_differ_by_rounding(exposures):
    """The polynomial has no two nodes at the same place, where it would not be a number."""
    exposure = exposures["EXT"]
    seeing, airmass = (float(v[0]) for v in psf_sizes.air_coordinates([exposure]))
    ranges = AirRange((seeing, np.nextafter(seeing, 9.0)), (airmass, np.nextafter(airmass, 9.0)))
    both = psf_sizes.in_air([exposure], ranges, passbands.load("lsst_r"), resolve())
    same = psf_sizes.in_air([exposure], AirRange((seeing,) * 2, (airmass,) * 2), passbands.load("lsst_r"), resolve())
    np.testing.assert_array_equal(both, same)


def test_nodes_do_not_depend_on_the_first_exposure(exposures, monkeypatch):
    """Processes read exposures in different orders; the elongation of the air depends on the place and the date."""
    nodes = []

    def record(exposure, *_):
        nodes.append((exposure.ra, exposure.dec, exposure.mjd, exposure.zenith, exposure.seeing, exposure.airmass))
        return 1.0, 1.0

    monkeypatch.setattr(psf_sizes, "_cached_sizes", record)
    one = exposures["EXT"]
    for first in (one, replace(one, ra=one.ra + 1.0, dec=0.0, mjd=one.mjd + 2.0, zenith=3.0, seeing=0.9)):
        psf_sizes.in_air([first], AirRange((0.55, 1.4), (1.0, 1.6)), passbands.load("lsst_r"), resolve())
    assert nodes[:6] == nodes[6:]
    assert len(set(nodes)) == 6
