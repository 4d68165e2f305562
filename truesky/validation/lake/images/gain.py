"""The gain by two frames of a detector: what the response of its pixels brings is in both and falls out.

Counts of S electrons have the variance S. Neighbours that share charge, by capacitance or because a full pixel repels
it, take part of this variance to the covariances with them, whose sum is kept; rows or columns with offsets of their
own, and slopes, reach further than neighbours do, and are taken off by the covariances there.
Ref: Janesick 2007, Photon Transfer; Antilogus et al. 2014, JINST 9, C03048; Moore et al. 2006, Opt. Eng. 45, 076402
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Bool
from truesky.validation.lake.images.noise import ramp_factor, reading
from truesky.validation.lake.measure import blank, covariances, frames
from truesky.validation.lake.measure.blank import Tiles
from truesky.validation.lake.measure.frames import Amplifier, Frame
from truesky.validation.lake.measure.references import Reference
from truesky.validation.lake.measure.rows import Row, not_applicable
from truesky.validation.lake.measure.seen import RAMPS, Check, Seen

SOURCE = "photon transfer of two frames (Janesick 2007); covariances: Antilogus et al. 2014, JINST 9, C03048"
TOLERANCE = 0.015
# Pixels about one that share its charge, to either side: of the sky, and from so many e- on.
_NEAR, _WIDE, _MUCH = 1, 2, 5000.0
# Levels of the two frames, one over the other, at most: of the sky, of flats, which the frames before shine through;
# part of the full well; pixels that an amplifier wants.
_UNLIKE, _UNLIKE_FLATS, _FULL, _LEAST = 30.0, 1.03, 0.7, 60_000


def check(of: Seen) -> list[Row]:
    """Of each amplifier, and the mean of them."""
    assert of.before is not None
    other = frames.opened(of.before.path, of.frame.instrument)
    if other.electrons.shape != of.frame.electrons.shape:
        return [not_applicable("gain", of.place, "the other frame is of another size", SOURCE)]
    unlike = _UNLIKE if of.sees_sky else _UNLIKE_FLATS
    two = [_tiles(of.frame, of.known), _tiles(other, of.before.known)]
    factor = ramp_factor(of) if of.channel in RAMPS else 1.0
    found = []
    for amplifier, again in zip(of.frame.amplifiers, other.amplifiers, strict=True):
        one = _of(of.frame, two, (amplifier, again), factor, unlike)
        if one is not None:
            found.append((amplifier.name.rpartition(".")[2], *one))
    beside = f"with exposure {of.before.exposure_id}"
    if not found:
        why = f"{beside}: no {_LEAST} blank pixels of an amplifier, or levels that are too unlike or too full"
        return [not_applicable("gain", of.place, why, SOURCE)]
    rows = [Row("gain", f"pair_{name}", of.place, gain, error, 1.0, TOLERANCE, "", SOURCE,
                note=f"{pixels} blank pixels, level {level:.4g} e-, {beside}")
            for name, gain, error, level, pixels in found if len(found) > 1]  # fmt: skip
    gains, errors = (np.array([one[i] for one in found]) for i in (1, 2))
    weight = 1.0 / errors**2
    mean, error = float((weight * gains).sum() / weight.sum()), float(weight.sum() ** -0.5)
    note = f"{sum(one[4] for one in found)} blank pixels of {len(found)} amplifiers, {beside}"
    return [*rows, Row("gain", "pair", of.place, mean, error, 1.0, TOLERANCE, "", SOURCE, note=note)]


def _tiles(frame: Frame, known: Reference) -> Tiles:
    return blank.tiles(frame, known, blank.rough_noise(frame), every=1)


def _of(
    frame: Frame, two: list[Tiles], amplifiers: tuple[Amplifier, Amplifier], factor: float, unlike: float
) -> tuple[float, float, float, int] | None:
    """(gain over the header's, its error, level e-, pixels) of an amplifier; None where there is too little."""
    a, b = (tiles.of(amplifier) for tiles, amplifier in zip(two, amplifiers, strict=True))
    a, b = a.where(_held(a, b)), b.where(_held(b, a))
    both = a.blank & b.blank
    enough = both.sum(axis=(1, 2)) > 0.2 * blank.SIDE**2
    a, b, both = a.where(enough), b.where(enough), both[enough]
    many = int(both.sum())
    if many < _LEAST or len(both) < 2:
        return None
    light = [np.asarray(frame.light(tiles.pixels), np.float64) for tiles in (a, b)]
    level = [float(np.mean(one[both])) for one in light]
    if min(level) <= 0.0 or max(level) > _FULL * amplifiers[0].full:
        return None
    ratio = level[0] / level[1]
    if not 1.0 / unlike < ratio < unlike:
        return None
    value, error = covariances.own_variance(light[0] - ratio * light[1], both, _WIDE if max(level) > _MUCH else _NEAR)
    own = value - reading(amplifiers[0]) - ratio**2 * reading(amplifiers[1])
    if own <= 0.0:
        return None
    gain = factor * (level[0] + ratio**2 * level[1]) / own
    return gain, gain * error / own, level[0], many


def _held(a: Tiles, b: Tiles) -> Bool:
    """bool[t] of the tiles of a: those that b has, too."""
    there = set(zip(b.row.tolist(), b.column.tolist(), strict=True))
    return np.array([place in there for place in zip(a.row.tolist(), a.column.tolist(), strict=True)], bool)


def _applies(of: Seen) -> str:
    return "" if of.before is not None else "no other frame of this detector, or another one tells it"


GAIN = Check("gain", SOURCE, _applies, check)
