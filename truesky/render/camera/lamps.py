"""Calibration lamps of VIS and NISP, and dome lamps of ground cameras."""

from __future__ import annotations

from collections.abc import Mapping

# Light-emitting diodes of the VIS calibration unit (Serrano et al. 2024).
LEDS = 6
# Lamps of NISP's calibration unit (Serrano et al. 2024).
NISP_LAMPS = 5
# Number of lamps of each camera, and its passbands. The passband with the highest response defines their brightness.
LAMPS: Mapping[str, tuple[int, tuple[str, ...]]] = {
    "vis": (LEDS, ("euclid_vis",)),
    "nisp": (NISP_LAMPS, ("euclid_y", "euclid_j", "euclid_h")),
}


def count(section: str) -> int:
    """Number of lamps of a camera ("vis", "nisp" or, for instance, "ext.decam"); ground cameras have one white lamp."""
    return LAMPS[section][0] if section in LAMPS else 1
