"""Add a pointing error to the headers of raw images, since telescopes know their pointing only to some arcseconds.

The true WCS is in the head file, a text file next to the image; all tables of truesky have the true pointing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from lake_schema.fits.images import Card
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.randomness import rng
from truesky.render.camera import astrometry, pointing
from truesky.render.camera.detectors import Detector
from truesky.render.channels import image_types

# Keywords with the rms error of the coordinates (Greisen & Calabretta 2002). Only headers with a pointing error have
# them.
ERRORS = ("CSYER1", "CSYER2")
_TEXT = "[deg] rms error of CRVAL; true WCS in .head"


def commanded_pointing(
    exposure: ExposureRow, detector: Detector, mission: MissionConfiguration, seed: int
) -> tuple[float, float, float]:
    """Return the boresight and the position angle with the pointing error that raw headers of an exposure have.

    Parameters
    ----------
    exposure : ExposureRow
        Row of the table `exposures`, with the true pointing.
    detector : Detector
        Any detector of the camera; the result is the same for every detector.
    mission : MissionConfiguration
        Mission database, with the rms pointing errors of cameras.
    seed : int
        Seed of the request, from which the errors are drawn.

    Returns
    -------
    ra, dec, position_angle : float
        Angles in degrees; the true ones if the camera has no pointing error.

    Notes
    -----
    Offset and rotation have normal distributions. They are the same for repetitions of an exposure that differ only in
    their noise.
    """
    true = exposure.ra, exposure.dec, exposure.position_angle
    offset, rotation = _rms_errors(detector, mission)
    if offset == rotation == 0.0:
        return true
    draws = rng.stream(seed, "exposures.header", image_types.identity(replace(exposure, realisation=None)))
    x, y, turn = (float(normal) for normal in draws.standard_normal(3))
    # The boresight with the error is the one for which the true boresight lies at the offset (x, y) in the focal plane.
    # Adding the offset to ra and dec would be wrong near the poles.
    shifted_detector = replace(detector, x=offset * x, y=offset * y, distortion_terms=())
    ra, dec, angle = pointing.boresight_for(shifted_detector, true[0], true[1], true[2] + rotation * turn / 3600.0)
    return ra, dec, angle


def cards(
    header: Sequence[Card], exposure: ExposureRow, detector: Detector, mission: MissionConfiguration, seed: int
) -> tuple[Card, ...]:
    """Return a header in which the boresight and the linear terms of the WCS have the pointing error of a raw image.

    Parameters
    ----------
    header : sequence of Card
        Header with the true WCS and the distortion as SIP, which does not change.
    exposure : ExposureRow
        Row of the table `exposures`, with the true pointing.
    detector : Detector
        Detector to which the header belongs.
    mission : MissionConfiguration
        Mission database, with the rms pointing errors of cameras.
    seed : int
        Seed of the request, from which the errors are drawn.

    Returns
    -------
    tuple of Card
        The header with the pointing error, and with its rms in the cards CSYER1 and CSYER2. It is the given header if
        the camera has no pointing error.
    """
    offset, rotation = _rms_errors(detector, mission)
    if offset == rotation == 0.0:
        return tuple(header)
    ra, dec, angle = commanded_pointing(exposure, detector, mission, seed)
    raw_values: dict[str, Any] = {"RA": ra, "DEC": dec}
    raw_values |= {
        key: value
        for key, value, _ in astrometry.follow_axes(astrometry.cards(astrometry.wcs(detector, ra, dec, angle)), header)
        if _depends_on_pointing(key)
    }
    out: list[Card] = []
    for key, value, comment in header:
        out.append((key, raw_values.get(key, value), comment))
        if key == "RADESYS":
            out += [(error, offset / 3600.0, _TEXT) for error in ERRORS]
    return tuple(out)


def _depends_on_pointing(keyword: str) -> bool:
    """Return True for the WCS keywords CRVALi and CDi_j, which depend on the boresight and not only on the detector."""
    return keyword.startswith(("CRVAL", "CD"))


def _rms_errors(detector: Detector, mission: MissionConfiguration) -> tuple[float, float]:
    """Return the rms error of each pointing coordinate and the rms error of the position angle, both in arcsec.

    A value that the mission database does not have is 0.
    """
    keys = (f"{detector.section}.header.{name}" for name in ("offset", "rotation"))
    offset, rotation = (mission.value(key, "arcsec") if key in mission else 0.0 for key in keys)
    return offset, rotation
