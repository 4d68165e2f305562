"""Conventions for the files of each camera: names of telescope, instrument and filters, time scale, distortion.

References
----------
Rubin Observatory, obs_decam, obs_subaru, obs_cfht and obs_lsst: names of filters in raw headers
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Observatory:
    """Names of a camera's telescope and instrument, and the conventions of its files.

    Attributes
    ----------
    telescope, instrument : str
        Names in the headers of the camera's files; "" if unknown.
    convention : str
        How the camera's pipeline writes the distortion of the optics in FITS headers, "sip" or "tpv".
    time_scale : str
        Time scale in the camera's files, such as "UTC" or "TAI".
    seconds_ahead_of_utc : float
        Times in the time scale of the files minus times in UTC, s.
    filters : mapping of str to str
        Names of the filters in the camera's files (keyword FILTER), by name of the passband. A passband that is not in
        the mapping, such as that of a user, has the same name in the files.
    has_noao_sections : bool
        True if DETSEC and DETSIZE count pixels of the mosaic of all detectors, and BIASSEC covers all rows of an array.
        False, as for LSSTCam, if DETSEC and DETSIZE count pixels of the detector, and BIASSEC covers the rows of its
        pixels only.
    """

    telescope: str
    instrument: str
    convention: str
    time_scale: str = "UTC"
    seconds_ahead_of_utc: float = 0.0
    filters: Mapping[str, str] = field(default_factory=dict)
    has_noao_sections: bool = True


# Time in the scale TAI minus time in UTC, s, since 2017.
_TAI = 37.0
_DECAM_FILTERS = {
    "des_g": "g DECam SDSS c0001 4720.0 1520.0",
    "des_r": "r DECam SDSS c0002 6415.0 1480.0",
    "des_i": "i DECam SDSS c0003 7835.0 1470.0",
    "des_z": "z DECam SDSS c0004 9260.0 1520.0",
}
# The passbands r and i are curves of the filters of 2016.
_HSC_FILTERS = {f"hsc_{name[0]}": f"HSC-{name}" for name in ("g", "r2", "i2", "z", "y")}
_MEGACAM_FILTERS = {"cfis_u": "u.MP9302", "cfis_r": "r.MP9602"}
_LSSTCAM_FILTERS = {
    f"{survey}_{name[0]}": name
    for survey in ("lsst", "lsst2016")
    for name in ("u_24", "g_6", "r_57", "i_39", "z_20", "y_10")
}
# The VIS distortion model is fitted as SIP (Euclid Data Product Description Document, VIS, Distortion Model); NISP has
# the same convention. LSST and HSC share a pipeline that writes SIP. The pipelines of the other ground cameras use
# SCAMP and SWarp, which read TPV.
_OBSERVATORIES = {
    "vis": Observatory("Euclid", "VIS", "sip"),
    "nisp": Observatory("Euclid", "NISP", "sip"),
    "decam": Observatory("CTIO 4.0-m telescope", "DECam", "tpv", filters=_DECAM_FILTERS),
    "lsstcam": Observatory("Simonyi Survey Telescope", "LSSTCam", "sip", "TAI", _TAI, _LSSTCAM_FILTERS, False),
    "megacam": Observatory("CFHT 3.6m", "MegaPrime", "tpv", filters=_MEGACAM_FILTERS),
    "jpcam": Observatory("JST250", "JPCam", "tpv"),
    "gpc1": Observatory("PS1", "GPC1", "tpv"),
    "hsc": Observatory("Subaru", "Hyper Suprime-Cam", "sip", filters=_HSC_FILTERS),
}


def for_camera(camera: str) -> Observatory:
    """Return the names of a camera's telescope and instrument, and the conventions of its files.

    For an unknown camera, the instrument has the name of the camera and the telescope the name "". Its files have the
    convention "sip" and times in UTC.
    """
    return _OBSERVATORIES.get(camera, Observatory("", camera, "sip"))
