"""The gain by two frames of a detector: what the response of its pixels brings is in both and falls out.

Counts of S electrons have the variance S. Neighbours that share charge, by capacitance or because a full pixel repels
it, take part of this variance to the covariances with them, whose sum is kept; rows or columns with offsets of their
own, and slopes, reach further than neighbours do, and are taken off by the covariances there.
Ref: Janesick 2007, Photon Transfer; Antilogus et al. 2014, JINST 9, C03048; Moore et al. 2006, Opt. Eng. 45, 076402
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jobs.validation.images.noise import ramp_factor, reading
from jobs.validation.measure import blank, frames
from jobs.validation.measure.blank import Tiles
from jobs.validation.measure.frames import Amplifier, Frame
from jobs.validation.measure.rows import Row, not_applicable
from jobs.validation.measure.seen import RAMPS, Check, Seen
from lake_schema.arrays import Array, Bool, Float

SOURCE = "photon transfer of two frames (Janesick 2007); covariances: Antilogus et al. 2014, JINST 9, C03048"
TOLERANCE = 0.015
# Pixels about one that share its charge, to either side: of the sky, and from so many e- on.
_NEAR, _WIDE, _MUCH = 1, 2, 5000.0
# (Rows, columns) away where offsets of rows, of columns and slopes alone are in common; of the latter two rings.
_ROW, _COLUMN = ((0, 3), (0, 4), (0, 5)), ((3, 0), (4, 0), (5, 0))
_INNER = tuple((i, sign * j) for i, j in ((3, 1), (3, 2), (3, 3), (2, 3), (1, 3)) for sign in (-1, 1))
_OUTER = tuple((2 * i, 2 * j) for i, j in _INNER)
# Levels of the two frames, one over the other, at most: of the sky, of flats, which the frames before shine through;
# part of the full well; pixels that an amplifier wants.
_UNLIKE, _UNLIKE_FLATS, _FULL, _LEAST = 30.0, 1.03, 0.7, 60_000


def check(of: Seen) -> list[Row]:
    """Of each amplifier, and the mean of them."""
    assert of.before is not None
    other = frames.opened(of.before.path, of.frame.curve, of.frame.bowl)
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


def _tiles(frame: Frame, known: blank.Reference) -> Tiles:
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
    value, error = shared_variance(light[0] - ratio * light[1], both, _WIDE if max(level) > _MUCH else _NEAR)
    own = value - reading(amplifiers[0]) - ratio**2 * reading(amplifiers[1])
    if own <= 0.0:
        return None
    gain = factor * (level[0] + ratio**2 * level[1]) / own
    return gain, gain * error / own, level[0], many


def _held(a: Tiles, b: Tiles) -> Bool:
    """bool[t] of the tiles of a: those that b has, too."""
    there = set(zip(b.row.tolist(), b.column.tolist(), strict=True))
    return np.array([place in there for place in zip(a.row.tolist(), a.column.tolist(), strict=True)], bool)


def shared_variance(values: Array, kept: Bool, near: int) -> tuple[float, float]:
    """(variance of a pixel with what its neighbours have of it, its standard error from the scatter of the tiles).

    values : float[t, n, n];  kept : which of them count;  near : pixels to either side that share charge
    """
    n = kept.sum(axis=(1, 2))
    mean = (values * kept).sum(axis=(1, 2)) / n
    off = np.where(kept, values - mean[:, None, None], 0.0)
    row, column, inner, outer = (
        np.mean([_covariance(off, kept, *lag) for lag in lags], 0) for lags in (_ROW, _COLUMN, _INNER, _OUTER)
    )
    # What is smooth falls with the square of the distance: so much higher is it where the pixels are nearer.
    nearer = _square(_INNER) - 2.0 * near * (near + 1) / 3.0
    smooth = inner + (inner - outer) * nearer / (_square(_OUTER) - _square(_INNER))
    side = 2 * near + 1
    # Each stands for that on the other side of the pixel, too.
    half = [(i, j) for i in range(near + 1) for j in range(-near, near + 1) if i > 0 or j > 0]
    total = _covariance(off, kept, 0, 0) + 2.0 * np.sum([_covariance(off, kept, *lag) for lag in half], 0)
    own = total - side * (row - inner) - side * (column - inner) - side**2 * smooth
    weight = n / n.sum()
    value = float((weight * own).sum())
    return value, float(np.sqrt((weight**2 * (own - value) ** 2).sum()))


def _square(lags: Sequence[tuple[int, int]]) -> float:
    """Mean square of the distance."""
    return float(np.mean([i**2 + j**2 for i, j in lags]))


def _covariance(off: Float, kept: Bool, down: int, across: int) -> Float:
    """float[t] of pixels that lie so many rows and columns apart; down is not negative."""
    ny, nx = off.shape[1:]
    first = (slice(None), slice(0, ny - down), slice(max(-across, 0), nx - max(across, 0)))
    second = (slice(None), slice(down, ny), slice(max(across, 0), nx - max(-across, 0)))
    pairs = np.count_nonzero(kept[first] & kept[second], axis=(1, 2))
    return np.asarray(np.einsum("tij,tij->t", off[first], off[second]) / np.maximum(pairs, 1))


def _applies(of: Seen) -> str:
    return "" if of.before is not None else "no other frame of this detector, or another one tells it"


GAIN = Check("gain", SOURCE, _applies, check)
