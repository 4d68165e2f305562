"""Measure the nonlinearity of each pixel of a NISP detector from flats of one lamp at several intensities.

A lamp with the relative intensity x gives a pixel N = g x electrons, of which about N (1 - b N) are measured. The
response g and the coefficient b (1/electron) are fitted for each pixel.
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

# Smallest number of different lamp intensities for a fit.
_MIN_LEVELS = 3
# The ratio of the highest to the lowest lamp intensity must be larger than this.
_MIN_RANGE = 3.0
# Number of iterations of the fit.
_ROUNDS = 4
# A value of a pixel in a flat is rejected if it deviates from the fit by more than this number of standard deviations.
_CLIP = 5.0
# Number of detector rows that are fitted at a time, to limit memory.
_ROWS = 32


def longest_series(flats: Sequence[Frame]) -> list[Frame]:
    """Return the longest series of flats to which the nonlinearity can be fitted, or [] without such a series.

    Flats of a series have the same channel, band, lamp and readout mode. They have three or more different intensities,
    of which the highest is more than three times the lowest.
    """
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
    """Fit the nonlinearity of every pixel: the coefficient b in 1/electron, if N (1 - b N) of N electrons are measured.

    Parameters
    ----------
    frames : sequence of Frame
        Flats of one lamp at several intensities, from `longest_series`.
    extra_charge : callable
        Function of a frame that returns the electrons per pixel that do not come from the lamp: of persistence,
        shape (ny, nx), and of dark current (the same shape or a number).
    scratch : Path
        Folder for temporary files, which take 8 bytes per pixel and frame.

    Returns
    -------
    CombinedFrame
        b and its uncertainty. To reduce noise, b is the weighted mean of the fit of the pixel and the median of all
        pixels; pixels without a valid fit have the median.

    Notes
    -----
    The intensities of the lamp are assumed to be exact. Persistence is predicted with the mean properties of traps,
    because differences between pixels are not known to an observer.
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
    """Fit the response and the nonlinearity b of each pixel in some rows to n flats of different intensity.

    Parameters
    ----------
    observed, extra : float array, shape (n, rows, nx)
        Measured electrons; electrons among them that are dark current or persistence, not light of the lamp.
    levels, noise : float array, shape (n,)
        Intensity of the lamp relative to the brightest flat; variance of the measured signal in electrons^2.
    nonlinearity : RampNonlinearity
        Effect of b on the measured signal of a ramp.

    Returns
    -------
    b, sigma, count : array, shape (rows, nx)
        Coefficient b in 1/electron, 0 or more; its standard deviation, infinite with fewer than three accepted flats;
        number of accepted flats.
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
        # Limit b such that a tenth of the signal is lost at most: the fit of a dead pixel has no meaningful b.
        b = np.clip(b + b_step, 0.0, 0.1 / np.maximum(y.max(axis=0), 1.0))
    return b, np.where(enough, np.sqrt(sigma), np.inf), accepted.sum(axis=0).astype(np.int16)


def _shrink_to_median(b: Float, sigma: Float, count: Array) -> CombinedFrame:
    """Return the mean of each pixel's b and the median b of all pixels, weighted by their inverse variances.

    `sigma` is the uncertainty of b in a pixel. The uncertainty of the median is the standard deviation of b between
    pixels after subtraction of their noise, at least 1 % of the median. Pixels with b = 0 or infinite `sigma` get the
    median.
    """
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
