"""Compute the diffuse sky through a grism on a grid over the detector.

A pixel at (x, y) receives light of wavelength lambda by order m from the undispersed position (x - X_m, y - Y_m)::

    B(x, y) = sum_m int S(lambda) T_m(lambda) V(x - X_m, y - Y_m) dlambda + thermal light

S is zodiacal light through the passband and T_m the throughput of an order. V is the vignetting of a tilted grism
within the field stop, and 0 beyond it. Thermal light is assumed to be uniform and to have no other orders.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lake_schema.arrays import Bool, Float
from lake_schema.mission.configuration import MissionConfiguration
from truesky.render.camera.detectors import Detector
from truesky.render.camera.traces import Trace
from truesky.render.channels.aim import Aim
from truesky.render.effects.scene import Frame, Scene
from truesky.render.sky import diffuse_light

# Grid spacing in pixels, and wavelength step in Angstrom, which is 16 pixels of the second order.
_CELL, _STEP = 64, 100


def sky_change(scene: Scene, aim: Aim, seed: int) -> Frame | None:
    """Change of a uniform sky by the orders of a grism, on an even grid from corner to corner of a detector.

    Parameters
    ----------
    scene : Scene
        Scene before anything is drawn.
    aim : Aim
        Exposure and detector.
    seed : int
        Seed of the request.

    Returns
    -------
    float array, shape (gy, gx), or None
        Electrons. None if there is no grism in the beam, or no light of the sky.

    Notes
    -----
    Traces are evaluated at the position of the light instead of the source. The error is 1 % of the length of a trace,
    which matters only at the field stop.
    """
    dispersion, detector, mission = aim.channel.dispersion, aim.detector, scene.mission
    if dispersion is None or not aim.sees_sky or not scene.sky_rate > 0.0:
        return None
    band, section = aim.band, detector.section
    photons = diffuse_light.photons(section, scene.sky_rate, band, mission) * scene.exposure_time_s
    photons -= diffuse_light.thermal_photons(section, band, mission) * scene.exposure_time_s
    nodes = (np.linspace(0.0, n - 1.0, int(np.ceil(n / _CELL)) + 1) for n in (detector.nx, detector.ny))
    column, row = np.meshgrid(*nodes)
    out = np.full(column.shape, -float(photons.sum()))
    parts = np.array_split(np.arange(len(photons)), max(len(photons) // _STEP, 1))
    middle = np.array([band.wavelength[part].mean() for part in parts])
    for trace in dispersion.traces(aim.exposure, detector, mission, seed):
        passed = photons * dispersion.throughput(aim.exposure, trace.order, band.wavelength, detector, mission)
        for wavelength, part in zip(middle, parts, strict=True):
            x, y = _offset(trace, column, row, float(wavelength))
            transmitted = dispersion.vignetting(aim.exposure, detector, column - x, row - y, mission)
            out += float(passed[part].sum()) * transmitted * _is_in_field_stop(column - x, row - y, detector, mission)
    return out


def with_sky_change(scene: Scene, aim: Aim, seed: int) -> Scene:
    """Return a scene with the change of its sky by a grism in the beam.

    Parameters
    ----------
    scene, aim, seed : Scene, Aim, int
        Same as in `sky_change`.

    Returns
    -------
    Scene
        Scene with `sky_change`.
    """
    return replace(scene, sky_change=sky_change(scene, aim, seed))


def _offset(trace: Trace, column: Float, row: Float, wavelength: float) -> tuple[Float, Float]:
    """Return the displacement in columns and rows of light with a wavelength, for arrays of positions."""
    t = (wavelength - trace.first) / (trace.last - trace.first)
    x, y = (np.asarray(np.polynomial.polynomial.polyval(t, part)) for part in (trace.x, trace.y))
    return x[0] + x[1] * column + x[2] * row, y[0] + y[1] * column + y[2] * row


def _is_in_field_stop(column: Float, row: Float, detector: Detector, mission: MissionConfiguration) -> Bool:
    """Return a mask of the positions that are not hidden by the field stop."""
    turn = np.radians(detector.rotation)
    u = (column - (detector.nx - 1) / 2) * detector.pixel_scale
    v = (row - (detector.ny - 1) / 2) * detector.pixel_scale
    x = detector.x + np.cos(turn) * u - np.sin(turn) * v
    y = detector.y + np.sin(turn) * u + np.cos(turn) * v
    half = [0.5 * mission.value(f"plm.unvignetted_{axis}", "arcsec") for axis in "xy"]
    return np.asarray((np.abs(x) <= half[0]) & (np.abs(y) <= half[1]))
