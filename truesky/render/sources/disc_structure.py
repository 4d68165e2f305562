"""Spiral arms and knots of discs, as pictures of light added to and removed from a smooth disc.

On every circle about the middle of a disc, the structure adds and removes the same amount of light. Flux and half-light
radius therefore remain those of the profile. The random numbers depend on the galaxy's identifier only, so that the
structure is the same in every band and exposure.

References
----------
Yu & Ho 2019, ApJ 871, 194 (pitch angles decrease with the bulge fraction); Kendall et al. 2011, MNRAS 414, 538
(contrast of arms); Kennicutt, Edgar & Hodge 1989, ApJ 337, 761 (H II regions: dN / dL is proportional to L^-2).
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

# Half the side of a picture, scale lengths of the disc; preferred pixel size, arcsec; and available sides, pixels.
REACH = 5.0
_FINE = 0.05
_SIDES = np.array([128, 192, 256, 384, 512])
# Ranges, in scale lengths, in which the structure begins and fades; and its largest width, arcsec, which is limited by
# the largest stamp of the finest pixels.
_INNER, _OUTER, _WIDEST = (0.3, 0.9), (3.6, 4.9), 180.0
# Bulge fraction from which a disc is smooth.
_SMOOTH = 0.5
# Pitch angles, deg: without a bulge, and for the bulge fraction `_SMOOTH`; their scatter and limits.
_OPEN, _TIGHT, _SCATTER, _PITCHES = 26.0, 13.0, 4.0, (10.0, 30.0)
# Numbers of arms, and fractions of galaxies with these numbers.
_ARMS, _ODDS = (2, 3, 4), (0.65, 0.15, 0.20)
# Range of the narrowness of arms: half the natural logarithm of the ratio of ridge and trough.
_NARROW = (1.3, 2.4)
# Spurs and patches between the arms: number of waves, and their scatter in the logarithm of the light.
_WAVES, _PATCHY = 14, 0.28
# Knots: flux ratio of the brightest and the faintest; widths in scale lengths; fraction at any angle; scatter about an
# arm as a fraction of the angle to the next arm.
_RANGE, _WIDTHS, _FIELD, _ASTRAY = 30.0, (0.030, 0.075), 0.2, 0.07
# Width of the rings on which light is balanced, scale lengths.
_RING = 0.12


@dataclass(frozen=True, slots=True)
class DiscStructure:
    """Options for the structure of discs.

    Attributes
    ----------
    arms : Arms
        Options of the request.
    seed : int
        Seed of the request.
    """

    arms: Arms
    seed: int


def sides(shape: Shapes, discs: DiscStructure | None) -> Float:
    """Widths of the structures of galaxies [n], arcsec; 0 for galaxies without structure.

    Large discs without a dominant bulge have a structure, if it fits on the largest stamp.
    """
    if discs is None:
        return np.zeros(len(shape))
    # Apparent half-light radius of the disc, without the bulge, along the major axis.
    half_light_radius = galaxy_shapes.half_light(replace(shape, bulge_fraction=np.zeros(len(shape))))
    wide = 2 * REACH / EXPONENTIAL_RADIUS * half_light_radius
    has_structure = (shape.disk_radius >= discs.arms.least_radius) & (shape.bulge_fraction < _SMOOTH) & (wide < _WIDEST)
    return np.where(has_structure, wide, 0.0)


def add_structure(sources: Sources, shape: Shapes, discs: DiscStructure | None) -> Sources:
    """Add pictures of the structure of discs to the sources.

    Parameters
    ----------
    sources : Sources
        The sources.
    shape : Shapes
        Shapes of all galaxies.
    discs : DiscStructure or None
        Options; None returns the sources unchanged.

    Returns
    -------
    Sources
        Sources with the additional pictures.
    """
    if discs is None:
        return sources
    indices = np.flatnonzero(np.append(sides(shape, discs) > 0.0, False)[sources.shape])
    new_pictures = _pictures(sources.ids[indices], shape.take(sources.shape[indices]), discs)
    picture = np.full(len(sources), -1) if sources.picture is None else sources.picture.copy()
    picture[indices] = len(sources.pictures) + np.arange(len(indices))
    return replace(sources, picture=picture, pictures=(*sources.pictures, *new_pictures))


def _pictures(ids: Int, shape: Shapes, discs: DiscStructure) -> tuple[Picture, ...]:
    form = galaxy_shapes.forms(shape, np.broadcast_to(np.eye(2), (len(ids), 2, 2)))
    pictures = []
    for i, galaxy in enumerate(ids.tolist()):
        length = float(shape.disk_radius[i]) / EXPONENTIAL_RADIUS
        side = int(_SIDES[min(int(np.searchsorted(_SIDES, 2 * REACH * length / _FINE)), len(_SIDES) - 1)])
        generator = rng.stream(discs.seed, "disc structure", galaxy)
        image = arms_and_knots(side, float(shape.bulge_fraction[i]), discs.arms, generator)
        pictures.append(Picture(image, form.disk[i] * (2 * REACH / side), form.thick[i]))
    return tuple(pictures)


def arms_and_knots(side: int, bulge_fraction: float, arms: Arms, generator: np.random.Generator) -> Float32:
    """Structure of a face-on exponential disc of flux 1.

    Parameters
    ----------
    side : int
        Side of the picture, pixels; it is 2 REACH scale lengths wide.
    bulge_fraction : float
        Fraction of the galaxy's light in the bulge.
    arms : Arms
        Options of the request.
    generator : numpy.random.Generator
        Source of random numbers.

    Returns
    -------
    float32 array, shape (side, side)
        Structure with the sum 0.
    """
    step = 2 * REACH / side
    at: Float = (np.arange(float(side)) - 0.5 * (side - 1)) * step
    radius, angle = np.hypot(at, at[:, None]), np.arctan2(at[:, None], at)
    winding = _Winding.draw(bulge_fraction, generator)
    smooth = np.exp(-radius) * (step**2 / (2 * np.pi))
    window = _rise(radius, *_INNER) * (1.0 - _rise(radius, *_OUTER))
    pattern = _pattern(np.log(np.maximum(radius, step)), angle, winding, arms.contrast, generator)
    light = smooth * (1.0 + window * (pattern - 1.0))
    light *= 1.0 - arms.knots * window
    light += window * _knots(at, winding, arms, generator)
    return _balance_rings(light, smooth, radius, window, step)


@dataclass(frozen=True, slots=True)
class _Winding:
    """Logarithmic spirals with small random deviations.

    Attributes
    ----------
    arms : int
        Number of arms.
    slope : float
        Change of the angle with the logarithm of the radius, radian.
    first : float
        Angle of the first arm at radius 1, radian.
    wander : float array, shape (2, 3)
        Amplitudes of the deviations.
    """

    arms: int
    slope: float
    first: float
    wander: Float

    @classmethod
    def draw(cls, bulge_fraction: float, generator: np.random.Generator) -> _Winding:
        arms = int(generator.choice(_ARMS, p=_ODDS))
        pitch = _OPEN + (_TIGHT - _OPEN) * bulge_fraction / _SMOOTH + _SCATTER * generator.standard_normal()
        hand = 1.0 if generator.random() < 0.5 else -1.0
        slope = hand / np.tan(np.radians(np.clip(pitch, *_PITCHES)))
        first = 2 * np.pi * generator.random()
        return cls(arms, slope, first, generator.uniform(-1.0, 1.0, (2, 3)))

    def angle(self, log_radius: Float) -> Float:
        """Angle of the first arm, radian."""
        arm_angle = self.first + self.slope * log_radius
        for wave, (cosine, sine) in enumerate(self.wander.T, start=2):
            arm_angle = arm_angle + (0.25 / wave) * (
                cosine * np.cos(wave * log_radius) + sine * np.sin(wave * log_radius)
            )
        return np.asarray(arm_angle)


def _pattern(
    log_radius: Float, angle: Float, winding: _Winding, contrast: float, generator: np.random.Generator
) -> Float:
    """Light of arms with spurs and patches, relative to about the mean of its circle."""
    narrow = generator.uniform(*_NARROW)
    mean = i0e(narrow)
    strength = contrast * generator.uniform(0.7, 1.1) / (1.0 / mean - 1.0)
    phase = angle - winding.angle(log_radius)
    ridge = np.exp(narrow * (np.cos(winding.arms * phase) - 1.0)) / mean
    # The brightness differs between arms and along each arm.
    uneven = 1.0 + 0.35 * np.cos(phase + generator.uniform(0, 2 * np.pi) + 1.3 * log_radius)
    pattern = 1.0 + min(strength, 0.95) * (ridge * uneven - 1.0)
    patches = np.zeros_like(pattern)
    for _ in range(_WAVES):
        number, tilt = int(generator.integers(2, 10)), generator.uniform(0.35, 1.1)
        patches += np.cos(number * (angle - tilt * winding.slope * log_radius) + generator.uniform(0, 2 * np.pi))
    spread = contrast / (contrast + 1.0) * 2.0 * _PATCHY * np.sqrt(2.0 / _WAVES)
    return np.asarray(np.maximum(pattern, 0.05) * np.exp(spread * patches))


def _knots(at: Float, winding: _Winding, arms: Arms, generator: np.random.Generator) -> Float:
    """Light of knots along the arms; `at` [side] are the columns and rows of the picture in scale lengths."""
    light, count = np.zeros((len(at), len(at))), arms.number
    if not count or not arms.knots:
        return light
    step = at[1] - at[0]
    steps = np.linspace(0.0, REACH, 501)
    inside = np.cumsum(steps * np.exp(-steps))
    # The number of knots at each radius is proportional to the light of the disc.
    radius = np.interp((np.arange(count) + generator.random(count)) / count, inside / inside[-1], steps)
    flux = 1.0 / (1.0 - generator.random(count) * (1.0 - 1.0 / _RANGE))
    width = generator.uniform(*_WIDTHS, count) * (flux / flux.mean()) ** 0.2
    arm = generator.integers(0, winding.arms, count) + _ASTRAY * generator.standard_normal(count)
    arm = np.where(generator.random(count) < _FIELD, winding.arms * generator.random(count), arm)
    angle = winding.angle(np.log(np.maximum(radius, step))) + 2 * np.pi * arm / winding.arms
    for x, y, s, f in zip(
        radius * np.cos(angle), radius * np.sin(angle), np.maximum(width, 0.8 * step), flux / flux.sum(), strict=True
    ):
        x_first, y_first = (max(int(np.searchsorted(at, p - 4 * s)), 0) for p in (x, y))
        x_stop, y_stop = (int(np.searchsorted(at, p + 4 * s)) for p in (x, y))
        across, up = (
            np.exp(-0.5 * ((part - p) / s) ** 2) for part, p in ((at[x_first:x_stop], x), (at[y_first:y_stop], y))
        )
        light[y_first:y_stop, x_first:x_stop] += arms.knots * f * (step / s) ** 2 / (2 * np.pi) * up[:, None] * across
    return light


def _balance_rings(light: Float, smooth: Float, radius: Float, window: Float, step: float) -> Float32:
    """Light [side, side] minus the smooth disc, after scaling it to the same sum on all circles."""
    ring = (radius / step).astype(np.int64).ravel()
    ring_light, smooth_light = (
        gaussian_filter1d(np.bincount(ring, part.ravel()), _RING / step) for part in (light, smooth)
    )
    middles = (np.arange(len(ring_light)) + 0.5) * step
    light = light * np.interp(radius, middles, smooth_light / ring_light)
    structure = window * (light - smooth)
    # Remaining imbalance, because rings have a finite width, is removed inside and outside the half-light radius.
    within = radius < EXPONENTIAL_RADIUS
    for weight in (window * smooth * within, window * smooth * ~within):
        structure -= weight * (structure.sum(where=weight > 0.0) / weight.sum())
    return np.asarray(structure, np.float32)


def _rise(radius: Float, low: float, high: float) -> Float:
    """Rise smoothly from 0 at `low` to 1 at `high`."""
    part = np.clip((radius - low) / (high - low), 0.0, 1.0)
    return np.asarray(part**2 * (3.0 - 2.0 * part))
