"""Bright sources on and around a detector, which make ghosts and scattered light; long trails as points."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from astropy.wcs import WCS

from lake_schema.arrays import Float
from truesky.render.camera import astrometry
from truesky.render.effects.scene import Lights
from truesky.render.sources.source_list import Sources

# Electrons of a source that may shine where it is not.
_MIN_ELECTRONS = 1e6
# Pixels of a trail whose scattered light is that of a point.
_PIECE = 32.0


def catalogue_lights(galaxies: tuple[pa.Table, Float], stars: tuple[pa.Table, Float], wcs: WCS) -> Lights:
    """Bright sources on the detector and around it, as far as rows were given.

    galaxies, stars : rows, and expected electrons of each
    system          : world coordinates of the detector
    """
    columns = []
    for rows, electrons in (galaxies, stars):
        bright = np.flatnonzero(electrons > _MIN_ELECTRONS)
        chosen = rows.select(["id", "ra", "dec"]).take(bright)
        column, row = astrometry.pixel_of_sky(wcs, chosen["ra"].to_numpy(), chosen["dec"].to_numpy())
        columns.append((chosen["id"].to_numpy(), column, row, electrons[bright]))
    ids, column, row, electrons = (np.concatenate(part) for part in zip(*columns, strict=True))
    order = np.argsort(ids)
    return Lights(column[order], row[order], electrons[order])


def trail_lights(bodies: Sources) -> Lights:
    """Bright bodies as points along their trails, close to each other beside the extent of scattered light."""
    bright = np.flatnonzero(bodies.electrons > _MIN_ELECTRONS)
    pieces = np.ceil(bodies.trail_length[bright] / _PIECE).astype(np.int64) + 1
    body, first = np.repeat(bright, pieces), np.repeat(np.cumsum(pieces) - pieces, pieces)
    count = np.repeat(pieces, pieces)
    # Of the trail, from its middle.
    place = (np.arange(len(body)) - first + 0.5) / count - 0.5
    trail = np.zeros((len(bodies), 2)) if bodies.trail is None else bodies.trail
    along = place[:, None] * trail[body]
    return Lights(bodies.column[body] + along[:, 0], bodies.row[body] + along[:, 1], bodies.electrons[body] / count)
