"""The signal of a ramp as an observer has it: how the estimator errs and scatters, what non-linearity makes of it.

With the n differences of groups of mean d (light and beta), the variance a and the covariance b of neighbours, T their
sum and SS the sum of squares about their mean, the estimated signal is to second order

    Q = S + [2 d (T - E T) + SS - n A d] / (2 d + A),      A = 1 + alpha

so that its mean and variance are those of T and SS (effects/charge/ramp.py, effects/readout/macc.py).  Where of N
electrons N (1 - b N) are seen, Q is the root mean square of differences that fall:

    Q^2 = S^2 (1 - 2 k1 b S + k2 b^2 S^2)

with k1 and k2 of the frames that a ramp is read in, or 1 where the signal itself is not linear.

Estimator     of a mode: .bias, .variance of a signal
Bend          of a mode: .linearised, .bent, .slope, .misfit of a signal
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Float
from truesky.render.effects.charge import ipc, ramp, ramp_nonlinearity
from truesky.render.effects.charge.ramp import Mode
from truesky.render.effects.readout import macc, ramp_noise
from truesky.render.effects.scene import Scene

# Signals at which tables are made, e-.
_LEVELS = np.concatenate([[0.0], np.geomspace(1.0, 2e5, 200)])
# Rounds in which a signal is linearised: each brings three digits at 1e5 e-.
_ROUNDS = 8


@dataclass(frozen=True, slots=True)
class Estimator:
    """How the signal of a ramp is estimated.

    read_noise : of one read, e-;  drift : of the outputs in the signal, e-
    coupling   : what is left of the variance of photons where neighbours share their charge
    rounding   : variance of whole ADU, e-^2
    """

    mode: Mode
    read_noise: float
    drift: float
    coupling: float
    rounding: float

    @classmethod
    def from_scene(cls, scene: Scene, applied: Container[str]) -> Estimator:
        """Of a frame's detector; applied : names of the effects that are in it."""
        side, diagonal = ipc.EFFECT.parameters(scene) if ipc.EFFECT.name in applied else (0.0, 0.0)
        return cls(
            ramp.mode_of_scene(scene),
            scene.value("read_noise", "electron"),
            scene.value(f"drift_{scene.ramp}", "electron") if ramp_noise.DRIFT.name in applied else 0.0,
            (1.0 - 4.0 * (side + diagonal)) ** 2 + 4.0 * (side**2 + diagonal**2),
            scene.value("gain", "electron / adu") ** 2 / 12.0,
        )

    def bias(self, signal: Float) -> Float:
        """What is estimated less what is there, e-; signal : e-."""
        return np.asarray(np.interp(signal, _LEVELS, self._moments(_LEVELS)[0]))

    def variance(self, signal: Float) -> Float:
        """Of what is estimated of a signal, e-^2; signal : expected, e-."""
        return np.asarray(np.interp(signal, _LEVELS, self._moments(_LEVELS)[1]))

    def _moments(self, signal: Float) -> tuple[Float, Float]:
        mode, n = self.mode, self.mode.differences
        r, frames_per_group = float(mode.reads), mode.reads + mode.drops
        light, noise, big = signal / n, self.read_noise**2 / r, 1.0 + mode.alpha
        d = light + macc.beta(mode, self.read_noise)
        f = light / frames_per_group
        a = self.coupling * light * big + 2.0 * noise
        b = (self.coupling * f * (r * r - 1.0) / (6.0 * r) - noise) if n > 1 else np.zeros_like(a)
        total = n * a + 2.0 * (n - 1) * b
        ends = (n - 2) * (a + 2.0 * b) ** 2 + 2.0 * (a + b) ** 2
        squares = 2.0 * (n * a * a + 2.0 * (n - 1) * b * b - 2.0 / n * ends + total**2 / n**2) if n > 1 else 0.0 * a
        _, mixed, fourth = mode.third_moments() if n > 1 else (0.0, 0.0, 0.0)
        wide = 2.0 * d + big
        bias = (n * a - total / n - n * big * d) / wide
        variance = (4.0 * d**2 * (total + self.drift**2) + squares + f * fourth + 4.0 * d * f * mixed) / wide**2
        return bias, variance + self.rounding


@dataclass(frozen=True, slots=True)
class RampNonlinearity:
    """What a ramp's frames make of non-linearity.

    first, second : k1 and k2;  uneven : what differences depart from their mean of, of chi^2
    """

    k1: float
    k2: float
    misfit_factor: float

    @classmethod
    def from_scene(cls, scene: Scene, applied: Container[str]) -> RampNonlinearity:
        """Of a frame; applied : names of the effects that are in it."""
        mode = ramp.mode_of_scene(scene)
        if ramp_nonlinearity.SIGNAL.name in applied:
            return cls(1.0, 1.0, 0.0)
        frames_per_group = mode.reads + mode.drops
        frames = np.arange(mode.groups)[:, None] * frames_per_group + np.arange(1, mode.reads + 1)
        steps = np.diff((frames.astype(float) ** 2).mean(axis=1)) / frames_per_group
        mean, square, all_frames = float(steps.mean()), float((steps**2).mean()), mode.integration_frames
        return cls(mean / all_frames, square / all_frames**2, (square - mean**2) / all_frames**2 / (1.0 + mode.alpha))

    def nonlinear_signal(self, signal: Float, b: Float) -> Float:
        """What is seen of a signal, e-; b : 1/e-."""
        loss = b * np.maximum(signal, 0.0)
        return np.asarray(signal * np.sqrt(np.maximum(1.0 - 2.0 * self.k1 * loss + self.k2 * loss**2, 0.0)))

    def linearise(self, observed: Float, b: Float) -> Float:
        """The signal of which this is seen, e-; b : 1/e-.  Error: of what no signal gives, about the largest."""
        out = np.array(observed, float)
        for _ in range(_ROUNDS):
            loss = b * np.maximum(out, 0.0)
            out = observed / np.sqrt(np.maximum(1.0 - 2.0 * self.k1 * loss + self.k2 * loss**2, 0.1))
        return out

    def slope(self, signal: Float) -> Float:
        """What a signal changes with b where that is small, e-^2."""
        return np.asarray(self.k1 * np.maximum(signal, 0.0) ** 2)

    def chi_square(self, signal: Float, b: Float) -> Float:
        """chi^2 that non-linearity alone makes of a ramp."""
        return np.asarray(self.misfit_factor * b**2 * np.maximum(signal, 0.0) ** 3)
