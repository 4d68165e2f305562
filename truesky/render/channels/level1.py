"""Name files of whole exposures as Euclid's level-1 products (raw frames), and make the cards that only those have.

The cards are added to the usual ones. Several keywords of the real products have no counterpart in a
simulation, such as telemetry and the numbers of on-board plans; they are missing.

References
----------
Euclid Data Product Description Document 2.0 (Q1): LE1 VIS Raw Frame, LE1 NISP Raw Frame, VIS Calibrated Quad Frame (the
keywords that its primary header takes from the raw frame). Euclid Q1 at IRSA: names of files. Kuijken, VISQL: values of
IMG_T1 in raw frames of the survey. GWA_POS and GWA_TILT: names and units as in SIR science frames.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from datetime import datetime, timedelta
from typing import Any

from lake_schema import __version__
from lake_schema.fits.images import Card, Image
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import GRISM_NAMES, ExposureRow
from truesky.render.camera.sections import Section

# Instrument in the name of a file, by channel. Files of ground cameras keep their names.
INSTRUMENTS: Mapping[str, str] = {"VIS": "VIS", "NISP-P": "NISP", "NISP-S": "NISP"}
# Channels whose arrays have the axes of the focal plane, not those of the detector.
FOCAL_PLANE_AXES = ("VIS",)
# Calendar date of MJD 0.
_MJD_ZERO = datetime(1858, 11, 17)
# Number by which the observation of a field grows with each visit; surveys have fewer fields.
_VISIT_STEP = 100_000
# Numbers added to the number of an exposure without a field, which is its own observation, and to the number of a field
# at a user's position, which is not one of a survey.
_WITHOUT_FIELD, _OWN_FIELD = 10_000_000, 200_000_000
# Number by which the pointing grows with each observation; observations have fewer dithers.
_POINTING_STEP = 1000
# Decimals of angles in degrees, which are so exact on every processor.
_DECIMALS = 6
# Values of IMG_T1 and SEQID by image type. Image types that are not listed have their names in capitals.
_IMAGE_TYPES: Mapping[str, str] = {"science": "SURVEY", "deep": "SURVEY", "charge_injection": "CHARGE_INJ"}
# Image types without light, and image types that are lit by a lamp or filled electronically.
_UNLIT = ("bias", "dark", "persistence", "charge_injection", "trap_pumping")
# Position of NISP's filter wheel by passband; spectra are taken through the open position.
_FILTERS: Mapping[str, str] = {"euclid_y": "Y", "euclid_j": "J", "euclid_h": "H"}
# Cards of a quadrant of VIS that have another name in Euclid's files: name, name in truesky, comment.
_OVERSCANS = (
    ("PRESCANX", "PRESCAN", "[pix] number of serial prescan columns"),
    ("OVRSCANX", "OVERSCAN", "[pix] number of serial overscan columns"),
    ("OVRSCANY", "OVERROWS", "[pix] number of parallel overscan rows"),
)
# Keywords of sections of an array, and of the places of an array's pixels on the detector and in the mosaic.
_OWN_SECTIONS, _PLACES = ("DATASEC", "TRIMSEC", "BIASSEC"), ("CCDSEC", "DETSEC")
# Keyword of a SIP coefficient, with the powers of column and row.
_SIP_COEFFICIENT = re.compile(r"[AB]_(\d+)_(\d+)")


def observation(exposure: ExposureRow) -> int:
    """Return the number of the observation (OBS_ID) to which an exposure belongs.

    It is the number of the field plus 100,000 for each earlier visit, and plus 200,000,000 for a user's own position,
    which is more than the numbers of 1000 visits.
    Without a field it is the number of the exposure plus 10,000,000, so that it differs from the numbers of fields.
    """
    if exposure.field is None:
        return _WITHOUT_FIELD + exposure.exposure_id
    number = exposure.field + _VISIT_STEP * ((exposure.visit or 1) - 1)
    return _OWN_FIELD + number if exposure.survey == "own" else number


def file_name(exposure: ExposureRow) -> str:
    """Return the name of the file of an exposure: EUC_LE1_VIS-00012-1-D_20240701T001045.000000Z.fits, for example.

    The parts are instrument, observation, dither (1 without dithers), survey, and start of the exposure (UTC). "D" is
    the survey of all files of Q1, and the same for all exposures. Exposures that differ only in their noise end with
    the number of the realisation from the second one on, for example Z_02.fits.

    Parameters
    ----------
    exposure : ExposureRow
        Row of the table `exposures`, with a channel in `INSTRUMENTS`.

    Returns
    -------
    str
        The name.
    """
    start = (_MJD_ZERO + timedelta(days=exposure.mjd)).strftime("%Y%m%dT%H%M%S.%f")
    noise = f"_{exposure.realisation:02d}" if (exposure.realisation or 1) > 1 else ""
    place = f"{observation(exposure):05d}-{exposure.dither or 1}-D"
    return f"EUC_LE1_{INSTRUMENTS[exposure.channel]}-{place}_{start}Z{noise}.fits"


def exposure_cards(exposure: ExposureRow, detectors: int, mission: MissionConfiguration) -> tuple[Card, ...]:
    """Return the cards of the primary header that only Euclid's files have.

    Parameters
    ----------
    exposure : ExposureRow
        Row of the table `exposures`.
    detectors : int
        Number of detectors in the file.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    tuple of Card
        Keyword, value and comment of each card.
    """
    kind, angle = exposure.image_type, round(exposure.position_angle % 360.0, _DECIMALS)
    is_vis, is_sky = exposure.channel == "VIS", kind in ("science", "deep")
    end = _MJD_ZERO + timedelta(days=exposure.mjd + exposure.exposure_time_s / 86400.0)
    dither, number = exposure.dither or 1, observation(exposure)
    return (
        ("FITS_DEF", "le1.visRawImage" if is_vis else "le1.nispRawImage", "FITS definition name"),
        ("SOFTVERS", f"truesky {__version__}", "version of the simulator"),
        ("IMG_CAT", "SCIENCE" if is_sky else "CALIB", "data product category"),
        ("IMG_T1", _IMAGE_TYPES.get(kind, kind.upper()), "image type"),
        ("IMG_T2", "LAMP" if kind == "flat" else "OTHER" if kind in _UNLIT else "SKY", "source of the light"),
        ("OBSMODE", {"science": "WIDE", "deep": "DEEP"}.get(kind, "CALIBRATION"), "observation mode"),
        ("OBSTYPE", "SPECTROIMAGE" if exposure.channel == "NISP-S" else "IMAGE", "technique"),
        ("SEQID", _sequence(exposure, mission), "sequence of the instrument"),
        ("MJDATE", exposure.mjd, "[d] start of the exposure, MJD (UTC)"),
        ("DATE-END", end.isoformat(timespec="milliseconds"), "end of the exposure"),
        ("FIELDID", number if exposure.field is None else exposure.field, "field"),
        ("OBS_ID", number, "observation"),
        ("DITHOBS", dither, "dither of the observation, from 1"),
        ("PTGID", _POINTING_STEP * number + dither, "pointing"),
        ("PA", angle, "[deg] position angle of the focal plane"),
        ("ORIENTAT", angle, "[deg] position angle of the y axis"),
        ("DATAUNIT", "ADU", "unit of the pixels"),
        ("N_CCD" if is_vis else "N_DET", detectors, "number of detectors in this file"),
        *(_vis_cards(kind) if is_vis else _wheel_cards(exposure)),
    )


def _sequence(exposure: ExposureRow, mission: MissionConfiguration) -> str:
    """Return SEQID: nominal or short for VIS images of the sky, otherwise the image type."""
    if exposure.image_type not in ("science", "deep"):
        return _IMAGE_TYPES.get(exposure.image_type, exposure.image_type.upper())
    is_short = exposure.channel == "VIS" and exposure.exposure_time_s <= mission.value("vis.exposure_time_short", "s")
    return "SHORT" if is_short else "NOMINAL"


def _vis_cards(kind: str) -> tuple[Card, ...]:
    states = (
        ("CI_STAT", kind == "charge_injection", "charge injection"),
        ("TP_STAT", kind == "trap_pumping", "trap pumping"),
        ("CUSTATUS", kind == "flat", "calibration unit"),
    )
    return tuple((keyword, "On" if state else "Off", f"{text}: On or Off") for keyword, state, text in states)


def _wheel_cards(exposure: ExposureRow) -> tuple[Card, ...]:
    """Return the positions of the wheels of NISP. A dark is taken with the filter wheel closed."""
    spectrum = exposure.grism is not None
    filter_name = "CLOSED" if exposure.image_type in _UNLIT else "OPEN" if spectrum else _FILTERS[exposure.band]
    cards: tuple[Card, ...] = (
        ("FWA_POS", filter_name, "position of the filter wheel"),
        ("GWA_POS", exposure.grism or "OPEN", "position of the grism wheel"),
    )
    if exposure.grism is None or exposure.grism_angle is None:
        return cards
    tilt = (exposure.grism_angle - GRISM_NAMES[exposure.grism][1] + 180.0) % 360.0 - 180.0
    return (*cards, ("GWA_TILT", tilt, "[deg] turn of the grism by its wheel"))


def array_cards(name: str, header: Mapping[str, Any], exposure: ExposureRow) -> tuple[Card, ...]:
    """Return the cards of an extension that only Euclid's files have.

    Parameters
    ----------
    name : str
        Name of the extension (EXTNAME): detector and quadrant such as "3-4.E", or "DET22.SCI".
    header : mapping of str to value
        Header of the extension, with the WCS and the sizes of prescan and overscan.
    exposure : ExposureRow
        Row of the table `exposures`.

    Returns
    -------
    tuple of Card
        Keyword, value and comment of each card.
    """
    detector, _, part = name.partition(".")
    cards: list[Card] = []
    if exposure.channel == "VIS":
        cards += [("CCDID", detector, "CCD, row-column"), ("QUADID", part, "quadrant")]
        cards += [(keyword, header[usual], text) for keyword, usual, text in _OVERSCANS if usual in header]
    else:
        cards.append(("DET_ID", detector.removeprefix("DET"), "detector, row and column"))
    if part != "CHI2":
        cards.append(("DATAUNIT", "ADU", "unit of the pixels"))
    if "CD1_2" in header and "CD2_2" in header:
        # A y axis with a component CD1_2 to the east and CD2_2 to the north has this position angle.
        angle = math.degrees(math.atan2(header["CD1_2"], header["CD2_2"])) % 360.0
        cards.append(("ORIENTAT", round(angle, _DECIMALS) % 360.0, "[deg] position angle of the y axis"))
    pointing = (("RA", exposure.ra % 360.0), ("DEC", exposure.dec), ("PA", exposure.position_angle % 360.0))
    text = {"RA": "right ascension", "DEC": "declination", "PA": "position angle"}
    cards += [(key, round(value, _DECIMALS), f"[deg] boresight {text[key]}") for key, value in pointing]
    return tuple(cards)


def turn_array(image: Image) -> Image:
    """Turn an array by 180 deg, with its WCS and its sections, so that each pixel keeps its place on the sky.

    Arrays of VIS have the axes of the focal plane in Euclid's files, and the axes of the CCD in files of detectors. The
    two are opposite for CCDs that are mounted upside down.
    """
    assert image.data is not None
    ny, nx = image.data.shape
    return Image(image.data[::-1, ::-1], turn_cards(image.cards, (nx, ny)), image.name)


def turn_cards(cards: Iterable[Card], size: tuple[int, int]) -> tuple[Card, ...]:
    """Return the header of an array that is turned by 180 deg.

    Parameters
    ----------
    cards : iterable of Card
        Header of the array: sections, and a WCS with the matrix CD and distortion as SIP or TPV.
    size : (int, int)
        Numbers of columns and rows of the array.

    Returns
    -------
    tuple of Card
        The same keywords; the numbers in CCDSEC and DETSEC run in the opposite direction.
    """
    return tuple((keyword, _turn_value(keyword, value, size), text) for keyword, value, text in cards)


def _turn_value(keyword: str, value: Any, size: tuple[int, int]) -> Any:
    if keyword in ("CRPIX1", "CRPIX2"):
        return size[int(keyword[-1]) - 1] + 1.0 - value
    if re.fullmatch(r"CD[12]_[12]", keyword):
        return -value
    if powers := _SIP_COEFFICIENT.fullmatch(keyword):
        # The distortion of a column or row changes its sign, and so does each factor of the term.
        return value if (int(powers[1]) + int(powers[2])) % 2 else -value
    if keyword in _OWN_SECTIONS:
        section = Section.from_text(value)
        x, y = size[0] - section.x - section.nx, size[1] - section.y - section.ny
        return Section(x, y, section.nx, section.ny).text
    if keyword in _PLACES:
        return re.sub(r"(\d+):(\d+)", r"\2:\1", value)
    # Coefficients of TPV apply after the matrix CD and do not change.
    return value
