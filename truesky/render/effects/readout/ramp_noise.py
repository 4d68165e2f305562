"""Noise of a ramp's reads: each group's mean of r reads has the noise s / sqrt(r) of its own, and the outputs drift.

A detector has 32 outputs, each of which reads its columns row by row.  What is left of their slow drift after the
reference pixels were subtracted is noise of spectrum 1 / f along the order in which an output reads its pixels.  It is
given by the width that it adds to the signal of a ramp and taken as linear in time over the ramp: a part in n of it
goes to each of the n differences of groups, and none to their scatter.

apply, EFFECT        noise of the reads
apply_drift, DRIFT   1 / f noise of the outputs
apply_reset, RESET   the level that each pixel was reset to: the same in all groups, so that the signal has none of it

Ref : Kubik et al. 2025, NISP detectors on ground (7 and 9 e- of the estimated signal); Moseley et al. 2010, Proc. SPIE
      7742, 77421B (1 / f of these outputs)
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
# Rows in which reference pixels follow a drift (assumed): what is slower was subtracted.
_REFERENCE_ROWS = 64


def edges(columns: int) -> Int:
    """int[33]: the first column of each output, and the end of the last."""
    return np.linspace(0, columns, OUTPUTS + 1).astype(int)


def apply(frame: Frame, sigma: float, reads: int, rng: np.random.Generator) -> Frame:
    """Groups [groups, ny, nx] e- -> with the noise of the mean of `reads` reads of sigma e- each.

    frame : the groups;  rng : random numbers
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
    """Groups [groups, ny, nx] e- -> with 1 / f noise of `width` e- rms in the last group above the first.

    The columns are those of the outputs, neighbours together; their number need not be a multiple of 32.
    Error : the mission's width is what was measured of a signal beyond the noise of its reads, all of it taken as 1 / f
            noise; a ramp of other groups or another length has as much of it
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
    """Groups [groups, ny, nx] e- -> above the level of each pixel's reset, of sigma e- rms."""
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
    """float32[count] of spectrum 1 / f from `slowest` cycles a stream on, of rms 1 over the ensemble; its mean is 0."""
    size = scipy.fft.next_fast_len(max(count, 2), real=True)
    frequency = np.arange(size // 2 + 1)
    amplitude = np.zeros(len(frequency), np.float32)
    slowest = min(slowest, size // 2)
    amplitude[slowest:] = 1.0 / np.sqrt(frequency[slowest:])
    # Of a real stream all but the last frequency of an even size stand for two.
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
    """Of the difference of two groups."""
    sigma, reads = _read_parameters(scene)
    return sigma * float(np.sqrt(2.0 / reads))


EFFECT = Effect("group_noise", apply, _read_parameters, _difference_noise, cost=1.7e-2, systematic=zero_contribution)
DRIFT = Effect("drift", apply_drift, lambda scene: (_drift(scene),), _drift, cost=3.2e-2, systematic=zero_contribution)
RESET = Effect(
    "reset_level", apply_reset, lambda scene: (_reset(scene),), _reset, cost=1e-2, systematic=zero_contribution
)
