"""Fringes: light of red emission lines of the sky interferes with its reflection between the two faces of a detector.

The thickness of the silicon varies by several wavelengths over a detector, and fringes follow lines of equal thickness.
A passband contains a few emission lines of hydroxyl. The contrast is high where the fringes of these lines coincide,
and low elsewhere. Sources have no fringes because their light has a continuous spectrum.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from truesky.numerics import matrices
from truesky.numerics.compiling import jit
from truesky.render.effects.effect import Effect, copy_frame
from truesky.render.effects.scene import Frame, Scene

# (Relative wave number, relative intensity) of four groups of emission lines, as in the z and y bands (assumed).
_LINES = ((0.965, 0.2), (0.99, 0.35), (1.0, 0.25), (1.03, 0.2))
# Mean path difference between light and its reflection (twice the thickness of the detector), in wavelengths.
_ORDERS = 120.0
# The thickness of the detector varies as a sum of cosines of the position. The cosines have 0 to this number of half
# waves along each side of the detector.
_MODES = 4
# The thickness of the detector is a sum of cosines of the position with random amplitudes. Their rms is proportional to
# (1 + k) to the minus this power. k^2 is the sum of the squared numbers of half waves of a cosine along both sides of
# the detector.
_STEEPNESS = 1.5
# Distance in pixels between the points of the detector at which the path difference of interfering rays is computed. It
# is interpolated between them.
_NODE_SPACING = 8
# Number of samples per fringe (one wavelength of path difference) of the lookup table with the brightness of fringes.
_STEPS_PER_CYCLE = 64


def apply(
    frame: Frame,
    electrons: float,
    amplitude: float,
    period: float,
    rng: np.random.Generator,
    out: Frame | None = None,
) -> Frame:
    """Add fringes of the sky background to a frame: a pattern of the detector that is the same in every exposure.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    electrons : float
        Electrons of the sky background per pixel.
    amplitude : float
        Amplitude of the strongest fringes as a fraction of the sky background, 0 to 1. With 0 the frame is unchanged.
    period : float
        Mean distance between neighbouring fringes in pixels, 4 to 1e5.
    rng : numpy.random.Generator
        Random generator of the detector, in the same state in every exposure, so that the fringes do not change.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons including fringes.

    Raises
    ------
    OutOfRange
        If `amplitude` or `period` is outside its limits or NaN.

    Notes
    -----
    The brightness of the fringes is read from a lookup table, and the thickness of the detector is interpolated. Both
    together have an error of 1e-3 of the amplitude.
    """
    if not 0.0 <= amplitude <= 1.0:
        raise OutOfRange("fringes", amplitude, 0.0, 1.0)
    if not 4.0 <= period <= 1e5:
        raise OutOfRange("period of fringes", period, 4.0, 1e5)
    out = copy_frame(frame, out)
    if amplitude == 0.0 or electrons == 0.0 or not out.size:
        return out
    nodes = phase(frame.shape[1], frame.shape[0], period, rng)
    first = float(nodes.min())
    steps = np.arange(math.ceil((float(nodes.max()) - first) * _STEPS_PER_CYCLE) + 2) / _STEPS_PER_CYCLE
    table = contrast(first + steps)
    _add_fringes(out, nodes, electrons * amplitude / float(np.abs(table).max()) * table, first)
    return out


def contrast(cycles: Float) -> Float:
    """Return the relative brightness of the fringes, -1 to 1, at given path differences.

    `cycles`, shape (n,), is the path difference in wavelengths of the emission line with the relative wave number 1.
    The result has the same shape.
    """
    waves, light = np.array(_LINES).T
    terms = np.cos(2.0 * np.pi * np.multiply.outer(cycles, waves)) * (light / light.sum())
    return np.asarray(terms.sum(axis=1))


def phase(nx: int, ny: int, period: float, rng: np.random.Generator) -> Float:
    """Draw a smooth random map of the path difference between interfering rays, in wavelengths.

    Parameters
    ----------
    nx, ny : int
        Columns and rows of the detector.
    period : float
        Mean distance between neighbouring fringes in pixels: the path difference changes by one wavelength.
    rng : numpy.random.Generator
        Random generator of the detector, in the same state in every exposure, so that the map does not change.

    Returns
    -------
    float array, shape (n, m)
        Path difference in wavelengths, at nodes that are `_NODE_SPACING` = 8 pixels apart. The first node is pixel 0.
    """
    across, up = (np.arange((n - 1) // _NODE_SPACING + 2) * float(_NODE_SPACING) for n in (nx, ny))
    # Scale both directions by the longer side of the detector, so that the pattern of fringes is isotropic.
    side = float(max(nx, ny, 4 * _NODE_SPACING))
    number = np.arange(_MODES + 1)
    strength = rng.standard_normal((_MODES + 1, _MODES + 1)) / (1.0 + np.hypot.outer(number, number)) ** _STEEPNESS
    strength[0, 0] = 0.0
    waves = [np.cos(np.pi * np.multiply.outer(at / side, number)) for at in (across, up)]
    slopes = [-np.pi / side * number * np.sin(np.pi * np.multiply.outer(at / side, number)) for at in (across, up)]
    slope_x, slope_y, height = (
        matrices.matmul(matrices.matmul(up_, strength), across_.T)
        for up_, across_ in ((waves[1], slopes[0]), (slopes[1], waves[0]), (waves[1], waves[0]))
    )
    rms_slope = float(np.sqrt(np.mean(slope_x**2 + slope_y**2)))
    return np.asarray(_ORDERS + height / (rms_slope * period))


@jit
def _add_fringes(frame: Any, nodes: Any, table: Any, first: float) -> None:
    """Add the brightness of the fringes to each pixel of a frame, in place.

    `nodes` is the path difference in wavelengths at points `_NODE_SPACING` = 8 pixels apart; between them it is
    interpolated. `table` contains the brightness in electrons for path differences from `first` (wavelengths) on, in
    steps of 1 / `_STEPS_PER_CYCLE` wavelengths.
    """
    ny, nx = frame.shape
    line = np.empty(nodes.shape[1])
    for r in range(ny):
        low, part = r // _NODE_SPACING, (r % _NODE_SPACING) / _NODE_SPACING
        for k in range(len(line)):
            line[k] = nodes[low, k] + part * (nodes[low + 1, k] - nodes[low, k])
        for c in range(nx):
            k, share = c // _NODE_SPACING, (c % _NODE_SPACING) / _NODE_SPACING
            place = (line[k] + share * (line[k + 1] - line[k]) - first) * _STEPS_PER_CYCLE
            i = min(max(int(place), 0), len(table) - 2)
            frame[r, c] += table[i] + (place - i) * (table[i + 1] - table[i])


def parameters(scene: Scene) -> tuple[float, float, float]:
    """Return the parameters of `apply`: electrons of the sky per pixel, amplitude, and distance of fringes (pixels).

    The amplitude is a fraction of the sky background. It is 0 if the scene has no passband, or if the mission database
    has no fringes for its passband.
    """
    key = "" if scene.band is None else f"{scene.section}.{scene.band.name}.fringes"
    amplitude = scene.mission.value(key) if key in scene.mission else 0.0
    return scene.sky_electrons, amplitude, scene.value("fringe_period", "pix") if amplitude else 1e3


def _contribution(scene: Scene) -> float:
    electrons, amplitude, _ = parameters(scene)
    return electrons * amplitude


EFFECT = Effect("fringes", apply, parameters, _contribution, fixed=True, cost=6e-3, in_place=True)
