"""Compute the diffuse sky behind a grism, on a coarse grid over a detector.

A pixel at (x, y) receives light of wavelength lambda in spectral order m from the undispersed position (x - X_m, y -
Y_m), where (X_m, Y_m) is the displacement by the grism::

    B(x, y) = sum_m int S(lambda) T_m(lambda) V(x - X_m, y - Y_m) dlambda + thermal light

S is the spectrum of zodiacal light through the passband, and T_m the throughput of an order. V is the fraction that a
tilted grism transmits inside the field stop, and 0 outside it. Thermal light is assumed to be uniform and not
dispersed.
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

# Largest distance of neighbouring points of the grid on the detector at which the sky is computed, pixels.
_CELL = 64
# Step in wavelength of the integral over the spectrum of the sky, Angstrom. The second spectral order of the grism
# spreads this step over 16 pixels.
_STEP = 100


def sky_change(scene: Scene, aim: Aim, seed: int) -> Frame | None:
    """Return the difference between the diffuse sky behind a grism and a uniform sky, on a grid over a detector.

    Parameters
    ----------
    scene : Scene
        Properties of the exposure before anything is drawn, with the rate of the uniform sky.
    aim : Aim
        Exposure and detector.
    seed : int
        Seed of the request, from which the position error of the grism wheel is drawn.

    Returns
    -------
    float array, shape (gy, gx), or None
        Electrons per pixel in the exposure (also negative), at evenly spaced nodes from the first to the last pixel.
        None without a grism, without light of the sky, or with a sky of 0.

    Notes
    -----
    The displacement by the grism depends on the undispersed position. It is evaluated at the position of the dispersed
    light instead. The error is 1 % of the displacement, which matters only at the edge of the field stop.
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
    """Return the properties of an exposure (scene) with the change of its sky by a grism.

    Parameters
    ----------
    scene, aim, seed : Scene, Aim, int
        Scene before anything is drawn, exposure and detector, and seed of the request, as for `sky_change`.

    Returns
    -------
    Scene
        Scene with the result of `sky_change` in its attribute `sky_change`, which is None without a grism.
    """
    return replace(scene, sky_change=sky_change(scene, aim, seed))


def _offset(trace: Trace, column: Float, row: Float, wavelength: float) -> tuple[Float, Float]:
    """Return by how many columns and rows a spectral order of a grism displaces light of a wavelength in Angstrom.

    `column` and `row` are arrays of the undispersed positions on the detector, pixels. `trace` is the spectral order.
    """
    t = (wavelength - trace.first) / (trace.last - trace.first)
    x, y = (np.asarray(np.polynomial.polynomial.polyval(t, part)) for part in (trace.x, trace.y))
    return x[0] + x[1] * column + x[2] * row, y[0] + y[1] * column + y[2] * row


def _is_in_field_stop(column: Float, row: Float, detector: Detector, mission: MissionConfiguration) -> Bool:
    """Return the mask of the positions (columns and rows of the detector) that the telescope's field stop transmits."""
    u = (column - (detector.nx - 1) / 2) * detector.pixel_scale
    v = (row - (detector.ny - 1) / 2) * detector.pixel_scale
    x, y = detector.to_focal_plane(u, v)
    half = [0.5 * mission.value(f"plm.unvignetted_{axis}", "arcsec") for axis in "xy"]
    return np.asarray((np.abs(x) <= half[0]) & (np.abs(y) <= half[1]))
