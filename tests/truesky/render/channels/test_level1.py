"""Names and cards of Euclid's level-1 files: those of public readers and of the public descriptions."""

import re
import warnings

import pytest
from astropy.time import Time

from lake_schema.fits import images
from lake_schema.mission.configuration import resolve
from tests.truesky.render.fields import exposure
from truesky.render.channels import level1

MISSION = resolve()
# Names of the raw frames of Q1: the page of IRSA about the release, with the time as [YYYYMMDD]T[HHMMSS.SSSSSS]Z.
Q1_NAME = re.compile(r"EUC_LE1_(VIS|NISP)-\d{5,}-\d+-D_\d{8}T\d{6}\.\d{6}Z(_\d\d)?\.fits")


def cards(**columns):
    found = level1.exposure_cards(exposure(**columns), 36, MISSION)
    assert len({keyword for keyword, *_ in found}) == len(found)
    with warnings.catch_warnings():
        # Comments are not truncated.
        warnings.simplefilter("error")
        assert len(images.cards_to_text(found).splitlines()) == len(found)
    return {keyword: value for keyword, value, _ in found}


def test_the_name_of_a_file_is_that_of_a_raw_frame():
    """The time and the observation are those of a real file: EUC_LE1_VIS-02370-1-W_20240701T001045.000000Z (VISQL)."""
    start = Time("2024-07-01T00:10:45", scale="utc").mjd
    named = level1.file_name(exposure(mjd=start, field=2370, visit=1, dither=1))
    assert re.sub(r"\.\d{6}Z", "", named) == "EUC_LE1_VIS-02370-1-D_20240701T001045.fits"
    assert float(re.search(r"45(\.\d{6})Z", named)[1]) < 1e-4
    assert Q1_NAME.fullmatch(named)
    spectrum = exposure(channel="NISP-S", camera="nisp", band="nisp_red", mjd=start, field=7, visit=3, dither=4)
    assert level1.file_name(spectrum).startswith("EUC_LE1_NISP-200007-4-D_20240701T001045.")
    alone = exposure(exposure_id=31, mjd=start)
    assert level1.file_name(alone).startswith("EUC_LE1_VIS-10000031-1-D_")
    repeated = level1.file_name(exposure(exposure_id=31, mjd=start, realisation=2))
    assert repeated == level1.file_name(alone).replace("Z.fits", "Z_02.fits")
    assert Q1_NAME.fullmatch(repeated)


def test_types_of_exposures():
    """VISQL sorts raw frames by IMG_T1: BIAS, DARK, FLAT, SURVEY, and names with CHARGE and TRAP."""
    keys = ("IMG_CAT", "IMG_T1", "IMG_T2", "OBSMODE", "OBSTYPE", "SEQID", "CI_STAT", "TP_STAT", "CUSTATUS")
    for columns, expected in (
        ({}, ("SCIENCE", "SURVEY", "SKY", "WIDE", "IMAGE", "NOMINAL", "Off", "Off", "Off")),
        ({"image_type": "deep"}, ("SCIENCE", "SURVEY", "SKY", "DEEP", "IMAGE", "NOMINAL", "Off", "Off", "Off")),
        ({"image_type": "bias"}, ("CALIB", "BIAS", "OTHER", "CALIBRATION", "IMAGE", "BIAS", "Off", "Off", "Off")),
        (
            {"image_type": "flat", "lamp": 2},
            ("CALIB", "FLAT", "LAMP", "CALIBRATION", "IMAGE", "FLAT", "Off", "Off", "On"),
        ),
        (
            {"image_type": "charge_injection"},
            ("CALIB", "CHARGE_INJ", "OTHER", "CALIBRATION", "IMAGE", "CHARGE_INJ", "On", "Off", "Off"),
        ),
        (
            {"image_type": "trap_pumping"},
            ("CALIB", "TRAP_PUMPING", "OTHER", "CALIBRATION", "IMAGE", "TRAP_PUMPING", "Off", "On", "Off"),
        ),
    ):
        found = cards(exposure_time_s=560.0, **columns)
        assert tuple(found[key] for key in keys) == expected
    assert cards(exposure_time_s=89.5)["SEQID"] == "SHORT"


def test_numbers_of_an_exposure():
    found = cards(
        field=12, visit=2, dither=3, mjd=61000.5, exposure_time_s=560.0, position_angle=-10.0,
    )  # fmt: skip
    assert {key: found[key] for key in ("FIELDID", "OBS_ID", "DITHOBS", "PTGID", "N_CCD")} == {
        "FIELDID": 12, "OBS_ID": 100012, "DITHOBS": 3, "PTGID": 100012003, "N_CCD": 36,
    }  # fmt: skip
    assert (found["PA"], found["ORIENTAT"], found["MJDATE"], found["DATAUNIT"]) == (350.0, 350.0, 61000.5, "ADU")
    assert found["FITS_DEF"] == "le1.visRawImage"
    ends = Time(found["DATE-END"], scale="utc") - Time(61000.5, format="mjd", scale="utc")
    assert ends.sec == pytest.approx(560.0, abs=1e-3)


def test_pointings_have_different_numbers():
    """A self-calibration has tens of dithers."""
    numbers = {cards(field=field, visit=1, dither=dither)["PTGID"] for field in (12, 13, 14) for dither in range(1, 61)}
    assert len(numbers) == 3 * 60


def test_fields_at_own_positions_are_not_those_of_a_survey():
    numbers = [cards(field=1, visit=visit, survey=name)["OBS_ID"] for name in ("wide", "own") for visit in (1, 2)]
    assert numbers == [1, 100001, 200000001, 200100001]
    assert cards(field=99_999, visit=1000, survey="wide")["OBS_ID"] < min(numbers[2:])


def test_wheels_of_nisp():
    """Angles of the survey: 184 deg is RGS180 turned by 4 deg, -4 deg RGS000 by -4 deg (Serrano et al. 2024)."""
    keys = ("FWA_POS", "GWA_POS", "GWA_TILT", "OBSTYPE", "N_DET", "FITS_DEF")
    spectra = {"channel": "NISP-S", "camera": "nisp", "band": "nisp_red"}
    for columns, expected in (
        ({**spectra, "grism": "RGS180", "grism_angle": 184.0}, ("OPEN", "RGS180", 4.0, "SPECTROIMAGE")),
        ({**spectra, "grism": "RGS000", "grism_angle": -4.0}, ("OPEN", "RGS000", -4.0, "SPECTROIMAGE")),
        ({**spectra, "image_type": "dark"}, ("CLOSED", "OPEN", None, "SPECTROIMAGE")),
        ({"channel": "NISP-P", "camera": "nisp", "band": "euclid_j"}, ("J", "OPEN", None, "IMAGE")),
        (
            {"channel": "NISP-P", "camera": "nisp", "band": "euclid_j", "image_type": "persistence"},
            ("CLOSED", "OPEN", None, "IMAGE"),
        ),
    ):
        found = cards(**columns)
        assert tuple(found.get(key) for key in keys) == (*expected, 36, "le1.nispRawImage")


def test_cards_of_arrays():
    """PyAutoArray reads CCDID, QUADID, PRESCANX, OVRSCANX and OVRSCANY; flight quadrants have 51, 29 and 20."""
    header = {"PRESCAN": 51, "OVERSCAN": 29, "OVERROWS": 20, "CD1_2": -1e-5, "CD2_2": 1e-5}
    row = exposure(ra=-1.0, dec=-27.0, position_angle=370.0)
    found = {key: value for key, value, _ in level1.array_cards("3-4.E", header, row)}
    assert found == {
        "CCDID": "3-4", "QUADID": "E", "PRESCANX": 51, "OVRSCANX": 29, "OVRSCANY": 20, "DATAUNIT": "ADU",
        "ORIENTAT": 315.0, "RA": 359.0, "DEC": -27.0, "PA": 10.0,
    }  # fmt: skip
    nisp = exposure(channel="NISP-P", camera="nisp", band="euclid_h")
    for name, keys in (("DET22.SCI", {"DET_ID", "DATAUNIT"}), ("DET22.CHI2", {"DET_ID"})):
        found = {key: value for key, value, _ in level1.array_cards(name, {}, nisp)}
        assert set(found) == keys | {"RA", "DEC", "PA"}
        assert found["DET_ID"] == "22"
