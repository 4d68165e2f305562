"""Conventions for the files of each camera: names of telescope and instrument, time scale, form of the distortion."""

from __future__ import annotations

from dataclasses import dataclass


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
    has_noao_sections: bool = True


# Time in the scale TAI minus time in UTC, s, since 2017.
_TAI = 37.0
# The VIS distortion model is fitted as SIP (Euclid Data Product Description Document, VIS, Distortion Model); NISP has
# the same convention. LSST and HSC share a pipeline that writes SIP. The pipelines of the other ground cameras use
# SCAMP and SWarp, which read TPV.
_OBSERVATORIES = {
    "vis": Observatory("Euclid", "VIS", "sip"),
    "nisp": Observatory("Euclid", "NISP", "sip"),
    "decam": Observatory("CTIO 4.0-m telescope", "DECam", "tpv"),
    "lsstcam": Observatory("Simonyi Survey Telescope", "LSSTCam", "sip", "TAI", _TAI, has_noao_sections=False),
    "megacam": Observatory("CFHT 3.6m", "MegaPrime", "tpv"),
    "jpcam": Observatory("JST250", "JPCam", "tpv"),
    "gpc1": Observatory("PS1", "GPC1", "tpv"),
    "hsc": Observatory("Subaru", "Hyper Suprime-Cam", "sip"),
}


def for_camera(camera: str) -> Observatory:
    """Return the names of a camera's telescope and instrument, and the conventions of its files.

    For an unknown camera, the instrument has the name of the camera and the telescope the name "". Its files have the
    convention "sip" and times in UTC.
    """
    return _OBSERVATORIES.get(camera, Observatory("", camera, "sip"))
