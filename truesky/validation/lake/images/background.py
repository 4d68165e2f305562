"""The level of blank sky against the sky and the dark current of the header."""

from __future__ import annotations

import numpy as np

from truesky.validation.lake.measure.rows import Row, not_applicable
from truesky.validation.lake.measure.seen import Check, Seen, wants_blank

SOURCE = "SKYRATE and DARKRATE of the header, which the sky's model sets (Leinert et al. 1998 in space)"
# Of the level: what faint sources, wings and scattered light bring, and the fall towards the edge of the field.
TOLERANCE = 0.05


def check(of: Seen) -> list[Row]:
    """Mean of blank sky over what the header foresees."""
    assert of.tiles is not None
    header, seconds = of.frame.header, of.frame.seconds
    told = (float(header["SKYRATE"]) + float(header["DARKRATE"])) * seconds
    if told <= 0.0:
        return [not_applicable("background", of.place, "the header foresees no sky", SOURCE)]
    level = of.tiles.level / told
    of.series["background"] = np.stack([of.tiles.column, of.tiles.row, level], axis=1)
    error = float(np.std(level)) / np.sqrt(len(level))
    note = f"{len(level)} tiles, {told:.4g} e- foreseen"
    return [Row("background", "level", of.place, float(level.mean()), error, 1.0, TOLERANCE, "", SOURCE, note=note)]


BACKGROUND = Check("background", SOURCE, wants_blank, check)
