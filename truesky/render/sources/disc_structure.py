"""Spiral arms and knots of discs: what they add to a smooth disc, and take from it.

DiscStructure   what is asked for
sides           how large a stamp it wants;  added : sources with it
arms_and_knots  of one face-on disc: a picture whose sum is 0, to be drawn on top of the smooth profile

On every circle about a disc's middle its structure adds as much light as it takes away, so that flux and half-light
radius stay those of the profile. Its random numbers are of the galaxy's identifier: it is the same in every band and
exposure.
Ref : Yu & Ho 2019, ApJ 871, 194 (pitch angles fall with the bulge's part); Kendall et al. 2011, MNRAS 414, 538
      (contrast of arms); Kennicutt, Edgar & Hodge 1989, ApJ 337, 761 (H II regions: dN / dL goes with L^-2)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.special import i0e

from lake_schema.arrays import Float, Float32, Int
from truesky.randomness import rng
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.galaxy_shapes import EXPONENTIAL_RADIUS, Shapes
from truesky.render.sources.lensed_arcs import Picture
from truesky.render.sources.source_list import Sources
from truesky.request.structure import Arms

# Half the side of a picture, in the disc's scale lengths; arcsec of a pixel that are wanted, and sides to be had.
REACH = 5.0
_FINE = 0.05
_SIDES = np.array([128, 192, 256, 384, 512])
# Scale lengths between which the structure sets in, and fades; arcsec that it is narrower than, so that the largest
# stamp of the finest pixels holds it.
_INNER, _OUTER, _WIDEST = (0.3, 0.9), (3.6, 4.9), 180.0
# Of the light in the bulge, from which on a disc is smooth.
_SMOOTH = 0.5
# Pitch angles, deg: of no bulge and of `_SMOOTH`, their scatter, and bounds.
_OPEN, _TIGHT, _SCATTER, _PITCHES = 26.0, 13.0, 4.0, (10.0, 30.0)
# Number of arms, and how many galaxies of a hundred have them.
_ARMS, _ODDS = (2, 3, 4), (0.65, 0.15, 0.20)
# How narrow arms are: ln of ridge over trough is twice this.
_NARROW = (1.3, 2.4)
# Spurs and patches between the arms: waves, and the scatter that they bring to the log of the light.
_WAVES, _PATCHY = 14, 0.28
# Knots: the brightest over the faintest, widths in scale lengths, part that lies anywhere, scatter about an arm as a
# part of the angle to the next.
_RANGE, _WIDTHS, _FIELD, _ASTRAY = 30.0, (0.030, 0.075), 0.2, 0.07
# Scale lengths over which light on circles is balanced.
_RING = 0.12


@dataclass(frozen=True, slots=True)
class DiscStructure:
    """What structure discs have; wanted : numbers of the request;  seed : of the request"""

    wanted: Arms
    seed: int


def sides(shape: Shapes, discs: DiscStructure | None) -> Float:
    """[n] arcsec that the structure of galaxies is wide, 0 of those that have none.

    Of large discs that the bulge does not outshine, as far as the largest stamp holds them.
    """
    if discs is None:
        return np.zeros(len(shape))
    # The half-light radius along the major axis, of the disc alone, as it is seen.
    seen = galaxy_shapes.half_light(replace(shape, bulge_fraction=np.zeros(len(shape))))
    wide = 2 * REACH / EXPONENTIAL_RADIUS * seen
    some = (shape.disk_radius >= discs.wanted.least_radius) & (shape.bulge_fraction < _SMOOTH) & (wide < _WIDEST)
    return np.where(some, wide, 0.0)


def added(sources: Sources, shape: Shapes, discs: DiscStructure | None) -> Sources:
    """The sources, with pictures of the structure of those discs that have one; shape : of all galaxies."""
    if discs is None:
        return sources
    which = np.flatnonzero(np.append(sides(shape, discs) > 0.0, False)[sources.shape])
    found = _pictures(sources.ids[which], shape.take(sources.shape[which]), discs)
    picture = np.full(len(sources), -1) if sources.picture is None else sources.picture.copy()
    picture[which] = len(sources.pictures) + np.arange(len(which))
    return replace(sources, picture=picture, pictures=(*sources.pictures, *found))


def _pictures(ids: Int, shape: Shapes, discs: DiscStructure) -> tuple[Picture, ...]:
    form = galaxy_shapes.forms(shape, np.broadcast_to(np.eye(2), (len(ids), 2, 2)))
    found = []
    for i, galaxy in enumerate(ids.tolist()):
        length = float(shape.disk_radius[i]) / EXPONENTIAL_RADIUS
        side = int(_SIDES[min(int(np.searchsorted(_SIDES, 2 * REACH * length / _FINE)), len(_SIDES) - 1)])
        numbers = rng.stream(discs.seed, "disc structure", galaxy)
        image = arms_and_knots(side, float(shape.bulge_fraction[i]), discs.wanted, numbers)
        found.append(Picture(image, form.disk[i] * (2 * REACH / side), form.thick[i]))
    return tuple(found)


def arms_and_knots(side: int, bulge_fraction: float, wanted: Arms, numbers: np.random.Generator) -> Float32:
    """float32[side, side] of sum 0: the structure of a face-on exponential disc of flux 1, 2 REACH scale lengths wide.

    bulge_fraction : of the galaxy's light;  wanted : numbers of the request;  numbers : random ones
    """
    step = 2 * REACH / side
    at: Float = (np.arange(float(side)) - 0.5 * (side - 1)) * step
    radius, angle = np.hypot(at, at[:, None]), np.arctan2(at[:, None], at)
    winding = _Winding.drawn(bulge_fraction, numbers)
    smooth = np.exp(-radius) * (step**2 / (2 * np.pi))
    window = _rise(radius, *_INNER) * (1.0 - _rise(radius, *_OUTER))
    pattern = _pattern(np.log(np.maximum(radius, step)), angle, winding, wanted.contrast, numbers)
    light = smooth * (1.0 + window * (pattern - 1.0))
    light *= 1.0 - wanted.knots * window
    light += window * _knots(at, winding, wanted, numbers)
    return _balanced(light, smooth, radius, window, step)


@dataclass(frozen=True, slots=True)
class _Winding:
    """Logarithmic spirals, which wander a little; slope : radian by the log of the radius, the first arm at `first`."""

    arms: int
    slope: float
    first: float
    wander: Float

    @classmethod
    def drawn(cls, bulge_fraction: float, numbers: np.random.Generator) -> _Winding:
        arms = int(numbers.choice(_ARMS, p=_ODDS))
        pitch = _OPEN + (_TIGHT - _OPEN) * bulge_fraction / _SMOOTH + _SCATTER * numbers.standard_normal()
        hand = 1.0 if numbers.random() < 0.5 else -1.0
        slope = hand / np.tan(np.radians(np.clip(pitch, *_PITCHES)))
        first = 2 * np.pi * numbers.random()
        return cls(arms, slope, first, numbers.uniform(-1.0, 1.0, (2, 3)))

    def angle(self, log_radius: Float) -> Float:
        """Of the first arm, radian."""
        found = self.first + self.slope * log_radius
        for wave, (cosine, sine) in enumerate(self.wander.T, start=2):
            found = found + (0.25 / wave) * (cosine * np.cos(wave * log_radius) + sine * np.sin(wave * log_radius))
        return np.asarray(found)


def _pattern(
    log_radius: Float, angle: Float, winding: _Winding, contrast: float, numbers: np.random.Generator
) -> Float:
    """Light of arms with spurs and patches over the mean of its circle, about."""
    narrow = numbers.uniform(*_NARROW)
    mean = i0e(narrow)
    strength = contrast * numbers.uniform(0.7, 1.1) / (1.0 / mean - 1.0)
    phase = angle - winding.angle(log_radius)
    ridge = np.exp(narrow * (np.cos(winding.arms * phase) - 1.0)) / mean
    # One arm is not as bright as the other, nor all along.
    uneven = 1.0 + 0.35 * np.cos(phase + numbers.uniform(0, 2 * np.pi) + 1.3 * log_radius)
    pattern = 1.0 + min(strength, 0.95) * (ridge * uneven - 1.0)
    patches = np.zeros_like(pattern)
    for _ in range(_WAVES):
        number, tilt = int(numbers.integers(2, 10)), numbers.uniform(0.35, 1.1)
        patches += np.cos(number * (angle - tilt * winding.slope * log_radius) + numbers.uniform(0, 2 * np.pi))
    spread = contrast / (contrast + 1.0) * 2.0 * _PATCHY * np.sqrt(2.0 / _WAVES)
    return np.asarray(np.maximum(pattern, 0.05) * np.exp(spread * patches))


def _knots(at: Float, winding: _Winding, wanted: Arms, numbers: np.random.Generator) -> Float:
    """Light of knots along the arms; at : [side] scale lengths of the picture's columns and rows."""
    light, count = np.zeros((len(at), len(at))), wanted.number
    if not count or not wanted.knots:
        return light
    step = at[1] - at[0]
    steps = np.linspace(0.0, REACH, 501)
    inside = np.cumsum(steps * np.exp(-steps))
    # As many in each part of the disc as it has light.
    radius = np.interp((np.arange(count) + numbers.random(count)) / count, inside / inside[-1], steps)
    flux = 1.0 / (1.0 - numbers.random(count) * (1.0 - 1.0 / _RANGE))
    width = numbers.uniform(*_WIDTHS, count) * (flux / flux.mean()) ** 0.2
    arm = numbers.integers(0, winding.arms, count) + _ASTRAY * numbers.standard_normal(count)
    arm = np.where(numbers.random(count) < _FIELD, winding.arms * numbers.random(count), arm)
    angle = winding.angle(np.log(np.maximum(radius, step))) + 2 * np.pi * arm / winding.arms
    for x, y, s, f in zip(
        radius * np.cos(angle), radius * np.sin(angle), np.maximum(width, 0.8 * step), flux / flux.sum(), strict=True
    ):
        left, low = (max(int(np.searchsorted(at, p - 4 * s)), 0) for p in (x, y))
        right, high = (int(np.searchsorted(at, p + 4 * s)) for p in (x, y))
        across, up = (np.exp(-0.5 * ((part - p) / s) ** 2) for part, p in ((at[left:right], x), (at[low:high], y)))
        light[low:high, left:right] += wanted.knots * f * (step / s) ** 2 / (2 * np.pi) * up[:, None] * across
    return light


def _balanced(light: Float, smooth: Float, radius: Float, window: Float, step: float) -> Float32:
    """What is left of light [side, side] without the smooth disc, once circles have as much of both."""
    ring = (radius / step).astype(np.int64).ravel()
    has, wants = (gaussian_filter1d(np.bincount(ring, part.ravel()), _RING / step) for part in (light, smooth))
    middles = (np.arange(len(has)) + 0.5) * step
    light = light * np.interp(radius, middles, wants / has)
    found = window * (light - smooth)
    # What the width of a ring leaves over, within the half-light radius and beyond.
    within = radius < EXPONENTIAL_RADIUS
    for weight in (window * smooth * within, window * smooth * ~within):
        found -= weight * (found.sum(where=weight > 0.0) / weight.sum())
    return np.asarray(found, np.float32)


def _rise(radius: Float, low: float, high: float) -> Float:
    """From 0 at `low` to 1 at `high`, smoothly."""
    part = np.clip((radius - low) / (high - low), 0.0, 1.0)
    return np.asarray(part**2 * (3.0 - 2.0 * part))
