"""Exposures of ground surveys, and tables of pointings; errors name the line of the table."""

import re
from dataclasses import replace

import numpy as np
import pytest
from astropy.coordinates import AltAz, EarthLocation, get_sun
from astropy.time import Time

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from tests.truesky import nightly
from truesky.render.planning import ground_surveys, planned_exposures
from truesky.request.area import Area
from truesky.request.exposures.observations import Observation

MISSION = resolve()
BLOCK = Observation(("EXT",), survey="lsst", exposure_time_s=77.0, detectors=("R22_S11",))
HEAD = "channel,camera,band,ra,dec,position_angle,mjd"
ROW = "EXT,lsstcam,lsst_r,-10.0,20.5,30.0,60905.25"


def read(tmp_path, text):
    path = tmp_path / "pointings.csv"
    path.write_text(text)
    return ground_surveys.read(path, BLOCK, MISSION)


def test_a_line_is_an_exposure(tmp_path):
    plain, full = read(
        tmp_path,
        f"# my survey\n{HEAD},exposure_time_s,sky,seeing,zero_point,psf,detectors,image_type\n"
        f"{ROW},,,,,,,\n\n# better\n{ROW},30,12.5,0.61,28.1,psf.fits,R22_S11 R22_S12,deep\n",
    )
    assert (plain.ra, plain.dec, plain.position_angle, plain.mjd) == (350.0, 20.5, 30.0, 60905.25)
    assert (plain.exposure_time_s, plain.image_type, plain.detectors) == (77.0, "science", ("R22_S11",))
    assert (plain.sky, plain.seeing, plain.zero_point, plain.psf) == (None, None, None, None)
    assert (full.exposure_time_s, full.sky, full.seeing, full.zero_point) == (30.0, 12.5, 0.61, 28.1)
    # Relative paths start at the folder of the table.
    assert (full.psf, full.detectors, full.image_type) == (str(tmp_path / "psf.fits"), ("R22_S11", "R22_S12"), "deep")
    assert (plain.field, full.field, full.survey) == (1, 2, "lsst")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "columns ra, dec are missing"),
        (HEAD.replace(",dec", "") + "\n", "column dec is missing"),
        (f"{HEAD},colour\n{ROW},red\n", "column colour is unknown"),
        (f"# one\n# two\n{HEAD}\n{ROW}\n{ROW.replace('20.5', 'x')}\n", "line 5: dec = 'x' must be a number in degrees"),
        (f"{HEAD}\n{ROW.replace('20.5', '90.1')}\n", "line 2: dec = 90.1 is outside [-90.0, 90.0]"),
        (f"{HEAD}\n{ROW.replace('20.5', 'nan')}\n", "line 2: dec = nan is outside"),
        (f"{HEAD}\n{ROW.replace('EXT', 'RADIO')}\n", "line 2: channel = 'RADIO'"),
        (f"{HEAD}\n{ROW.replace('lsstcam', 'vis')}\n", "line 2: camera: channel EXT has no camera 'vis'"),
        (f"{HEAD}\n{ROW.replace('lsst_r', 'lsst_q')}\n", "line 2: camera lsstcam has no band 'lsst_q'"),
        (f"{HEAD},image_type\n{ROW},art\n", "line 2: image_type = 'art'"),
        (f"{HEAD},seeing\n{ROW},0\n", "line 2: seeing = 0.0 is outside"),
        (f"{HEAD}\nEXT,lsstcam,lsst_r\n", "line 2: ra is missing"),
        (f"{HEAD}\n{ROW}\n" + "\n" * 2_000_000, "more than 2000000 lines"),
        (f"{HEAD}{',ra' * 7000}\n{ROW}\n", "one of more than 20000 characters"),
    ],
)
def test_errors_name_the_line(tmp_path, text, words):
    with pytest.raises(BadInput, match=r"pointings\.csv") as caught:
        read(tmp_path, text)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def survey_of(name, number, seed=3, **changes):
    block = Observation(("EXT",), survey=name, exposures=number, **changes)
    area = Area(ra=60.0, dec=-35.0, radius=2.0) if name != "cfis" else Area(ra=200.0, dec=40.0, radius=2.0)
    return [*ground_surveys.exposures(block, area, MISSION, seed, 60500.0)]


@nightly.parametrize(("name", "error"), [("des", 3.0), ("lsst", 0.0), ("cfis", 0.0)], (0, 2))
def test_surveys_observe_at_night_with_pointing_errors(name, error):
    found = survey_of(name, 30)
    table = planned_exposures.table(found, [MISSION] * len(found))
    assert max(table["airmass"].to_pylist()) <= 2.0
    assert (np.diff([one.mjd for one in found]) > 0).all()
    # The pointings of bands that are observed together differ only by the pointing errors.
    if name == "des":
        first, second = (np.array([(e.ra, e.dec) for e in found if e.band == band]) for band in ("des_g", "des_r"))
        apart = 3600.0 * (first - second) * np.stack([np.cos(np.radians(first[:, 1])), np.ones(len(first))], axis=1)
        assert np.std(apart) == pytest.approx(error * np.sqrt(2.0), rel=0.35)
    dated = survey_of(name, 30, mjd=60500.0)
    assert dated[0].mjd == 60500.0
    assert dated[1].mjd == pytest.approx(60500.0 + (dated[0].exposure_time_s + 30.0) / 86400.0)


@pytest.mark.parametrize(("name", "camera", "band"), [("lsst", "lsstcam", "lsst_y"), ("whigs", "hsc", "hsc_g")])
def test_bands_outside_the_challenge_can_be_planned(name, camera, band):
    found = survey_of(name, 5, bands=(band,))
    assert {(one.camera, one.band) for one in found} == {(camera, band)}
    assert len(found) == 5
    table = planned_exposures.table(found, [MISSION] * len(found))
    assert (np.diff(table["mjd"].to_numpy()) > 0).all()
    assert min(table["sky"].to_pylist()) > 0.0


def test_warning_about_dates_in_daylight():
    """Compare the Sun's altitude with astropy."""
    none = survey_of("lsst", 4, bands=("lsst_r",))
    assert ground_surveys.daylight_warning(none, MISSION) == ""
    # 11:30 local time.
    dated = [replace(one, mjd=60500.68 if i else one.mjd) for i, one in enumerate(none[:2])]
    dated.append(replace(dated[1], image_type="flat"))
    line = ground_surveys.daylight_warning(dated, MISSION)
    where = EarthLocation.from_geodetic(-70.7494, -30.2446, 2663.0)
    when = Time(60500.68, format="mjd")
    high = get_sun(when).transform_to(AltAz(obstime=when, location=where)).alt.deg
    assert line.startswith("EXT: 1 of 2 exposures of the sky have dates when the Sun is above -12 deg")
    assert float(re.search(r"the Sun at ([+-]\d+) deg", line)[1]) == pytest.approx(high, abs=0.8)
    assert "\n" not in line


def test_seeing_is_drawn_for_each_exposure():
    """Log-normal about the survey's median; the same for the same exposure, whatever the other exposures are."""
    found = survey_of("lsst", 300)
    found = [one for one in found if one.band == "lsst_r"]
    seeing = np.array(planned_exposures.table(found, [MISSION] * len(found), seed=5)["seeing"])
    assert np.median(seeing) == pytest.approx(0.62, rel=0.05)
    assert np.std(np.log10(seeing)) == pytest.approx(0.09, rel=0.2)
    backwards = planned_exposures.table(found[::-1], [MISSION] * len(found), seed=5)["seeing"].to_pylist()
    assert backwards[::-1] == seeing.tolist()
    assert planned_exposures.table(found[:1], [MISSION], seed=6)["seeing"].to_pylist()[0] != seeing[0]
    still = resolve(overrides={"ext.lsstcam.seeing_scatter": (0.0, "dex")})
    assert set(planned_exposures.table(found, [still] * len(found))["seeing"].to_pylist()) == {0.62}
    own = [replace(found[0], seeing=1.4, zero_point=28.0, sky=5.0)]
    (row,) = planned_exposures.table(own, [MISSION]).to_pylist()
    assert (row["seeing"], row["zero_point"], row["sky"]) == (1.4, 28.0, 5.0)
    with pytest.raises(BadInput, match=r"seeing of ext\.lsstcam in lsst_r .*arcsec = 0.1\d+ is outside"):
        planned_exposures.table([replace(found[0], seeing=0.1)], [MISSION])
    own = replace(found[0], seeing=0.1, psf="own.psf")
    assert planned_exposures.table([own], [MISSION])["seeing"].to_pylist() == [0.1]


def test_a_row_without_a_date_is_observed_at_night(tmp_path):
    """The field is near the Sun on the first date, where zodiacal light would be 20 times a dark sky."""
    (bare,) = read(tmp_path, "channel,camera,band,ra,dec\nEXT,lsstcam,lsst_r,100.0,20.0\n")
    site = ground_surveys.Site.from_mission("ext.lsstcam", MISSION)
    assert site.altitude(bare.ra, bare.dec, bare.mjd) > 29.0
    (row,) = planned_exposures.table([bare], [MISSION]).to_pylist()
    assert 32.95 < row["sky"] < 150.0


def test_exposure_times_of_the_bands_of_a_survey(tmp_path):
    """CFIS: 80 s in u and 200 s in r, both for its pattern and for a table of pointings."""
    seconds = {one.band: one.exposure_time_s for one in survey_of("cfis", 4)}
    assert seconds == {"cfis_u": 80.0, "cfis_r": 200.0}
    assert {one.exposure_time_s for one in survey_of("cfis", 4, exposure_time_s=60.0)} == {60.0}
    path = tmp_path / "cfis.csv"
    path.write_text("ra,dec,band\n200.0,40.0,cfis_u\n200.0,40.0,cfis_r\n")
    rows = ground_surveys.read(path, Observation(("EXT",), survey="cfis"), MISSION)
    assert {row.band: row.exposure_time_s for row in rows} == seconds
