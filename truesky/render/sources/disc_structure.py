"""Draw spiral arms and knots of galaxy discs, as images of the light that is added to and removed from a smooth disc.

On every circle about the middle of a disc, the structure adds and removes the same amount of light. Flux and half-light
radius therefore remain those of the smooth profile. The random numbers depend on the galaxy's identifier and the seed
only, so that the structure is the same in every band and exposure.

References
----------
Yu & Ho 2019, ApJ 871, 194 (pitch angles decrease with the bulge fraction); Kendall et al. 2011, MNRAS 414, 538
(contrast of arms); Kennicutt, Edgar & Hodge 1989, ApJ 337, 761 (H II regions: dN / dL is proportional to L^-2).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from lake_schema.arrays import Float, Float32, Int
from truesky.randomness import rng
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.galaxy_shapes import EXPONENTIAL_RADIUS, Shapes
from truesky.render.sources.lensed_arcs import Picture
from truesky.render.sources.source_list import Sources
from truesky.request.structure import Arms

# Half the side of the image of a disc's structure (spiral arms and knots), in scale lengths of the disc.
REACH = 5.0
# Preferred pixel size of the image of a disc's structure (arms and knots), arcsec.
_FINE = 0.05
# Possible sides of the image of a disc's structure (arms and knots), pixels. The smallest one with pixels of at most
# `_FINE` is used, or the largest if none is large enough.
_SIDES = np.array([128, 192, 256, 384, 512])
# Range of radii (scale lengths) over which the structure of a disc rises from nothing to its full strength.
_INNER = (0.3, 0.9)
# Range of radii (scale lengths) over which the structure of a disc fades to nothing.
_OUTER = (3.6, 4.9)
# Discs for which the image of arms and knots would be wider (arcsec) are smooth. The limit is below the side of
# the largest stamp (square image in which a source is drawn) of the camera with the finest pixels.
_WIDEST = 180.0
# Galaxies with at least this fraction of their light in the bulge have discs without spiral arms and knots.
_SMOOTH = 0.5
# Mean pitch angle of spiral arms in a galaxy without a bulge, deg.
_OPEN = 26.0
# Mean pitch angle of spiral arms in a galaxy with the bulge fraction `_SMOOTH`, deg.
_TIGHT = 13.0
# Standard deviation of the pitch angles of spiral arms about their mean, deg.
_SCATTER = 4.0
# Smallest and largest pitch angle of spiral arms, deg.
_PITCHES = (10.0, 30.0)
# Possible numbers of spiral arms of a galaxy.
_ARMS = (2, 3, 4)
# Fractions of galaxies that have each of the numbers of spiral arms in `_ARMS`.
_ODDS = (0.65, 0.15, 0.20)
# Range of the narrowness of spiral arms: half the natural logarithm of the brightness at their ridge divided by that at
# their trough.
_NARROW = (1.3, 2.4)
# Number of random waves whose sum gives spurs and patches between spiral arms.
_WAVES = 14
# Standard deviation of the natural logarithm of the light due to spurs and patches between spiral arms, for arms with
# contrast 1 (the ridge is twice as bright as the mean).
_PATCHY = 0.28
# Flux ratio of the brightest and the faintest possible knot (star-forming region) of a disc.
_RANGE = 30.0
# Range of the Gaussian widths (standard deviations) of star-forming knots with the mean flux, in scale lengths of the
# disc.
_WIDTHS = (0.030, 0.075)
# Fraction of star-forming knots that lie at any angle, between the arms too; the others lie near an arm.
_FIELD = 0.2
# Standard deviation of the angle between a star-forming knot and the ridge of its spiral arm, as a fraction of the
# angle to the next arm.
_ASTRAY = 0.07
# Width (Gaussian standard deviation) of the rings, in scale lengths of the disc, on which its structure adds as much
# light as it removes.
_RING = 0.12


@dataclass(frozen=True, slots=True)
class DiscStructure:
    """Options for the structure (spiral arms and star-forming knots) that is added to smooth galaxy discs.

    Attributes
    ----------
    arms : Arms
        Options of the request: contrast of arms, light in knots, and size of the smallest disc with structure.
    seed : int
        Seed of the request, used to draw the structure of each galaxy.
    """

    arms: Arms
    seed: int


def sides(shape: Shapes, discs: DiscStructure | None) -> Float:
    """Return the width in arcsec of the image of each disc's structure (arms and knots), shape (n,); 0 means none.

    A disc has structure if its half-light radius is at least that in the request, less than half of the galaxy's light
    is in the bulge, and the image is less than 180 arcsec wide. `discs` None means that no disc has structure.
    """
    if discs is None:
        return np.zeros(len(shape))
    # Half-light radius (arcsec) of the disc alone after lensing, along its major axis.
    half_light_radius = galaxy_shapes.half_light(replace(shape, bulge_fraction=np.zeros(len(shape))))
    wide = 2 * REACH / EXPONENTIAL_RADIUS * half_light_radius
    has_structure = (shape.disk_radius >= discs.arms.least_radius) & (shape.bulge_fraction < _SMOOTH) & (wide < _WIDEST)
    return np.where(has_structure, wide, 0.0)


def add_structure(sources: Sources, shape: Shapes, discs: DiscStructure | None) -> Sources:
    """Give the galaxies with large discs an image of their structure (spiral arms and knots).

    Parameters
    ----------
    sources : Sources
        Sources to be drawn.
    shape : Shapes
        Shapes of the galaxies, to which `sources.shape` refers.
    discs : DiscStructure or None
        Options; None means that no disc has structure.

    Returns
    -------
    Sources
        The same sources with the additional images; `sources` itself if `discs` is None.
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
    """Draw the structure (spiral arms and knots) of a face-on exponential disc of flux 1.

    Parameters
    ----------
    side : int
        Side of the image in pixels; it spans 2 REACH = 10 scale lengths of the disc.
    bulge_fraction : float
        Fraction of the galaxy's light in the bulge, on which the mean pitch angle depends.
    arms : Arms
        Options of the request: contrast of arms, number of knots and their light.
    generator : numpy.random.Generator
        Source of random numbers.

    Returns
    -------
    float32 array, shape (side, side)
        Light that the structure adds (positive) or removes (negative) in each pixel; its sum is 0.
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
    """Logarithmic spiral arms with small random deviations.

    Attributes
    ----------
    arms : int
        Number of arms, equally spaced in angle.
    slope : float
        Change of an arm's angle (radians) per unit of the natural logarithm of the radius; its sign is the handedness.
    first : float
        Angle of the first arm at a radius of one scale length, radians.
    wander : float array, shape (2, 3)
        Random numbers from -1 to 1. With rows c and s, an arm deviates from the spiral by the angle sum_k (c_k cos(k ln
        r) + s_k sin(k ln r)) / (4 k) in radians, for k = 2, 3, 4 and the radius r in scale lengths.
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
        """Return the angle of the first arm in radians, at natural logarithms of the radius in scale lengths."""
        arm_angle = self.first + self.slope * log_radius
        for wave, (cosine, sine) in enumerate(self.wander.T, start=2):
            arm_angle = arm_angle + (0.25 / wave) * (
                cosine * np.cos(wave * log_radius) + sine * np.sin(wave * log_radius)
            )
        return np.asarray(arm_angle)


def _pattern(
    log_radius: Float, angle: Float, winding: _Winding, contrast: float, generator: np.random.Generator
) -> Float:
    """Return the light of spiral arms with spurs and patches in each pixel, on a scale with a mean of about 1.

    The mean is that of the pixels at the same radius. `log_radius` is the natural logarithm of the radius in scale
    lengths, and `angle` is in radians. `contrast` is about the brightness at the ridge of an arm divided by the mean,
    minus 1; each disc has 0.7 to 1.1 times this value.
    """
    narrow = generator.uniform(*_NARROW)
    mean = scipy.special.i0e(narrow)
    strength = contrast * generator.uniform(0.7, 1.1) / (1.0 / mean - 1.0)
    phase = angle - winding.angle(log_radius)
    ridge = np.exp(narrow * (np.cos(winding.arms * phase) - 1.0)) / mean
    # Random factor of the brightness of a spiral arm at each pixel: arms differ from one another, and each arm varies
    # along its length.
    uneven = 1.0 + 0.35 * np.cos(phase + generator.uniform(0, 2 * np.pi) + 1.3 * log_radius)
    pattern = 1.0 + min(strength, 0.95) * (ridge * uneven - 1.0)
    patches = np.zeros_like(pattern)
    for _ in range(_WAVES):
        number, tilt = int(generator.integers(2, 10)), generator.uniform(0.35, 1.1)
        patches += np.cos(number * (angle - tilt * winding.slope * log_radius) + generator.uniform(0, 2 * np.pi))
    spread = contrast / (contrast + 1.0) * 2.0 * _PATCHY * np.sqrt(2.0 / _WAVES)
    return np.asarray(np.maximum(pattern, 0.05) * np.exp(spread * patches))


def _knots(at: Float, winding: _Winding, arms: Arms, generator: np.random.Generator) -> Float:
    """Return an image with the light of the knots (star-forming regions) along the arms of a disc of flux 1.

    `at`, shape (side,), has the distances of columns and of rows from the middle in scale lengths. `winding` defines
    the arms; `arms` has the number of knots and the fraction of the disc's light in them.
    """
    light, count = np.zeros((len(at), len(at))), arms.number
    if not count or not arms.knots:
        return light
    step = at[1] - at[0]
    steps = np.linspace(0.0, REACH, 501)
    inside = np.cumsum(steps * np.exp(-steps))
    # Draw the radii of knots so that their density is proportional to the light of the disc.
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
    """Return the structure of a disc: `light` scaled to the sum of `smooth` on every circle, minus `smooth`.

    `light` is the disc with arms and knots, and `smooth` the disc without them; all images have the shape (side, side).
    `radius` is the distance of each pixel from the middle and `step` the pixel size, in scale lengths. `window`, 0 to
    1, is the strength of the structure in each pixel, by which the difference is multiplied.
    """
    ring = (radius / step).astype(np.int64).ravel()
    ring_light, smooth_light = (
        scipy.ndimage.gaussian_filter1d(np.bincount(ring, part.ravel()), _RING / step) for part in (light, smooth)
    )
    middles = (np.arange(len(ring_light)) + 0.5) * step
    light = light * np.interp(radius, middles, smooth_light / ring_light)
    structure = window * (light - smooth)
    # Rings have a finite width, so that the sum of the structure is not exactly 0. Correct it separately inside and
    # outside the half-light radius.
    within = radius < EXPONENTIAL_RADIUS
    for weight in (window * smooth * within, window * smooth * ~within):
        structure -= weight * (structure.sum(where=weight > 0.0) / weight.sum())
    return np.asarray(structure, np.float32)


def _rise(radius: Float, low: float, high: float) -> Float:
    """Return a function of the radius that rises smoothly from 0 at `low` to 1 at `high`; constant outside."""
    part = np.clip((radius - low) / (high - low), 0.0, 1.0)
    return np.asarray(part**2 * (3.0 - 2.0 * part))
