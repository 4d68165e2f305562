"""Names of telescopes and instruments, time scales, and distortion conventions for the files of each camera."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Observatory:
    """Observatory and file conventions of a camera.

    Attributes
    ----------
    telescope, instrument : str
        Names in its files; "" if unknown.
    convention : str
        Convention of its pipeline for the distortion of the optics, one of `tpv.CONVENTIONS`.
    time_scale : str
        Scale of the times in its files.
    seconds_ahead_of_utc : float
        Difference between that scale and UTC, s.
    """

    telescope: str
    instrument: str
    convention: str
    time_scale: str = "UTC"
    seconds_ahead_of_utc: float = 0.0


# TAI - UTC since 2017, s.
_TAI = 37.0
# The VIS distortion model is fitted as SIP (Euclid Data Product Description Document, VIS, Distortion Model). LSST and
# HSC share a pipeline that writes SIP. The pipelines of the other cameras use SCAMP and SWarp, which read TPV.
_OBSERVATORIES = {
    "vis": Observatory("Euclid", "VIS", "sip"),
    "nisp": Observatory("Euclid", "NISP", "sip"),
    "decam": Observatory("CTIO 4.0-m telescope", "DECam", "tpv"),
    "lsstcam": Observatory("Simonyi Survey Telescope", "LSSTCam", "sip", "TAI", _TAI),
    "megacam": Observatory("CFHT 3.6m", "MegaPrime", "tpv"),
    "jpcam": Observatory("JST250", "JPCam", "tpv"),
    "gpc1": Observatory("PS1", "GPC1", "tpv"),
    "hsc": Observatory("Subaru", "Hyper Suprime-Cam", "sip"),
}


def for_camera(camera: str) -> Observatory:
    """Observatory of a camera; for an unknown camera, only the name of the instrument is set."""
    return _OBSERVATORIES.get(camera, Observatory("", camera, "sip"))
