"""Camera-specific headers, with which software of the observatories identifies raw frames and trims them."""

import re
import subprocess
from dataclasses import replace
from functools import cache

import astropy.units as u
import numpy as np
import pytest
from astro_metadata_translator import PROPERTIES, DecamTranslator, HscTranslator, MegaPrimeTranslator, ObservationInfo
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.io import fits
from astropy.time import Time
from astropy.utils import iers

from lake_schema.fits import images, joined
from tests.truesky.render import fields
from tests.truesky.render.fields import MISSION
from tests.truesky.render.products import lsst_translator
from tests.truesky.render.products import test_tools as tools
from truesky.render.camera import bands
from truesky.render.camera.detectors import detectors
from truesky.render.products import camera_cards, exposure_files, fits_files, raw_pointing
from truesky.render.sky import observatory
from truesky.request.accuracy import SURVEY

# Some of the numbers of DECam's CCDs.
NUMBERS = {"S29": 1, "S25": 4, "S1": 25, "S4": 28, "S7": 31, "N1": 32, "N4": 35, "N30": 61, "N31": 62}


def ends(text):
    """First and last column and row of a section, in the order in which it lists them."""
    x0, x1, y0, y1 = map(int, re.fullmatch(r"\[(\d+):(\d+),(\d+):(\d+)\]", text).groups())
    return (x0, x1), (y0, y1)


@pytest.fixture(scope="module")
def decam(tmp_path_factory):
    field = tools.written("decam", tmp_path_factory.mktemp("decam"), sky=5.0)
    with fits.open(field.path) as units:
        return field.one, units[0].header, units[0].data


def test_a_ccd_has_its_number_and_its_name(decam):
    one, header, _ = decam
    names = [detector.name for detector in detectors("decam", MISSION)]
    assert len(names) == 62
    assert {name: names.index(name) + 1 for name in NUMBERS} == NUMBERS
    assert header["CCDNUM"] == names.index(one.detector.name) + 1
    assert (header["DETPOS"], header["OBSTYPE"], header["INSTRUME"]) == (one.detector.name, "object", "DECam")
    assert header["EXPNUM"] == one.exposure.exposure_id


def test_sections_of_both_amplifiers_cover_the_frame(decam):
    """Each pixel belongs to one section of one amplifier, except for the corners of the overscans."""
    one, header, pixels = decam
    seen = np.zeros(pixels.shape, int)
    for letter in "AB":
        assert header[f"TRIMSEC{letter}"] == header[f"DATASEC{letter}"]
        for key in ("DATASEC", "PRESEC", "BIASSEC", "POSTSEC"):
            seen[tools.window(header[f"{key}{letter}"])] += 1
    assert seen.max() == 1
    layout = one.scene.layout
    assert (seen == 0).sum() == layout.overscan_rows * layout.scan_columns * 2
    data = np.zeros(pixels.shape, bool)
    data[tools.window(header["DATASEC"])] = True
    for letter in "AB":
        assert data[tools.window(header[f"DATASEC{letter}"])].all()
        assert not data[tools.window(header[f"POSTSEC{letter}"])].any()
    # Pixels outside the detector have no light.
    sky = np.median(pixels[tools.window(header["DATASECA"])])
    for letter in "AB":
        level = np.median(pixels[tools.window(header[f"BIASSEC{letter}"])])
        for key in ("PRESEC", "POSTSEC"):
            assert abs(np.median(pixels[tools.window(header[f"{key}{letter}"])]) - level) < 0.1 * (sky - level)


def test_the_mosaic_is_of_both_amplifiers(decam):
    _, header, _ = decam
    whole, (a, b) = ends(header["DETSEC"]), (ends(header[f"DETSEC{letter}"]) for letter in "AB")
    along = [axis for axis in (0, 1) if a[axis] != b[axis]]
    assert len(along) == 1
    assert {*a[along[0]], *b[along[0]]} >= {min(whole[along[0]]), max(whole[along[0]])}
    assert a[1 - along[0]] == b[1 - along[0]] == whole[1 - along[0]]


def test_amplifiers_are_read_from_their_own_sides(decam):
    """In headers of raw frames of S1, AMPSECA is [2048:1025,4096:1] and AMPSECB is [1:1024,4096:1]."""
    _, header, _ = decam
    assert header["DETPOS"].startswith("S")
    (a, rows), (b, _) = (ends(header[f"AMPSEC{letter}"]) for letter in "AB")
    assert b[0] < b[1] < a[1] < a[0]
    assert rows[0] > rows[1]


def test_values_of_each_amplifier(decam):
    one, header, _ = decam
    for key, unit, name in (("gain", "electron / adu", "GAIN"), ("read_noise", "electron", "RDNOISE")):
        values = np.broadcast_to(one.scene.amplifier_values(key, unit), 2)
        assert values[0] != values[1]
        np.testing.assert_allclose([header[f"{name}{letter}"] for letter in "AB"], values)
    assert header["SATURATE"] == min(header["SATURATA"], header["SATURATB"])
    assert 30_000.0 < header["SATURATE"] < 65_535.0


def test_other_cameras_have_no_such_cards():
    assert camera_cards.cards(tools.stars_on("jpcam", 0.05)) == ()


# Two CCDs of each camera with their numbers and names in the headers of the observatories.
CCDS = {
    ("decam", "S25"): (4, "S25"), ("decam", "N31"): (62, "N31"), ("hsc", "1_53"): (0, "1_53"),
    ("hsc", "0_30"): (16, "0_30"), ("megacam", "ccd02"): (2, "ccd02"), ("megacam", "ccd14"): (14, "ccd14"),
    ("lsstcam", "R01_S00"): (0, "R01_S00"), ("lsstcam", "R22_S11"): (94, "R22_S11"),
}  # fmt: skip
CAMERAS = tuple(dict.fromkeys(camera for camera, _ in CCDS))
# Rafts (row, column) of LSSTCam without science sensors.
CORNERS = ((0, 0), (0, 4), (4, 0), (4, 4))
# Instrument, filter and observation identifier.
WORDS = {
    "decam": ("DECam", "r DECam SDSS c0002 6415.0 1480.0", "ct4m20250818t071200"),
    "hsc": ("HSC", "HSC-Z", "HSCE00134567"),
    "megacam": ("MegaPrime", "r.MP9602", "134567"),
    "lsstcam": ("LSSTCam", "r_57", "MC_S_20250817_030727"),
}
# Properties that the translator of a camera reads from no keyword.
UNKNOWN = {"decam": {"altaz_end"}, "hsc": {"altaz_end"}, "megacam": {"altaz_end", "detector_group"}, "lsstcam": set()}
# Air pressure in real headers of each camera, hPa.
PRESSURES = {"decam": 779.0, "hsc": 621.7, "megacam": 617.65, "lsstcam": 742.1}
# Values of some keywords of real headers.
REAL = {
    "decam": {
        "OBSID": "ct4m20130901t060255", "TELRA": "02:51:16.790", "TELDEC": "-00:00:05.699", "ZD": 50.46, "AZ": 61.24,
        "OBS-LONG": 70.81489, "OBS-LAT": -30.16606, "OBS-ELEV": 2215.0, "EXPREQ": 200.0, "DARKTIME": 201.15662,
        "EXPNUM": 160496, "CCDNUM": 25, "DETPOS": "S25", "OUTTEMP": 11.9, "PRESSURE": 779.0, "HUMIDITY": 23.0,
        "OBSTYPE": "object", "FILTER": "z DECam SDSS c0004 9260.0 1520.0",
    },
    "hsc": {
        "EXP-ID": "HSCE00123456", "FRAMEID": "HSCA90402512", "DET-ID": 50, "T_CCDSN": "120", "FILTER01": "HSC-i",
        "DATA-TYP": "OBJECT", "UT-STR": "06:15:55.908", "UT-END": "06:16:27.928", "MJD": 56598.261,
        "RA2000": "21:22:59.982", "DEC2000": "+00:30:00.07", "INST-PA": 0.0, "ALTITUDE": 63.04, "AZIMUTH": 226.7,
        "OUT-TMP": 272.35, "OUT-HUM": 33.1, "OUT-PRS": 621.7, "FOC-VAL": 3.7,
    },
    "megacam": {
        "EXPNUM": 1038843, "OBSID": 1038843, "OBSTYPE": "OBJECT", "EXPREQ": 615.0, "DARKTIME": 615.0,
        "UTC-OBS": "14:33:32.400", "RA_DEG": 135.409417, "DEC_DEG": -2.4, "TELALT": 52.02, "TELAZ": 122.34,
        "LATITUDE": 19.825252, "LONGITUD": -155.468876, "TEMPERAT": 0.9, "RELHUMID": 39.77, "PRESSURE": 617.65,
        "FILTER": "i.MP9702", "EXTNAME": "ccd02",
    },
    "lsstcam": {
        "OBSID": "MC_O_20250609_000578", "DAYOBS": "20250609", "SEQNUM": 578, "IMGTYPE": "OBJECT", "CONTRLLR": "O",
        "DATE-BEG": "2025-06-10T07:31:55.280", "MJD-BEG": 60836.3, "DATE-END": "2025-06-10T07:32:26.229",
        "DATE": "2025-06-10T07:32:26.225", "RASTART": 320.6, "DECSTART": -17.94, "ELSTART": 67.99, "AZSTART": 60.27,
        "ELEND": 68.09, "AZEND": 60.07, "ROTPA": 131.4, "TRACKSYS": "RADEC", "VIGN_MIN": "NO", "FILTER": "y_10",
        "AIRTEMP": 9.7, "PRESSURE": 74210.0, "HUMIDITY": 11.2, "FOCUSZ": -3.2, "SHUTTIME": 30.0, "DARKTIME": 30.9,
    },
}  # fmt: skip


@cache
def frame(camera, name, kind="science", exact=True, **columns):
    """Return a small frame for tests of its cards, with the pixels of a bias frame: they need no PSF and no sources."""
    none, band = fields.galaxies([], []), tools.BANDS[camera]
    exposed = {
        "channel": "EXT", "camera": camera, "band": band, "exposure_id": 134567, "image_type": "bias", "ra": 53.1,
        "dec": -27.8, "position_angle": 12.0, "mjd": 60905.3, "exposure_time_s": 90.0, "airmass": 1.37, **columns,
    }  # fmt: skip
    tables = none, fields.fluxes(none, band, 0.0), fields.stars([], []), fields.fluxes(none, band, 0.0)
    one = fields.rendered(exposed, fields.small(camera, name, 64), tables, tools.SURE if exact else MISSION, SURVEY)
    seconds = 0.0 if kind == "bias" else 90.0
    return replace(
        one, exposure=replace(one.exposure, image_type=kind), scene=replace(one.scene, exposure_time_s=seconds)
    )


def header_of(one):
    """Return the header of the first image in the file of a detector."""
    (unit,) = fits_files._science_images(one)
    cards = raw_pointing.cards(unit.cards, one.exposure, one.detector, one.scene.mission, one.seed)
    return images.primary_hdu(replace(unit, cards=cards)).header


def translated(one):
    """Return the properties that the translator of the observatory reads; it raises if it cannot read one."""
    translator = lsst_translator.LsstCamTranslator if one.exposure.camera == "lsstcam" else None
    return ObservationInfo(header_of(one), translator_class=translator, pedantic=True)


@pytest.mark.parametrize("kind", ["science", "flat", "dark", "bias"])
@pytest.mark.parametrize(("camera", "name"), CCDS)
def test_translators_read_every_property(camera, name, kind):
    found = translated(frame(camera, name, kind))
    assert len(PROPERTIES) == 40
    # A flat of MegaPrime may be of the sky or of a lamp. Flats and bias frames of LSSTCam have no position.
    unclear = {("megacam", "flat"): {"can_see_sky"}} | {("lsstcam", k): {"tracking_radec"} for k in ("flat", "bias")}
    unknown = {key for key in PROPERTIES if getattr(found, key) is None}
    assert unknown == UNKNOWN[camera] | unclear.get((camera, kind), set())
    types = {"science": "science", "flat": "flat", "dark": "dark", "bias": "bias"}
    types |= {"decam": {"flat": "dome flat", "bias": "zero"}, "hsc": {"flat": "domeflat"}}.get(camera, {})
    assert found.observation_type == types[kind]
    assert bool(found.can_see_sky) == (kind == "science")


@pytest.mark.parametrize(("camera", "name"), CCDS)
def test_translated_properties_are_those_of_the_plan(camera, name):
    one = frame(camera, name)
    row, found = one.exposure, translated(one)
    start = Time(row.mjd, format="mjd", scale="utc")
    assert abs(found.datetime_begin - start).to_value("s") < 1e-3
    assert abs(found.datetime_end - start).to_value("s") == pytest.approx(row.exposure_time_s, abs=1e-3)
    for key in ("exposure_time", "exposure_time_requested", "dark_time"):
        assert getattr(found, key).to_value("s") == row.exposure_time_s
    assert found.tracking_radec.separation(SkyCoord(row.ra, row.dec, unit="deg")).arcsec < 0.1
    assert found.boresight_airmass == row.airmass
    assert (found.detector_num, found.detector_unique_name) == CCDS[camera, name]
    assert (found.instrument, found.physical_filter, found.observation_id) == WORDS[camera]
    assert found.exposure_id == found.visit_id == (2025081730727 if camera == "lsstcam" else row.exposure_id)
    assert found.object == header_of(one)["OBJECT"]
    # DECam and MegaPrime cannot be rotated. The y axis of the pipelines of DECam and HSC points east and west (90 and
    # 270 deg) where the position angle is 0.
    angle = {"decam": 90.0, "megacam": 0.0, "hsc": 270.0 + row.position_angle}.get(camera, row.position_angle)
    assert found.boresight_rotation_angle.deg == pytest.approx(angle, abs=1e-9)


@pytest.mark.parametrize("camera", CAMERAS)
def test_translated_place_and_weather(camera):
    """They agree with astropy (direction), the mission database (place) and real headers (weather)."""
    one = frame(camera, *(name for key, name in list(CCDS)[::2] if key == camera))
    found, row = translated(one), one.exposure
    site = EarthLocation.from_geodetic(*(
        one.scene.mission.value(f"ext.{camera}.site.{key}", unit)
        for key, unit in (("longitude", "deg"), ("latitude", "deg"), ("height", "m"))
    ))  # fmt: skip
    metres = [(getattr(found.location, axis) - getattr(site, axis)).to_value("m") for axis in "xyz"]
    assert np.linalg.norm(metres) < 1000.0
    with iers.conf.set_temp("auto_download", False):
        real = SkyCoord(row.ra, row.dec, unit="deg").transform_to(AltAz(obstime=found.datetime_begin, location=site))
    seen = found.altaz_begin
    if camera in ("decam", "lsstcam"):
        assert SkyCoord(seen.az, seen.alt).separation(SkyCoord(real.az, real.alt)).deg < 0.2
    else:
        # The field is below the horizon of Maunakea at this date. It is highest in the south.
        assert real.alt.deg < 10.0
        assert seen.az.deg == 180.0
        assert seen.alt.deg == pytest.approx(90.0 - site.lat.deg + row.dec, abs=0.01)
    assert found.pressure.to_value("hPa") == pytest.approx(PRESSURES[camera], rel=0.01)
    assert found.temperature.to_value("deg_C", equivalencies=u.temperature()) == pytest.approx(7.0)
    assert found.relative_humidity == 40.0


# Real headers: boresight, start (UTC; LSSTCam: TAI), altitude and azimuth.
DIRECTIONS = {
    "decam": (42.81996, -0.00158, "2013-09-01T06:02:55.754", 90.0 - 50.46, 61.24),
    "hsc": (320.74993, 0.50002, "2013-11-02T06:15:55.908", 63.0436, 226.6892),
    "megacam": (135.40942, -2.4, "2008-11-01T14:33:32.4", 52.02, 122.34),
    "lsstcam": (320.6, -17.94, "2025-06-10T07:31:55.280", 67.99, 60.27),
}


@pytest.mark.parametrize("camera", CAMERAS)
def test_directions_are_those_of_real_headers(camera):
    """The error is 0.2 deg of a great circle, because precession is neglected."""
    ra, dec, start, altitude, azimuth = DIRECTIONS[camera]
    mjd = Time(start, scale="tai" if camera == "lsstcam" else "utc").utc.mjd
    site = observatory.Site.from_mission(f"ext.{camera}", MISSION)
    up, along = observatory.altitude_and_azimuth(ra, dec, mjd, site)
    assert SkyCoord(along, up, unit="deg").separation(SkyCoord(azimuth, altitude, unit="deg")).deg < 0.2


@pytest.mark.parametrize("camera", CAMERAS)
def test_cards_have_the_form_of_real_ones(camera):
    """The types are equal. Texts with numbers have digits, and other characters, at the same places."""
    header = header_of(frame(camera, *(name for key, name in list(CCDS)[::2] if key == camera)))
    for key, real in REAL[camera].items():
        assert type(header[key]) is type(real), key
        if isinstance(real, str) and any(mark in real for mark in ":0123456789") and "FILTER" not in key:
            assert re.sub(r"\d", "0", header[key]).replace("_S_", "_O_")[1:] == re.sub(r"\d", "0", real)[1:], key


def test_raw_pointings_have_the_error_of_the_header():
    """All cards have the same boresight, which includes the pointing error."""
    one = frame("decam", "S25", exact=False)
    header, found = header_of(one), translated(one).tracking_radec
    raw, true = (SkyCoord(ra, dec, unit="deg") for ra, dec in ((header["RA"], header["DEC"]), (53.1, -27.8)))
    assert found.separation(raw).arcsec < 0.02
    assert found.separation(true).arcsec > 0.5


def test_detector_numbers_do_not_depend_on_the_layout():
    """One CCD of HSC does not work, and the standard layout leaves it out: the numbers of the others stay."""
    names = [detector.name for detector in detectors("hsc", MISSION)]
    assert "1_47" not in names
    assert names.index("0_30") == 15
    assert translated(frame("hsc", "0_30")).detector_num == 16


def test_every_ccd_has_the_number_of_the_observatory():
    """All CCDs of DECam and HSC that work, and all of MegaCam and LSSTCam, whose numbers follow from their names."""
    rafts = [f"R{row}{column}" for row in range(5) for column in range(5) if (row, column) not in CORNERS]
    numbers = {
        "decam": {name: number - 1 for number, name in DecamTranslator.detector_names.items()} | {"N30": 60},
        "hsc": {name: number for number, name in enumerate(HscTranslator._DETECTOR_NUM_TO_UNIQUE_NAME)},
        "megacam": {f"ccd{number:02d}": number for number in range(40)},
        "lsstcam": {f"{raft}_S{n // 3}{n % 3}": 9 * i + n for i, raft in enumerate(rafts) for n in range(9)},
    }
    for camera, expected in numbers.items():
        one = frame(camera, *(name for key, name in list(CCDS)[::2] if key == camera))
        for detector in detectors(camera, MISSION):
            assert camera_cards._detector_number(replace(one, detector=detector)) == expected[detector.name]


def test_sensors_of_a_users_layout_may_have_any_name(monkeypatch):
    one = frame("lsstcam", "R22_S11")
    spare = replace(one.detector, name="spare")
    monkeypatch.setattr(camera_cards.detectors, "detectors", lambda camera, mission: (spare,))
    cards = {key: value for key, value, _ in camera_cards.cards(replace(one, detector=spare))}
    assert [cards[key] for key in ("RAFTBAY", "CCDSLOT", "CHIPID", "DETNUM")] == ["", "spare", "spare", 189]


def test_identifiers_of_hsc_images_are_those_of_real_headers():
    """Real images of two exposures, 904024 and 40900, which are the first of two numbers for an exposure each."""
    assert camera_cards._frame_identifier(904_024 // 2, "1_12", 50) == "HSCA90402512"
    assert camera_cards._frame_identifier(40_900 // 2, "1_07", 37) == "HSCA04090107"


def test_identifiers_of_hsc_images_differ():
    names = [detector.name for detector in detectors("hsc", MISSION)]
    found = {camera_cards._frame_identifier(n, name, 0) for n in (0, 1, 2, 499_999, 500_000) for name in names}
    assert len(found) == 5 * len(names)
    assert all(re.fullmatch(r"HSC[A-Z]\d{8}", text) for text in found)
    assert camera_cards._frame_identifier(3, "spare", 112) == "HSCA00000712"


@pytest.mark.parametrize(
    ("value", "decimals", "plus", "text"),
    [
        (23.99999999, 3, "", "00:00:00.000"),
        (-0.5, 2, "+", "-00:30:00.00"),
        (89.99999999, 2, "+", "+90:00:00.00"),
        (2.8546639, 3, "", "02:51:16.790"),
    ],
)
def test_sexagesimal_numbers(value, decimals, plus, text):
    assert camera_cards._sexagesimal(value, decimals, plus) == text


def test_lsst_counts_exposures_of_a_night_in_15_bits():
    header = header_of(frame("lsstcam", "R22_S11", exposure_id=1_200_003))
    assert (header["SEQNUM"], header["OBSID"]) == (26067, "MC_S_20250817_026067")


# Nights and SEQNUM for which obs_lsst corrects headers of LSSTCam (translators/lsstCam.py, fix_header): position angle,
# shutter, filter z instead of y, filter i.
CORRECTED = {20250422: (0, 250), 20250705: (1, 736), 20250715: (205, 1218), 20250609: (76, 578), 20250819: (4, 1052)}


@pytest.mark.parametrize("exposure_id", [0, 1, 300, 22_767, 22_768, 100_000])
def test_lsst_exposures_are_not_mistaken_for_real_ones(exposure_id):
    number = header_of(frame("lsstcam", "R22_S11", exposure_id=exposure_id))["SEQNUM"]
    assert all(not first <= number <= last for first, last in CORRECTED.values())
    assert 10_000 <= number < 2**15


# Noon 12 h behind TAI, at which the nights of 2 March and 22 April 2025 begin.
NIGHTS = 60736.5, 60787.5


@pytest.mark.parametrize("angle", [0.0, 12.0, 270.0])
@pytest.mark.parametrize("mjd", [NIGHTS[0] - 0.01, NIGHTS[0] + 0.01, NIGHTS[1] - 0.01, NIGHTS[1] + 0.01])
def test_lsst_rotations_are_right_after_the_corrections_of_obs_lsst(mjd, angle):
    """Its corrections of real headers of the first nights also apply to simulated frames."""
    one = frame("lsstcam", "R22_S11", mjd=mjd, position_angle=angle)
    day = int(header_of(one)["DAYOBS"])
    assert (20250301 < day < 20250422) == (NIGHTS[0] < mjd < NIGHTS[1])
    assert translated(one).boresight_rotation_angle.wrap_at("360d").deg == pytest.approx(angle, abs=1e-9)


# Filters of the passbands in obs_decam, obs_subaru, obs_cfht and obs_lsst, which HSC spells in capitals. HSC has the
# filters r and i of 2016 (R2, I2), and MegaCam the filters u and r of 2015.
FILTERS = {
    "des_g": "g DECam SDSS c0001 4720.0 1520.0", "des_r": "r DECam SDSS c0002 6415.0 1480.0",
    "des_i": "i DECam SDSS c0003 7835.0 1470.0", "des_z": "z DECam SDSS c0004 9260.0 1520.0",
    "hsc_g": "HSC-G", "hsc_r": "HSC-R2", "hsc_i": "HSC-I2", "hsc_z": "HSC-Z", "hsc_y": "HSC-Y",
    "cfis_u": "u.MP9302", "cfis_r": "r.MP9602",
    "lsst_u": "u_24", "lsst_g": "g_6", "lsst_r": "r_57", "lsst_i": "i_39", "lsst_z": "z_20", "lsst_y": "y_10",
}  # fmt: skip


@pytest.mark.parametrize("camera", CAMERAS)
def test_every_band_has_the_filter_of_the_observatory(camera):
    one = frame(camera, *(name for key, name in list(CCDS)[::2] if key == camera))
    names = {
        band: translated(replace(one, exposure=replace(one.exposure, band=band))).physical_filter
        for band in bands.ground_bands(camera, MISSION)
    }
    assert names == {band: FILTERS[band.replace("lsst2016", "lsst")] for band in names}
    assert names


def test_filters_of_users_keep_their_names():
    one = frame("decam", "S25")
    header = header_of(replace(one, exposure=replace(one.exposure, band="narrow")))
    assert header["FILTER"] == header["BAND"] == "narrow"
    assert header_of(one)["BAND"] == "des_r"


def written(one, folder, rice=False):
    """Write the science image of a detector and return its path."""
    rows, writers = fits_files.products(one, (), rice)
    path = folder / f"{one.detector.name}.fits"
    writers[rows["path"][0].as_py()](path)
    return path


@pytest.mark.parametrize("rice", [False, True])
@pytest.mark.parametrize("camera", ["decam", "megacam"])
def test_translators_find_the_detectors_in_the_file_of_an_exposure(camera, rice, tmp_path):
    """The software of DECam reads the primary header, and the software of MegaPrime does not."""
    names = [name for key, name in CCDS if key == camera]
    files = [(name, written(frame(camera, name), tmp_path, rice)) for name in names]
    path = tmp_path / "exposure.fits"
    exposure_files._write(files, (), joined.no_cards, exposure_files._kept_keywords(camera), (), path)
    translator = {"decam": DecamTranslator, "megacam": MegaPrimeTranslator}[camera]
    found = [
        ObservationInfo(header, translator_class=translator, pedantic=True)
        for header in translator.determine_translatable_headers(str(path))
    ]
    assert [one.detector_num for one in found] == [CCDS[camera, name][0] for name in names]
    assert {(one.physical_filter, one.visit_id, one.exposure_time.to_value("s")) for one in found} == {
        (WORDS[camera][1], 134567, 90.0)
    }
    with fits.open(path) as units:
        assert ("TELESCOP" in units[1].header) == (camera == "megacam")
        assert [unit.header["EXTNAME"] for unit in units[1:]] == names


@pytest.mark.parametrize("rice", [False, True])
@pytest.mark.parametrize("camera", CAMERAS)
def test_files_follow_the_standard(camera, rice, tmp_path):
    path = written(frame(camera, *(name for key, name in list(CCDS)[::2] if key == camera)), tmp_path, rice)
    with fits.open(path, checksum=True) as units:
        units.verify("exception")
    done = subprocess.run([tools.tool("fitsverify", "HEASARC"), "-q", str(path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
