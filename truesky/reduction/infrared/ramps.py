"""Model the estimated signal of a ramp: bias and noise of the estimator, and the effect of nonlinearity.

Let n be the number of differences of groups, d their mean (light and beta), a their variance, b the covariance of
neighbours, T their sum, and SS the sum of squares about their mean. To second order the estimated signal is::

    Q = S + [2 d (T - E T) + SS - n A d] / (2 d + A),      A = 1 + alpha

Its mean and variance follow from the moments of T and SS (effects/charge/ramp.py, effects/readout/macc.py). If
N (1 - b N) of N electrons are measured, differences decrease along the ramp, and Q is their root mean square::

    Q^2 = S^2 (1 - 2 k1 b S + k2 b^2 S^2)

Here k1 and k2 depend on the frames in which a ramp is read. They are 1 if the signal itself is not linear.
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

# Tabulated signals, e-.
_LEVELS = np.concatenate([[0.0], np.geomspace(1.0, 2e5, 200)])
# Iterations of the linearisation; each adds three digits at 1e5 e-.
_ROUNDS = 8


@dataclass(frozen=True, slots=True)
class Estimator:
    """Estimator of the signal of a ramp.

    Attributes
    ----------
    mode : Mode
        Readout mode.
    read_noise : float
        Noise of one read in electrons.
    drift : float
        Drift of the outputs in the signal in electrons.
    coupling : float
        Factor of the photon variance that remains if neighbours share charge.
    rounding : float
        Variance of rounding to whole ADU in electrons^2.
    """

    mode: Mode
    read_noise: float
    drift: float
    coupling: float
    rounding: float

    @classmethod
    def from_scene(cls, scene: Scene, applied: Container[str]) -> Estimator:
        """Return the estimator for a detector; `applied` has the names of the effects in the frame."""
        side, diagonal = ipc.EFFECT.parameters(scene) if ipc.EFFECT.name in applied else (0.0, 0.0)
        return cls(
            ramp.mode_of_scene(scene),
            scene.value("read_noise", "electron"),
            scene.value(f"drift_{scene.ramp}", "electron") if ramp_noise.DRIFT.name in applied else 0.0,
            (1.0 - 4.0 * (side + diagonal)) ** 2 + 4.0 * (side**2 + diagonal**2),
            scene.value("gain", "electron / adu") ** 2 / 12.0,
        )

    def bias(self, signal: Float) -> Float:
        """Return the bias of the estimate (estimated minus true signal) in electrons, for a signal in electrons."""
        return np.asarray(np.interp(signal, _LEVELS, self._moments(_LEVELS)[0]))

    def variance(self, signal: Float) -> Float:
        """Return the variance of the estimate in electrons^2, for an expected signal in electrons."""
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
    """Effect of nonlinearity on the signal of a ramp.

    Attributes
    ----------
    k1, k2 : float
        Coefficients of the loss, see the module's docstring.
    misfit_factor : float
        Factor of chi^2 due to the deviation of differences from their mean.
    """

    k1: float
    k2: float
    misfit_factor: float

    @classmethod
    def from_scene(cls, scene: Scene, applied: Container[str]) -> RampNonlinearity:
        """Return the nonlinearity of a frame's ramp; `applied` has the names of the effects in the frame."""
        mode = ramp.mode_of_scene(scene)
        if ramp_nonlinearity.SIGNAL.name in applied:
            return cls(1.0, 1.0, 0.0)
        frames_per_group = mode.reads + mode.drops
        frames = np.arange(mode.groups)[:, None] * frames_per_group + np.arange(1, mode.reads + 1)
        steps = np.diff((frames.astype(float) ** 2).mean(axis=1)) / frames_per_group
        mean, square, all_frames = float(steps.mean()), float((steps**2).mean()), mode.integration_frames
        return cls(mean / all_frames, square / all_frames**2, (square - mean**2) / all_frames**2 / (1.0 + mode.alpha))

    def nonlinear_signal(self, signal: Float, b: Float) -> Float:
        """Return the measured signal for a true signal, both in electrons; `b` is in 1/electron."""
        loss = b * np.maximum(signal, 0.0)
        return np.asarray(signal * np.sqrt(np.maximum(1.0 - 2.0 * self.k1 * loss + self.k2 * loss**2, 0.0)))

    def linearise(self, observed: Float, b: Float) -> Float:
        """Return the true signal for a measured signal, both in electrons; `b` is in 1/electron.

        For a measured signal that no true signal gives, the result is about the largest possible signal.
        """
        out = np.array(observed, float)
        for _ in range(_ROUNDS):
            loss = b * np.maximum(out, 0.0)
            out = observed / np.sqrt(np.maximum(1.0 - 2.0 * self.k1 * loss + self.k2 * loss**2, 0.1))
        return out

    def slope(self, signal: Float) -> Float:
        """Return the decrease of the measured signal per unit of b, for small b, in electrons^2."""
        return np.asarray(self.k1 * np.maximum(signal, 0.0) ** 2)

    def chi_square(self, signal: Float, b: Float) -> Float:
        """Return chi^2 of a ramp due to nonlinearity alone."""
        return np.asarray(self.misfit_factor * b**2 * np.maximum(signal, 0.0) ** 3)
