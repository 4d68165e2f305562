"""Check the fraction of blank-sky pixels that cosmic rays hit: pixels far above the level without a known source."""

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
# VIS: fraction of the pixels that is hit per second, and its relative tolerance.
_VIS, _VIS_TOLERANCE = 0.025 / 565.0, 0.4
# NISP: hits per pixel (18 um) and second, and pixels per hit, including neighbours to which charge leaks; tolerance.
_NISP, _PIXELS, _NISP_TOLERANCE = 2.6 * 1.8e-3**2, 2.0, 0.6


def check(context: FrameContext) -> list[Row]:
    """Check the fraction of blank pixels that are hit over the expected fraction."""
    assert context.tiles is not None
    usable = context.tiles.blank | context.tiles.hit
    hit = context.tiles.hit & _has_step(context)
    hits, pixels = int(hit.sum()), int(usable.sum())
    if context.channel == "VIS":
        expected, tolerance = _VIS * context.frame.seconds, _VIS_TOLERANCE
    else:
        expected, tolerance = _NISP * _PIXELS * float(context.frame.header["ELAPTIME"]), _NISP_TOLERANCE
    # Pixels of one track are not independent, so the error is from the scatter of the tiles.
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
    """Pixels of the tiles whose ramp has a step; hot pixels have none."""
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
