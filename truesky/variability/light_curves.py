"""Light curves of pulsating stars: shapes as Fourier series, and amplitudes by wavelength.

A light curve in magnitudes is amplitude times shape. The shape depends on the type of the star, and on its amplitude
(RR Lyrae stars) or its period (Cepheids). It is the same at all wavelengths; the amplitude is smaller at longer ones.
The mean flux over a period is the flux of the catalogue (intensity mean). The files light_curve_shapes.csv and
amplitude_ratios.csv contain the numbers and their sources.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from lake_schema.arrays import Float, Int

SHAPES = Path(__file__).with_name("light_curve_shapes.csv")
RATIOS = Path(__file__).with_name("amplitude_ratios.csv")
HARMONICS = 6
# Phases at which shapes are normalised, and nodes of the tables by shape parameter and amplitude. With them the mean
# flux of a period is right within 2e-4 (tests/truesky/variability/test_light_curves.py).
_PHASES, _SHAPE_NODES, _AMPLITUDE_NODES, _LARGEST_AMPLITUDE = 512, 49, 321, 16.0


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Shapes of light curves in magnitudes by one parameter; the amplitude is 1, and the maximum light is at phase 0.

    Attributes
    ----------
    node : float array, shape (s,)
        Values of the parameter, ascending and equally spaced.
    cosine, sine : float array, shape (s, HARMONICS)
        Fourier coefficients of the shape.
    amplitude : float array, shape (a,)
        Amplitudes, mag, equally spaced from 0.
    log_mean : float array, shape (s, a)
        Natural logarithm of the mean of 10^(-0.4 amplitude shape) over a period.
    """

    node: Float
    cosine: Float
    sine: Float
    amplitude: Float
    log_mean: Float


@lru_cache(maxsize=8)
def shape(kind: str) -> Shape:
    """Return the shapes of "rr_ab", "rr_c", "cepheid" or "long_period" stars; KeyError for another name."""
    rows = [row for row in _read_rows(SHAPES) if row["kind"] == kind]
    if not rows:
        raise KeyError(kind)
    knots = np.array([float(row["node"]) for row in rows])
    order = range(2, HARMONICS + 1)
    r = np.array([[1.0, *(float(row[f"r_{k}1"]) for k in order)] for row in rows])
    phi = np.array([[0.0, *(float(row[f"phi_{k}1"]) for k in order)] for row in rows])
    node = np.linspace(knots[0], knots[-1], _SHAPE_NODES) if len(rows) > 1 else knots[0] + np.arange(2.0)
    cosine, sine = (
        np.stack([np.interp(node, knots, values) for values in parts.T], 1)
        for parts in (r * np.sin(phi), r * np.cos(phi))
    )
    cosine, sine, wave = _normalise(cosine, sine)
    amplitude = np.linspace(0.0, _LARGEST_AMPLITUDE, _AMPLITUDE_NODES)
    log_mean = np.log(np.stack([np.exp(-0.4 * np.log(10.0) * a * wave).mean(1) for a in amplitude], 1))
    return Shape(node, cosine, sine, amplitude, log_mean)


def _normalise(cosine: Float, sine: Float) -> tuple[Float, Float, Float]:
    """Shift and scale series so that their minimum (maximum light) is at phase 0 and their range is 1.

    Return the coefficients of cosines and sines, and the values of the new series at equally spaced phases.
    """
    angle = 2.0 * np.pi * np.arange(_PHASES) / _PHASES
    wave = _series(cosine, sine, np.broadcast_to(angle, (len(cosine), _PHASES)))
    start = angle[wave.argmin(1)]
    span = (wave.max(1) - wave.min(1))[:, None]
    turn = start[:, None] * np.arange(1, HARMONICS + 1)
    cosine, sine = (
        (cosine * np.cos(turn) + sine * np.sin(turn)) / span,
        (sine * np.cos(turn) - cosine * np.sin(turn)) / span,
    )
    return cosine, sine, _series(cosine, sine, np.broadcast_to(angle, (len(cosine), _PHASES)))


def _series(cosine: Float, sine: Float, angle: Float) -> Float:
    """Return the sum of Fourier series with coefficients, shape (n, HARMONICS), at angles (rad), shape (n, m)."""
    cos_1, sin_1 = np.cos(angle), np.sin(angle)
    cos_k, sin_k = cos_1, sin_1
    total = cosine[:, :1] * cos_1 + sine[:, :1] * sin_1
    for k in range(1, HARMONICS):
        cos_k, sin_k = cos_k * cos_1 - sin_k * sin_1, sin_k * cos_1 + cos_k * sin_1
        if cosine[:, k].any() or sine[:, k].any():
            total += cosine[:, k : k + 1] * cos_k + sine[:, k : k + 1] * sin_k
    return np.asarray(total)


def amplitude_ratio(family: str, wavelength: float) -> float:
    """Return the amplitude at a pivot wavelength (A) relative to V, of "rr_lyrae", "cepheid" or "long_period" stars.

    It is interpolated in ln(wavelength), and constant outside 3600 to 22,000 A.
    """
    rows = _read_rows(RATIOS)
    at = np.log([float(row["wavelength"]) for row in rows])
    return float(np.interp(np.log(wavelength), at, [float(row[family]) for row in rows]))


def flux_factors(curve: Shape, parameter: Float, amplitude: Float, phase: Float) -> Float:
    """Return the flux relative to its mean over a period.

    Parameters
    ----------
    curve : Shape
        Shapes of the light curves.
    parameter : float array, shape (n,)
        Parameter of each star's shape; values outside the nodes get the first or last shape.
    amplitude : float array, shape (n,)
        Difference between minimum and maximum in the passband, mag.
    phase : float array, shape (n, m)
        Phases since the maximum light, in periods.

    Returns
    -------
    float array, shape (n, m)
        Flux relative to its mean.
    """
    low, part = _bracket(curve.node, parameter)
    cosine, sine = (
        (1.0 - part)[:, None] * table[low] + part[:, None] * table[low + 1] for table in (curve.cosine, curve.sine)
    )
    first, weight = _bracket(curve.amplitude, amplitude)
    means = [
        (1.0 - weight) * curve.log_mean[row, first] + weight * curve.log_mean[row, first + 1] for row in (low, low + 1)
    ]
    log_mean = (1.0 - part) * means[0] + part * means[1]
    magnitudes = _series(cosine, sine, (2.0 * np.pi) * phase)
    magnitudes *= (-0.4 * np.log(10.0) * amplitude)[:, None]
    magnitudes -= log_mean[:, None]
    return np.asarray(np.exp(magnitudes, out=magnitudes))


def _bracket(nodes: Float, at: Float) -> tuple[Int, Float]:
    """Return the index of the node before each value, and the weight (0 to 1) of the node after it."""
    place = np.clip((at - nodes[0]) / (nodes[1] - nodes[0]), 0.0, nodes.size - 1.0)
    low = np.minimum(place.astype(np.int64), nodes.size - 2)
    return low, place - low


@lru_cache(maxsize=2)
def _read_rows(file: Path) -> tuple[dict[str, str], ...]:
    with file.open(newline="", encoding="utf-8") as lines:
        return tuple(csv.DictReader(line for line in lines if not line.startswith("#")))
