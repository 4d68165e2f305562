"""Shot noise: expected electrons become whole electrons.

Every pixel has random numbers of its own, so that what changes in one of them changes no other.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from jobs.compiling import jit
from jobs.render.effects.effect import Effect, Frame, Scene

# Far above this a normal deviate is the same to 1e-5 of the noise.
_NORMAL_ABOVE = 1e9
# Below this the sum of the probabilities is followed, above it numbers are proposed and rejected.
_SUMMED_BELOW = 10.0
# Steele, Lea & Flood 2014: SplitMix64.
_GOLDEN, _FIRST, _SECOND = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)


def apply(frame: Frame, rng: np.random.Generator) -> Frame:
    """Expected e- [..] -> counted e-, whole; a negative expectation (a transform's ringing) is 0.

    Ref : Hoermann 1993, PTRS: transformed rejection with squeeze
    """
    counted = np.array(frame, dtype=float, order="C")
    _count(counted.reshape(-1), rng.integers(0, 2**64, dtype=np.uint64))
    return counted


@jit
def _mixed(word: Any) -> Any:
    word = (word ^ (word >> _S30)) * _FIRST
    word = (word ^ (word >> _S27)) * _SECOND
    return word ^ (word >> _S31)


@jit
def _uniform(word: Any) -> float:
    """53 bits of a word: in (0, 1]."""
    return (float(word >> _S11) + 1.0) * 2.0**-53


@jit
def _count(light: Any, key: Any) -> None:
    """Replaces expectations by counts."""
    for i in range(len(light)):
        mean = light[i]
        if mean <= 0.0:
            light[i] = 0.0
            continue
        # Each pixel counts on from a place of its own.
        state = _mixed(key + np.uint64(i) * _GOLDEN)
        state += _GOLDEN
        u = _uniform(_mixed(state))
        if mean < _SUMMED_BELOW:
            term = math.exp(-mean)
            count = 0.0
            while u > term and count < 200.0:
                u -= term
                count += 1.0
                term *= mean / count
            light[i] = count
            continue
        state += _GOLDEN
        v = _uniform(_mixed(state))
        if mean > _NORMAL_ABOVE:
            light[i] = np.rint(mean + math.sqrt(-2.0 * mean * math.log(u)) * math.cos(2.0 * math.pi * v))
            continue
        b = 0.931 + 2.53 * math.sqrt(mean)
        a = -0.059 + 0.02483 * b
        squeeze = 0.9277 - 3.6224 / (b - 2.0)
        while True:
            u -= 0.5
            us = 0.5 - abs(u)
            count = math.floor((2.0 * a / us + b) * u + mean + 0.43) if us > 0.0 else -1.0
            if us >= 0.07 and v <= squeeze:
                break
            if count >= 0.0 and (us >= 0.013 or v <= us):
                inverse = 1.1239 + 1.1328 / (b - 3.4)
                wanted = math.log(v * inverse / (a / (us * us) + b))
                if wanted <= count * math.log(mean) - mean - math.lgamma(count + 1.0):
                    break
            state += _GOLDEN
            u = _uniform(_mixed(state))
            state += _GOLDEN
            v = _uniform(_mixed(state))
        light[i] = count


def _contribution(scene: Scene) -> float:
    return float(np.sqrt(max(scene.peak_electrons, 0.0) + scene.sky_electrons))


EFFECT = Effect("poisson", apply, lambda scene: (), _contribution, cost=3e-2)
