"""Non-linearity of each pixel from flats of one lamp at several levels.

Of x times the lamp's light a pixel gets g x electrons, of which Q are seen; g and b of N (1 - b N) are fitted to them.

series    of flats those that are of use
fitted    b of each pixel, with its uncertainty
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from lake_schema.arrays import Array, Float
from truesky.reduction.combining import Combined
from truesky.reduction.frames import Frame
from truesky.reduction.infrared.ramps import Bend, Estimator

# Levels, the brightest over the faintest at least, rounds of the fit, standard deviations of a frame that is left out.
_LEVELS, _RANGE, _ROUNDS, _CLIP = 3, 3.0, 4, 5.0
# Rows that are fitted at a time: memory.
_ROWS = 32


def series(flats: Sequence[Frame]) -> list[Frame]:
    """Flats of one channel, band, lamp and ramp at three levels or more; of several series the longest; else none."""
    groups: dict[tuple[object, ...], list[Frame]] = defaultdict(list)
    for frame in flats:
        groups[frame.exposure.channel, frame.exposure.band, frame.scene.lamp, frame.ramp].append(frame)
    useful = [
        own
        for own in groups.values()
        if len(levels := {_level(frame) for frame in own}) >= _LEVELS and max(levels) > _RANGE * min(levels)
    ]
    return max(useful, key=len, default=[])


def _level(frame: Frame) -> float:
    return frame.scene.value("flat.signal", "electron")


def fitted(frames: Sequence[Frame], added: Callable[[Frame], tuple[Float, Float | float]], scratch: Path) -> Combined:
    """b of every pixel, 1/e-, and its uncertainty: of each pixel's own fit what its noise allows, else the median.

    frames  : of `series`;  added : frame -> e- [ny, nx] of persistence and of dark current in it
    scratch : folder for the frames meanwhile: 8 bytes a pixel and frame
    Error   : the lamp's levels are taken as exact, as they are told; what a pixel's traps have of their own is unknown
    """
    scene, applied = frames[0].scene, frames[0].applied
    estimator, bend = Estimator.of(scene, applied), Bend.of(scene, applied)
    levels = np.array([_level(frame) for frame in frames]) / max(map(_level, frames))
    shape, spread = (scene.ny, scene.nx), scene.value("persistence.spread", "")
    seen, more = (np.memmap(scratch / name, np.float32, "w+", shape=(len(frames), *shape)) for name in ("seen", "more"))
    noise = np.zeros(len(frames))
    for number, frame in enumerate(frames):
        estimated, (left, dark) = frame.electrons(), added(frame)
        seen[number] = estimated - estimator.bias(estimated)
        more[number] = left + dark
        typical, remembered = float(np.median(estimated)), float(np.median(left))
        noise[number] = float(estimator.variance(np.array(typical))) + (spread * remembered) ** 2
    b, sigma, count = np.zeros(shape), np.ones(shape), np.zeros(shape, np.int16)
    for first in range(0, shape[0], _ROWS):
        rows = slice(first, first + _ROWS)
        part = np.asarray(seen[:, rows], float), np.asarray(more[:, rows], float)
        b[rows], sigma[rows], count[rows] = _of_rows(*part, levels, noise, bend)
    del seen, more
    for name in ("seen", "more"):
        (scratch / name).unlink()
    return _as_sure_as_it_is(b, sigma, count)


def _of_rows(seen: Float, added: Float, levels: Float, noise: Float, bend: Bend) -> tuple[Float, Float, Array]:
    """(b, its uncertainty, frames that are left) of pixels [rows, nx], of frames of which these [n, rows, nx] are seen.

    seen, added : e- that are seen, and of these what is no light of the lamp's
    levels, noise : [n] of the lamp, and variance of what is seen;  bend : of the ramp
    """
    b, kept, x = np.zeros(seen.shape[1:]), np.ones(seen.shape, bool), levels[:, None, None]
    sigma = np.full(b.shape, np.inf)
    for _ in range(_ROUNDS):
        came = bend.linearised(seen, b)
        y, c = came - added, bend.slope(came)
        weight = kept / noise[:, None, None]
        xx, xc, cc, xy, cy = ((weight * part).sum(axis=0) for part in (x * x, -x * c, c * c, x * y, -c * y))
        determinant = xx * cc - xc * xc
        with np.errstate(divide="ignore", invalid="ignore"):
            gain, more, sigma = (cc * xy - xc * cy) / determinant, (xx * cy - xc * xy) / determinant, xx / determinant
        enough = (kept.sum(axis=0) >= _LEVELS) & np.isfinite(more)
        gain, more = np.where(enough, gain, 0.0), np.where(enough, more, 0.0)
        kept = np.abs(y + more * c - gain * x) <= _CLIP * np.sqrt(noise)[:, None, None]
        # A tenth of its own signal at most: a dead pixel has no b.
        b = np.clip(b + more, 0.0, 0.1 / np.maximum(y.max(axis=0), 1.0))
    return b, np.where(enough, np.sqrt(sigma), np.inf), kept.sum(axis=0).astype(np.int16)


def _as_sure_as_it_is(b: Float, sigma: Float, count: Array) -> Combined:
    """Each pixel's b and the median of all, by their variances."""
    sure = np.isfinite(sigma) & (b > 0.0)
    middle = float(np.median(b[sure])) if sure.any() else 0.0
    width = 1.4826 * float(np.median(np.abs(b[sure] - middle))) if sure.any() else 0.0
    own = max(width**2 - float(np.median(sigma[sure])) ** 2, (0.01 * middle) ** 2) if sure.any() else 0.0
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(sure, own / (own + sigma**2), 0.0)
    mean = middle + share * (b - middle)
    return Combined(mean.astype(np.float32), np.sqrt((1.0 - share) * own).astype(np.float32), count)
