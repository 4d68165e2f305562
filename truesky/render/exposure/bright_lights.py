"""Select bright sources on and around a detector, which cause ghosts and scattered light on it."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Float
from truesky.render.camera import astrometry
from truesky.render.channels.aim import Aim
from truesky.render.effects.scene import Lights
from truesky.render.sources.source_list import Sources

# Ghosts and scattered light are computed for sources with more expected electrons per exposure than this.
_MIN_ELECTRONS = 1e6
# The trail of a moving body is divided into pieces of at most this length, pixels. The scattered light of each piece is
# computed as that of a point.
_PIECE = 32.0


def catalogue_lights(galaxies: tuple[pa.Table, Float], stars: tuple[pa.Table, Float], aim: Aim) -> Lights:
    """Select bright catalogue sources on the detector and around it.

    Parameters
    ----------
    galaxies, stars : (Table, float array)
        Catalogue rows, and expected electrons of each.
    aim : Aim
        Exposure and detector.

    Returns
    -------
    Lights
        Sources with more than 1e6 electrons by ascending identifier, also outside the detector. Empty if there are
        none.
    """
    columns = []
    for rows, electrons in (galaxies, stars):
        bright = np.flatnonzero(electrons > _MIN_ELECTRONS)
        chosen = rows.select(["id", "ra", "dec"]).take(bright)
        column, row = astrometry.pixel_of_sky(aim.wcs, chosen["ra"].to_numpy(), chosen["dec"].to_numpy())
        place = column - aim.drawn.column, row - aim.drawn.row
        columns.append((chosen["id"].to_numpy(), *place, electrons[bright]))
    ids, column, row, electrons = (np.concatenate(part) for part in zip(*columns, strict=True))
    order = np.argsort(ids)
    return Lights(column[order], row[order], electrons[order])


def trail_lights(bodies: Sources) -> Lights:
    """Return the moving bodies with more than 1e6 electrons as several points along their trails.

    The electrons of a body are divided equally among its points. Neighbouring points are at most 32 pixels apart, which
    is small compared with the extent of scattered light.
    """
    bright = np.flatnonzero(bodies.electrons > _MIN_ELECTRONS)
    pieces = np.ceil(bodies.trail_length[bright] / _PIECE).astype(np.int64) + 1
    body, first = np.repeat(bright, pieces), np.repeat(np.cumsum(pieces) - pieces, pieces)
    count = np.repeat(pieces, pieces)
    # Position of each point along the trail as a fraction of the trail's length, from -0.5 to 0.5 with 0 in the middle.
    place = (np.arange(len(body)) - first + 0.5) / count - 0.5
    trail = np.zeros((len(bodies), 2)) if bodies.trail is None else bodies.trail
    along = place[:, None] * trail[body]
    return Lights(bodies.column[body] + along[:, 0], bodies.row[body] + along[:, 1], bodies.electrons[body] / count)
