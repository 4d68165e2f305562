"""Depths of single exposures, against published ones for the same sky, zero point and width of the PSF."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from lake_schema.tables.exposures import ExposureRow
from tests.truesky import nightly
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


# Fields of Euclid's first data release: north, south, Fornax (deg).
RELEASE_FIELDS = ((269.73, 66.02), (61.24, -48.42), (52.93, -28.09))
# Targets of Euclid's early release observations (deg), and a date on which Euclid may observe each (MJD).
EARLY_FIELDS = {
    "NGC 6397": (265.18, -53.67, 60916.0), "NGC 6254": (254.29, -4.10, 60905.0), "Dorado": (64.0, -55.7, 60905.0),
    "Fornax": (54.0, -35.3, 60905.0), "Perseus": (49.95, 41.51, 60908.0), "Abell 2390": (328.4, 17.7, 60988.0),
    "Abell 2764": (5.14, -49.25, 60983.0), "Horsehead": (85.25, -2.46, 60934.0), "M78": (86.69, 0.08, 60936.0),
    "NGC 6744": (287.44, -63.86, 60926.0), "NGC 6822": (296.24, -14.80, 60949.0), "IC 342": (56.7, 68.1, 60921.0),
    "IC 10": (5.07, 59.30, 60905.0), "NGC 2403": (114.21, 65.60, 60953.0), "Holmberg II": (124.77, 70.72, 60956.0),
}  # fmt: skip
# Their aperture corrections for a diameter of 1.2 arcsec, mag (Cuillandre et al. 2025, A&A 697, A6, Fig. 22).
CORRECTIONS = {"euclid_y": 0.130, "euclid_j": 0.167, "euclid_h": 0.249}
# A field whose sky is near the median of all.
TYPICAL = "IC 342"


def aperture_depths(pointings, diameter, sigmas, folder):
    """Return the magnitude by band of light in an aperture (arcsec) that is some sigmas above the noise of exposures.

    The pointings of a band have one detector, and their inverse variances are summed.
    """
    folder.mkdir(exist_ok=True)
    _, rows, tasks = plan(folder, planned.request(pointings))
    mission, inverse = resolve(), defaultdict(float)
    names = dict(zip(tasks["exposure_id"].to_pylist(), tasks["detector"].to_pylist(), strict=True))
    for row in rows.to_pylist():
        exposure = ExposureRow.from_row(row)
        detector = detectors.detector(exposure.camera, names[exposure.exposure_id], mission)
        _, (variance,) = exposure_noise.variances([exposure], [detector], mission)
        signal = exposure.exposure_time_s * 10.0 ** (0.4 * exposure.zero_point)
        inverse[exposure.band] += signal**2 * detector.pixel_scale**2 / (variance * np.pi * (diameter / 2.0) ** 2)
    return {band: 1.25 * np.log10(total) - 2.5 * np.log10(sigmas) for band, total in inverse.items()}


@pytest.mark.parametrize(("ra", "dec"), RELEASE_FIELDS)
def test_a_stack_of_vis(ra, dec, tmp_path):
    """Four nominal and two short exposures reach 25.6 (10 sigma, 1.3 arcsec diameter; arXiv:2503.15303).

    This was measured on images. The prediction is 0.12 to 0.2 mag deeper.
    """
    times = [*[{}] * 4, *[{"exposure_time_s": 89.5}] * 2]
    pointings = [
        planned.pointing("VIS", "vis", "euclid_vis", ["3-4"], ra=ra, dec=dec, mjd=60905.0 + 0.02 * i, **time)
        for i, time in enumerate(times)
    ]
    depth = aperture_depths(pointings, 1.3, 10.0, tmp_path)["euclid_vis"]
    assert 0.12 < depth - 25.6 < 0.2


@nightly.parametrize("name", [*EARLY_FIELDS], ([*EARLY_FIELDS].index(TYPICAL),))
def test_stacks_of_nisp(name, tmp_path):
    """Four exposures reach a median of 24.5 in the early release observations (5 sigma, point sources, see above).

    It is from apertures of 1.2 arcsec with a correction. The prediction is deeper by 0.1 to 0.2 mag in the typical
    field. Those of other fields differ from it with the sky.
    """
    ra, dec, mjd = EARLY_FIELDS[name]
    pointings = [
        planned.pointing("NISP-P", "nisp", band, ["DET22"], ra=ra, dec=dec, mjd=mjd + 0.02 * i)
        for i in range(4)
        for band in CORRECTIONS
    ]
    depths = aperture_depths(pointings, 1.2, 5.0, tmp_path)
    for band, correction in CORRECTIONS.items():
        difference = depths[band] - correction - 24.5
        if name == TYPICAL:
            assert 0.1 < difference < 0.2
        assert -0.2 < difference < 0.4
