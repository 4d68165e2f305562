"""Measure the wings of the PSF in a frame (its light at large distances, a power law) from its brightest stars.

Notes
-----
Single pixels are too noisy, so pixels are averaged in rings around the stars. The result is combined with typical wings
of space or ground telescopes. A frame without bright stars or with an uneven sky therefore has wings with a large error
(a fifth in space, a half on the ground).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from lake_schema.arrays import Bool, Float, Int
from truesky.validation.lake.measure import masks
from truesky.validation.lake.measure.frames import Frame
from truesky.validation.lake.measure.references import Reference

# Slopes (negative exponents of the power law) that are tried in the fit. Far wings fall as r^-3 (diffraction by an
# obscured aperture) or r^-11/3 (turbulence); nearer wings with diffraction rings are shallower.
_SLOPES = np.arange(2.4, 4.01, 0.05)
# Typical slope of the wings: their light per pixel falls with radius as r^-slope.
_TYPICAL_SLOPE = 3.0
# Standard deviation of the slope from the typical slope, which constrains the fit.
_SLOPE_SPREAD = 0.03
# The total light of a star in ground images is defined as the light within this radius (arcsec), because zero points
# are calibrated with standard stars in apertures.
_GROUND_EXTENT = 25.0
# Inner radius of the smallest ring, as a fraction of half the side of the stars' cutouts.
_FROM = 0.5
# Outer radius of the largest ring, as a multiple of half the side of the stars' cutouts.
_TO = 4.0
# Largest outer radius of the rings around stars in which the light of the wings is averaged, pixels.
_MAX_RADIUS = 120
# Number of rings around each star in which the light of the wings is averaged.
_RINGS = 14
# A star is not used if it has fewer usable rings than this number.
_MIN_RINGS = 6
# Typical wings of Euclid by filter: fraction of the total light per arcsec^2 at 1" (diffraction by edges of the pupil).
_SPACE = {"euclid_vis": 9.3e-3, "euclid_y": 1.4e-2, "euclid_j": 1.8e-2, "euclid_h": 2.3e-2}
# Typical wings of ground telescopes: fraction of the total light per arcsec^2 at 1". Turbulence and an aureole together
# fall as r^-3 from 5" to 25".
_GROUND = 1.5e-2
# Relative error of the typical wings in space.
_UNSURE_SPACE = 0.2
# Relative error of the typical wings on the ground.
_UNSURE_GROUND = 0.5
# Largest number of stars around which wings are measured.
_MAX_STARS = 24
# With fewer stars than this number, typical wings are used.
_MIN_STARS = 2
# A star is not used if a nearby source has more than this multiple of the star's flux.
_MAX_NEIGHBOUR = 1.0
# Rough wings of any source, for masks and noise: fraction of its light in a pixel at 1 pixel; they fall as r^-3.
_WING = 0.1
# A neighbour is visible in a pixel if its light is more than this fraction of the noise.
_SHOWS = 0.1
# Smallest radius of the masked disc around a visible neighbour of a star, pixels.
_CORE = 6.0
# A pixel is hit by a cosmic ray if it exceeds the median of its ring by more than this number of standard deviations
# plus the allowance for spikes.
_HIT = 4.0
# Allowance for diffraction spikes when cosmic rays are searched, as a multiple of the rough wings (light of a source
# that falls as r^-3).
_SPIKE = 8.0


@dataclass(frozen=True, slots=True)
class Wings:
    """Wings of a PSF: strength * r^-slope is the fraction of a point source's total light in a pixel at r pixels.

    Attributes
    ----------
    strength : float
        Fraction of the total light in a pixel at a distance of 1 pixel (extrapolated).
    slope : float
        Negative exponent of the power law, larger than 2.
    outer_radius : float
        Radius at which the wings end, pixels; infinite in space.
    error : float
        Standard error of the strength.
    """

    strength: float
    slope: float
    outer_radius: float = np.inf
    error: float = 0.0

    def profile(self, radius: Float) -> Float:
        """Return the fraction of the total light in a pixel at each radius (pixels, above 0)."""
        return np.asarray(self.strength * radius**-self.slope)

    def fraction_beyond(self, radius: float) -> float:
        """Return the fraction of the total light beyond a radius in pixels; 0 beyond the end of the wings."""
        power = 2.0 - self.slope
        return float(2.0 * np.pi * self.strength * (radius**power - max(self.outer_radius, radius) ** power) / -power)


def typical(frame: Frame) -> Wings:
    """Return typical wings of a ground telescope, or of Euclid in the filter of the frame, with their error.

    Notes
    -----
    A pupil of area A, whose edges have the total length P, diffracts the fraction lambda P / (4 pi^3 A theta^3) of the
    light per steradian to the angle theta from the source, averaged over position angles.

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
    """Measure the wings of the PSF around bright stars, and average them with typical wings, weighted by the errors.

    Parameters
    ----------
    frame : Frame
        Raw frame in electrons.
    sources : Reference
        Known sources of the frame.
    index : int array, shape (n,)
        Indices, in `sources`, of the unsaturated stars, brightest first.
    noise : float
        rms noise of a pixel of blank sky, e-.
    reach : int
        Half of the side of the stars' cutouts, pixels. Rings extend from 0.5 to 4 times `reach`, at most to 120 pixels.

    Returns
    -------
    Wings
        Wings of a point source; typical wings if fewer than two stars can be used.
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
    # Average the strengths at the radius `reach`: convert the typical strength to the fitted slope at this radius.
    as_steep = float(reach) ** (fit.slope - expected.slope)
    first, second = fit.error**-2, (expected.error * as_steep) ** -2
    strength = (first * fit.strength + second * expected.strength * as_steep) / (first + second)
    return Wings(max(strength, 0.0), fit.slope, expected.outer_radius, (first + second) ** -0.5)


def _rings(
    frame: Frame, sources: Reference, i: int, neighbours: Int, edges: Float, noise: float
) -> tuple[Float, Float]:
    """Return the mean e- per pixel of each ring around source number `i`, and its weight (inverse variance, e-^-2).

    `edges` are the radii of the rings in pixels. Pixels of neighbours and of cosmic rays are left out. The weight is 0
    if less than a fifth of the ring's pixels, or fewer than eight, can be used.
    """
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
        # Remove cosmic rays, but keep diffraction spikes, whose light belongs to the wings.
        middle = float(np.median(values))
        wing_signal = sources.expected[i] * _WING * edges[k] ** -_TYPICAL_SLOPE
        values = values[np.abs(values - middle) < _HIT * np.hypot(noise, np.sqrt(wing_signal)) + _SPIKE * wing_signal]
        mean[k], weight[k] = values.mean(), values.size / (noise**2 + wing_signal)
    return mean, weight


def neighbour_mask(sources: Reference, neighbours: Int, across: Int, up: Int, noise: float) -> Bool:
    """Return a mask of the pixels of a cutout in which one of the given sources is visible above the noise.

    Parameters
    ----------
    sources : Reference
        Known sources of the frame.
    neighbours : int array, shape (n,)
        Indices, in `sources`, of the sources to mask.
    across, up : int array, shape (nx,) and (ny,)
        Column numbers and row numbers of the cutout's pixels in the frame, consecutive.
    noise : float
        rms noise of a pixel of blank sky, e-.

    Returns
    -------
    bool array, shape (ny, nx)
        True for pixels to which a source may contribute more than a tenth of the noise.
    """
    out = np.zeros((len(up), len(across)), bool)
    reach = np.cbrt(_WING * sources.expected[neighbours] / (_SHOWS * noise))
    radius = np.where(reach > 1.0, np.maximum(reach, _CORE), 0.0)
    masks.mark_discs(sources.x[neighbours] - across[0], sources.y[neighbours] - up[0], radius, out)
    return out


def _fit_wings(mean: Float, weight: Float, flux: Float, radius: Float) -> Wings:
    """Fit the means of rings around n stars with a sky level for each star plus flux x strength x r^-slope.

    `mean` (e- per pixel) and `weight` (inverse variance) have the shape (n, rings); `flux` is in e-, `radius` in
    pixels. Strength and slope are the same for all stars; the slope is constrained to be near the typical one.
    """
    total = weight.sum(axis=1, keepdims=True)
    # Subtract the weighted mean over the rings of each star from data and model: this eliminates the sky level.
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
    # If the rings scatter more than their noise, reduce their weight compared with the constraint on the slope.
    scale = max(min(residuals) / freedom, 1.0)
    best = fits[int(np.argmin(np.array(residuals) / scale + ((_SLOPES - _TYPICAL_SLOPE) / _SLOPE_SPREAD) ** 2))]
    return replace(best, error=best.error * scale**0.5)
