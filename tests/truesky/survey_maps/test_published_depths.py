"""Depths of single exposures, against published ones for the same sky, zero point and width of the PSF."""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes import passbands
from truesky.render.camera import detectors
from truesky.render.plan_exposures import plan
from truesky.survey_maps import exposure_noise, psf_sizes

from . import planned

# Rubin Observatory, 30 s at the zenith (SMTN-002, syseng_throughputs 1.9): zero point (AB mag of 1 electron / s),
# sky (electrons / s / pixel), FWHM (arcsec), and 5 sigma depth of a point source (AB mag).
LSST = {
    "lsst_g": (28.51, 15.45, 0.77, 24.97),
    "lsst_r": (28.36, 32.95, 0.73, 24.52),
    "lsst_i": (28.17, 52.94, 0.71, 24.13),
    "lsst_z": (27.78, 79.4, 0.69, 23.56),
}


@pytest.mark.parametrize("band", LSST)
def test_a_visit_of_lsst(band, tmp_path):
    """Within 0.1 mag."""
    zero_point, sky, fwhm, published = LSST[band]
    _, rows, _ = plan(tmp_path, planned.request([planned.pointing("EXT", "lsstcam", band, ["R22_S11"], mjd=60905.25)]))
    mission = resolve()
    detector = detectors.detector("lsstcam", "R22_S11", mission)
    exposure = ExposureRow.from_row(rows.to_pylist()[0])
    exposure = replace(exposure, zero_point=zero_point, sky=sky, airmass=1.0, zenith=None, sky_slope_x=None)
    exposure = replace(exposure, sky_slope_y=None)
    seeings = (0.5, 0.8)
    found = [psf_sizes.sizes(replace(exposure, seeing=s), detector, passbands.load(band), mission, 0) for s in seeings]
    area = np.interp(fwhm, *zip(*((width, size) for size, width in found), strict=True))
    _, (variance,) = exposure_noise.variances([exposure], [detector], mission)
    noise = np.sqrt(area * variance) / detector.pixel_scale
    depth = zero_point - 2.5 * np.log10(5.0 * noise / exposure.exposure_time_s)
    assert depth == pytest.approx(published, abs=0.1)
