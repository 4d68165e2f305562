"""Noise of an up-the-ramp exposure (reads without reset): read noise, 1/f drift of the outputs, and reset levels.

Reads are averaged in groups. A group of r reads with the noise s each has the read noise s / sqrt(r). A detector has 32
outputs, each of which reads its columns row by row. Reference pixels correct slow drifts of an output. The rest is
noise with a 1/f spectrum in the order in which pixels are read.

The mission database contains the standard deviation that the 1/f noise adds to the signal of a ramp (an up-the-ramp
exposure). As an approximation, this noise grows linearly from the first group to the last: each of the n differences of
successive groups gets 1 / n of it, so that it does not increase their scatter. The random level to which each pixel is
reset is the same in all groups, so that it cancels in the signal.

References
----------
Kubik et al. 2025, NISP detectors on ground (7 and 9 electrons in the estimated signal). Moseley et al. 2010, Proc. SPIE
7742, 77421B (1/f noise of these outputs).
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import scipy

from lake_schema.arrays import Int
from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.effect import Effect, zero_contribution
from truesky.render.effects.scene import Frame, Scene

# Number of readout outputs of a detector.
OUTPUTS = 32
# Longest period of the simulated 1/f noise of an output, in detector rows (assumed). Slower drifts are left out,
# because they are measured with reference pixels and subtracted.
_REFERENCE_ROWS = 64


def edges(columns: int) -> Int:
    """Return the first column of each of the 32 outputs, then the number of columns: an int array of 33 values."""
    return np.linspace(0, columns, OUTPUTS + 1).astype(int)


def apply(frame: Frame, sigma: float, reads: int, rng: np.random.Generator) -> Frame:
    """Add read noise to each group (mean of several reads) of a ramp.

    Parameters
    ----------
    frame : float array, shape (groups, ny, nx)
        Mean charge of the reads of each group in electrons.
    sigma : float
        Standard deviation of the noise of one read in electrons, at least 0, below 1e5.
    reads : int
        Number of reads per group.
    rng : numpy.random.Generator
        Random generator from which one 64-bit key is drawn. Each pixel derives its random numbers from the key and its
        index.

    Returns
    -------
    float array, shape of `frame`
        Electrons including noise.

    Raises
    ------
    OutOfRange
        If `sigma` is outside its limits or NaN.
    """
    if not 0.0 <= sigma < 1e5:
        raise OutOfRange("read noise", sigma, 0.0, 1e5)
    out = np.empty_like(frame)
    _add(frame.reshape(-1), out.reshape(-1), sigma / np.sqrt(reads), pixel_random.draw_key(rng))
    return out


@jit
def _add(frame: Any, out: Any, sigma: float, key: Any) -> None:
    normals, bits = np.empty(pixel_random.BLOCK), np.empty(pixel_random.BLOCK, np.uint64)
    for start in range(0, len(frame), pixel_random.BLOCK):
        block, filled = frame[start : start + pixel_random.BLOCK], out[start : start + pixel_random.BLOCK]
        pixel_random.fill_normals(normals[: len(block)], bits, key, start)
        for i in range(len(block)):
            filled[i] = block[i] + sigma * normals[i]


def apply_drift(frame: Frame, width: float, rng: np.random.Generator) -> Frame:
    """Add 1/f noise of the outputs to the groups of a ramp. It grows linearly from the first group to the last.

    Parameters
    ----------
    frame : float array, shape (groups, ny, nx)
        Mean charge of the reads of each group in electrons, for at least 2 groups. Each output reads neighbouring
        columns; nx need not be a multiple of 32.
    width : float
        Standard deviation of the noise in the difference of the last and the first group, in electrons, at least 0,
        below 1e5.
    rng : numpy.random.Generator
        Random generator of the noise, which is different in each call.

    Returns
    -------
    float array, shape of `frame`
        Electrons including noise.

    Raises
    ------
    OutOfRange
        If `width` is outside its limits or NaN.

    Notes
    -----
    The mission database has the measured noise of the signal of a ramp in excess of the noise of its reads. This excess
    is attributed to 1/f noise, and is used as `width`. As an approximation, `width` does not depend on the number of
    groups and on the duration of the ramp.
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
    """Add the random level to which each pixel was reset before a ramp, the same in all groups of the ramp.

    Parameters
    ----------
    frame : float array, shape (groups, ny, nx)
        Mean charge of the reads of each group in electrons.
    sigma : float
        Standard deviation of the level between pixels in electrons, at least 0, below 1e6.
    rng : numpy.random.Generator
        Random generator from which one 64-bit key is drawn. Each pixel derives its random number from the key and its
        index.

    Returns
    -------
    float array, shape of `frame`
        Electrons including the reset level, which may be negative.

    Raises
    ------
    OutOfRange
        If `sigma` is outside its limits or NaN.
    """
    if not 0.0 <= sigma < 1e6:
        raise OutOfRange("reset noise", sigma, 0.0, 1e6)
    out = np.empty_like(frame)
    groups = np.ascontiguousarray(frame).reshape(len(frame), -1)
    _add_levels(groups, out.reshape(len(frame), -1), sigma, pixel_random.draw_key(rng))
    return out


@jit
def _add_levels(groups: Any, out: Any, sigma: float, key: Any) -> None:
    normals, bits = np.empty(pixel_random.BLOCK), np.empty(pixel_random.BLOCK, np.uint64)
    for start in range(0, groups.shape[1], pixel_random.BLOCK):
        width = min(pixel_random.BLOCK, groups.shape[1] - start)
        pixel_random.fill_normals(normals[:width], bits, key, start)
        for i in range(len(groups)):
            for j in range(width):
                out[i, start + j] = groups[i, start + j] + sigma * normals[j]


def _one_over_f(count: int, rng: np.random.Generator, slowest: int = 1) -> Frame:
    """Draw a sequence of `count` values of 1/f noise (power inversely proportional to frequency), in order of time.

    Over many sequences it has the mean 0 and the rms 1. It contains no frequencies below `slowest` cycles per sequence.
    """
    size = scipy.fft.next_fast_len(max(count, 2), real=True)
    frequency = np.arange(size // 2 + 1)
    amplitude = np.zeros(len(frequency), np.float32)
    slowest = min(slowest, size // 2)
    amplitude[slowest:] = 1.0 / np.sqrt(frequency[slowest:])
    # `shares` is the number of terms of the full Fourier series that each frequency stands for: 2 (the positive and the
    # negative frequency), except 1 for the frequency 0 and for the highest frequency of a sequence of even length.
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
    """Return the read noise, in electrons rms, of the difference of two groups (means of several reads)."""
    sigma, reads = _read_parameters(scene)
    return sigma * float(np.sqrt(2.0 / reads))


EFFECT = Effect("group_noise", apply, _read_parameters, _difference_noise, cost=1.7e-2, systematic=zero_contribution)
DRIFT = Effect("drift", apply_drift, lambda scene: (_drift(scene),), _drift, cost=3.2e-2, systematic=zero_contribution)
RESET = Effect(
    "reset_level", apply_reset, lambda scene: (_reset(scene),), _reset, cost=1e-2, systematic=zero_contribution
)
