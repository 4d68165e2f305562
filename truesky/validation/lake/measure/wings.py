"""Measure the wings of the PSF in a frame (its light at large distances) from its brightest stars.

Notes
-----
In space, the wings have the shape that diffraction by the edges of the pupil gives them, from a table by band
(pupil_wings.csv, written by scripts/pupil_wings.py). They are no power law: spikes keep their height and their width up
to an angle of wavelength / width of the spider bars, 12" for VIS. Only their strength is fitted. On the ground, wings
are a power law.

Single pixels are too noisy, so pixels are averaged in rings around the stars. The result is combined with typical wings
of space or ground telescopes. A frame without bright stars or with an uneven sky therefore has wings with a large error
(a tenth in space, a half on the ground).
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from lake_schema.arrays import Bool, Float, Int
from lake_schema.errors import BadInput
from truesky.validation.lake.measure import masks
from truesky.validation.lake.measure.frames import Frame
from truesky.validation.lake.measure.references import Reference

# Slopes (negative exponents of the power law) that are tried in the fit on the ground. Far wings fall as r^-3 (aureole)
# or r^-11/3 (turbulence).
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
# Table of the wings of Euclid by filter: fraction of the total light per arcsec^2 by radius in arcsec.
TABLE = Path(__file__).with_name("pupil_wings.csv")
# Largest ratio of neighbouring radii in the table. In between, the wings are interpolated as power laws.
_MAX_STEP = 1.5
# Typical wings of ground telescopes: fraction of the total light per arcsec^2 at 1". Turbulence and an aureole together
# fall as r^-3 from 5" to 25".
_GROUND = 1.5e-2
# Relative error of the typical wings in space (assumed: aberrations change them by 3 to 6 % near the core).
_UNSURE_SPACE = 0.1
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
# Allowance for diffraction rings and spikes when cosmic rays are searched, as a multiple of the mean light in the ring,
# which typical wings (space) or rough wings (ground) give. Spikes of VIS have ten times the mean light at 6
# arcsec, but are fainter than the noise there. A larger allowance keeps more cosmic rays in bright inner rings.
_SPIKE_SPACE, _SPIKE_GROUND = 3.0, 8.0


@dataclass(frozen=True, slots=True)
class Wings:
    """Wings of a PSF: strength * shape is the fraction of a point source's total light in a pixel.

    Attributes
    ----------
    strength : float
        Factor of the shape. For a single radius of 1 pixel with the value 1, it is the fraction of the total light in a
        pixel at a distance of 1 pixel (extrapolated).
    slope : float
        Negative exponent of the power law beyond the last radius, or everywhere if there is only one, larger than 2.
    outer_radius : float
        Radius at which the wings end, pixels; infinite in space.
    error : float
        Standard error of the strength.
    radii, shape : tuple of float
        Radii in pixels, ascending, and the shape of the wings there, fraction per pixel. Between two radii it is a
        power law, and constant below the first of several.
    """

    strength: float
    slope: float
    outer_radius: float = np.inf
    error: float = 0.0
    radii: tuple[float, ...] = (1.0,)
    shape: tuple[float, ...] = (1.0,)

    def profile(self, radius: Float) -> Float:
        """Return the fraction of the total light in a pixel at each radius (pixels, above 0)."""
        outer = self.shape[-1] * (radius / self.radii[-1]) ** -self.slope
        if len(self.radii) == 1:
            return np.asarray(self.strength * outer)
        within = np.exp(np.interp(np.log(radius), np.log(self.radii), np.log(self.shape)))
        return np.asarray(self.strength * np.where(radius > self.radii[-1], outer, within))

    def fraction_beyond(self, radius: float) -> float:
        """Return the fraction of the total light beyond a radius in pixels; 0 beyond the end of the wings."""
        end = max(self.outer_radius, radius)
        nodes = [radius, *(node for node in self.radii if radius < node < end)] if len(self.radii) > 1 else [radius]
        values = replace(self, strength=1.0).profile(np.array(nodes))
        slopes = np.append(-np.diff(np.log(values)) / np.diff(np.log(nodes)), self.slope)
        light = 0.0
        for start, stop, value, slope in zip(nodes, [*nodes[1:], end], values, slopes, strict=True):
            # Light of a power law between two radii. A slope of 2, for which it is a logarithm, does not occur exactly.
            power = 2.0 - float(slope) if abs(float(slope) - 2.0) > 1e-9 else 1e-9
            grown = (stop / start) ** power if np.isfinite(stop) else 0.0
            light += 2.0 * np.pi * float(value) * start**2 * (grown - 1.0) / power
        return self.strength * light


@lru_cache(maxsize=8)
def read_table(path: Path = TABLE) -> dict[str, tuple[tuple[float, float], ...]]:
    """Read a table of wings: for each filter, pairs of a radius (arcsec) and the fraction of the light per arcsec^2.

    Parameters
    ----------
    path : pathlib.Path
        CSV file with the column `radius` and a column for each filter.

    Returns
    -------
    dict
        Pairs by ascending radius.

    Raises
    ------
    BadInput
        If a value is missing or not a number above 0, or if radii do not ascend in steps of at most 50 %.
    """
    with path.open(newline="") as file:
        header, *rows = list(csv.reader(file))
    if header[:1] != ["radius"] or len(header) < 2 or len(rows) < 2:
        raise BadInput(f"{path}: the columns must be radius and names of filters, with at least two rows")
    radius = 0.0
    for line, row in enumerate(rows, start=2):
        for name, text in zip(header, [*row, *[""] * (len(header) - len(row))], strict=False):
            try:
                value = float(text)
            except ValueError:
                value = np.nan
            if not 0.0 < value < np.inf:
                raise BadInput(f"{path}: line {line}, column {name}: must be a number above 0, got {text!r}")
        previous, radius = radius, float(row[0])
        if not previous < radius or (previous and radius > _MAX_STEP * previous):
            raise BadInput(
                f"{path}: line {line}, column radius: must be above the radius before, by at most "
                f"{_MAX_STEP - 1.0:.0%}, got {radius:g} after {previous:g}"
            )
    numbers = [[float(text) for text in row] for row in rows]
    return {name: tuple((row[0], row[column]) for row in numbers) for column, name in enumerate(header) if column}


def typical(frame: Frame) -> Wings:
    """Return typical wings of a ground telescope, or of Euclid in the filter of the frame, with their error.

    The wings of Euclid are in a table; beyond its last radius they fall as r^-3. A user's own passband has
    the wings of VIS, since their free strength absorbs most of the difference.
    """
    if frame.header["CHANNEL"] == "EXT":
        strength = _GROUND / frame.scale
        return Wings(strength, _TYPICAL_SLOPE, _GROUND_EXTENT / frame.scale, _UNSURE_GROUND * strength)
    bands = read_table()
    # Only VIS observes in passbands of users.
    radii, values = zip(*bands.get(str(frame.header["FILTER"]), bands["euclid_vis"]), strict=True)
    return Wings(
        1.0,
        _TYPICAL_SLOPE,
        error=_UNSURE_SPACE,
        radii=tuple(radius / frame.scale for radius in radii),
        shape=tuple(value * frame.scale**2 for value in values),
    )


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
    slopes = _SLOPES if len(expected.radii) == 1 else np.array([expected.slope])
    candidates = [replace(expected, strength=1.0, slope=float(slope)) for slope in slopes]
    fit = _fit_wings(np.array(means), np.array(weights), np.array(fluxes), edges, candidates)
    # Average the strengths at the radius `reach`: convert the typical strength to the fitted slope at this radius.
    as_steep = float(reach) ** (fit.slope - expected.slope)
    first, second = fit.error**-2, (expected.error * as_steep) ** -2
    strength = (first * fit.strength + second * expected.strength * as_steep) / (first + second)
    return replace(fit, strength=max(strength, 0.0), error=(first + second) ** -0.5)


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
    space = len((wings := typical(frame)).radii) > 1
    usual = wings.profile(edges[:-1]) if space else _WING * edges[:-1] ** -_TYPICAL_SLOPE
    spike = _SPIKE_SPACE if space else _SPIKE_GROUND
    ring = np.digitize(np.hypot(across - sources.x[i], (up - sources.y[i])[:, None]), edges) - 1
    mean, weight = np.zeros(len(edges) - 1), np.zeros(len(edges) - 1)
    for k in range(len(mean)):
        inside = ring == k
        values = cut[inside & good]
        if values.size < 0.2 * inside.sum() or values.size < 8:
            continue
        # Remove cosmic rays, but keep diffraction spikes, whose light belongs to the wings.
        middle = float(np.median(values))
        wing_signal = sources.expected[i] * float(usual[k])
        values = values[np.abs(values - middle) < _HIT * np.hypot(noise, np.sqrt(wing_signal)) + spike * wing_signal]
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


def _fit_wings(mean: Float, weight: Float, flux: Float, edges: Float, candidates: list[Wings]) -> Wings:
    """Fit the means of rings around n stars with a sky level for each star plus flux x strength x shape of the wings.

    `mean` (e- per pixel) and `weight` (inverse variance) have the shape (n, rings); `flux` is in e-. `edges` are the
    radii of the rings in pixels. The strength is the same for all stars. Returns the best of the candidates, which have
    the strength 1; their slopes are constrained to be near the typical one.
    """
    total = weight.sum(axis=1, keepdims=True)
    # Subtract the weighted mean over the rings of each star from data and model: this eliminates the sky level.
    offset = mean - (weight * mean).sum(axis=1, keepdims=True) / total
    fits, residuals = [], []
    for wings in candidates:
        light = -np.diff([wings.fraction_beyond(float(edge)) for edge in edges])
        shape = flux[:, None] * light / (np.pi * np.diff(edges**2))
        bent = shape - (weight * shape).sum(axis=1, keepdims=True) / total
        power = float((weight * bent**2).sum())
        strength = float((weight * bent * offset).sum()) / power
        residuals.append(float((weight * (offset - strength * bent) ** 2).sum()))
        fits.append(replace(wings, strength=strength, error=power**-0.5))
    freedom = max(int((weight > 0.0).sum()) - len(flux) - 2, 1)
    # If the rings scatter more than their noise, reduce their weight compared with the constraint on the slope.
    scale = max(min(residuals) / freedom, 1.0)
    slopes = np.array([wings.slope for wings in candidates])
    best = fits[int(np.argmin(np.array(residuals) / scale + ((slopes - _TYPICAL_SLOPE) / _SLOPE_SPREAD) ** 2))]
    return replace(best, error=best.error * scale**0.5)
