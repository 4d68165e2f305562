"""Check the fraction of blank-sky pixels hit by cosmic rays: pixels far above the sky level without a known source."""

from __future__ import annotations

from typing import Any

import numpy as np

from truesky.validation.lake.measure.blank_sky import SIDE
from truesky.validation.lake.measure.frame_context import FrameCheck, FrameContext, require_blank_sky
from truesky.validation.lake.measure.rows import Row

SOURCE = (
    "VIS: 1 cm-2 s-1 with STARDUST track lengths, 2 to 3 % of the pixels in 565 s (Niemi 2015); NISP: 2.6 cm-2 s-1 "
    "through 7 um of HgCdTe"
)
# Expected fraction of the pixels of VIS that cosmic rays hit per second of exposure time.
_VIS = 0.025 / 565.0
# Relative tolerance of the fraction of pixels hit by cosmic rays in VIS.
_VIS_TOLERANCE = 0.4
# Expected number of cosmic rays that hit a pixel of NISP (18 x 18 um) per second: 2.6 per cm^2.
_NISP = 2.6 * 1.8e-3**2
# Expected number of pixels above the detection limit per cosmic ray in NISP, including neighbours to which charge
# leaks.
_PIXELS = 2.0
# Relative tolerance of the fraction of pixels hit by cosmic rays in NISP.
_NISP_TOLERANCE = 0.6


def check(context: FrameContext) -> list[Row]:
    """Check the ratio of the fraction of blank pixels that are hit to the fraction expected for the exposure time.

    Returns one row (measurement with expected value and verdict).
    """
    assert context.tiles is not None
    usable = context.tiles.blank | context.tiles.hit
    hit = context.tiles.hit & _has_step(context)
    hits, pixels = int(hit.sum()), int(usable.sum())
    if context.channel == "VIS":
        expected, tolerance = _VIS * context.frame.seconds, _VIS_TOLERANCE
    else:
        expected, tolerance = _NISP * _PIXELS * float(context.frame.header["ELAPTIME"]), _NISP_TOLERANCE
    # Take the error from the scatter between tiles, because the pixels of one track are not independent.
    tile_shares = hit.sum(axis=(1, 2)) / np.maximum(usable.sum(axis=(1, 2)), 1)
    error = float(tile_shares.std() / np.sqrt(len(tile_shares))) if hits else float(np.sqrt(expected / pixels))
    note = f"{pixels} pixels without sources, {hits} of them hit"
    return [
        Row(
            "cosmic_rays",
            "cover",
            context.place,
            hits / pixels / expected,
            error / expected,
            1.0,
            tolerance,
            "",
            SOURCE,
            note=note,
        )
    ]


def _has_step(context: FrameContext) -> Any:
    """Return a mask of the tiles' pixels that a cosmic ray may have hit during an infrared ramp (series of reads).

    These are pixels in which chi^2 of the fit to the ramp, or the flag of a bad fit, is above 0. Hot pixels, whose
    charge increases evenly, are thus left out. The result is True for detectors that are read only once.
    """
    assert context.tiles is not None
    if context.frame.quality is None:
        return True
    places = zip(context.tiles.row, context.tiles.column, strict=True)
    return np.stack([context.frame.quality[r : r + SIDE, c : c + SIDE] > 0 for r, c in places])


def _why_not_applicable(context: FrameContext) -> str:
    if context.channel not in ("VIS", "NISP-P"):
        return "no rate and track lengths are published for its site"
    return require_blank_sky(context)


COSMIC_RAYS = FrameCheck("cosmic_rays", SOURCE, _why_not_applicable, check)
