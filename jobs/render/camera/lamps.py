"""The calibration lamps of VIS and NISP."""

from __future__ import annotations

# Of the calibration unit (Serrano et al. 2024).
LEDS = 6
# Lamps of NISP's calibration unit (Serrano et al. 2024).
NISP_LAMPS = 5
