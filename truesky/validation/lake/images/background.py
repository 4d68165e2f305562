"""Check the level of blank sky in an image against the sky brightness and the dark current in its header."""

from __future__ import annotations

import numpy as np

from truesky.validation.lake.measure.frame_context import FrameCheck, FrameContext, require_blank_sky
from truesky.validation.lake.measure.rows import Row, not_applicable

SOURCE = "SKYRATE and DARKRATE of the header, which the sky's model sets (Leinert et al. 1998 in space)"
# Relative tolerance of the level of blank sky. It allows for faint sources, wings of stars, scattered light and
# vignetting, which the expected level does not include.
TOLERANCE = 0.05


def check(context: FrameContext) -> list[Row]:
    """Check the ratio of the measured level of blank sky to the level expected from the header.

    Returns one row (measurement with expected value and verdict). The check does not apply if the expected level is 0.
    """
    assert context.tiles is not None
    header, seconds = context.frame.header, context.frame.seconds
    expected = (float(header["SKYRATE"]) + float(header["DARKRATE"])) * seconds
    if expected <= 0.0:
        return [not_applicable("background", context.place, "the header contains no sky and no dark current", SOURCE)]
    level = context.tiles.level / expected
    context.series["background"] = np.stack([context.tiles.column, context.tiles.row, level], axis=1)
    error = float(np.std(level)) / np.sqrt(len(level))
    note = f"{len(level)} tiles, {expected:.4g} e- expected"
    return [
        Row("background", "level", context.place, float(level.mean()), error, 1.0, TOLERANCE, "", SOURCE, note=note)
    ]


BACKGROUND = FrameCheck("background", SOURCE, require_blank_sky, check)
