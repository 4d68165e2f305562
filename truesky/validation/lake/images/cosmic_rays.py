"""How much of blank sky cosmic rays hit: pixels far above the level where no source shines."""

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
# Part of the pixels that are hit a second, and how far from that it may be, as a part of it: VIS.
_VIS, _VIS_TOLERANCE = 0.025 / 565.0, 0.4
# NISP: hits a pixel (18 um) and second, pixels that show one, neighbours to which charge leaks among them.
_NISP, _PIXELS, _NISP_TOLERANCE = 2.6 * 1.8e-3**2, 2.0, 0.6


def check(context: FrameContext) -> list[Row]:
    """Part of the blank pixels that are hit, over what is expected."""
    assert context.tiles is not None
    usable = context.tiles.blank | context.tiles.hit
    hit = context.tiles.hit & _has_step(context)
    hits, pixels = int(hit.sum()), int(usable.sum())
    if context.channel == "VIS":
        expected, tolerance = _VIS * context.frame.seconds, _VIS_TOLERANCE
    else:
        expected, tolerance = _NISP * _PIXELS * float(context.frame.header["ELAPTIME"]), _NISP_TOLERANCE
    # A track is of many pixels that are hit together.
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
    """Pixels of the tiles whose ramp has a step: a hot pixel has none."""
    assert context.tiles is not None
    if context.frame.quality is None:
        return True
    places = zip(context.tiles.row, context.tiles.column, strict=True)
    return np.stack([context.frame.quality[r : r + SIDE, c : c + SIDE] > 0 for r, c in places])


def _why_not_applicable(context: FrameContext) -> str:
    if context.channel not in ("VIS", "NISP-P"):
        return "no rate of its site is published with its tracks"
    return require_blank_sky(context)


COSMIC_RAYS = FrameCheck("cosmic_rays", SOURCE, _why_not_applicable, check)
