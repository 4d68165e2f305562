"""Measure the wings of a frame's point source, a power law, from rings around its brightest stars.

Notes
-----
The noise of single pixels hides the wings, so rings are averaged. If the rings contain little information, typical
wings of telescopes are used, with an error of a half. A frame without bright stars or with an uneven sky therefore has
a large error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from lake_schema.arrays import Bool, Float, Int
from truesky.validation.lake.measure import masks
from truesky.validation.lake.measure.frames import Frame
from truesky.validation.lake.measure.references import Reference

# Far wings fall as r^-3 (obscured aperture) or r^-11/3 (turbulence); nearer wings with diffraction rings are shallower.
_SLOPES = np.arange(2.4, 4.01, 0.05)
_TYPICAL_SLOPE, _SLOPE_SPREAD = 3.0, 0.03
# All light of a star in ground images is that within this radius (arcsec), since zero points use standard stars in
# apertures.
_GROUND_EXTENT = 25.0
# Inner and outer edge of the rings in units of the reach of the stars' apertures; largest radius, pixels; number of
# rings, and smallest number of usable rings.
_FROM, _TO, _MAX_RADIUS, _RINGS, _MIN_RINGS = 0.5, 4.0, 120, 14, 6
# Light per arcsec2 at 1" relative to all light. Space: diffraction by the edges of Euclid's pupil, by filter. Ground:
# turbulence and an aureole, which together fall this way from 5" to 25". Relative errors of both.
_SPACE = {"euclid_vis": 9.3e-3, "euclid_y": 1.4e-2, "euclid_j": 1.8e-2, "euclid_h": 2.3e-2}
_GROUND, _UNSURE_SPACE, _UNSURE_GROUND = 1.5e-2, 0.2, 0.5
# Largest and smallest number of stars, and largest flux of a nearby source relative to the star.
_MAX_STARS, _MIN_STARS, _MAX_NEIGHBOUR = 24, 2, 1.0
# Wings of neighbours are this fraction of their light times r^-3; they are visible above this fraction of the noise, at
# least within this radius (pixels).
_WING, _SHOWS, _CORE = 0.1, 0.1, 6.0
# Standard deviations above a ring from which a pixel is hit; factor by which diffraction spikes may exceed the ring.
_HIT, _SPIKE = 4.0, 8.0


@dataclass(frozen=True, slots=True)
class Wings:
    """Power-law wings: strength * r^-slope is the fraction of a point source's light in a pixel at r pixels.

    Attributes
    ----------
    strength : float
        Fraction of the light in a pixel at 1 pixel.
    slope : float
        Negative exponent of the power law.
    outer_radius : float
        Radius that contains all light, pixels.
    error : float
        Error of the strength.
    """

    strength: float
    slope: float
    outer_radius: float = np.inf
    error: float = 0.0

    def profile(self, radius: Float) -> Float:
        """Return the fraction of all light per pixel at a radius in pixels."""
        return np.asarray(self.strength * radius**-self.slope)

    def fraction_beyond(self, radius: float) -> float:
        """Return the fraction of all light beyond a radius in pixels."""
        power = 2.0 - self.slope
        return float(2.0 * np.pi * self.strength * (radius**power - max(self.outer_radius, radius) ** power) / -power)


def typical(frame: Frame) -> Wings:
    """Return typical wings of a telescope of this kind.

    Notes
    -----
    Edges of length P around a pupil of area A diffract the fraction lambda P / (4 pi^3 A theta^3) of the light into a
    solid angle, averaged over all directions.

    References
    ----------
    Born & Wolf 1999, Principles of Optics, sec. 8.8
    """
    if frame.header["CHANNEL"] == "EXT":
        strength = _GROUND / frame.scale
        return Wings(strength, _TYPICAL_SLOPE, _GROUND_EXTENT / frame.scale, _UNSURE_GROUND * strength)
    strength = _SPACE[str(frame.header["FILTER"])] / frame.scale
    return Wings(strength, _TYPICAL_SLOPE, np.inf, _UNSURE_SPACE * strength)


def measure(frame: Frame, sources: Reference, index: Int, noise: float, reach: int) -> Wings:
    """Measure the wings from the brightest stars, and combine them with typical wings weighted by their errors.

    Parameters
    ----------
    frame : Frame
        A frame.
    sources : Reference
        Known sources of the frame.
    index : int array, shape (n,)
        Indices of unsaturated stars, brightest first.
    noise : float
        rms of a pixel of blank sky, e-.
    reach : int
        Reach of the stars' apertures, pixels.

    Returns
    -------
    Wings
        Measured wings, or typical ones if there are too few stars.
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
    # The strengths at the reach of the aperture are compared, so the typical strength is scaled to the fitted slope.
    as_steep = float(reach) ** (fit.slope - expected.slope)
    first, second = fit.error**-2, (expected.error * as_steep) ** -2
    strength = (first * fit.strength + second * expected.strength * as_steep) / (first + second)
    return Wings(max(strength, 0.0), fit.slope, expected.outer_radius, (first + second) ** -0.5)


def _rings(
    frame: Frame, sources: Reference, i: int, neighbours: Int, edges: Float, noise: float
) -> tuple[Float, Float]:
    """Mean e- per pixel of each ring around a source and its weight (e-^-2), 0 if too little of the ring is usable."""
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
        # Diffraction spikes also count as light; only pixels above them are attributed to cosmic rays.
        middle = float(np.median(values))
        wing_signal = sources.expected[i] * _WING * edges[k] ** -_TYPICAL_SLOPE
        values = values[np.abs(values - middle) < _HIT * np.hypot(noise, np.sqrt(wing_signal)) + _SPIKE * wing_signal]
        mean[k], weight[k] = values.mean(), values.size / (noise**2 + wing_signal)
    return mean, weight


def neighbour_mask(sources: Reference, neighbours: Int, across: Int, up: Int, noise: float) -> Bool:
    """Return a mask of pixels of a cutout in which another source is visible.

    Parameters
    ----------
    sources : Reference
        Known sources of the frame.
    neighbours : int array, shape (n,)
        Indices of the sources to mask.
    across, up : int array, shape (nx,) and (ny,)
        Columns and rows of the cutout.
    noise : float
        rms of a pixel of blank sky, e-.

    Returns
    -------
    bool array, shape (ny, nx)
        Mask.
    """
    out = np.zeros((len(up), len(across)), bool)
    reach = np.cbrt(_WING * sources.expected[neighbours] / (_SHOWS * noise))
    radius = np.where(reach > 1.0, np.maximum(reach, _CORE), 0.0)
    masks.mark_discs(sources.x[neighbours] - across[0], sources.y[neighbours] - up[0], radius, out)
    return out


def _fit_wings(mean: Float, weight: Float, flux: Float, radius: Float) -> Wings:
    """Fit mean = sky of each star + flux strength r^-slope to all stars together.

    `mean` and `weight` have the shape (n, rings); `flux` is in e-, `radius` in pixels.
    """
    total = weight.sum(axis=1, keepdims=True)
    # The sky of each star is removed with weighted means.
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
    # Scatter of the rings beyond their noise lowers their weight relative to the typical slope.
    scale = max(min(residuals) / freedom, 1.0)
    best = fits[int(np.argmin(np.array(residuals) / scale + ((_SLOPES - _TYPICAL_SLOPE) / _SLOPE_SPREAD) ** 2))]
    return replace(best, error=best.error * scale**0.5)
