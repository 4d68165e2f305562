"""The calibration lamps of VIS and NISP, and the dome's of ground cameras."""

from __future__ import annotations

from collections.abc import Mapping

# Of the calibration unit (Serrano et al. 2024).
LEDS = 6
# Lamps of NISP's calibration unit (Serrano et al. 2024).
NISP_LAMPS = 5
# Of each camera how many it has, and the passbands of which the one that sees best tells how bright they are.
LAMPS: Mapping[str, tuple[int, tuple[str, ...]]] = {
    "vis": (LEDS, ("euclid_vis",)),
    "nisp": (NISP_LAMPS, ("euclid_y", "euclid_j", "euclid_h")),
}


def count(section: str) -> int:
    """Of a camera, "vis", "nisp" or "ext.decam": of a ground camera's dome one, which shines alike in all bands."""
    return LAMPS[section][0] if section in LAMPS else 1
