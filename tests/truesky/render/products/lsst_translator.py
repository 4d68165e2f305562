"""Translation of LSSTCam headers for tests, because obs_lsst, which translates real ones, is not a package of PyPI.

Each property is read from the keyword from which obs_lsst reads it.
"""

from typing import ClassVar

import astropy.units as u
from astro_metadata_translator import FitsTranslator
from astro_metadata_translator.translators import helpers
from astropy.coordinates import EarthLocation
from astropy.time import Time, TimeDelta

from tests.truesky.render.fields import MISSION
from truesky.render.camera import detectors


class LsstCamTranslator(FitsTranslator):
    """Translator of LSSTCam, whose nights begin at noon 12 h behind UTC."""

    name, supported_instrument = "LSSTCam", "LSSTCam"
    _const_map: ClassVar = {}
    # Properties that have the value of one keyword.
    _trivial_map: ClassVar = {
        "instrument": "INSTRUME",
        "telescope": "TELESCOP",
        "detector_group": "RAFTBAY",
        "detector_name": "CCDSLOT",
        "detector_serial": "LSST_NUM",
        "observation_id": "OBSID",
        "object": "OBJECT",
        "science_program": "PROGRAM",
        "physical_filter": "FILTER",
        "observation_counter": "SEQNUM",
        "exposure_time_requested": ("EXPTIME", {"unit": u.s}),
        "dark_time": ("DARKTIME", {"unit": u.s}),
        "boresight_rotation_angle": ("ROTPA", {"unit": u.deg}),
        "boresight_rotation_coord": "ROTCOORD",
        "boresight_airmass": "AMSTART",
        "temperature": ("AIRTEMP", {"unit": u.deg_C}),
        "pressure": ("PRESSURE", {"unit": u.Pa}),
        "relative_humidity": "HUMIDITY",
        "focus_z": ("FOCUSZ", {"unit": u.mm}),
    }

    @classmethod
    def observing_date_to_offset(cls, observing_date):
        return TimeDelta(43200.0, format="sec", scale="tai")

    @classmethod
    def fix_header(cls, header, instrument, obsid, filename=None):
        """Correct the rotation of the first nights, as obs_lsst does."""
        is_wrong = 20250301 < int(header["DAYOBS"]) < 20250422 and bool(header["ROTPA"])
        if is_wrong:
            header["ROTPA"] -= 90.0
        return is_wrong

    def to_observing_day(self):
        return int(self._header["DAYOBS"])

    def to_exposure_id(self):
        number = self._header["SEQNUM"]
        # obs_lsst packs it in 15 bits.
        assert 0 <= number < 2**15
        return int(f"{self._header['DAYOBS']}{number:05d}")

    def to_visit_id(self):
        return self.to_exposure_id()

    def to_detector_num(self):
        names = [detector.name for detector in detectors.detectors("lsstcam", MISSION)]
        return names.index(f"{self._header['RAFTBAY']}_{self._header['CCDSLOT']}")

    def to_detector_exposure_id(self):
        return 1000 * self.to_exposure_id() + self.to_detector_num()

    def to_location(self):
        return EarthLocation.from_geodetic(-70.749417, -30.244639, 2663.0)

    def to_datetime_begin(self):
        return Time(self._header["MJD-BEG"], format="mjd", scale="tai")

    def to_exposure_time(self):
        # The shutter does not open for a dark frame.
        return self._header["SHUTTIME"] * u.s if self._header["SHUTTIME"] > 0.0 else self.to_exposure_time_requested()

    def to_observation_type(self):
        return self._header["IMGTYPE"].lower().replace("skyexp", "science")

    def to_tracking_radec(self):
        if self.to_observation_type() in ("bias", "flat"):
            return None
        # obs_lsst takes equal dates as a sign of a repaired header.
        assert self._header["DATE"] != self._header["DATE-OBS"]
        assert self._header["TRACKSYS"] == "RADEC"
        return helpers.tracking_from_degree_headers(self, ("RADESYS",), (("RASTART", "DECSTART"),))

    def to_altaz_begin(self):
        return helpers.altaz_from_degree_headers(self, (("ELSTART", "AZSTART"),), self.to_datetime_begin())

    def to_altaz_end(self):
        return helpers.altaz_from_degree_headers(self, (("ELEND", "AZEND"),), self.to_datetime_end())

    def to_has_simulated_content(self):
        return self._header["CONTRLLR"] in "HPQS"

    def to_can_see_sky(self):
        return self._header["SHUTTIME"] != 0.0 and self._header["VIGN_MIN"] != "FULLY"
