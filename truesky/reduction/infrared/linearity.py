"""Measure the nonlinearity of each pixel from flats of one lamp at several levels.

A lamp at level x gives a pixel g x electrons, of which Q are measured. The gain g and the b of N (1 - b N) are fitted
for each pixel.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from lake_schema.arrays import Array, Float
from truesky.reduction.combining import CombinedFrame
from truesky.reduction.frames import Frame
from truesky.reduction.infrared.ramps import Estimator, RampNonlinearity

# Smallest number of levels, smallest ratio of the brightest to the faintest, iterations of the fit, and deviation
# (in standard deviations) above which a frame is rejected.
_MIN_LEVELS, _MIN_RANGE, _ROUNDS, _CLIP = 3, 3.0, 4, 5.0
# Rows that are fitted at a time, to limit memory.
_ROWS = 32


def longest_series(flats: Sequence[Frame]) -> list[Frame]:
    """Return the longest series of flats with one channel, band, lamp and ramp at three or more levels, else []."""
    groups: dict[tuple[object, ...], list[Frame]] = defaultdict(list)
    for frame in flats:
        groups[frame.exposure.channel, frame.exposure.band, frame.scene.lamp, frame.ramp].append(frame)
    useful = [
        group
        for group in groups.values()
        if len(levels := {_level(frame) for frame in group}) >= _MIN_LEVELS and max(levels) > _MIN_RANGE * min(levels)
    ]
    return max(useful, key=len, default=[])


def _level(frame: Frame) -> float:
    return frame.scene.value("flat.signal", "electron")


def fit(
    frames: Sequence[Frame], extra_charge: Callable[[Frame], tuple[Float, Float | float]], scratch: Path
) -> CombinedFrame:
    """Return b of every pixel in 1/electron, with its uncertainty.

    Parameters
    ----------
    frames : sequence of Frame
        Flats of `longest_series`.
    extra_charge : callable
        Function that returns the electrons of persistence [ny, nx] and of dark current in a frame.
    scratch : Path
        Folder for temporary files, 8 bytes per pixel and frame.

    Returns
    -------
    CombinedFrame
        Weighted mean of each pixel's fit and the median of all pixels.

    Notes
    -----
    The levels of the lamp are assumed to be exact. Pixel-to-pixel differences of the traps are not known.
    """
    scene, applied = frames[0].scene, frames[0].applied
    estimator, nonlinearity = Estimator.from_scene(scene, applied), RampNonlinearity.from_scene(scene, applied)
    levels = np.array([_level(frame) for frame in frames]) / max(map(_level, frames))
    shape, spread = (scene.ny, scene.nx), scene.value("persistence.spread", "")
    observed, extra = (
        np.memmap(scratch / name, np.float32, "w+", shape=(len(frames), *shape)) for name in ("seen", "more")
    )
    noise = np.zeros(len(frames))
    for number, frame in enumerate(frames):
        estimated, (persistence, dark) = frame.electrons(), extra_charge(frame)
        observed[number] = estimated - estimator.bias(estimated)
        extra[number] = persistence + dark
        typical, typical_persistence = float(np.median(estimated)), float(np.median(persistence))
        noise[number] = float(estimator.variance(np.array(typical))) + (spread * typical_persistence) ** 2
    b, sigma, count = np.zeros(shape), np.ones(shape), np.zeros(shape, np.int16)
    for first in range(0, shape[0], _ROWS):
        rows = slice(first, first + _ROWS)
        block = np.asarray(observed[:, rows], float), np.asarray(extra[:, rows], float)
        b[rows], sigma[rows], count[rows] = _fit_rows(*block, levels, noise, nonlinearity)
    del observed, extra
    for name in ("seen", "more"):
        (scratch / name).unlink()
    return _shrink_to_median(b, sigma, count)


def _fit_rows(
    observed: Float, extra: Float, levels: Float, noise: Float, nonlinearity: RampNonlinearity
) -> tuple[Float, Float, Array]:
    """Fit b of pixels [rows, nx] to frames [n, rows, nx]; return b, its uncertainty, and the number of accepted frames.

    Parameters
    ----------
    observed, extra : float array, shape (n, rows, nx)
        Measured electrons, and the electrons among them that are not light of the lamp.
    levels, noise : float array, shape (n,)
        Relative level of the lamp, and variance of the measured signal.
    nonlinearity : RampNonlinearity
        Nonlinearity of the ramp.

    Returns
    -------
    b, sigma, count : array, shape (rows, nx)
        Results.
    """
    b, accepted, x = np.zeros(observed.shape[1:]), np.ones(observed.shape, bool), levels[:, None, None]
    sigma = np.full(b.shape, np.inf)
    for _ in range(_ROUNDS):
        linear = nonlinearity.linearise(observed, b)
        y, c = linear - extra, nonlinearity.slope(linear)
        weight = accepted / noise[:, None, None]
        xx, xc, cc, xy, cy = ((weight * term).sum(axis=0) for term in (x * x, -x * c, c * c, x * y, -c * y))
        determinant = xx * cc - xc * xc
        with np.errstate(divide="ignore", invalid="ignore"):
            gain, b_step, sigma = (cc * xy - xc * cy) / determinant, (xx * cy - xc * xy) / determinant, xx / determinant
        enough = (accepted.sum(axis=0) >= _MIN_LEVELS) & np.isfinite(b_step)
        gain, b_step = np.where(enough, gain, 0.0), np.where(enough, b_step, 0.0)
        accepted = np.abs(y + b_step * c - gain * x) <= _CLIP * np.sqrt(noise)[:, None, None]
        # Limit the nonlinearity to a tenth of the signal, since a dead pixel has no meaningful b.
        b = np.clip(b + b_step, 0.0, 0.1 / np.maximum(y.max(axis=0), 1.0))
    return b, np.where(enough, np.sqrt(sigma), np.inf), accepted.sum(axis=0).astype(np.int16)


def _shrink_to_median(b: Float, sigma: Float, count: Array) -> CombinedFrame:
    """Return the mean of each pixel's b and the median of all pixels, weighted by their variances."""
    is_measured = np.isfinite(sigma) & (b > 0.0)
    median = float(np.median(b[is_measured])) if is_measured.any() else 0.0
    width = 1.4826 * float(np.median(np.abs(b[is_measured] - median))) if is_measured.any() else 0.0
    intrinsic_variance = (
        max(width**2 - float(np.median(sigma[is_measured])) ** 2, (0.01 * median) ** 2) if is_measured.any() else 0.0
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(is_measured, intrinsic_variance / (intrinsic_variance + sigma**2), 0.0)
    mean = median + share * (b - median)
    return CombinedFrame(mean.astype(np.float32), np.sqrt((1.0 - share) * intrinsic_variance).astype(np.float32), count)
