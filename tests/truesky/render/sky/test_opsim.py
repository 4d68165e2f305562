"""Visits of OpSim: seeing, sky, depth and rotation agree with its published formulas and with its tables.

The file opsim_visits.csv has 20 visits of surveys that OpSim simulated (versions 3 to 4). The package imSim of the LSST
Dark Energy Science Collaboration contains them as test data (small_opsim and small_opsim_9683).
"""

import csv
from pathlib import Path

import numpy as np
import pytest

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from lake_schema.tables.exposures import ExposureRow
from tests.truesky import nightly
from truesky.fluxes import passbands
from truesky.render.camera import astrometry, detectors
from truesky.render.planning import ground_surveys, planned_exposures
from truesky.render.psf import seeing, to_psfex
from truesky.render.sky import opsim
from truesky.request.exposures.observations import Observation

FILE = Path(__file__).with_name("opsim_visits.csv")
# The simulated surveys began before LSSTCam was on its telescope.
MISSION = resolve(overrides={"ext.lsstcam.first_light": (60000.0, "d")})
with FILE.open() as stream:
    VISITS = [{k: v if k == "filter" else float(v) for k, v in row.items()} for row in csv.DictReader(stream)]
BLOCK = Observation(("EXT",), survey="lsst")
DETECTOR = detectors.detector("lsstcam", "R22_S11", MISSION)
# Values of the system by filter (rubin_scheduler, SysEngVals, throughputs 1.9): C_m, its loss by instrumental noise,
# extinction, and surface brightness of the dark sky.
SYSTEM = {
    "u": (22.967681, 0.543325, 0.470116, 23.051983),
    "g": (24.582309, 0.088310, 0.212949, 22.253839),
    "r": (24.602134, 0.043438, 0.126369, 21.197579),
    "i": (24.541152, 0.027510, 0.095764, 20.462795),
    "z": (24.371077, 0.018530, 0.068417, 19.606305),
    "y": (23.840175, 0.016283, 0.171009, 18.601512),
}
NOISE = 8.8**2, 0.2  # read noise squared (electron2) and dark current (electron / s) of SMTN-002


def published_depth(visit):
    """Depth at S/N 5 (Ivezic et al. 2019, eqs. 6 and 7, with the values of rubin_scheduler)."""
    cm, loss, extinction, dark = SYSTEM[visit["filter"]]
    seconds = visit["visitExposureTime"] / visit["numExposures"]
    scale = seconds / 30.0 * 10.0 ** (-0.4 * (visit["skyBrightness"] - dark))
    cm += loss - 1.25 * np.log10(1.0 + (10.0 ** (0.8 * loss) - 1.0) / scale)
    depth = cm + 0.5 * (visit["skyBrightness"] - 21.0) + 2.5 * np.log10(0.7 / visit["seeingFwhmEff"])
    depth += 1.25 * np.log10(seconds / 30.0) - extinction * (visit["airmass"] - 1.0)
    return depth + 1.25 * np.log10(visit["numExposures"])


@pytest.fixture(scope="module")
def rows():
    """The first exposure of each visit, as a row of the table `exposures`."""
    found = ground_surveys.read(FILE, BLOCK, MISSION)
    table = planned_exposures.table(found, [MISSION] * len(found)).to_pylist()
    first = {row["field"]: row for row in reversed(table)}
    assert len(first) == len(VISITS) == 20
    assert len(table) == sum(int(visit["numExposures"]) for visit in VISITS)
    return [first[i + 1] for i in range(20)]


def effective_area(row):
    """Pixels of the PSF's effective area: 1 / sum of the squared light of the pixels of a star."""
    exposure = ExposureRow.from_row(row)
    psf = seeing.exposure_psf(exposure, DETECTOR, passbands.load(exposure.band), MISSION, 1)
    (model, *_), *_ = to_psfex.psfex_planes(psf)
    every_pixel = slice((len(model) // 2) % psf.planes.samples, None, psf.planes.samples)
    share = psf.planes.samples**2 * model[every_pixel, every_pixel].astype(float)
    return 1.0 / float((share**2).sum())


@nightly.parametrize("number", range(20), (0, 4))
def test_visits_are_as_deep_as_opsim_says(rows, number):
    """With the instrumental noise of the formula, PSF, sky, zero point and extinction give its depth."""
    row, visit = rows[number], VISITS[number]
    seconds, exposures = row["exposure_time_s"], visit["numExposures"]
    assert seconds * exposures == visit["visitExposureTime"]
    variance = effective_area(row) * (row["sky"] * seconds + NOISE[0] + NOISE[1] * seconds)
    light = 0.5 * (5.0**2 + np.sqrt(5.0**4 + 4.0 * 5.0**2 * variance))
    depth = row["zero_point"] - 2.5 * np.log10(light / seconds) + 1.25 * np.log10(exposures)
    assert depth == pytest.approx(published_depth(visit), abs=0.06)


def test_tables_contain_the_depth_of_the_formula():
    """The tables were made with older throughputs, which change the depth of a band by a constant, 0.4 mag in u."""
    differences = [published_depth(visit) - visit["fiveSigmaDepth"] for visit in VISITS]
    for band in SYSTEM:
        found = [one for one, visit in zip(differences, VISITS, strict=True) if visit["filter"] == band]
        assert np.ptp(found) < 0.02
        assert np.abs(found).max() < 0.4


def test_seeing_at_the_zenith_is_that_of_the_table():
    """The inverse of the formula for the effective FWHM. Effective wavelengths have changed by 1 %."""
    for visit in VISITS:
        wavelength = passbands.pivot_wavelength(passbands.load(f"lsst_{visit['filter']}"))
        found = opsim.zenith_seeing(visit["seeingFwhmEff"], visit["airmass"], wavelength)
        assert found == pytest.approx(visit["seeingFwhm500"], rel=0.01)
    with pytest.raises(BadInput, match=r"seeingFwhmEff = 0\.4 arcsec: telescope and camera alone have 0\.46"):
        opsim.zenith_seeing(0.4, 1.0, 6200.0)


def test_rows_have_the_sky_and_airmass_of_the_table(rows):
    """The published dark sky is 1.51 to 90.6 electrons per second (SMTN-002)."""
    rates = {"u": 1.51, "g": 15.45, "r": 32.95, "i": 52.94, "z": 79.4, "y": 90.6}
    for row, visit in zip(rows, VISITS, strict=True):
        brighter = SYSTEM[visit["filter"]][3] - visit["skyBrightness"]
        assert row["sky"] == pytest.approx(rates[visit["filter"]] * 10.0 ** (0.4 * brighter), rel=1e-3)
        assert row["airmass"] == pytest.approx(visit["airmass"], rel=0.012)
        assert row["mjd"] == visit["observationStartMJD"]
        # The aureole of our PSF makes up for the difference.
        assert 0.88 < row["seeing"] / visit["seeingFwhm500"] < 0.97


def wrap(angle):
    return (angle + 180.0) % 360.0 - 180.0


def angle_of_columns(row):
    """Position angle of the direction in which rows increase, from the WCS of the central detector."""
    system = astrometry.wcs(DETECTOR, row["ra"], row["dec"], row["position_angle"])
    middle = (DETECTOR.nx - 1) / 2, (DETECTOR.ny - 1) / 2
    here, there = (system.pixel_to_world(middle[0], middle[1] + step) for step in (-50.0, 50.0))
    return here.position_angle(there).deg


@pytest.mark.parametrize("number", [0, 7, 13])
def test_the_wcs_has_the_angle_of_the_rotator(rows, number):
    """The parallactic angle of the table, and the equation of rubin_scheduler and imSim for LSSTCam.

    The rows of these tables, of before 2025, have rotSkyPos = rotTelPos - paraAngle.
    """
    visit = VISITS[number]
    assert wrap(visit["rotTelPos"] - visit["paraAngle"] - visit["rotSkyPos"]) == pytest.approx(0.0, abs=1e-3)
    expected = 270.0 - visit["rotTelPos"] + visit["paraAngle"]
    assert wrap(angle_of_columns(rows[number]) - expected) == pytest.approx(0.0, abs=0.05)


def write(folder, **changes):
    """Write one visit in the current format, with other values in some columns; None leaves a column out."""
    visit = {**VISITS[3], "rotSkyPos": 40.0, **changes}
    visit = {key: value for key, value in visit.items() if value is not None}
    path = folder / "visits.csv"
    path.write_text(f"{','.join(visit)}\n{','.join(map(str, visit.values()))}\n")
    return path


def test_rot_sky_pos_is_the_position_angle_of_y(tmp_path):
    path = write(tmp_path, rotTelPos=None)
    row = planned_exposures.table(ground_surveys.read(path, BLOCK, MISSION)[:1], [MISSION]).to_pylist()[0]
    assert angle_of_columns(row) == pytest.approx(40.0, abs=0.05)


def test_rot_tel_pos_uses_the_direction_of_the_zenith(tmp_path):
    """Astropy gives the parallactic angle, of ICRF north."""
    import astropy.units as u
    from astropy.coordinates import AltAz, EarthLocation, SkyCoord
    from astropy.time import Time
    from astropy.utils import iers

    visit = VISITS[3]
    path = write(tmp_path, rotSkyPos=None, paraAngle=None, rotTelPos=-30.0)
    row = planned_exposures.table(ground_surveys.read(path, BLOCK, MISSION)[:1], [MISSION]).to_pylist()[0]
    with iers.conf.set_temp("auto_download", False):
        site = EarthLocation.from_geodetic(-70.7494, -30.2446, 2663.0)
        frame = AltAz(obstime=Time(visit["observationStartMJD"], format="mjd"), location=site)
        field = SkyCoord(visit["fieldRA"], visit["fieldDec"], unit="deg")
        up = field.transform_to(frame)
        zenith = SkyCoord(AltAz(az=up.az, alt=up.alt + 10.0 * u.arcsec, obstime=frame.obstime, location=site)).icrs
        parallactic = field.position_angle(zenith).deg
    expected = parallactic + 30.0 - 90.0
    assert wrap(angle_of_columns(row) - expected) == pytest.approx(0.0, abs=0.5)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rotSkyPos": None, "rotTelPos": 95.0}, "rotTelPos = 95 deg is outside the range of the rotator, -90 to 90"),
        ({"rotSkyPos": 10.0, "rotTelPos": 30.0}, "rotSkyPos = 10 and rotTelPos = 30 deg disagree"),
        ({"observationStartMJD": 60993.7}, r"the Sun is at \+\d+\.\d deg, but must be below -8 deg"),
        ({"observationStartMJD": 59993.1}, "MJD 59993.100 is before first light of lsstcam on MJD 60000"),
        ({"fieldDec": 70.0, "rotTelPos": None}, r"the field has an altitude of -\d+\.\d deg, below the horizon"),
        ({"seeingFwhmEff": 0.3, "rotTelPos": None}, "seeingFwhmEff = 0.3 arcsec: telescope and camera alone"),
    ],
)
def test_impossible_visits_are_refused_in_one_line(tmp_path, changes, words):
    with pytest.raises(BadInput, match=words) as caught:
        ground_surveys.read(write(tmp_path, **changes), BLOCK, MISSION)
    assert caught.value.messages == (str(caught.value),)
    assert "visits.csv row 1: " in str(caught.value)


def test_cameras_without_a_rotator_need_rot_sky_pos(tmp_path):
    block, mission = Observation(("EXT",), survey="des"), resolve()
    (one, two) = ground_surveys.read(write(tmp_path, rotTelPos=None), block, mission)
    assert (one.camera, one.band, one.position_angle) == ("decam", "des_i", 40.0)
    assert two.mjd - one.mjd == pytest.approx(17.0 / 86400.0, abs=1e-9)
    with pytest.raises(BadInput, match="rotTelPos: decam has no rotator"):
        ground_surveys.read(write(tmp_path, rotSkyPos=None, rotTelPos=10.0), block, mission)


def test_the_layout_of_the_camera_is_read_once_for_all_visits(monkeypatch):
    """It takes milliseconds, and a table may have a million visits."""
    calls, original = [], detectors.detectors
    monkeypatch.setattr(detectors, "detectors", lambda *names: calls.append(names) or original(*names))
    mission = resolve(overrides={"ext.lsstcam.first_light": (60001.0, "d")})
    assert len({one.field for one in ground_surveys.read(FILE, BLOCK, mission)}) == 20
    assert calls == [("lsstcam", mission)]
