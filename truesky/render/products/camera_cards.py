"""Make the FITS cards that only raw images of DECam, Hyper Suprime-Cam, MegaPrime or LSSTCam have.

With them, software of the observatories recognises the images. For example, `ObservationInfo` of the package
astro_metadata_translator reads the date, the pointing, the weather and the number of the detector from them.

References
----------
NOAO Data Handbook 2.2 (DECam); Subaru Telescope, FITS keywords of Hyper Suprime-Cam; CFHT, MegaPrime header keywords;
LSE-400 (LSSTCam: header service); astro_metadata_translator and obs_lsst (keywords that the translators read)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import resources

import numpy as np

from lake_schema.fits.images import Card
from lake_schema.mission import model
from truesky.render.camera import detectors, observatories, sections
from truesky.render.camera.amplifiers import Amplifier
from truesky.render.channels import image_types
from truesky.render.exposure.rendered_detector import RenderedDetector
from truesky.render.products import headers, raw_pointing
from truesky.render.psf import atmosphere
from truesky.render.sky import observatory

# Hectopascals in 1 mm Hg.
_HECTOPASCAL = 1.333224
# Decimals of the altitude and azimuth in degrees, which are so exact on every processor.
_DECIMALS = 6
# Relative humidity in headers, percent: the weather is not simulated.
_HUMIDITY = 40.0
# Temperature of 0 deg C, K.
_ZERO_CELSIUS = 273.15
# Value of cards that name a proposal or a run of the telescope.
_PROGRAM = "truesky"
_PROGRAM_TEXT = "program (no meaning in a simulation)"
_FOCUS_TEXT = "focus (no meaning in a simulation)"
_HUMIDITY_TEXT = "[percent] humidity (no meaning in a simulation)"
# Number of different values of SEQNUM, the number of an LSSTCam exposure in its night: obs_lsst stores it in 15 bits.
_SEQUENCE_NUMBERS = 32_768
# Image types for which the shutter opens.
_SHUTTER_TYPES = ("science", "deep", "flat")
# Names of the image types of truesky in the headers of each camera.
_IMAGE_TYPES: Mapping[str, Mapping[str, str]] = {
    "decam": {"science": "object", "deep": "object", "flat": "dome flat", "dark": "dark", "bias": "zero"},
    "hsc": {"science": "OBJECT", "deep": "OBJECT", "flat": "DOMEFLAT", "dark": "DARK", "bias": "BIAS"},
    "megacam": {"science": "OBJECT", "deep": "OBJECT", "flat": "FLAT", "dark": "DARK", "bias": "BIAS"},
    "lsstcam": {"science": "SKYEXP", "deep": "SKYEXP", "flat": "FLAT", "dark": "DARK", "bias": "BIAS"},
}
# Nights (YYYYMMDD) between which ROTPA of LSSTCam was 90 deg too large, and exposure of the last night before which it
# was wrong by 180 deg (obs_lsst, translator of LSSTCam).
_FIRST_ROTPA_NIGHT, _LAST_ROTPA_NIGHT, _LAST_ROTPA_SEQUENCE = "20250301", "20250422", 251


@dataclass(frozen=True, slots=True)
class _Conditions:
    """Dates of an exposure, and state of the telescope, as a header of its camera has them.

    Attributes
    ----------
    mjd, end_mjd : float
        Start and end of the exposure (MJD), in the time scale of the camera's files.
    ra, dec, position_angle : float
        Boresight and position angle in degrees, with the pointing error of raw headers.
    altitude, azimuth, end_altitude, end_azimuth : float
        Altitude, and azimuth from north through east, of the boresight at start and end of the exposure in degrees.
    pressure : float
        Air pressure in hPa.
    site : Site
        The observatory.
    """

    mjd: float
    end_mjd: float
    ra: float
    dec: float
    position_angle: float
    altitude: float
    azimuth: float
    end_altitude: float
    end_azimuth: float
    pressure: float
    site: observatory.Site

    @property
    def start(self) -> str:
        """Start of the exposure in ISO 8601."""
        return headers.iso_date(self.mjd)

    @property
    def end(self) -> str:
        """End of the exposure in ISO 8601."""
        return headers.iso_date(self.end_mjd)


def cards(rendered: RenderedDetector) -> tuple[Card, ...]:
    """Return the cards that raw images of the detector's camera have in addition to the cards of every camera.

    The result is () for all cameras but DECam, Hyper Suprime-Cam, MegaCam and LSSTCam.
    """
    make_cards = _CARDS_BY_CAMERA.get(rendered.exposure.camera)
    return make_cards(rendered, _conditions(rendered)) if make_cards else ()


def first_name(rendered: RenderedDetector) -> str:
    """Return the name (EXTNAME) of the first header of a detector's file: the detector for MegaCam, "" for others."""
    return rendered.detector.name if rendered.exposure.camera == "megacam" else ""


def _conditions(rendered: RenderedDetector) -> _Conditions:
    exposure, mission = rendered.exposure, rendered.scene.mission
    site = observatory.Site.from_mission(image_types.section(exposure.camera), mission)
    ra, dec, angle = raw_pointing.commanded_pointing(exposure, rendered.detector, mission, rendered.seed)
    days = rendered.scene.exposure_time_s / 86400.0
    start = exposure.mjd + observatories.for_camera(exposure.camera).seconds_ahead_of_utc / 86400.0
    altitude, azimuth = observatory.altitude_and_azimuth(ra, dec, exposure.mjd, site)
    end_altitude, end_azimuth = observatory.altitude_and_azimuth(ra, dec, exposure.mjd + days, site)
    return _Conditions(
        mjd=start,
        end_mjd=start + days,
        ra=ra % 360.0,
        dec=dec,
        position_angle=angle % 360.0,
        altitude=round(altitude, _DECIMALS),
        azimuth=round(azimuth, _DECIMALS),
        end_altitude=round(end_altitude, _DECIMALS),
        end_azimuth=round(end_azimuth, _DECIMALS),
        pressure=round(_HECTOPASCAL * atmosphere.pressure(site.height), 2),
        site=site,
    )


def _decam(rendered: RenderedDetector, conditions: _Conditions) -> tuple[Card, ...]:
    """Return the cards of a DECam CCD, and of its amplifiers A and B, whose letters are the ends of keywords."""
    exposure, site = rendered.exposure, conditions.site
    identifier = "ct4m" + conditions.start[:19].replace("-", "").replace(":", "").replace("T", "t")
    return (
        ("OBSTYPE", _image_type(rendered), "type of observation"),
        ("PROCTYPE", "RAW", "data processing level"),
        ("PRODTYPE", "image", "data product"),
        ("EXPNUM", exposure.exposure_id, "exposure number"),
        ("OBSID", identifier, "observation identifier: start of the exposure"),
        ("CCDNUM", _detector_number(rendered) + 1, "CCD number"),
        ("DETPOS", rendered.detector.name, "position of the CCD in the focal plane"),
        ("CCDSUM", "1 1", "binning along columns and rows"),
        ("EXPREQ", exposure.exposure_time_s, "[s] requested exposure time"),
        ("DARKTIME", rendered.scene.exposure_time_s, "[s] time from clearing to readout"),
        ("TELRA", _sexagesimal(conditions.ra / 15.0, 3, ""), "[h:m:s] boresight right ascension"),
        ("TELDEC", _sexagesimal(conditions.dec, 3, "+"), "[d:m:s] boresight declination"),
        ("ZD", 90.0 - conditions.altitude, "[deg] zenith distance at the start"),
        ("AZ", conditions.azimuth, "[deg] azimuth at the start, north through east"),
        ("OBS-LONG", -site.longitude, "[deg] longitude of the observatory, to the west"),
        ("OBS-LAT", site.latitude, "[deg] latitude of the observatory"),
        ("OBS-ELEV", site.height, "[m] height of the observatory"),
        ("OUTTEMP", atmosphere.TEMPERATURE, "[deg C] air temperature"),
        ("PRESSURE", conditions.pressure, "[hPa] air pressure"),
        ("HUMIDITY", _HUMIDITY, _HUMIDITY_TEXT),
        ("PROPID", _PROGRAM, _PROGRAM_TEXT),
        ("TELFOCUS", "0.00,0.00,0.00,0.00,0.00,0.00", _FOCUS_TEXT),
        *_amplifier_cards(rendered),
    )


def _hsc(rendered: RenderedDetector, conditions: _Conditions) -> tuple[Card, ...]:
    """Return the cards of a CCD of Hyper Suprime-Cam."""
    exposure, number = rendered.exposure, _detector_number(rendered)
    filters = observatories.for_camera(exposure.camera).filters
    return (
        ("DATA-TYP", _image_type(rendered), "type of observation"),
        ("EXP-ID", f"HSCE{exposure.exposure_id:08d}", "exposure identifier"),
        ("FRAMEID", _frame_identifier(exposure.exposure_id, number), "identifier of this image"),
        ("DET-ID", number, "CCD number, from 0"),
        ("T_CCDSN", f"{number:03d}", "serial number (simulation: CCD number)"),
        ("FILTER01", filters.get(exposure.band, exposure.band), "filter"),
        ("UT-STR", conditions.start[11:], "[h:m:s] UTC at the start"),
        ("UT-END", conditions.end[11:], "[h:m:s] UTC at the end"),
        ("UT", conditions.start[11:], "[h:m:s] UTC at the start"),
        ("MJD-STR", conditions.mjd, "[d] MJD at the start"),
        ("MJD-END", conditions.end_mjd, "[d] MJD at the end"),
        ("MJD", conditions.mjd, "[d] MJD at the start"),
        ("RA2000", _sexagesimal(conditions.ra / 15.0, 3, ""), "[h:m:s] boresight right ascension"),
        ("DEC2000", _sexagesimal(conditions.dec, 2, "+"), "[d:m:s] boresight declination"),
        ("INST-PA", (270.0 - conditions.position_angle) % 360.0, "[deg] 270 deg - position angle of y"),
        ("ALTITUDE", conditions.altitude, "[deg] altitude at the start"),
        ("AZIMUTH", conditions.azimuth, "[deg] azimuth at the start, north through east"),
        ("OUT-TMP", atmosphere.TEMPERATURE + _ZERO_CELSIUS, "[K] air temperature"),
        ("OUT-PRS", conditions.pressure, "[hPa] air pressure"),
        ("OUT-HUM", _HUMIDITY, _HUMIDITY_TEXT),
        ("PROP-ID", _PROGRAM, _PROGRAM_TEXT),
        ("FOC-VAL", 0.0, f"[mm] {_FOCUS_TEXT}"),
    )


def _megacam(rendered: RenderedDetector, conditions: _Conditions) -> tuple[Card, ...]:
    """Return the cards of a CCD of MegaPrime; `first_name` is its extension name."""
    exposure, site = rendered.exposure, conditions.site
    return (
        ("OBSTYPE", _image_type(rendered), "type of observation"),
        ("EXPNUM", exposure.exposure_id, "exposure number"),
        ("OBSID", exposure.exposure_id, "exposure number"),
        ("CCDNAME", rendered.detector.name, "name of the CCD (simulation: place)"),
        ("EXPREQ", exposure.exposure_time_s, "[s] requested exposure time"),
        ("DARKTIME", rendered.scene.exposure_time_s, "[s] time from clearing to readout"),
        ("UTC-OBS", conditions.start[11:], "[h:m:s] UTC at the start"),
        ("RA_DEG", conditions.ra, "[deg] boresight right ascension"),
        ("DEC_DEG", conditions.dec, "[deg] boresight declination"),
        ("TELALT", conditions.altitude, "[deg] altitude at the start"),
        ("TELAZ", conditions.azimuth, "[deg] azimuth at the start, north through east"),
        ("LONGITUD", site.longitude, "[deg] longitude of the observatory, to the east"),
        ("LATITUDE", site.latitude, "[deg] latitude of the observatory"),
        ("TEMPERAT", atmosphere.TEMPERATURE, "[deg C] air temperature"),
        ("PRESSURE", conditions.pressure, "[hPa] air pressure"),
        ("RELHUMID", _HUMIDITY, _HUMIDITY_TEXT),
        ("RUNID", _PROGRAM, _PROGRAM_TEXT),
    )


def _lsstcam(rendered: RenderedDetector, conditions: _Conditions) -> tuple[Card, ...]:
    """Return the cards of an LSSTCam sensor; ROTPA is the position angle to which the rotator turns the camera."""
    exposure, (raft, sensor) = rendered.exposure, rendered.detector.name.split("_")
    kind, number = rendered.detector.kind.upper(), _detector_number(rendered)
    seconds, opens = rendered.scene.exposure_time_s, exposure.image_type in _SHUTTER_TYPES
    # A night begins at noon in the time zone 12 h west of Greenwich.
    night, sequence = headers.iso_date(conditions.mjd - 0.5)[:10].replace("-", ""), _sequence_number(rendered)
    sees_sky = exposure.image_type in ("science", "deep")
    return (
        ("OBSID", f"MC_S_{night}_{sequence:06d}", "observation identifier"),
        ("DAYOBS", night, "date of the night's first noon, 12 h behind TAI"),
        ("SEQNUM", sequence, "exposure identifier modulo 32768"),
        ("CAMCODE", "MC", "code of the camera"),
        ("IMGTYPE", _image_type(rendered), "type of observation"),
        ("CONTRLLR", "S", "controller (S: simulation)"),
        ("RAFTBAY", raft, "raft name"),
        ("CCDSLOT", sensor, "sensor position in the raft"),
        ("CHIPID", rendered.detector.name, "names of raft and sensor"),
        ("DETNUM", number, "sensor number, from 0"),
        ("LSST_NUM", f"{kind}-{number:03d}", "manufacturer and number of the sensor"),
        ("DATE", conditions.end, "end of the exposure"),
        ("DATE-BEG", conditions.start, "start of the exposure"),
        ("MJD-BEG", conditions.mjd, "[d] start of the exposure"),
        ("DATE-END", conditions.end, "end of the exposure"),
        ("MJD-END", conditions.end_mjd, "[d] end of the exposure"),
        ("TRACKSYS", "RADEC", "coordinates that the telescope tracks"),
        ("ROTPA", _rotator_angle(conditions.position_angle, night, sequence), "[deg] position angle of y"),
        ("ROTCOORD", "sky", "reference of ROTPA"),
        ("RASTART", conditions.ra, "[deg] boresight RA at exposure start"),
        ("DECSTART", conditions.dec, "[deg] boresight Dec at exposure start"),
        ("ELSTART", conditions.altitude, "[deg] altitude at exposure start"),
        ("AZSTART", conditions.azimuth, "[deg] azimuth at exposure start"),
        ("ELEND", conditions.end_altitude, "[deg] altitude at exposure end"),
        ("AZEND", conditions.end_azimuth, "[deg] azimuth at exposure end"),
        *((("AMSTART", exposure.airmass, "airmass at exposure start"),) if exposure.airmass is not None else ()),
        ("SHUTTIME", seconds if opens else 0.0, "[s] shutter open time"),
        ("DARKTIME", seconds, "[s] time from clearing to readout"),
        ("VIGN_MIN", "NO" if sees_sky else "FULLY", "vignetting by the dome"),
        ("AIRTEMP", atmosphere.TEMPERATURE, "[deg C] air temperature"),
        ("PRESSURE", 100.0 * conditions.pressure, "[Pa] air pressure"),
        ("HUMIDITY", _HUMIDITY, _HUMIDITY_TEXT),
        ("PROGRAM", _PROGRAM, _PROGRAM_TEXT),
        ("FOCUSZ", 0.0, f"[mm] {_FOCUS_TEXT}"),
        *_file_name(rendered),
    )


def _rotator_angle(position_angle: float, night: str, sequence: int) -> float:
    """Return ROTPA of LSSTCam for a position angle (deg), as real headers of a night (YYYYMMDD) have it.

    In its first nights the camera wrote other angles, which the translator of obs_lsst corrects in all frames of these
    nights.
    """
    if _FIRST_ROTPA_NIGHT < night < _LAST_ROTPA_NIGHT:
        return position_angle + 90.0
    if night == _LAST_ROTPA_NIGHT and sequence < _LAST_ROTPA_SEQUENCE:
        return (position_angle + 360.0) % 360.0 - 180.0
    return position_angle


def _file_name(rendered: RenderedDetector) -> tuple[Card, ...]:
    """Return card FILENAME with the name that the simulator imSim 0.6 would give to the file of an LSSTCam sensor.

    The result is () for a file with all amplifiers in one array in ADU, a format that imSim does not have.
    """
    exposure, arrays = rendered.exposure, rendered.readout.extensions
    kind = "eimage" if arrays[0].unit == "electron" else "amp" if len(arrays) > 1 else ""
    if not kind:
        return ()
    band = exposure.band.rpartition("_")[2]
    name = (
        f"{kind}_{exposure.exposure_id:08d}-0-{band}-{rendered.detector.name}-det{_detector_number(rendered):03d}.fits"
    )
    return (("FILENAME", name, "imSim file name"),)


# Functions that make the FITS cards that only certain cameras have, by name of the camera.
_CARDS_BY_CAMERA: Mapping[str, Callable[[RenderedDetector, _Conditions], tuple[Card, ...]]] = {
    "decam": _decam,
    "hsc": _hsc,
    "megacam": _megacam,
    "lsstcam": _lsstcam,
}


def _image_type(rendered: RenderedDetector) -> str:
    return _IMAGE_TYPES[rendered.exposure.camera][rendered.exposure.image_type]


def _detector_number(rendered: RenderedDetector) -> int:
    """Return the number, from 0, of a detector: its place in the complete list of detectors that truesky has.

    A layout of the mission database may leave out detectors that do not work. Detectors that only this layout has come
    after all others.
    """
    camera = rendered.exposure.camera
    layout = resources.files("lake_schema.mission") / "models" / f"layout_{camera}.csv"
    names = [row["detector"] for row in model.parse_rows(layout.read_bytes())]
    names += [detector.name for detector in detectors.detectors(camera, rendered.scene.mission)]
    return list(dict.fromkeys(names)).index(rendered.detector.name)


def _sequence_number(rendered: RenderedDetector) -> int:
    """Return the number of an LSSTCam exposure in its night."""
    return rendered.exposure.exposure_id % _SEQUENCE_NUMBERS


def _frame_identifier(exposure_id: int, number: int) -> str:
    """Return the identifier of an image of Hyper Suprime-Cam: HSC, a letter and 8 digits.

    Two digits have the CCD number modulo 100. The other digits count pairs of numbers per exposure, of which CCDs from
    100 on have the second. The letter counts millions.
    """
    hundreds, last_digits = divmod(number, 100)
    millions, count = divmod(2 * exposure_id + hundreds, 1_000_000)
    return f"HSC{chr(ord('A') + millions % 26)}{count:06d}{last_digits:02d}"


def _sexagesimal(value: float, decimals: int, plus: str) -> str:
    """Return hours or degrees as text such as "-00:30:00.07".

    `decimals` is the number of decimals of the seconds, and `plus` is the sign of positive values.
    """
    unit = 10**decimals
    seconds, fraction = divmod(round(abs(value) * 3600 * unit), unit)
    # Rounded hours may be 24.
    hours = seconds // 3600 % 24 if plus == "" else seconds // 3600
    sign = "-" if value < 0.0 else plus
    return f"{sign}{hours:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}.{fraction:0{decimals}d}"


def _amplifier_cards(rendered: RenderedDetector) -> tuple[Card, ...]:
    """Return cards with sections, gain and noise of each amplifier of a DECam CCD.

    They are the cards that DECam has in addition to the amplifier cards of all ground cameras. The result is () unless
    all amplifiers are in one array in ADU.
    """
    layout, arrays = rendered.scene.layout, rendered.readout.extensions
    if layout is None or len(arrays) > 1 or arrays[0].unit != "adu":
        return ()
    all_detectors = detectors.detectors(rendered.exposure.camera, rendered.scene.mission)
    numbers = {key: value for key, value, _ in headers.amplifier_values(rendered)}
    letter_cards: list[Card] = []
    for number, amplifier in enumerate(layout.amplifiers):
        letter, pixels = amplifier.name, layout.amplifier_data_section(number)
        place = sections.to_mosaic_section(rendered.detector, amplifier.pixels, all_detectors)
        letter_cards += [
            (f"AMPSEC{letter}", _readout_section(amplifier), "CCDSEC in readout order"),
            (f"TRIMSEC{letter}", pixels.text, f"pixels of amplifier {letter}"),
            (f"PRESEC{letter}", layout.amplifier_prescan_section(number).text, f"prescan of amplifier {letter}"),
            (
                f"POSTSEC{letter}",
                layout.amplifier_overscan_section(number).text,
                f"overscan rows of amplifier {letter}",
            ),
            *(((f"DETSEC{letter}", place, f"amplifier {letter} in the mosaic"),) if place else ()),
            *(
                (f"{key}{letter}", float(np.broadcast_to(numbers[name], len(layout.amplifiers))[number]), text)
                for key, name, text in _NUMBERS
            ),
        ]
    return tuple(letter_cards)


# Gain, read noise and saturation level in DECam headers: beginning of the keyword (the letter of the amplifier
# follows), keyword of the same quantity for other cameras, and comment of the card.
_NUMBERS = (
    ("GAIN", "GAIN", "[electron/adu] conversion gain"),
    ("RDNOISE", "RDNOISE", "[electron] rms read noise"),
    ("SATURAT", "SATURATE", "[adu] lowest level of a saturated pixel"),
)


def _readout_section(amplifier: Amplifier) -> str:
    """Return the rectangle of an amplifier's pixels on the detector as a FITS section, in the order of the readout.

    For example, "[2048:1025,1:4096]" is read from column 2048 down to column 1025.
    """
    (x, y), pixels = (axis + 1 for axis in (amplifier.pixels.x, amplifier.pixels.y)), amplifier.pixels
    columns, rows = (x, x + pixels.nx - 1), (y, y + pixels.ny - 1)
    columns = columns[::-1] if amplifier.read_right else columns
    rows = rows[::-1] if amplifier.read_top else rows
    return f"[{columns[0]}:{columns[1]},{rows[0]}:{rows[1]}]"
