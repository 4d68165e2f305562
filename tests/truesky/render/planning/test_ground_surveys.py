"""Exposures of ground surveys, and tables of pointings; errors name the line of the table."""

import re
from dataclasses import replace

import numpy as np
import pytest
from astropy.coordinates import AltAz, EarthLocation, SkyCoord, get_body, get_sun
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


def survey_of(name, number, seed=3, start=60500.0, **changes):
    block = Observation(("EXT",), survey=name, exposures=number, **changes)
    area = Area(ra=60.0, dec=-35.0, radius=2.0) if name != "cfis" else Area(ra=200.0, dec=40.0, radius=2.0)
    return [*ground_surveys.exposures(block, area, MISSION, seed, start)]


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


def test_warnings_about_impossible_dates():
    """Compare the Sun's altitude with astropy."""
    none = survey_of("lsst", 4, start=60850.0, bands=("lsst_r",))
    assert list(ground_surveys.date_warnings(none, MISSION)) == []
    # 11:30 local time.
    dated = [replace(one, mjd=60850.68 if i else one.mjd) for i, one in enumerate(none[:2])]
    dated.append(replace(dated[1], image_type="flat"))
    (line,) = (line for line in ground_surveys.date_warnings(dated, MISSION) if "Sun" in line)
    where = EarthLocation.from_geodetic(-70.7494, -30.2446, 2663.0)
    when = Time(60850.68, format="mjd")
    high = get_sun(when).transform_to(AltAz(obstime=when, location=where)).alt.deg
    assert line.startswith("EXT: 1 of 2 exposures of the sky have dates when the Sun is above -8 deg")
    assert float(re.search(r"the Sun at ([+-]\d+) deg", line)[1]) == pytest.approx(high, abs=0.8)
    assert "\n" not in line
    # At the antipodes of the field's meridian, the field is below the horizon. LSSTCam was not there in 2024.
    low, early = replace(none[0], mjd=none[0].mjd + 0.5), replace(none[0], mjd=60500.2)
    lines = list(ground_surveys.date_warnings([low, early], MISSION))
    assert any("2 exposures of the sky have dates when the field is lower than 19 deg" in line for line in lines)
    assert "1 of 2 exposures of the sky have dates before first light of the camera" in lines[-1]


FIRST_LIGHT = {"lsstcam": "2025-04-15", "jpcam": "2020-06-29", "megacam": "2003-01-10", "decam": "2012-09-12"}


@pytest.mark.parametrize(
    ("survey", "camera", "band"),
    [
        ("lsst", "lsstcam", "lsst_u"), ("lsst", "lsstcam", "lsst_r"), ("cfis", "megacam", "cfis_u"),
        ("cfis", "megacam", "cfis_r"), ("jedis", "jpcam", "jedis_g"), ("des", "decam", "des_z"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("ra", [40.0, 190.0])
def test_exposures_without_a_date_have_a_dark_sky(survey, camera, band, ra):
    """Astropy gives Sun and Moon: the Moon is down in blue bands, and down or less than 40 % lit in red bands."""
    site = ground_surveys.Site.from_mission(f"ext.{camera}", MISSION)
    place = (ra, float(np.clip(site.latitude + 15.0, -60.0, 50.0)))
    block = Observation(("EXT",), survey=survey, ra=place[0], dec=place[1], bands=(band,), exposures=3, dither="none")
    start = ground_surveys.earliest_date(camera, MISSION)
    dates = [one.mjd for one in ground_surveys.exposures(block, Area(ra=0.0, dec=0.0, radius=1.0), MISSION, 3, start)]
    dates.append(ground_surveys.first_date(("EXT", camera), band, place, MISSION))
    where = EarthLocation.from_geodetic(site.longitude, site.latitude, site.height)
    for mjd in dates:
        when = Time(mjd, format="mjd")
        assert mjd >= max(60126.0, Time(FIRST_LIGHT[camera]).mjd)
        frame = AltAz(obstime=when, location=where)
        moon, sun = (get_body(name, when, where) for name in ("moon", "sun"))
        assert sun.transform_to(frame).alt.deg < -17.5
        phase = np.arctan2(
            sun.distance * np.sin(sun.separation(moon)),
            moon.distance - sun.distance * np.cos(sun.separation(moon)),
        )
        lit = 0.5 * (1.0 + np.cos(phase.value))
        field = SkyCoord(*place, unit="deg")
        if moon.transform_to(frame).alt.deg > -1.0:
            assert band not in ("lsst_u", "cfis_u", "jedis_g")
            assert lit < 0.41
            assert field.separation(SkyCoord(moon.ra, moon.dec)).deg > 29.0
        assert field.transform_to(frame).secz < 1.3


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
    with pytest.raises(BadInput, match=r"seeing of ext\.lsstcam in lsst_r .*arcsec = 0\.\d+ is outside"):
        planned_exposures.table([replace(found[0], seeing=0.1)], [MISSION])
    own = replace(found[0], seeing=0.1, psf="own.psf")
    assert planned_exposures.table([own], [MISSION])["seeing"].to_pylist() == [0.1]


def test_clouds_dim_the_zero_point(tmp_path):
    """By the extinction of the column `clouds`, for surveys and tables of pointings; sky and seeing do not change."""
    clear, cloudy = (survey_of("lsst", 6, start=60850.0, bands=("lsst_r",), clouds=mag) for mag in (0.0, 0.5))
    rows = [planned_exposures.table(one, [MISSION] * 6, seed=5).to_pylist() for one in (clear, cloudy)]
    extinctions = [row["clouds"] for row in rows[1]]
    assert len(set(extinctions)) == 6
    assert 0.1 < np.mean(extinctions) < 0.9
    for without, with_clouds in zip(*rows, strict=True):
        assert without["clouds"] == 0.0
        assert with_clouds["zero_point"] == pytest.approx(without["zero_point"] - with_clouds["clouds"], abs=1e-12)
        assert {**with_clouds, "clouds": 0.0, "zero_point": 0.0} == {**without, "zero_point": 0.0}
    given = read(tmp_path, f"{HEAD},clouds,zero_point\n{ROW},0.3,28.0\n{ROW},,\n")
    table = planned_exposures.table(given, [MISSION] * 2).to_pylist()
    assert table[0]["zero_point"] == pytest.approx(28.0 - table[0]["clouds"])
    assert table[0]["clouds"] > 0.0
    assert table[1]["clouds"] == 0.0
    with pytest.raises(BadInput, match=r"line 2: clouds = 6\.0 is outside 0 to 5"):
        read(tmp_path, f"{HEAD},clouds\n{ROW},6\n")


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
