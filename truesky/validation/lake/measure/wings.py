"""Wings of a frame's point source, where the noise of a pixel hides them: a power law through rings about its stars.

Where the rings do not tell it, wings are those that telescopes have, to a half: a frame without bright stars, or whose
sky is uneven, says so by the error.

Wings   what of a point's light lies in a pixel, and beyond a radius
told    a frame's stars -> Wings
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from lake_schema.arrays import Bool, Float, Int
from truesky.validation.lake.measure import masks
from truesky.validation.lake.measure.frames import Frame
from truesky.validation.lake.measure.references import Reference

# Far wings fall as r^-3 (obscured aperture) or r^-11/3 (turbulence); nearer ones, with their rings, a little less.
_SLOPES = np.arange(2.4, 4.01, 0.05)
_TYPICAL_SLOPE, _SLOPE_SPREAD = 3.0, 0.03
# All light of a star of the ground is what lies within so many arcsec: zero points are of standard stars in apertures.
_GROUND_EXTENT = 25.0
# Rings, from a part of the reach of a star's aperture to several times that; pixels at most; the least that tell it.
_FROM, _TO, _MAX_RADIUS, _RINGS, _MIN_RINGS = 0.5, 4.0, 120, 14, 6
# Of a point's light in an arcsec2 at 1": diffraction by the edges of Euclid's pupil, by filter; of turbulence and an
# aureole, which fall so together from 5" to 25". Part of itself by which either may be wrong.
_SPACE = {"euclid_vis": 9.3e-3, "euclid_y": 1.4e-2, "euclid_j": 1.8e-2, "euclid_h": 2.3e-2}
_GROUND, _UNSURE_SPACE, _UNSURE_GROUND = 1.5e-2, 0.2, 0.5
# Stars that are asked, the fewest that tell anything, and what another nearby may have of a star's light.
_MAX_STARS, _MIN_STARS, _MAX_NEIGHBOUR = 24, 2, 1.0
# Where another source's wings, r^-3 of this part of its light at a pixel, bring more than so much of the noise.
_WING, _SHOWS, _CORE = 0.1, 0.1, 6.0
# Standard deviations above the ring from which a pixel is hit; how much brighter spikes may be, whose light counts.
_HIT, _SPIKE = 4.0, 8.0


@dataclass(frozen=True, slots=True)
class Wings:
    """strength r^-slope of a point's light is in a pixel at r pixels.

    whole : pixels, within which all light lies;  error : of the strength
    """

    strength: float
    slope: float
    outer_radius: float = np.inf
    error: float = 0.0

    def profile(self, radius: Float) -> Float:
        """Part of all light in a pixel, pix^-2."""
        return np.asarray(self.strength * radius**-self.slope)

    def fraction_beyond(self, radius: float) -> float:
        """Part of all light."""
        power = 2.0 - self.slope
        return float(2.0 * np.pi * self.strength * (radius**power - max(self.outer_radius, radius) ** power) / -power)


def typical(frame: Frame) -> Wings:
    """Of a telescope of its kind.

    Ref : edges of length P about a pupil of area A bring lambda P / (4 pi^3 A theta^3) of the light into a solid angle
          (the mean over all directions; Born & Wolf 1999, Principles of Optics, sec. 8.8)
    """
    if frame.header["CHANNEL"] == "EXT":
        strength = _GROUND / frame.scale
        return Wings(strength, _TYPICAL_SLOPE, _GROUND_EXTENT / frame.scale, _UNSURE_GROUND * strength)
    strength = _SPACE[str(frame.header["FILTER"])] / frame.scale
    return Wings(strength, _TYPICAL_SLOPE, np.inf, _UNSURE_SPACE * strength)


def measure(frame: Frame, sources: Reference, index: Int, noise: float, reach: int) -> Wings:
    """Of the frame's brightest stars, and the usual ones, each by its error.

    known : sources of the frame;  index : of the stars in it, brightest first, none of them saturated
    noise : e- rms of a pixel of blank sky;  reach : of the stars' apertures, pixels
    """
    outer_radius = min(round(_TO * reach), _MAX_RADIUS)
    edges = np.geomspace(_FROM * reach, outer_radius, _RINGS + 1)
    tree = cKDTree(np.stack([sources.x, sources.y], axis=1)) if len(sources.x) else None
    means, weights, fluxes = [], [], []
    for i in index:
        assert tree is not None
        neighbours = [j for j in tree.query_ball_point([sources.x[i], sources.y[i]], 1.5 * outer_radius) if j != i]
        if len(neighbours) and sources.expected[neighbours].max() > _MAX_NEIGHBOUR * sources.expected[i]:
            continue
        mean, weight = _rings(frame, sources, int(i), np.array(neighbours, int), edges, noise)
        if (weight > 0.0).sum() >= _MIN_RINGS:
            means.append(mean)
            weights.append(weight)
            fluxes.append(sources.expected[i])
        if len(means) == _MAX_STARS:
            break
    expected = typical(frame)
    if len(means) < _MIN_STARS:
        return expected
    fit = _fit_wings(np.array(means), np.array(weights), np.array(fluxes), np.sqrt(edges[1:] * edges[:-1]))
    # Slopes turn about the aperture's edge.
    as_steep = float(reach) ** (fit.slope - expected.slope)
    first, second = fit.error**-2, (expected.error * as_steep) ** -2
    strength = (first * fit.strength + second * expected.strength * as_steep) / (first + second)
    return Wings(max(strength, 0.0), fit.slope, expected.outer_radius, (first + second) ** -0.5)


def _rings(
    frame: Frame, sources: Reference, i: int, neighbours: Int, edges: Float, noise: float
) -> tuple[Float, Float]:
    """(e- a pixel of each ring about a source, its weight e-^-2), 0 where little of the ring is left."""
    ny, nx = frame.electrons.shape
    outer_radius = int(np.ceil(edges[-1]))
    column, row = round(float(sources.x[i])), round(float(sources.y[i]))
    across = np.arange(max(column - outer_radius, 0), min(column + outer_radius + 1, nx))
    up = np.arange(max(row - outer_radius, 0), min(row + outer_radius + 1, ny))
    cut = frame.linearize(frame.electrons[up[0] : up[-1] + 1, across[0] : across[-1] + 1].astype(float))
    good = ~neighbour_mask(sources, neighbours, across, up, noise) & (cut != 0.0)
    ring = np.digitize(np.hypot(across - sources.x[i], (up - sources.y[i])[:, None]), edges) - 1
    mean, weight = np.zeros(len(edges) - 1), np.zeros(len(edges) - 1)
    for k in range(len(mean)):
        inside = ring == k
        values = cut[inside & good]
        if values.size < 0.2 * inside.sum() or values.size < 8:
            continue
        # Spikes are light, too: only what is above them is put down to cosmic rays.
        middle = float(np.median(values))
        wing_signal = sources.expected[i] * _WING * edges[k] ** -_TYPICAL_SLOPE
        values = values[np.abs(values - middle) < _HIT * np.hypot(noise, np.sqrt(wing_signal)) + _SPIKE * wing_signal]
        mean[k], weight[k] = values.mean(), values.size / (noise**2 + wing_signal)
    return mean, weight


def neighbour_mask(sources: Reference, neighbours: Int, across: Int, up: Int, noise: float) -> Bool:
    """bool[ny, nx]: pixels of a cut in which another source shows.

    known, near : sources of the frame, and indices of those that are looked at
    across, up  : columns [nx] and rows [ny] of the cut;  noise : e- rms of a pixel of blank sky
    """
    out = np.zeros((len(up), len(across)), bool)
    reach = np.cbrt(_WING * sources.expected[neighbours] / (_SHOWS * noise))
    radius = np.where(reach > 1.0, np.maximum(reach, _CORE), 0.0)
    masks.mark_discs(sources.x[neighbours] - across[0], sources.y[neighbours] - up[0], radius, out)
    return out


def _fit_wings(mean: Float, weight: Float, flux: Float, radius: Float) -> Wings:
    """Of all stars together: mean = sky of each star + flux strength r^-slope.

    mean, weight : [n, rings];  flux : [n] e-;  radius : [rings]
    """
    total = weight.sum(axis=1, keepdims=True)
    # The sky of each star is what the weighted means of both leave.
    offset = mean - (weight * mean).sum(axis=1, keepdims=True) / total
    fits, residuals = [], []
    for slope in _SLOPES:
        shape = flux[:, None] * radius**-slope
        bent = shape - (weight * shape).sum(axis=1, keepdims=True) / total
        power = float((weight * bent**2).sum())
        strength = float((weight * bent * offset).sum()) / power
        residuals.append(float((weight * (offset - strength * bent) ** 2).sum()))
        fits.append(Wings(strength, float(slope), error=power**-0.5))
    freedom = max(int((weight > 0.0).sum()) - len(flux) - 2, 1)
    # What rings differ by beyond their noise tells the slope no better than the noise does.
    scale = max(min(residuals) / freedom, 1.0)
    best = fits[int(np.argmin(np.array(residuals) / scale + ((_SLOPES - _TYPICAL_SLOPE) / _SLOPE_SPREAD) ** 2))]
    return replace(best, error=best.error * scale**0.5)
