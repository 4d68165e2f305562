"""What an instrument's files say of where it is, and what its pipeline reads.

of  camera -> Observatory
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Observatory:
    """Of a camera.

    telescope, instrument : as its files name them; "" = it is not told
    convention            : how its pipeline tells the distortion of the optics, one of tpv.CONVENTIONS
    time_scale            : of the times in its files;  ahead : s, of UTC
    """

    telescope: str
    instrument: str
    convention: str
    time_scale: str = "UTC"
    seconds_ahead_of_utc: float = 0.0


# TAI - UTC since 2017.
_TAI = 37.0
# VIS: its distortion model is fitted as SIP (Euclid Data Product Description Document, VIS, Distortion Model). LSST and
# HSC share a pipeline, which writes SIP; those of the others are built about SCAMP and SWarp, which read TPV.
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
    """Of a camera; of one that nothing is known of, with its name, somewhere."""
    return _OBSERVATORIES.get(camera, Observatory("", camera, "sip"))
