"""Trails of artificial satellites: straight lines over the field, blurred by seeing and by the defocused pupil.

The rate of satellites is a parameter of the mission database, by default 0. All detectors of an exposure see the same
satellites: each receives the part of a trail that crosses it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import scipy

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.camera import detectors as camera_detectors
from truesky.render.camera import distortion
from truesky.render.camera.detectors import Detector
from truesky.render.effects.effect import Effect, copy_frame, zero_contribution
from truesky.render.effects.scene import Frame, Scene

# Distance in pixels between computed points of a satellite trail, which is drawn as a straight line between them.
_STEP = 64.0
# A trail is followed to this multiple of the field's radius from the boresight, because with optical distortion a
# detector may show slightly more of the sky.
_TRAIL_EXTENT = 1.1
# With optical distortion, a detector may show the sky up to this multiple of half its diagonal from its centre.
_DETECTOR_EXTENT = 1.3
# Number of samples per pixel of the profile across a trail.
_SUBSAMPLES = 8
# The profile across a trail includes the wings of the seeing up to this multiple of the FWHM of the seeing.
_SEEING_RANGE = 8.0
# A satellite's magnitude differs from the mean by at most this number of standard deviations; larger random differences
# are set to this limit.
_MAX_SIGMA = 3.0
# Exponent of the Moffat profile of the seeing.
_BETA = 3.0
_ARCSEC = np.pi / 180.0 / 3600.0
# Mission parameter with the number of satellites per second and degree of the field's diameter.
_RATE = "survey.satellites.rate"


class Satellites(NamedTuple):
    """Number and brightness of the satellites that cross a field.

    Attributes
    ----------
    number : float
        Mean number of satellites that cross the circle around the field during the exposure, at least 0, below 1e4.
    electrons : float
        Electrons that a satellite of mean brightness leaves per pixel of trail length.
    spread : float
        Standard deviation of the magnitudes of satellites in mag.
    """

    number: float
    electrons: float
    spread: float


class Blur(NamedTuple):
    """Blur across a satellite trail, by the atmosphere and because a near satellite is out of focus.

    Attributes
    ----------
    seeing : float
        FWHM of the seeing in pixels.
    outer, inner : float
        Outer and inner radius of the defocused image of the telescope's pupil, a ring, in pixels.
    """

    seeing: float
    outer: float
    inner: float


class Trail(NamedTuple):
    """Trail of a satellite over the field.

    Attributes
    ----------
    direction : float
        Angle in radians from the x axis of the focal plane towards the y axis, from 0 to pi.
    offset : float
        Smallest distance from the boresight in arcsec, positive on the left of the direction.
    electrons : float
        Electrons per pixel of trail length.
    """

    direction: float
    offset: float
    electrons: float


def apply(
    frame: Frame,
    satellites: Satellites,
    blur: Blur,
    detector: Detector | None,
    radius: float,
    rng: np.random.Generator,
    out: Frame | None = None,
) -> Frame:
    """Draw the random satellites of an exposure, and add the trails that cross a frame.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    satellites : Satellites
        Mean number and brightness of satellites.
    blur : Blur
        Blur of their trails by seeing and defocus.
    detector : Detector or None
        Detector of the frame. None for a detector in the middle of the field with pixels of 1 arcsec.
    radius : float
        Radius of the circle around the field in arcsec.
    rng : numpy.random.Generator
        Random generator of the exposure, in the same state for all detectors, so that they see the same satellites.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons including trails.

    Raises
    ------
    OutOfRange
        If `satellites.number` is negative, 1e4 or more, or NaN.

    Notes
    -----
    The profile across a trail is sampled in steps of 1/8 pixel, with an error of 1e-3 of its height. Satellites that
    tumble or flare are not modelled.
    """
    out, trail_profile = copy_frame(frame, out), profile(blur)
    for direction, offset, electrons in draw_trails(satellites, radius, rng):
        if not _may_touch(direction, offset, detector, len(trail_profile) / _SUBSAMPLES):
            continue
        column, row = _path(direction, offset, radius, detector, frame.shape)
        table = electrons * trail_profile
        steep = np.abs(row[-1] - row[0]) > np.abs(column[-1] - column[0])
        along, across = (row, column) if steep else (column, row)
        if along[0] > along[-1]:
            along, across = along[::-1], across[::-1]
        _add_trail(out.T if steep else out, along, across, table)
    return out


def draw_trails(satellites: Satellites, radius: float, rng: np.random.Generator) -> Iterator[Trail]:
    """Draw the trails of the random satellites of an exposure.

    Parameters
    ----------
    satellites : Satellites
        Mean number and brightness of satellites.
    radius : float
        Radius of the circle around the field in arcsec.
    rng : numpy.random.Generator
        Random generator of the exposure.

    Yields
    ------
    Trail
        Each trail that crosses the circle.

    Raises
    ------
    OutOfRange
        If `satellites.number` is negative, 1e4 or more, or NaN.
    """
    if not 0.0 <= satellites.number < 1e4:
        raise OutOfRange("satellites of an exposure", satellites.number, 0.0, 1e4)
    for _ in range(int(rng.poisson(satellites.number))):
        direction, offset, deviate = np.pi * rng.random(), radius * (2.0 * rng.random() - 1.0), rng.standard_normal()
        fainter = satellites.spread * float(np.clip(deviate, -_MAX_SIGMA, _MAX_SIGMA))
        yield Trail(direction, offset, satellites.electrons * 10.0 ** (-0.4 * fainter))


def half_width(trail: Trail, blur: Blur, limit: float) -> float:
    """Return the distance from a trail, in pixels, up to which it is brighter than a limit.

    Parameters
    ----------
    trail : Trail
        The trail.
    blur : Blur
        Blur of the trail.
    limit : float
        Electrons of a pixel.

    Returns
    -------
    float
        The distance; 0 if the whole trail is fainter.
    """
    return float(np.count_nonzero(trail.electrons * profile(blur) > limit)) / _SUBSAMPLES


def _may_touch(direction: float, offset: float, detector: Detector | None, width: float) -> bool:
    """Return False if a satellite trail certainly does not touch a detector.

    `direction` is the angle of the trail in radians, from the x axis of the focal plane towards the y axis. `offset` is
    its smallest distance to the boresight in arcsec, positive on the left of this direction, and `width` its half width
    in pixels. Without a detector the result is True.
    """
    if detector is None:
        return True
    x, y = (float(place) for place in distortion.distort(detector.x, detector.y, detector.distortion_terms))
    # With distortion, a detector may show more of the sky than its size in pixels implies.
    reach = _DETECTOR_EXTENT * detector.half_diagonal + detector.pixel_scale * width
    return bool(abs(np.cos(direction) * y - np.sin(direction) * x - offset) < reach)


def _path(
    direction: float, offset: float, radius: float, detector: Detector | None, shape: tuple[int, ...]
) -> tuple[Float, Float]:
    """Return the columns and rows of points along a satellite trail over the whole field, in pixels of the detector.

    `direction` is the angle of the trail in radians, from the x axis of the focal plane towards the y axis. `offset` is
    its smallest distance to the boresight in arcsec, positive on the left of this direction. `radius` is the radius of
    the field in arcsec. `shape` (rows, columns) is used only without a detector, whose pixels are then 1 arcsec wide.
    """
    scale = 1.0 if detector is None else detector.pixel_scale
    reach = float(np.sqrt((_TRAIL_EXTENT * radius) ** 2 - offset**2))
    at = np.arange(-reach, reach + _STEP * scale, _STEP * scale)
    # Satellites move along great circles, which are straight lines on the tangent plane.
    u, v = (
        (offset * f + at * g) / scale
        for f, g in ((-np.sin(direction), np.cos(direction)), (np.cos(direction), np.sin(direction)))
    )
    if detector is None:
        return u + (shape[1] - 1) / 2, v + (shape[0] - 1) / 2
    if detector.distortion_terms:
        u, v = distortion.undo_sip(u, v, *distortion.sip(detector.distortion_terms, scale * np.eye(2)))
    along, up = detector.from_focal_plane(u - detector.x / scale, v - detector.y / scale)
    return along + (detector.nx - 1) / 2, up + (detector.ny - 1) / 2


def profile(blur: Blur) -> Float:
    """Return the profile across a satellite trail: light per pixel at n / `_SUBSAMPLES` pixels from it, n = 0, 1, ...

    The light is relative to the light per pixel of trail length, so that the sum over pixels across the trail is 1. The
    Moffat profile of the seeing is integrated along the trail. It is convolved with a pixel and with the chords of the
    ring-shaped pupil (out of focus), whose lengths are proportional to the light.
    """
    reach = blur.outer + _SEEING_RANGE * blur.seeing + 2.0
    x = np.arange(-int(reach * _SUBSAMPLES), int(reach * _SUBSAMPLES) + 1) / _SUBSAMPLES
    core = 0.5 * blur.seeing / np.sqrt(2.0 ** (1.0 / _BETA) - 1.0)
    seeing = (1.0 + (x / core) ** 2) ** (0.5 - _BETA)
    # Area of the ring-shaped image of the pupil in each step of 1 / `_SUBSAMPLES` pixels across the trail: the
    # difference between its areas on the left of the two edges of the step.
    edges = np.append(x - 0.5 / _SUBSAMPLES, x[-1] + 0.5 / _SUBSAMPLES)
    ring = np.diff(_area_left_of(edges, blur.outer))
    if blur.inner > 0.0:
        ring -= np.diff(_area_left_of(edges, blur.inner))
    pixel = np.clip(0.5 * _SUBSAMPLES + 0.5 - np.abs(x) * _SUBSAMPLES, 0.0, 1.0)
    half, transform = len(x) // 2, np.ones(2 * len(x) + 1)
    for part in (seeing, ring, pixel):
        centred = np.zeros(4 * len(x))
        centred[: half + 1], centred[-half:] = part[half:], part[:half]
        # The seeing, the ring and the pixel are even functions, so that their Fourier transforms are real.
        transform *= scipy.fft.rfft(centred / part.sum()).real
    return np.asarray(np.maximum(scipy.fft.irfft(transform, 4 * len(x))[: half + 1] * _SUBSAMPLES, 0.0))


def _area_left_of(x: Float, radius: float) -> Float:
    """Return the area of a disc on the left of a vertical line, minus half the area of the disc.

    `x` is the position of the line relative to the centre of the disc. A disc with a radius of 0 or less is a point:
    the result is a step from 0 to 1 at x = 0.
    """
    if radius <= 0.0:
        return np.where(x > 0.0, 1.0, 0.0)
    t = np.clip(x / radius, -1.0, 1.0)
    return np.asarray(radius**2 * (np.arcsin(t) + t * np.sqrt(1.0 - t**2)))


@jit
def _add_trail(frame: Any, along: Any, across: Any, table: Any) -> None:
    """Add a satellite trail with the profile `table` to a frame, in place.

    `along` (ascending, pixels on the second axis of the frame) and `across` (pixels on its first axis) are points of
    the trail. `table` contains electrons per pixel at distances of 0, 1, 2, ... / `_SUBSAMPLES` pixels from the trail.
    """
    ny, nx = frame.shape
    k = 0
    for c in range(max(0, int(np.ceil(along[0]))), min(nx, int(along[-1]) + 1)):
        while k + 2 < len(along) and along[k + 1] < c:
            k += 1
        slope = (across[k + 1] - across[k]) / (along[k + 1] - along[k])
        middle = across[k] + slope * (c - along[k])
        # Shortest distance between a pixel and the trail, divided by their distance along the first axis of the frame.
        shorter = 1.0 / np.sqrt(1.0 + slope * slope)
        reach = (len(table) - 2) / (_SUBSAMPLES * shorter)
        for r in range(max(0, int(np.ceil(middle - reach))), min(ny, int(np.floor(middle + reach)) + 1)):
            place = abs(r - middle) * shorter * _SUBSAMPLES
            i = int(place)
            if i + 1 < len(table):
                frame[r, c] += table[i] + (place - i) * (table[i + 1] - table[i])


def parameters(scene: Scene) -> tuple[Satellites, Blur, Detector | None, float]:
    """Return the parameters of `apply` for a scene, from the mission database.

    They are the mean number and brightness of satellites, the blur of their trails, the detector, and the radius of the
    circle around all detectors (arcsec). The mean number is 0 if the database has a rate of 0 (the default), or if the
    scene has no detector.
    """
    mission, d = scene.mission, scene.detector
    if mission.value(_RATE, "1 / (deg s)") == 0.0 or d is None:
        return Satellites(0.0, 0.0, 0.0), Blur(3.0, 0.0, 0.0), d, 1.0
    radius = camera_detectors.field_radius(camera_detectors.detectors(scene.section.rpartition(".")[2], mission))
    satellites, blur = in_field(scene, d, radius)
    return satellites, blur, d, radius


def in_field(scene: Scene, detector: Detector, radius: float) -> tuple[Satellites, Blur]:
    """Return the mean number and brightness of the satellites in an exposure, and the blur of their trails.

    Parameters
    ----------
    scene : Scene
        Settings of the exposure.
    detector : Detector
        A detector of the camera.
    radius : float
        Radius of the circle around all detectors, arcsec.

    Returns
    -------
    Satellites
        Number and brightness.
    Blur
        Blur in pixels of the detector.
    """
    mission, d = scene.mission, detector
    magnitude, spread = (mission.value(f"survey.satellites.{key}", "mag") for key in ("magnitude", "magnitude_spread"))
    # Time in seconds in which a satellite moves by one pixel.
    seconds = d.pixel_scale / mission.value("survey.satellites.speed", "arcsec / s")
    electrons = 10.0 ** (0.4 * (scene.zero_point - magnitude)) * seconds
    outer = 0.5 * scene.value("aperture_diameter", "m") / mission.value("survey.satellites.distance", "m") / _ARCSEC
    inner = outer * mission.value("survey.satellites.obscuration")
    pixels = (size / d.pixel_scale for size in (max(scene.seeing, d.pixel_scale), outer, inner))
    count = mission.value(_RATE, "1 / (deg s)") * 2.0 * radius / 3600.0 * scene.exposure_time_s
    return Satellites(count, float(electrons), spread), Blur(*pixels)


def _contribution(scene: Scene) -> float:
    """Return the electrons in the brightest pixel of the brightest possible satellite trail; 0 without satellites."""
    satellites, blur, *_ = parameters(scene)
    if satellites.number == 0.0:
        return 0.0
    return float(satellites.electrons * 10.0 ** (0.4 * _MAX_SIGMA * satellites.spread) * profile(blur).max())


# `systematic` (the part of the effect that remains in a mean of exposures) is 0, because each exposure has different
# satellites.
EFFECT = Effect(
    "satellite_trails",
    apply,
    parameters,
    _contribution,
    shared=True,
    cost=3e-3,
    systematic=zero_contribution,
    in_place=True,
)
