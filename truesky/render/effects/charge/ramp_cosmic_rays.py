"""Cosmic rays in a thin layer that is read without being emptied: each leaves its charge at one moment of the ramp.

Directions are isotropic: of tracks through a layer of thickness T, l^2 / (l^2 + T^2) are shorter than l when seen from
above.  A particle leaves its charge in proportion to its path sqrt(l^2 + T^2), with a scatter of its own.
"""

from __future__ import annotations

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.render.effects.charge import cosmic_rays, ramp
from truesky.render.effects.effect import Effect, zero_contribution
from truesky.render.effects.scene import Frame, Scene

# Expected hits that nobody waits for.
_NEGLIGIBLE = 1e-3
_SQUARE_CM = 1e-8


def apply(
    frame: Frame, expected: float, thickness: float, electrons: float, scatter: float, rng: np.random.Generator
) -> Frame:
    """Expected light [ny, nx] e- -> [3, ny, nx] of ramp.apply, with the charge of hits and their moments.

    frame     : expected e-
    expected  : mean number of particles in the ramp;  thickness : of the layer, pixels
    electrons : median that a particle leaves on a path of one pixel;  scatter : rms of its decimal logarithm
    Error     : a pixel that two particles hit has all of their charge at the moment of the second
    rng       : random numbers of the hits
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
    # In (0, 1]: the part of the tracks that are longer.
    longer, logarithm = 1.0 - rng.random(count), rng.normal(0.0, scatter, count)
    length = np.minimum(thickness * np.sqrt((1.0 - longer) / longer), float(nx + ny))
    charge = np.rint(electrons * np.hypot(length, thickness) * 10.0**logarithm)
    moment = rng.random(count)
    # A track of no length at all has one pixel, too.
    events = (x, y, np.cos(angle), np.sin(angle), np.maximum(length, 1e-9), charge)
    event, columns, rows, pixel_charge = cosmic_rays.pixels_of_events(events)
    cosmic_rays.add_charge(out[1], rows, columns, pixel_charge)
    out[2][rows % ny, columns % nx] = moment[event]
    return out


def _parameters(scene: Scene) -> tuple[float, float, float, float]:
    """Of the whole ramp, from its reset."""
    pixel = scene.value("fpa.pixel_size", "um / pix")
    seconds = ramp.mode_of_scene(scene).frames * ramp.frame_time(scene)
    area = scene.nx * scene.ny * pixel**2 * _SQUARE_CM
    rate = scene.mission.value("env.cosmic_rays.flux", "cm-2 s-1") * area
    deposit = scene.mission.value("env.cosmic_rays.hgcdte_deposit", "electron / um")
    scatter = scene.mission.value("env.cosmic_rays.deposit_scatter", "dex")
    return rate * seconds, scene.value("hgcdte_thickness", "um") / pixel, deposit * pixel, scatter


def _contribution(scene: Scene) -> float:
    """Of the usual particle, straight through."""
    expected, thickness, electrons, _ = _parameters(scene)
    return electrons * thickness * (expected > _NEGLIGIBLE)


EFFECT = Effect("ramp_cosmic_rays", apply, _parameters, _contribution, cost=1e-2, systematic=zero_contribution)
