"""Model the signal Q that NISP's on-board software estimates from a ramp: its bias, noise and nonlinearity.

A ramp consists of groups of averaged reads. Let n be the number of differences between successive groups, d their mean
(including the constant beta that the software adds), T their sum, and SS the sum of their squares about the mean. S is
the true signal in electrons, and E T the expected value of T. To second order the estimated signal is::

    Q = S + [2 d (T - E T) + SS - n A d] / (2 d + A),      A = 1 + alpha

The module effects/readout/macc.py defines alpha and beta. The mean and the variance of Q follow from the moments of T
and SS, which depend on the variance a of a difference and the covariance b of neighbouring differences.

If N (1 - b N) of N electrons are measured (with another b: the nonlinearity in 1/electron), differences decrease along
the ramp, and Q is n times their root mean square::

    Q^2 = S^2 (1 - 2 k1 b S + k2 b^2 S^2)

Here k1 and k2 depend on the times at which the ramp is read. They are 1 if the nonlinearity was simulated in the total
signal and not in each read.
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

# Signals, in electrons, at which bias and variance of the estimate are tabulated for interpolation.
_LEVELS = np.concatenate([[0.0], np.geomspace(1.0, 2e5, 200)])
# Iterations of the correction for nonlinearity. For 1e5 electrons in NISP, where b is 6e-7 per electron, each iteration
# adds about one correct digit.
_ROUNDS = 8


@dataclass(frozen=True, slots=True)
class Estimator:
    """Bias and noise of the on-board estimate of a ramp's signal.

    Attributes
    ----------
    mode : Mode
        Readout mode: numbers of groups, reads per group, and dropped reads.
    read_noise : float
        Noise of one read in electrons (standard deviation).
    drift : float
        Standard deviation, in electrons, of the signal due to drifts of the output amplifiers.
    coupling : float
        Factor by which interpixel capacitance reduces the photon noise (variance) of a pixel, at most 1.
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
        """Return the estimator with the mission parameters of the scene's detector and readout mode.

        Drift and interpixel capacitance are included only if their names are in `applied`, the effects that were
        simulated in the frame.
        """
        side, diagonal = ipc.EFFECT.parameters(scene) if ipc.EFFECT.name in applied else (0.0, 0.0)
        return cls(
            ramp.mode_of_scene(scene),
            scene.value("read_noise", "electron"),
            scene.value(f"drift_{scene.ramp}", "electron") if ramp_noise.DRIFT.name in applied else 0.0,
            (1.0 - 4.0 * (side + diagonal)) ** 2 + 4.0 * (side**2 + diagonal**2),
            scene.value("gain", "electron / adu") ** 2 / 12.0,
        )

    def bias(self, signal: Float) -> Float:
        """Return the mean of estimated minus true signal in electrons, for true signals in electrons (any shape).

        Signals outside 0 to 200,000 electrons have the bias of the nearest limit.
        """
        return np.asarray(np.interp(signal, _LEVELS, self._moments(_LEVELS)[0]))

    def variance(self, signal: Float) -> Float:
        """Return the variance of the estimated signal in electrons^2, for expected signals in electrons (any shape).

        Signals outside 0 to 200,000 electrons have the variance of the nearest limit.
        """
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
    """Effect of nonlinearity on the signal Q that is estimated from a ramp with the true signal S.

    Of N electrons, N (1 - b N) are measured in each read. Then Q^2 = S^2 (1 - 2 k1 b S + k2 b^2 S^2), and chi^2 of the
    fit is misfit_factor b^2 S^3.

    Attributes
    ----------
    k1, k2 : float
        Coefficients of the first and second order of the loss, which depend on the readout mode.
    misfit_factor : float
        Coefficient of chi^2; 0 if nonlinearity was simulated in the total signal and not in each read.
    """

    k1: float
    k2: float
    misfit_factor: float

    @classmethod
    def from_scene(cls, scene: Scene, applied: Container[str]) -> RampNonlinearity:
        """Return the coefficients for the readout mode of a scene.

        If `applied` (effects that were simulated in the frame) contains the nonlinearity of the total signal, k1 and k2
        are 1 and chi^2 is 0.
        """
        mode = ramp.mode_of_scene(scene)
        if ramp_nonlinearity.SIGNAL.name in applied:
            return cls(1.0, 1.0, 0.0)
        frames_per_group = mode.reads + mode.drops
        frames = np.arange(mode.groups)[:, None] * frames_per_group + np.arange(1, mode.reads + 1)
        steps = np.diff((frames.astype(float) ** 2).mean(axis=1)) / frames_per_group
        mean, square, all_frames = float(steps.mean()), float((steps**2).mean()), mode.integration_frames
        return cls(mean / all_frames, square / all_frames**2, (square - mean**2) / all_frames**2 / (1.0 + mode.alpha))

    def nonlinear_signal(self, signal: Float, b: Float) -> Float:
        """Return the measured signals for true signals, both in electrons; `b` is the nonlinearity in 1/electron.

        Signals of 0 or less are returned unchanged.
        """
        loss = b * np.maximum(signal, 0.0)
        return np.asarray(signal * np.sqrt(np.maximum(1.0 - 2.0 * self.k1 * loss + self.k2 * loss**2, 0.0)))

    def linearise(self, observed: Float, b: Float) -> Float:
        """Return the true signals for measured signals, both in electrons; `b` is the nonlinearity in 1/electron.

        Signals of 0 or less are returned unchanged. If a measured signal is higher than any true signal can give, the
        loss is limited, and the result is at most 3.2 times the measured signal.
        """
        out = np.array(observed, float)
        for _ in range(_ROUNDS):
            loss = b * np.maximum(out, 0.0)
            out = observed / np.sqrt(np.maximum(1.0 - 2.0 * self.k1 * loss + self.k2 * loss**2, 0.1))
        return out

    def slope(self, signal: Float) -> Float:
        """Return by how much a small b reduces the measured signal, divided by b, in electrons^2: k1 `signal`^2."""
        return np.asarray(self.k1 * np.maximum(signal, 0.0) ** 2)

    def chi_square(self, signal: Float, b: Float) -> Float:
        """Return chi^2 of the fit to a ramp without noise; the signal is in electrons, nonlinearity `b` in 1/electron.

        It is 0 for signals of 0 or less.
        """
        return np.asarray(self.misfit_factor * b**2 * np.maximum(signal, 0.0) ** 3)
