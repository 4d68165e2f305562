"""Cosmic rays in a thin infrared detector, which is read several times during an exposure (up the ramp).

Each particle leaves its charge at one moment of the ramp (series of reads). The directions of particles are isotropic.
In a layer of thickness T, the fraction l^2 / (l^2 + T^2) of the tracks has a length below l, projected on the detector.
A particle leaves charge in proportion to its path length sqrt(l^2 + T^2), with log-normal scatter.
"""

from __future__ import annotations

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.render.effects.charge import cosmic_rays, ramp
from truesky.render.effects.effect import Effect, zero_contribution
from truesky.render.effects.scene import Frame, Scene

# If the expected number of particles per exposure is at most this, `_contribution` returns 0, so that no cosmic rays
# are drawn unless the user switches the effect on.
_NEGLIGIBLE = 1e-3
# Square centimetres per square micrometre.
_SQUARE_CM = 1e-8


def apply(
    frame: Frame, expected: float, thickness: float, electrons: float, scatter: float, rng: np.random.Generator
) -> Frame:
    """Draw cosmic rays, and return them as additional planes of the frame from which the effect `ramp` draws the reads.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    expected : float
        Expected number of particles during the ramp, 0 to 1e8. The number drawn has a Poisson distribution.
    thickness : float
        Thickness of the detector layer in pixels, 0 to 1000.
    electrons : float
        Median charge in electrons that a particle leaves per pixel of path length, 0 to 1e8.
    scatter : float
        Standard deviation of the logarithm (base 10) of the charge, 0 to 3.
    rng : numpy.random.Generator
        Random generator of the particles.

    Returns
    -------
    float32 array, shape (3, ny, nx), or float64 array, shape (ny, nx)
        Plane 0: `frame`. Plane 1: charge of cosmic rays in electrons. Plane 2: time at which it arrives, 0 <= time < 1,
        in units of the time from the reset to the last read. Without any particle, a copy of `frame` alone.

    Raises
    ------
    OutOfRange
        If `expected`, `thickness`, `electrons` or `scatter` is outside its limits or NaN.

    Notes
    -----
    If two particles hit the same pixel, all of their charge arrives at the time of the second one.
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
    for batch in cosmic_rays.batches(count):
        _add_tracks(out, batch, thickness, electrons, scatter, rng)
    return out


def _add_tracks(
    planes: Frame, count: int, thickness: float, electrons: float, scatter: float, rng: np.random.Generator
) -> None:
    """Draw `count` tracks, and add their charge and times to the planes 1 and 2, in place.

    `planes` is a float array of shape (3, ny, nx). See `apply` for the other parameters.
    """
    ny, nx = planes.shape[1:]
    angle, x, y = 2.0 * np.pi * rng.random(count), nx * rng.random(count), ny * rng.random(count)
    # `longer` is a random number in (0, 1] for each track: the fraction of all tracks that are longer than it.
    longer, logarithm = 1.0 - rng.random(count), rng.normal(0.0, scatter, count)
    length = np.minimum(thickness * np.sqrt((1.0 - longer) / longer), float(nx + ny))
    charge = np.rint(electrons * np.hypot(length, thickness) * 10.0**logarithm)
    moment = rng.random(count)
    # A track of length 0 still crosses one pixel: `pixels_of_events` needs a length above 0.
    events = (x, y, np.cos(angle), np.sin(angle), np.maximum(length, 1e-9), charge)
    event, columns, rows, pixel_charge = cosmic_rays.pixels_of_events(events)
    cosmic_rays.add_charge(planes[1], rows, columns, pixel_charge)
    planes[2][rows % ny, columns % nx] = moment[event]


def _parameters(scene: Scene) -> tuple[float, float, float, float]:
    pixel = scene.value("fpa.pixel_size", "um / pix")
    # Count particles during the whole ramp, from the reset of the detector to its last read.
    seconds = ramp.mode_of_scene(scene).frames * ramp.frame_time(scene)
    area = scene.nx * scene.ny * pixel**2 * _SQUARE_CM
    rate = scene.mission.value("env.cosmic_rays.flux", "cm-2 s-1") * area
    deposit = scene.mission.value("env.cosmic_rays.hgcdte_deposit", "electron / um")
    scatter = scene.mission.value("env.cosmic_rays.deposit_scatter", "dex")
    return rate * seconds, scene.value("hgcdte_thickness", "um") / pixel, deposit * pixel, scatter


def _contribution(scene: Scene) -> float:
    """Return the electrons that a median particle leaves if it crosses the detector layer perpendicularly.

    It is 0 if the expected number of particles is not above 1e-3.
    """
    expected, thickness, electrons, _ = _parameters(scene)
    return electrons * thickness * (expected > _NEGLIGIBLE)


EFFECT = Effect("ramp_cosmic_rays", apply, _parameters, _contribution, cost=1e-2, systematic=zero_contribution)
