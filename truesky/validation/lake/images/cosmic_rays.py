"""How much of blank sky cosmic rays hit: pixels far above the level where no source shines."""

from __future__ import annotations

from typing import Any

import numpy as np

from truesky.validation.lake.measure.blank import SIDE
from truesky.validation.lake.measure.rows import Row
from truesky.validation.lake.measure.seen import Check, Seen, wants_blank

SOURCE = (
    "VIS: 1 cm-2 s-1 with STARDUST track lengths, 2 to 3 % of the pixels in 565 s (Niemi 2015); NISP: 2.6 cm-2 s-1 "
    "through 7 um of HgCdTe"
)
# Part of the pixels that are hit a second, and how far from that it may be, as a part of it: VIS.
_VIS, _VIS_MOST = 0.025 / 565.0, 0.4
# NISP: hits a pixel (18 um) and second, pixels that show one, neighbours to which charge leaks among them.
_NISP, _PIXELS, _NISP_MOST = 2.6 * 1.8e-3**2, 2.0, 0.6


def check(of: Seen) -> list[Row]:
    """Part of the blank pixels that are hit, over what is expected."""
    assert of.tiles is not None
    seen = of.tiles.blank | of.tiles.hit
    hit = of.tiles.hit & _stepped(of)
    hits, pixels = int(hit.sum()), int(seen.sum())
    if of.channel == "VIS":
        told, tolerance = _VIS * of.frame.seconds, _VIS_MOST
    else:
        told, tolerance = _NISP * _PIXELS * float(of.frame.header["ELAPTIME"]), _NISP_MOST
    # A track is of many pixels that are hit together.
    each = hit.sum(axis=(1, 2)) / np.maximum(seen.sum(axis=(1, 2)), 1)
    error = float(each.std() / np.sqrt(len(each))) if hits else float(np.sqrt(told / pixels))
    note = f"{pixels} pixels without sources, {hits} of them hit"
    return [Row("cosmic_rays", "cover", of.place, hits / pixels / told, error / told, 1.0, tolerance, "", SOURCE,
                note=note)]  # fmt: skip


def _stepped(of: Seen) -> Any:
    """Pixels of the tiles whose ramp has a step: a hot pixel has none."""
    assert of.tiles is not None
    if of.frame.quality is None:
        return True
    places = zip(of.tiles.row, of.tiles.column, strict=True)
    return np.stack([of.frame.quality[r : r + SIDE, c : c + SIDE] > 0 for r, c in places])


def _applies(of: Seen) -> str:
    if of.channel not in ("VIS", "NISP-P"):
        return "no rate of its site is published with its tracks"
    return wants_blank(of)


COSMIC_RAYS = Check("cosmic_rays", SOURCE, _applies, check)
