"""Where a raw frame says that it looks: a telescope knows its place and its angle no better than to some arcseconds.

Beside the frame its head file has the true solution, as has all else that is said of an exposure.

believed   (right ascension, declination, position angle) of an exposure in its raw headers
cards      a header with these in place of the true ones
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from lake_schema.fits.images import Card
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.randomness import rng
from truesky.render.camera import astrometry, pointing
from truesky.render.camera.detectors import Detector
from truesky.render.channels import image_types

# Of a header whose place is not the true one, its error (FITS, paper I).
ERRORS = ("CSYER1", "CSYER2")
_TEXT = "[deg] rms error of CRVAL; true: .head"


def commanded_pointing(
    exposure: ExposureRow, detector: Detector, mission: MissionConfiguration, seed: int
) -> tuple[float, float, float]:
    """Boresight and position angle as all raw headers of an exposure have them, deg; the true ones without an error.

    Offset and rotation are normal, of the camera's rms errors, and the same for exposures that differ in their noise.

    exposure : its row;  detector : of its camera;  mission : the mission database;  seed : of the request
    """
    true = exposure.ra, exposure.dec, exposure.position_angle
    offset, rotation = _rms_errors(detector, mission)
    if offset == rotation == 0.0:
        return true
    draws = rng.stream(seed, "exposures.header", image_types.identity(replace(exposure, realisation=None)))
    x, y, turn = (float(normal) for normal in draws.standard_normal(3))
    # As if what is at (x, y) of the field were in its middle: right at the poles, too.
    shifted_detector = replace(detector, x=offset * x, y=offset * y, distortion_terms=())
    ra, dec, angle = pointing.boresight_for(shifted_detector, true[0], true[1], true[2] + rotation * turn / 3600.0)
    return ra, dec, angle


def cards(
    header: Sequence[Card], exposure: ExposureRow, detector: Detector, mission: MissionConfiguration, seed: int
) -> tuple[Card, ...]:
    """A header of a raw frame: its boresight and its linear terms are the believed ones, the distortion is the true.

    header : with the true system, the distortion as SIP
    exposure, detector, mission, seed : of `believed`
    """
    offset, rotation = _rms_errors(detector, mission)
    if offset == rotation == 0.0:
        return tuple(header)
    ra, dec, angle = commanded_pointing(exposure, detector, mission, seed)
    raw_values = {"RA": ra, "DEC": dec}
    raw_values |= {
        key: value
        for key, value, _ in astrometry.cards(astrometry.wcs(detector, ra, dec, angle))
        if _depends_on_pointing(key)
    }
    out: list[Card] = []
    for key, value, comment in header:
        out.append((key, raw_values.get(key, value), comment))
        if key == "RADESYS":
            out += [(error, offset / 3600.0, _TEXT) for error in ERRORS]
    return tuple(out)


def _depends_on_pointing(keyword: str) -> bool:
    """Of a system, what another boresight changes: pixels and their distortion are the detector's."""
    return keyword.startswith(("CRVAL", "CD"))


def _rms_errors(detector: Detector, mission: MissionConfiguration) -> tuple[float, float]:
    """arcsec rms of each coordinate, and of the position angle; of spacecraft nothing is known of one."""
    keys = (f"{detector.section}.header.{name}" for name in ("offset", "rotation"))
    offset, rotation = (mission.value(key, "arcsec") if key in mission else 0.0 for key in keys)
    return offset, rotation
