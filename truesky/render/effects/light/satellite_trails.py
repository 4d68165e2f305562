"""Satellite trails: straight lines over the field, blurred by the seeing and by the defocused pupil.

The rate of satellites is a parameter, by default 0. All detectors of an exposure have the same satellites, and each
receives the piece of a trail that crosses it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.fft

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.camera import detectors as camera_detectors
from truesky.render.camera import distortion
from truesky.render.camera.detectors import Detector
from truesky.render.effects.effect import Effect, zero_contribution
from truesky.render.effects.scene import Frame, Scene

# Pixels between points of a trail. The trail is straight between them.
_STEP = 64.0
# Length of a trail beyond the field, in radii of the field: distortion may show slightly more of the sky.
_TRAIL_EXTENT = 1.1
# Half diagonals of a detector that it may cover to each side with distortion.
_DETECTOR_EXTENT = 1.3
# Samples per pixel of a trail's profile, and its extent in widths of the seeing.
_SUBSAMPLES, _SEEING_RANGE = 8, 8.0
# Limit on the difference between magnitudes of satellites and their mean, in standard deviations.
_MAX_SIGMA = 3.0
# Exponent of the Moffat profile of the seeing.
_BETA = 3.0
_ARCSEC = np.pi / 180.0 / 3600.0


class Satellites(NamedTuple):
    """Satellites of a field.

    Attributes
    ----------
    number : float
        Mean number of satellites that cross the circle around the field during the exposure, 0 to 1e4.
    electrons : float
        Electrons of a mean satellite per pixel of trail length.
    spread : float
        Standard deviation of the magnitudes.
    """

    number: float
    electrons: float
    spread: float


class Blur(NamedTuple):
    """Blur of a trail.

    Attributes
    ----------
    seeing : float
        FWHM of the seeing in pixels.
    outer, inner : float
        Radii of the defocused pupil in pixels.
    """

    seeing: float
    outer: float
    inner: float


def apply(
    frame: Frame, satellites: Satellites, blur: Blur, detector: Detector | None, radius: float, rng: np.random.Generator
) -> Frame:
    """Add the trails that cross a frame.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    satellites : Satellites
        Number and brightness of satellites.
    blur : Blur
        Blur of their trails.
    detector : Detector or None
        Detector of the frame. None for a detector in the middle of the field with pixels of 1 arcsec.
    radius : float
        Radius of the circle around the field in arcsec.
    rng : numpy.random.Generator
        Random numbers of the exposure, the same for all its detectors.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons including trails.

    Raises
    ------
    OutOfRange
        If the number of satellites is outside its limits.

    Notes
    -----
    The profile is sampled at eighths of a pixel, with an error of 1e-3 of its height. Not modelled: satellites that
    tumble or flare.
    """
    if not 0.0 <= satellites.number < 1e4:
        raise OutOfRange("satellites of an exposure", satellites.number, 0.0, 1e4)
    out, trail_profile = np.array(frame, dtype=float, order="C"), profile(blur)
    for _ in range(int(rng.poisson(satellites.number))):
        direction, offset, deviate = np.pi * rng.random(), radius * (2.0 * rng.random() - 1.0), rng.standard_normal()
        fainter = satellites.spread * float(np.clip(deviate, -_MAX_SIGMA, _MAX_SIGMA))
        if not _may_touch(direction, offset, detector, len(trail_profile) / _SUBSAMPLES):
            continue
        column, row = _path(direction, offset, radius, detector, frame.shape)
        table = satellites.electrons * 10.0 ** (-0.4 * fainter) * trail_profile
        steep = np.abs(row[-1] - row[0]) > np.abs(column[-1] - column[0])
        along, across = (row, column) if steep else (column, row)
        if along[0] > along[-1]:
            along, across = along[::-1], across[::-1]
        _add_trail(out.T if steep else out, along, across, table)
    return out


def _may_touch(direction: float, offset: float, detector: Detector | None, width: float) -> bool:
    """Return False if a trail cannot touch a detector.

    `direction` and `offset` are as in `_path`; `width` is the half width of a trail in pixels.
    """
    if detector is None:
        return True
    x, y = (float(place) for place in distortion.distort(detector.x, detector.y, detector.distortion_terms))
    # With distortion, a detector may show more of the sky than the size of its pixels implies.
    reach = _DETECTOR_EXTENT * detector.half_diagonal + detector.pixel_scale * width
    return bool(abs(np.cos(direction) * y - np.sin(direction) * x - offset) < reach)


def _path(
    direction: float, offset: float, radius: float, detector: Detector | None, shape: tuple[int, ...]
) -> tuple[Float, Float]:
    """Return the columns and rows of points of a trail over the whole field.

    `direction` is in radians. `offset`, the smallest distance to the boresight, and `radius`, the radius of the
    field, are in arcsec.
    """
    scale = 1.0 if detector is None else detector.pixel_scale
    reach = float(np.sqrt((_TRAIL_EXTENT * radius) ** 2 - offset**2))
    at = np.arange(-reach, reach + _STEP * scale, _STEP * scale)
    # Great circles are straight on the tangent plane.
    u, v = (
        (offset * f + at * g) / scale
        for f, g in ((-np.sin(direction), np.cos(direction)), (np.cos(direction), np.sin(direction)))
    )
    if detector is None:
        return u + (shape[1] - 1) / 2, v + (shape[0] - 1) / 2
    if detector.distortion_terms:
        u, v = distortion.undo_sip(u, v, *distortion.sip(detector.distortion_terms, scale * np.eye(2)))
    angle = np.radians(detector.rotation)
    cosine, sine = float(np.cos(angle)), float(np.sin(angle))
    x, y = u - detector.x / scale, v - detector.y / scale
    return cosine * x + sine * y + (detector.nx - 1) / 2, cosine * y - sine * x + (detector.ny - 1) / 2


def profile(blur: Blur) -> Float:
    """Return the light per pixel at distances of n / `_SUBSAMPLES` pixels from a trail, with a sum of 1 across it.

    The profile is the Moffat profile of the seeing integrated along the trail, convolved with the chords of the ring of
    the pupil and with a pixel.
    """
    reach = blur.outer + _SEEING_RANGE * blur.seeing + 2.0
    x = np.arange(-int(reach * _SUBSAMPLES), int(reach * _SUBSAMPLES) + 1) / _SUBSAMPLES
    core = 0.5 * blur.seeing / np.sqrt(2.0 ** (1.0 / _BETA) - 1.0)
    seeing = (1.0 + (x / core) ** 2) ** (0.5 - _BETA)
    # Mean chord of the ring in each step: differences of its area on one side of a line at x.
    edges = np.append(x - 0.5 / _SUBSAMPLES, x[-1] + 0.5 / _SUBSAMPLES)
    ring = np.diff(_area_left_of(edges, blur.outer))
    if blur.inner > 0.0:
        ring -= np.diff(_area_left_of(edges, blur.inner))
    pixel = np.clip(0.5 * _SUBSAMPLES + 0.5 - np.abs(x) * _SUBSAMPLES, 0.0, 1.0)
    half, transform = len(x) // 2, np.ones(2 * len(x) + 1)
    for part in (seeing, ring, pixel):
        centred = np.zeros(4 * len(x))
        centred[: half + 1], centred[-half:] = part[half:], part[:half]
        # All three functions are even, so that their transforms are real.
        transform *= scipy.fft.rfft(centred / part.sum()).real
    return np.asarray(np.maximum(scipy.fft.irfft(transform, 4 * len(x))[: half + 1] * _SUBSAMPLES, 0.0))


def _area_left_of(x: Float, radius: float) -> Float:
    """Area of a disc to the left of a line at x, minus half its area; a step of height 1 for a radius of 0."""
    if radius <= 0.0:
        return np.where(x > 0.0, 1.0, 0.0)
    t = np.clip(x / radius, -1.0, 1.0)
    return np.asarray(radius**2 * (np.arcsin(t) + t * np.sqrt(1.0 - t**2)))


@jit
def _add_trail(frame: Any, along: Any, across: Any, table: Any) -> None:
    """Add a trail with the profile `table`. Its second coordinate is a function of its first, which ascends."""
    ny, nx = frame.shape
    k = 0
    for c in range(max(0, int(np.ceil(along[0]))), min(nx, int(along[-1]) + 1)):
        while k + 2 < len(along) and along[k + 1] < c:
            k += 1
        slope = (across[k + 1] - across[k]) / (along[k + 1] - along[k])
        middle = across[k] + slope * (c - along[k])
        # Ratio of the distance from the line to the difference in the second coordinate.
        shorter = 1.0 / np.sqrt(1.0 + slope * slope)
        reach = (len(table) - 2) / (_SUBSAMPLES * shorter)
        for r in range(max(0, int(np.ceil(middle - reach))), min(ny, int(np.floor(middle + reach)) + 1)):
            place = abs(r - middle) * shorter * _SUBSAMPLES
            i = int(place)
            if i + 1 < len(table):
                frame[r, c] += table[i] + (place - i) * (table[i + 1] - table[i])


def parameters(scene: Scene) -> tuple[Satellites, Blur, Detector | None, float]:
    """Return the parameters of `apply`, without satellites if the rate is 0 in the mission database (the default)."""
    mission, d = scene.mission, scene.detector
    rate = mission.value("survey.satellites.rate", "1 / (deg s)")
    if rate == 0.0 or d is None:
        return Satellites(0.0, 0.0, 0.0), Blur(3.0, 0.0, 0.0), d, 1.0
    all_detectors = camera_detectors.detectors(scene.section.rpartition(".")[2], mission)
    radius = max(float(np.hypot(detector.x, detector.y)) + detector.half_diagonal for detector in all_detectors)
    magnitude, spread = (mission.value(f"survey.satellites.{key}", "mag") for key in ("magnitude", "magnitude_spread"))
    # Time in which a satellite crosses the length of a pixel.
    seconds = d.pixel_scale / mission.value("survey.satellites.speed", "arcsec / s")
    electrons = 10.0 ** (0.4 * (scene.zero_point - magnitude)) * seconds
    outer = 0.5 * scene.value("aperture_diameter", "m") / mission.value("survey.satellites.distance", "m") / _ARCSEC
    inner = outer * mission.value("survey.satellites.obscuration")
    pixels = (size / d.pixel_scale for size in (max(scene.seeing, d.pixel_scale), outer, inner))
    count = rate * 2.0 * radius / 3600.0 * scene.exposure_time_s
    return Satellites(count, float(electrons), spread), Blur(*pixels), d, radius


def _contribution(scene: Scene) -> float:
    """Return the electrons in the brightest pixel of the brightest satellite that is drawn."""
    satellites, blur, *_ = parameters(scene)
    if satellites.number == 0.0:
        return 0.0
    return float(satellites.electrons * 10.0 ** (0.4 * _MAX_SIGMA * satellites.spread) * profile(blur).max())


# Trails average out: the next exposure has different satellites.
EFFECT = Effect(
    "satellite_trails", apply, parameters, _contribution, shared=True, cost=3e-3, systematic=zero_contribution
)
