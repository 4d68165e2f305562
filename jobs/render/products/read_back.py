"""A science file -> pixels.

frame      a science file -> the detector's pixels in one piece, ADU
electrons  the same less the level of each amplifier's overscan
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from jobs.render.effects.readout import quadrants
from lake_schema.fits import images


def frame(path: Path) -> images.Image:
    """A science file's pixels [ny, nx], uint16 ADU, without pre- and overscan, with the header of the whole."""
    read = images.read_images(path)
    if read[0].data is not None:
        return read[0]
    raw, sizes = _raw(read)
    return images.Image(quadrants.assembled(raw, *sizes), read[0].cards)


def electrons(path: Path) -> images.Image:
    """A science file's pixels [ny, nx], float64 e- above the level of each amplifier."""
    read = images.read_images(path)
    header = {keyword: value for keyword, value, _ in read[0].cards}
    if read[0].data is not None:
        return images.Image((read[0].data - float(header["BIAS"])) * float(header["GAIN"]), read[0].cards)
    raw, sizes = _raw(read)
    # In the extension's header where the amplifiers have different gains.
    own = [{**header, **{keyword: value for keyword, value, _ in unit.cards}} for unit in read[1:]]
    gain = np.array([float(cards["GAIN"]) for cards in own]).reshape(-1, 1, 1)
    _, overscan, rows, _ = sizes
    # The last half of the columns after the pixels: charge that traps gave back is in the first.
    level = raw[:, : raw.shape[1] - rows, raw.shape[2] - max(overscan // 2, 1) :].mean(axis=(1, 2), keepdims=True)
    above = quadrants.assembled((raw - level) * gain, *sizes)
    return images.Image(above, read[0].cards)


def _raw(read: Sequence[images.Image]) -> tuple[npt.NDArray[np.uint16], tuple[int, int, int, int]]:
    """Quadrants in readout order; prescan, overscan, overscan rows, rows between the halves."""
    header = {keyword: value for keyword, value, _ in read[0].cards}
    raw = np.stack([quadrants.placed(np.asarray(unit.data), number) for number, unit in enumerate(read[1:])])
    prescan, overscan, rows = (int(header[key]) for key in ("PRESCAN", "OVERSCAN", "OVERROWS"))
    # Files of older versions know nothing of rows between the halves.
    return raw, (prescan, overscan, rows, int(header.get("INJROWS", 0)))
