"""Calibration lamps of VIS and NISP, and dome lamps of ground cameras."""

from __future__ import annotations

from collections.abc import Mapping

# Number of light-emitting diodes (LEDs) of the VIS calibration unit (Serrano et al. 2024).
LEDS = 6
# Number of lamps of the NISP calibration unit (Serrano et al. 2024).
NISP_LAMPS = 5
# For each camera with several lamps: their number, and the camera's built-in passbands. The brightness of a lamp is
# defined relative to the highest response of any of these passbands.
LAMPS: Mapping[str, tuple[int, tuple[str, ...]]] = {
    "vis": (LEDS, ("euclid_vis",)),
    "nisp": (NISP_LAMPS, ("euclid_y", "euclid_j", "euclid_h")),
}


def count(section: str) -> int:
    """Return the number of calibration lamps of a camera.

    `section` is the camera's prefix in the mission database: "vis", "nisp" or, for instance, "ext.decam". All cameras
    except VIS and NISP have one white lamp.
    """
    return LAMPS[section][0] if section in LAMPS else 1
