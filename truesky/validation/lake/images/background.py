"""The level of blank sky against the sky and the dark current of the header."""

from __future__ import annotations

import numpy as np

from truesky.validation.lake.measure.frame_context import FrameCheck, FrameContext, require_blank_sky
from truesky.validation.lake.measure.rows import Row, not_applicable

SOURCE = "SKYRATE and DARKRATE of the header, which the sky's model sets (Leinert et al. 1998 in space)"
# Of the level: what faint sources, wings and scattered light bring, and the fall towards the edge of the field.
TOLERANCE = 0.05


def check(context: FrameContext) -> list[Row]:
    """Mean of blank sky over what the header foresees."""
    assert context.tiles is not None
    header, seconds = context.frame.header, context.frame.seconds
    expected = (float(header["SKYRATE"]) + float(header["DARKRATE"])) * seconds
    if expected <= 0.0:
        return [not_applicable("background", context.place, "the header foresees no sky", SOURCE)]
    level = context.tiles.level / expected
    context.series["background"] = np.stack([context.tiles.column, context.tiles.row, level], axis=1)
    error = float(np.std(level)) / np.sqrt(len(level))
    note = f"{len(level)} tiles, {expected:.4g} e- foreseen"
    return [
        Row("background", "level", context.place, float(level.mean()), error, 1.0, TOLERANCE, "", SOURCE, note=note)
    ]


BACKGROUND = FrameCheck("background", SOURCE, require_blank_sky, check)
