"""Cosmic rays in a thin infrared detector: each particle leaves its charge at one moment of the ramp.

Directions are isotropic. In a layer of thickness T, the fraction l^2 / (l^2 + T^2) of the tracks has a projected
length below l. A particle leaves charge in proportion to its path length sqrt(l^2 + T^2), with log-normal scatter.
"""

from __future__ import annotations

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.render.effects.charge import cosmic_rays, ramp
from truesky.render.effects.effect import Effect, zero_contribution
from truesky.render.effects.scene import Frame, Scene

# Expected number of hits below which the effect is treated as absent.
_NEGLIGIBLE = 1e-3
_SQUARE_CM = 1e-8


def apply(
    frame: Frame, expected: float, thickness: float, electrons: float, scatter: float, rng: np.random.Generator
) -> Frame:
    """Add the planes of cosmic-ray charge and arrival time to the input of `ramp.apply`.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    expected : float
        Mean number of particles during the ramp, 0 to 1e8.
    thickness : float
        Thickness of the layer in pixels, 0 to 1000.
    electrons : float
        Median charge in electrons that a particle leaves per pixel of path length, 0 to 1e8.
    scatter : float
        Standard deviation of the decimal logarithm of the charge, 0 to 3.
    rng : numpy.random.Generator
        Random numbers of the hits.

    Returns
    -------
    float32 array, shape (3, ny, nx)
        Input of `ramp.apply`: light, charge of the hits in electrons, and their arrival time as a fraction of the
        ramp. Without any hit, a copy of `frame`, shape (ny, nx).

    Raises
    ------
    OutOfRange
        If a parameter is outside its limits.

    Notes
    -----
    If two particles hit the same pixel, all of their charge arrives with the second.
    """
    for name, value, highest in (
        ("thickness", thickness, 1e3), ("charge of a path", electrons, 1e8), ("scatter of the charge", scatter, 3.0)
    ):  # fmt: skip
        if not 0.0 <= value <= highest:
            raise OutOfRange(name, value, 0.0, highest)
    count = cosmic_rays.draw_event_count(expected, rng)
    if count == 0 or frame.size == 0:
        return np.array(frame, dtype=float)
    out = ramp.with_planes(frame, 3)
    ny, nx = frame.shape
    angle, x, y = 2.0 * np.pi * rng.random(count), nx * rng.random(count), ny * rng.random(count)
    # `longer` in (0, 1] is the fraction of tracks that are longer.
    longer, logarithm = 1.0 - rng.random(count), rng.normal(0.0, scatter, count)
    length = np.minimum(thickness * np.sqrt((1.0 - longer) / longer), float(nx + ny))
    charge = np.rint(electrons * np.hypot(length, thickness) * 10.0**logarithm)
    moment = rng.random(count)
    # A track of length 0 still crosses one pixel.
    events = (x, y, np.cos(angle), np.sin(angle), np.maximum(length, 1e-9), charge)
    event, columns, rows, pixel_charge = cosmic_rays.pixels_of_events(events)
    cosmic_rays.add_charge(out[1], rows, columns, pixel_charge)
    out[2][rows % ny, columns % nx] = moment[event]
    return out


def _parameters(scene: Scene) -> tuple[float, float, float, float]:
    pixel = scene.value("fpa.pixel_size", "um / pix")
    # Particles count during the whole ramp, from the reset to the last read.
    seconds = ramp.mode_of_scene(scene).frames * ramp.frame_time(scene)
    area = scene.nx * scene.ny * pixel**2 * _SQUARE_CM
    rate = scene.mission.value("env.cosmic_rays.flux", "cm-2 s-1") * area
    deposit = scene.mission.value("env.cosmic_rays.hgcdte_deposit", "electron / um")
    scatter = scene.mission.value("env.cosmic_rays.deposit_scatter", "dex")
    return rate * seconds, scene.value("hgcdte_thickness", "um") / pixel, deposit * pixel, scatter


def _contribution(scene: Scene) -> float:
    """Return the charge of a median particle that crosses the layer perpendicularly."""
    expected, thickness, electrons, _ = _parameters(scene)
    return electrons * thickness * (expected > _NEGLIGIBLE)


EFFECT = Effect("ramp_cosmic_rays", apply, _parameters, _contribution, cost=1e-2, systematic=zero_contribution)
