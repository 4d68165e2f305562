"""Trails of satellites: straight lines over the field, as wide as the seeing and as the pupil, which is out of focus.

How many cross a field is a parameter, by default none. All detectors of an exposure have the same ones, each the piece
that crosses it.
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

# Pixels between places of a trail: between them it is straight.
_STEP = 64.0
# Radii of the field that a trail goes on: optics may show a little more of the sky.
_TRAIL_EXTENT = 1.1
# Half diagonals of a detector that it may see to each side.
_DETECTOR_EXTENT = 1.3
# A trail's profile: steps of a pixel, and widths of the seeing that it is followed to.
_SUBSAMPLES, _SEEING_RANGE = 8, 8.0
# Magnitudes fainter or brighter than the mean are so many standard deviations off at the most.
_MAX_SIGMA = 3.0
# Wings of a trail: those of a Moffat profile of this exponent.
_BETA = 3.0
_ARCSEC = np.pi / 180.0 / 3600.0


class Satellites(NamedTuple):
    """Those of a field.

    number    : mean, of those that cross the circle about the field in the exposure
    electrons : of the mean one in a pixel's length of its trail;  spread : mag rms
    """

    number: float
    electrons: float
    spread: float


class Blur(NamedTuple):
    """seeing : FWHM, pixels;  outer, inner : radii of the defocused pupil, pixels."""

    seeing: float
    outer: float
    inner: float


def apply(
    frame: Frame, satellites: Satellites, blur: Blur, detector: Detector | None, radius: float, rng: np.random.Generator
) -> Frame:
    """frame [ny, nx] e- -> plus the trails that cross it.

    some     : satellites;  blur : of their trails
    detector : whose frame it is; None: one in the middle of the field, of pixels of 1 arcsec
    radius   : of the circle about the field, arcsec
    rng      : random numbers of the exposure, the same for all its detectors
    Error    : of a profile that is told at eighths of a pixel, 1e-3 of its height; satellites neither tumble nor flare
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
    """Whether a trail may touch a detector; turn, miss : as of `_path`;  width : pixels beside it."""
    if detector is None:
        return True
    x, y = (float(place) for place in distortion.distort(detector.x, detector.y, detector.distortion_terms))
    # Optics may show a detector more of the sky than its pixels say.
    reach = _DETECTOR_EXTENT * detector.half_diagonal + detector.pixel_scale * width
    return bool(abs(np.cos(direction) * y - np.sin(direction) * x - offset) < reach)


def _path(
    direction: float, offset: float, radius: float, detector: Detector | None, shape: tuple[int, ...]
) -> tuple[Float, Float]:
    """Columns and rows of places of a trail over the whole field.

    turn : rad, of its direction;  miss : arcsec, its nearest to the boresight;  radius : arcsec, of the field
    """
    scale = 1.0 if detector is None else detector.pixel_scale
    reach = float(np.sqrt((_TRAIL_EXTENT * radius) ** 2 - offset**2))
    at = np.arange(-reach, reach + _STEP * scale, _STEP * scale)
    # On the tangent plane, where great circles are straight.
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
    """[n] of a line's light in a pixel at n / `_FINE` pixels from it; all pixels across it have 1.

    The seeing's Moffat profile seen along a line, spread over the chords of the ring of the pupil and over a pixel.
    """
    reach = blur.outer + _SEEING_RANGE * blur.seeing + 2.0
    x = np.arange(-int(reach * _SUBSAMPLES), int(reach * _SUBSAMPLES) + 1) / _SUBSAMPLES
    core = 0.5 * blur.seeing / np.sqrt(2.0 ** (1.0 / _BETA) - 1.0)
    seeing = (1.0 + (x / core) ** 2) ** (0.5 - _BETA)
    # Area of the ring on one side of a line at x, of whose steps chords are means.
    edges = np.append(x - 0.5 / _SUBSAMPLES, x[-1] + 0.5 / _SUBSAMPLES)
    ring = np.diff(_area_left_of(edges, blur.outer))
    if blur.inner > 0.0:
        ring -= np.diff(_area_left_of(edges, blur.inner))
    pixel = np.clip(0.5 * _SUBSAMPLES + 0.5 - np.abs(x) * _SUBSAMPLES, 0.0, 1.0)
    half, transform = len(x) // 2, np.ones(2 * len(x) + 1)
    for part in (seeing, ring, pixel):
        centred = np.zeros(4 * len(x))
        centred[: half + 1], centred[-half:] = part[half:], part[:half]
        # All are even: their transforms are real.
        transform *= scipy.fft.rfft(centred / part.sum()).real
    return np.asarray(np.maximum(scipy.fft.irfft(transform, 4 * len(x))[: half + 1] * _SUBSAMPLES, 0.0))


def _area_left_of(x: Float, radius: float) -> Float:
    """Area of a disc left of a line, less half of it; a step of one without a radius."""
    if radius <= 0.0:
        return np.where(x > 0.0, 1.0, 0.0)
    t = np.clip(x / radius, -1.0, 1.0)
    return np.asarray(radius**2 * (np.arcsin(t) + t * np.sqrt(1.0 - t**2)))


@jit
def _add_trail(frame: Any, along: Any, across: Any, table: Any) -> None:
    """Adds a line whose second coordinate is a function of its first, which ascends; `table` : its profile."""
    ny, nx = frame.shape
    k = 0
    for c in range(max(0, int(np.ceil(along[0]))), min(nx, int(along[-1]) + 1)):
        while k + 2 < len(along) and along[k + 1] < c:
            k += 1
        slope = (across[k + 1] - across[k]) / (along[k + 1] - along[k])
        middle = across[k] + slope * (c - along[k])
        # From a pixel of this column to the line.
        shorter = 1.0 / np.sqrt(1.0 + slope * slope)
        reach = (len(table) - 2) / (_SUBSAMPLES * shorter)
        for r in range(max(0, int(np.ceil(middle - reach))), min(ny, int(np.floor(middle + reach)) + 1)):
            place = abs(r - middle) * shorter * _SUBSAMPLES
            i = int(place)
            if i + 1 < len(table):
                frame[r, c] += table[i] + (place - i) * (table[i + 1] - table[i])


def parameters(scene: Scene) -> tuple[Satellites, Blur, Detector | None, float]:
    """None where the mission database has no rate, which is the default."""
    mission, d = scene.mission, scene.detector
    rate = mission.value("survey.satellites.rate", "1 / (deg s)")
    if rate == 0.0 or d is None:
        return Satellites(0.0, 0.0, 0.0), Blur(3.0, 0.0, 0.0), d, 1.0
    all_detectors = camera_detectors.detectors(scene.section.rpartition(".")[2], mission)
    radius = max(float(np.hypot(detector.x, detector.y)) + detector.half_diagonal for detector in all_detectors)
    magnitude, spread = (mission.value(f"survey.satellites.{key}", "mag") for key in ("magnitude", "magnitude_spread"))
    # A pixel's length is crossed in so many seconds.
    seconds = d.pixel_scale / mission.value("survey.satellites.speed", "arcsec / s")
    electrons = 10.0 ** (0.4 * (scene.zero_point - magnitude)) * seconds
    outer = 0.5 * scene.value("aperture_diameter", "m") / mission.value("survey.satellites.distance", "m") / _ARCSEC
    inner = outer * mission.value("survey.satellites.obscuration")
    pixels = (size / d.pixel_scale for size in (max(scene.seeing, d.pixel_scale), outer, inner))
    count = rate * 2.0 * radius / 3600.0 * scene.exposure_time_s
    return Satellites(count, float(electrons), spread), Blur(*pixels), d, radius


def _contribution(scene: Scene) -> float:
    """Of the brightest likely one."""
    satellites, blur, *_ = parameters(scene)
    if satellites.number == 0.0:
        return 0.0
    return float(satellites.electrons * 10.0 ** (0.4 * _MAX_SIGMA * satellites.spread) * profile(blur).max())


# The next exposure has others.
EFFECT = Effect(
    "satellite_trails", apply, parameters, _contribution, shared=True, cost=3e-3, systematic=zero_contribution
)
