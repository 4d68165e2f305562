"""Stray light from bright stars in or near the field: a wide faint halo around every star.

The surface brightness I at the distance r from a star is given below. F is the flux of the star, f the fraction of it
in the halo, and s the scale length of the halo::

    I(r) = F f / (2 pi s^2) (1 + (r / s)^2)^(-3/2)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects.effect import Effect, copy_frame
from truesky.render.effects.scene import Frame, Lights, Scene

# Distance between nodes of the grid on which halos are computed, in units of the halo's scale length. Linear
# interpolation between the nodes has a relative error of at most 3e-3.
_NODE_SPACING = 1.0 / 16.0
# Largest distance in pixels between nodes of the grid on which halos are computed. It replaces `_NODE_SPACING` for
# halos with a scale length above 4096 pixels.
_MAX_STEP = 256


def apply(
    frame: Frame,
    lights: Lights,
    fraction: float,
    scale: float,
    rng: np.random.Generator | None = None,
    out: Frame | None = None,
) -> Frame:
    """Add the halo of every star in `lights` to a frame, also of stars outside the frame.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    lights : Lights
        Positions (columns and rows) and electrons of the stars.
    fraction : float
        Fraction of a star's flux that is in its halo, 0 to 1.
    scale : float
        Scale length of the halo in pixels, 1 to 1e6.
    rng : numpy.random.Generator, optional
        Not used.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons including halos.

    Raises
    ------
    OutOfRange
        If `fraction` or `scale` is outside its limits or NaN.
    """
    out = copy_frame(frame, out)
    nodes, step = halo_nodes((out.shape[0], out.shape[1]), lights, fraction, scale)
    if nodes is not None:
        _interpolate(out, nodes, step)
    return out


def halo_nodes(shape: tuple[int, int], lights: Lights, fraction: float, scale: float) -> tuple[Frame | None, int]:
    """Return the halos of stars at the nodes of a grid, between which `apply` interpolates.

    Parameters
    ----------
    shape : (int, int)
        Numbers of rows and columns of the frame.
    lights, fraction, scale : Lights, float, float
        Stars, fraction of their flux in the halo, and scale length of the halo in pixels, as for `apply`.

    Returns
    -------
    nodes : float array, shape (gy, gx), or None
        Electrons per pixel at the nodes; None without halos.
    step : int
        Distance between nodes in pixels. The first node lies on the first pixel.

    Raises
    ------
    OutOfRange
        If `fraction` or `scale` is outside its limits or NaN.
    """
    if not 0.0 <= fraction <= 1.0:
        raise OutOfRange("straylight fraction", fraction, 0.0, 1.0)
    if not 1.0 <= scale <= 1e6:
        raise OutOfRange("straylight scale", scale, 1.0, 1e6)
    step = int(np.clip(scale * _NODE_SPACING, 1, _MAX_STEP))
    if fraction == 0.0 or min(shape) == 0 or not len(lights.electrons):
        return None, step
    nodes = np.zeros(((shape[0] - 1) // step + 2, (shape[1] - 1) // step + 2))
    height = lights.electrons * fraction / (2.0 * np.pi * scale**2)
    _add_halos(nodes, step, lights.column, lights.row, height, 1.0 / scale**2)
    return nodes, step


@jit
def _add_halos(nodes: Any, step: int, column: Any, row: Any, height: Any, inverse: float) -> None:
    for i in range(len(column)):
        for r in range(nodes.shape[0]):
            dy = r * step - row[i]
            for c in range(nodes.shape[1]):
                dx = c * step - column[i]
                u = 1.0 + (dx * dx + dy * dy) * inverse
                nodes[r, c] += height[i] / (u * np.sqrt(u))


@jit
def _interpolate(frame: Any, nodes: Any, step: int) -> None:
    ny, nx = frame.shape
    line = np.empty(nodes.shape[1])
    for r in range(ny):
        low, part = r // step, (r % step) / step
        for k in range(len(line)):
            line[k] = nodes[low, k] + part * (nodes[low + 1, k] - nodes[low, k])
        for k in range(len(line) - 1):
            segment, slope = frame[r, k * step : min((k + 1) * step, nx)], (line[k + 1] - line[k]) / step
            for c in range(len(segment)):
                segment[c] += line[k] + c * slope


def _halo_parameters(scene: Scene) -> tuple[float, float]:
    """Return the fraction of a star's flux that is in its halo, and the scale length of the halo in pixels."""
    pixel_scale = scene.value("fpa.pixel_scale", "arcsec / pix")
    return scene.value("halo.fraction", ""), scene.value("halo.radius", "arcsec") / pixel_scale


def parameters(scene: Scene) -> tuple[Lights, float, float]:
    """Return the parameters of `apply` for a scene: stars with a noticeable halo, its fraction and scale in pixels."""
    fraction, scale = _halo_parameters(scene)
    lights = scene.lights
    # Omit halos whose peak is at most a thousandth of the noticeable change. Even a thousand of them at the same place
    # are not noticeable.
    height = fraction * lights.electrons / (2.0 * np.pi * scale**2)
    bright = height > 1e-3 * scene.noticeable_electrons
    return Lights(lights.column[bright], lights.row[bright], lights.electrons[bright]), fraction, scale


def _contribution(scene: Scene) -> float:
    fraction, scale = _halo_parameters(scene)
    return fraction * float(scene.lights.electrons.sum()) / (2.0 * np.pi * scale**2)


EFFECT = Effect("straylight", apply, parameters, _contribution, cost=5e-3, in_place=True)
