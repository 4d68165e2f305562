"""Noise of the reads of a ramp: white read noise, 1/f drift of the outputs, and reset levels.

A group is the mean of r reads with the noise s each, so that its read noise is s / sqrt(r). A detector has 32 outputs,
each of which reads its columns row by row. Reference pixels correct slow drifts of an output; the rest is noise with a
1/f spectrum in readout order. The mission gives the width that this noise adds to the signal of a ramp. It is taken as
linear in time over the ramp: each of the n differences of groups gets 1 / n of it, so that it does not increase their
scatter. The level to which each pixel is reset is the same in all groups, so that the signal does not contain it.

References
----------
Kubik et al. 2025, NISP detectors on ground (7 and 9 electrons in the estimated signal). Moseley et al. 2010, Proc. SPIE
7742, 77421B (1/f noise of these outputs).
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import scipy.fft

from lake_schema.arrays import Int
from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.effect import Effect, zero_contribution
from truesky.render.effects.scene import Frame, Scene

OUTPUTS = 32
# Number of rows in which reference pixels follow a drift (assumed). Slower drifts are subtracted.
_REFERENCE_ROWS = 64


def edges(columns: int) -> Int:
    """Return the first column of each output, and the number of columns: an int array of 33 values."""
    return np.linspace(0, columns, OUTPUTS + 1).astype(int)


def apply(frame: Frame, sigma: float, reads: int, rng: np.random.Generator) -> Frame:
    """Add the read noise of the groups.

    Parameters
    ----------
    frame : float array, shape (groups, ny, nx)
        Electrons.
    sigma : float
        Noise of one read in electrons, 0 to 1e5.
    reads : int
        Reads per group.
    rng : numpy.random.Generator
        Source of the key from which each pixel derives its random numbers.

    Returns
    -------
    float array, shape of `frame`
        Electrons including noise.

    Raises
    ------
    OutOfRange
        If `sigma` is outside its limits.
    """
    if not 0.0 <= sigma < 1e5:
        raise OutOfRange("read noise", sigma, 0.0, 1e5)
    out = np.empty_like(frame)
    _add(frame.reshape(-1), out.reshape(-1), sigma / np.sqrt(reads), pixel_random.draw_key(rng))
    return out


@jit
def _add(frame: Any, out: Any, sigma: float, key: Any) -> None:
    for i in range(len(frame)):
        out[i] = frame[i] + sigma * pixel_random.normal(pixel_random.pixel_bits(key, i))


def apply_drift(frame: Frame, width: float, rng: np.random.Generator) -> Frame:
    """Add 1/f noise of the outputs, which grows linearly from the first group to the last.

    Parameters
    ----------
    frame : float array, shape (groups, ny, nx)
        Electrons. Each output reads neighbouring columns; their number need not be a multiple of 32.
    width : float
        Standard deviation of the difference between the last and the first group in electrons, 0 to 1e5.
    rng : numpy.random.Generator
        Random numbers of the drift.

    Returns
    -------
    float array, shape of `frame`
        Electrons including noise.

    Raises
    ------
    OutOfRange
        If `width` is outside its limits.

    Notes
    -----
    The mission's width is the measured noise of a signal in excess of the noise of its reads. It is attributed to 1/f
    noise. Ramps with other groups or of another length have the same width.
    """
    if not 0.0 <= width < 1e5:
        raise OutOfRange("1/f noise", width, 0.0, 1e5)
    groups, ny, nx = frame.shape
    drift = np.empty((ny, nx), np.float32)
    for first, last in pairwise(edges(nx).tolist()):
        drift[:, first:last] = _one_over_f(ny * (last - first), rng, max(ny // _REFERENCE_ROWS, 1)).reshape(ny, -1)
    out = np.empty_like(frame)
    for group, read, step in zip(frame, out, (np.arange(groups) / (groups - 1.0)).tolist(), strict=True):
        _add_drift(np.ascontiguousarray(group).reshape(-1), drift.reshape(-1), step * width, read.reshape(-1))
    return out


@jit
def _add_drift(group: Any, drift: Any, width: float, out: Any) -> None:
    for i in range(len(group)):
        out[i] = group[i] + width * drift[i]


def apply_reset(frame: Frame, sigma: float, rng: np.random.Generator) -> Frame:
    """Add the reset level of each pixel, the same in all groups.

    Parameters
    ----------
    frame : float array, shape (groups, ny, nx)
        Electrons.
    sigma : float
        Standard deviation in electrons, 0 to 1e6.
    rng : numpy.random.Generator
        Source of the key from which each pixel derives its random number.

    Returns
    -------
    float array, shape of `frame`
        Electrons above the zero level.

    Raises
    ------
    OutOfRange
        If `sigma` is outside its limits.
    """
    if not 0.0 <= sigma < 1e6:
        raise OutOfRange("reset noise", sigma, 0.0, 1e6)
    out = np.empty_like(frame)
    groups = np.ascontiguousarray(frame).reshape(len(frame), -1)
    _add_levels(groups, out.reshape(len(frame), -1), sigma, pixel_random.draw_key(rng))
    return out


@jit
def _add_levels(groups: Any, out: Any, sigma: float, key: Any) -> None:
    for p in range(groups.shape[1]):
        level = sigma * pixel_random.normal(pixel_random.pixel_bits(key, p))
        for i in range(len(groups)):
            out[i, p] = groups[i, p] + level


def _one_over_f(count: int, rng: np.random.Generator, slowest: int = 1) -> Frame:
    """Draw 1/f noise with mean 0 and ensemble rms 1, without frequencies below `slowest` cycles per stream."""
    size = scipy.fft.next_fast_len(max(count, 2), real=True)
    frequency = np.arange(size // 2 + 1)
    amplitude = np.zeros(len(frequency), np.float32)
    slowest = min(slowest, size // 2)
    amplitude[slowest:] = 1.0 / np.sqrt(frequency[slowest:])
    # In the spectrum of a real stream each frequency represents two, except 0 and the last one of an even size.
    shares = np.where((frequency == size / 2) | (frequency == 0), 1.0, 2.0)
    amplitude /= np.sqrt((shares * amplitude**2).sum())
    parts = rng.standard_normal((2, len(frequency)), np.float32) * np.sqrt(np.float32(0.5))
    spectrum = (parts[0] + 1j * parts[1]) * amplitude
    if size % 2 == 0:
        spectrum[-1] = np.sqrt(np.float32(2.0)) * spectrum[-1].real
    return np.asarray(scipy.fft.irfft(spectrum, size, norm="forward")[:count])


def _read_parameters(scene: Scene) -> tuple[float, int]:
    return scene.value("read_noise", "electron"), int(scene.value(f"macc.{scene.ramp}.reads", ""))


def _drift(scene: Scene) -> float:
    return scene.value(f"drift_{scene.ramp}", "electron")


def _reset(scene: Scene) -> float:
    return scene.value("reset_noise", "adu") * scene.value("gain", "electron / adu")


def _difference_noise(scene: Scene) -> float:
    """Read noise of the difference of two groups, in electrons."""
    sigma, reads = _read_parameters(scene)
    return sigma * float(np.sqrt(2.0 / reads))


EFFECT = Effect("group_noise", apply, _read_parameters, _difference_noise, cost=1.7e-2, systematic=zero_contribution)
DRIFT = Effect("drift", apply_drift, lambda scene: (_drift(scene),), _drift, cost=3.2e-2, systematic=zero_contribution)
RESET = Effect(
    "reset_level", apply_reset, lambda scene: (_reset(scene),), _reset, cost=1e-2, systematic=zero_contribution
)
