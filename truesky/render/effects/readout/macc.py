"""Estimate the signal of an up-the-ramp exposure, and the quality of its fit, as the on-board software of NISP does.

The detector is read many times without reset (a ramp), and reads are averaged in groups. Let D_i (electrons) be the n
differences of successive group means plus the constant beta. Let A = 1 + alpha, M = mean D_i^2 and m = mean D_i. For
groups of r reads with d dropped reads between them, alpha = (1 - r^2) / (3 r (r + d)). The most likely signal in
electrons is Q = n (x - beta) with x^2 + A x = M. Kubik et al. give x = A / 2 (sqrt(1 + 4 M / A^2) - 1), a difference of
nearly equal numbers for small M. This module uses the equivalent::

    x = 2 M / (A + hypot(A, 2 sqrt(M)))
    beta = 2 s^2 / (r A)

with the noise s of one read in electrons. With this beta, the differences of a ramp without signal fit the model with
read noise alone. The fit has chi^2 = 2 n (sqrt(M) - m) / A. With SS = sum (D_i - m)^2, the equivalent form that does
not subtract nearly equal numbers is::

    chi^2 = 2 / A * SS / (sqrt(M) + m)       if m >= 0

References
----------
Kubik et al. 2016, PASP 128, 104504, eqs. 15 to 26. Euclid Data Product Description Document (chi^2 is not divided by
its degrees of freedom, the number of groups - 2).
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
    """Return the constant, in electrons, that the estimator of the signal adds to each difference of groups.

    `read_noise` is the noise of one read in electrons. The constant is 2 s^2 / (r (1 + alpha)), with this noise s, r
    reads per group, and alpha = `Mode.alpha`, the correction of the variance of a difference for reads that are
    averaged in groups.
    """
    return 2.0 * read_noise**2 / (mode.reads * (1.0 + mode.alpha))


def apply(frame: Frame, mode: Mode, read_noise: float, rng: np.random.Generator) -> Frame:
    """Estimate the signal of each pixel from the groups of a ramp (averaged reads without reset), and chi^2 of the fit.

    Parameters
    ----------
    frame : float array, shape (groups, ny, nx)
        Mean charge of the reads of each group in electrons.
    mode : Mode
        Readout mode of the ramp. Its number of groups must be that of `frame`.
    read_noise : float
        Noise of one read in electrons that the estimator assumes, at least 0, below 1e5.
    rng : numpy.random.Generator
        Not used.

    Returns
    -------
    float64 array, shape (2, ny, nx)
        Signal in electrons during the integration time (from the first to the last group), and chi^2. For a ramp of two
        groups with an increasing signal chi^2 is 0.

    Raises
    ------
    OutOfRange
        If `read_noise` is outside its limits or NaN.

    Notes
    -----
    The estimator is biased: the signal is 0.1 to 0.5 electrons too low.
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
        # Use sqrt instead of hypot, which only prevents an overflow: the charge of a pixel is far too small for one.
        x = 2.0 * (square / n) / (a + math.sqrt(a * a + 4.0 * (square / n)))
        out[0, p] = n * (x - beta)
        if mean >= 0.0:
            out[1, p] = 2.0 / a * scatter / (root + mean) if root > 0.0 else 0.0
        else:
            out[1, p] = 2.0 / a * n * (root - mean)


def _parameters(scene: Scene) -> tuple[Mode, float]:
    return mode_of_scene(scene), scene.value("read_noise", "electron")


EFFECT = Effect("macc", apply, _parameters, lambda scene: scene.pixel_noise, optional=False, cost=1.7e-2)
