"""The signal of a ramp as it is computed on board, and how well the ramp fits it.

With D_i (e-) the n differences of the groups' means plus beta, A = 1 + alpha, M = mean D_i^2 and m = mean D_i, the
most likely signal is Q = n (x - beta) with x^2 + A x = M: in Kubik et al. x = A / 2 (sqrt(1 + 4 M / A^2) - 1), a
difference of near-equal numbers where M is small, here its other form

    x = 2 M / (A + hypot(A, 2 sqrt(M)))
    beta = 2 s^2 / (r A)

(s the noise of one read, r reads a group: at zero signal the ramp's differences then fit their own noise).  What does
not fit is chi^2 = 2 n (sqrt(M) - m) / A, again without the difference: with SS = sum (D_i - m)^2 it is

    chi^2 = 2 / A * SS / (sqrt(M) + m)       where m >= 0

Ref : Kubik et al. 2016, PASP 128, 104504, eqs. 15 to 26; Euclid Data Product Description Document (chi^2 without
      n_g - 2)
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects.charge.ramp import Mode, mode_of_scene
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene


def beta(mode: Mode, read_noise: float) -> float:
    """What the estimator adds to each difference, e-; read_noise : of one read, e-."""
    return 2.0 * read_noise**2 / (mode.reads * (1.0 + mode.alpha))


def apply(frame: Frame, mode: Mode, read_noise: float, rng: np.random.Generator) -> Frame:
    """Charge of the groups [groups, ny, nx] e- -> float64[2, ny, nx]: signal Q, e- in the integration; chi^2.

    frame, mode : the groups, and how they were read;  rng : not used
    read_noise : e- of one read that the estimator expects
    Error      : Q is low by 0.1 to 0.5 e-, the estimator's own bias; two groups have no chi^2, 0
    """
    if not 0.0 <= read_noise < 1e5:
        raise OutOfRange("read noise", read_noise, 0.0, 1e5)
    out = np.empty((2, *frame.shape[1:]))
    groups = np.ascontiguousarray(frame).reshape(mode.groups, -1)
    _estimate(groups, out.reshape(2, -1), beta(mode, read_noise), 1.0 + mode.alpha)
    return out


@jit
def _estimate(groups: Any, out: Any, beta: float, a: float) -> None:
    n = len(groups) - 1
    for p in range(groups.shape[1]):
        square, total = 0.0, 0.0
        for i in range(n):
            difference = float(groups[i + 1, p]) - float(groups[i, p]) + beta
            square += difference * difference
            total += difference
        mean, scatter = total / n, 0.0
        for i in range(n):
            scatter += (float(groups[i + 1, p]) - float(groups[i, p]) + beta - mean) ** 2
        root = math.sqrt(square / n)
        # Of charge that a pixel can hold: what hypot guards against does not happen.
        x = 2.0 * (square / n) / (a + math.sqrt(a * a + 4.0 * (square / n)))
        out[0, p] = n * (x - beta)
        if mean >= 0.0:
            out[1, p] = 2.0 / a * scatter / (root + mean) if root > 0.0 else 0.0
        else:
            out[1, p] = 2.0 / a * n * (root - mean)


def _parameters(scene: Scene) -> tuple[Mode, float]:
    return mode_of_scene(scene), scene.value("read_noise", "electron")


EFFECT = Effect("macc", apply, _parameters, lambda scene: scene.pixel_noise, optional=False, cost=1.7e-2)
