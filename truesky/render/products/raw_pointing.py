"""Add a pointing error to the headers of raw images, since telescopes know their pointing only to some arcseconds.

The head file next to the image has the true solution, and so have all tables.
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

# Keywords of the WCS error in a header without the true pointing (FITS, paper I).
ERRORS = ("CSYER1", "CSYER2")
_TEXT = "[deg] rms error of CRVAL; true WCS in .head"


def commanded_pointing(
    exposure: ExposureRow, detector: Detector, mission: MissionConfiguration, seed: int
) -> tuple[float, float, float]:
    """Return the boresight and position angle that all raw headers of an exposure have.

    Parameters
    ----------
    exposure : ExposureRow
        Row of the table `exposures`.
    detector : Detector
        A detector of the camera.
    mission : MissionConfiguration
        The mission database.
    seed : int
        Seed of the request.

    Returns
    -------
    ra, dec, position_angle : float
        Angles in degrees; the true ones if the camera has no error.

    Notes
    -----
    Offset and rotation are drawn from normal distributions with the rms errors of the camera. They are the same for
    exposures that differ only in their noise.
    """
    true = exposure.ra, exposure.dec, exposure.position_angle
    offset, rotation = _rms_errors(detector, mission)
    if offset == rotation == 0.0:
        return true
    draws = rng.stream(seed, "exposures.header", image_types.identity(replace(exposure, realisation=None)))
    x, y, turn = (float(normal) for normal in draws.standard_normal(3))
    # Treat the position (x, y) of the field as its centre. This is correct at the poles, too.
    shifted_detector = replace(detector, x=offset * x, y=offset * y, distortion_terms=())
    ra, dec, angle = pointing.boresight_for(shifted_detector, true[0], true[1], true[2] + rotation * turn / 3600.0)
    return ra, dec, angle


def cards(
    header: Sequence[Card], exposure: ExposureRow, detector: Detector, mission: MissionConfiguration, seed: int
) -> tuple[Card, ...]:
    """Return the header of a raw image: boresight and linear terms have the pointing error, the distortion is true.

    Parameters
    ----------
    header : sequence of Card
        Header with the true WCS and the distortion as SIP.
    exposure : ExposureRow
        Row of the table `exposures`.
    detector : Detector
        The detector.
    mission : MissionConfiguration
        The mission database.
    seed : int
        Seed of the request.

    Returns
    -------
    tuple of Card
        The header with the pointing error and its rms, or the given header if the camera has no error.
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
    """Return True if a WCS keyword depends on the boresight. Pixels and distortion depend only on the detector."""
    return keyword.startswith(("CRVAL", "CD"))


def _rms_errors(detector: Detector, mission: MissionConfiguration) -> tuple[float, float]:
    """Return the rms errors (arcsec) of each coordinate and of the position angle; 0 if the database has no value."""
    keys = (f"{detector.section}.header.{name}" for name in ("offset", "rotation"))
    offset, rotation = (mission.value(key, "arcsec") if key in mission else 0.0 for key in keys)
    return offset, rotation
