"""The diffuse sky through a grism, at places of a detector.

A pixel at (x, y) sees by order m light of wavelength lambda from the undispersed place (x - X_m, y - Y_m), so that

    B(x, y) = sum_m int S(lambda) T_m(lambda) V(x - X_m, y - Y_m) dlambda + thermal light

S zodiacal light through the passband, T_m the orders' throughputs, V what a grism that is turned lets through
within the field stop, and 0 beyond it.  Thermal light is taken as even, and of no other orders.

spread_sky   what this changes of the background of the passband
with_sky     a scene that knows it
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

# Pixels between places, and A between wavelengths: 16 pixels of the second order.
_CELL, _STEP = 64, 100


def sky_change(scene: Scene, aim: Aim, seed: int) -> Frame | None:
    """[gy, gx] e- that the orders change of an even sky, at places of a detector evenly from corner to corner.

    None where no grism is in the beam, or no sky is seen.
    scene : before anything is drawn;  aim : the exposure and detector;  seed : of the request
    Error : the field's gradients of the traces are taken at the light's place, not at the source's: 1 % of the trace's
            length, where it matters at the field stop alone
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
    """The scene, with what a grism in the beam changes of its sky.

    scene, aim, seed : as of `spread_sky`
    """
    return replace(scene, sky_change=sky_change(scene, aim, seed))


def _offset(trace: Trace, column: Float, row: Float, wavelength: float) -> tuple[Float, Float]:
    """[..] columns and rows by which a wavelength is moved at places [..]."""
    t = (wavelength - trace.first) / (trace.last - trace.first)
    x, y = (np.asarray(np.polynomial.polynomial.polyval(t, part)) for part in (trace.x, trace.y))
    return x[0] + x[1] * column + x[2] * row, y[0] + y[1] * column + y[2] * row


def _is_in_field_stop(column: Float, row: Float, detector: Detector, mission: MissionConfiguration) -> Bool:
    """[..] Places that the field stop does not hide."""
    turn = np.radians(detector.rotation)
    u = (column - (detector.nx - 1) / 2) * detector.pixel_scale
    v = (row - (detector.ny - 1) / 2) * detector.pixel_scale
    x = detector.x + np.cos(turn) * u - np.sin(turn) * v
    y = detector.y + np.sin(turn) * u + np.cos(turn) * v
    half = [0.5 * mission.value(f"plm.unvignetted_{axis}", "arcsec") for axis in "xy"]
    return np.asarray((np.abs(x) <= half[0]) & (np.abs(y) <= half[1]))
