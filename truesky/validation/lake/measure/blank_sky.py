"""Measure the blank sky of a frame in tiles without sources: level and noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lake_schema.arrays import Array, Bool, Float, Int
from truesky.numerics.compiling import exact_jit
from truesky.validation.lake.measure import masks
from truesky.validation.lake.measure.frames import Amplifier, Frame
from truesky.validation.lake.measure.references import Reference

# Side of a tile, pixels; step in tiles along rows and columns of large detectors.
SIDE, TILE_STEP = 64, 2
_LARGE = 2 << 20
# The light of a point source at r arcsec is this times its flux / r^3, per square arcsec (obscured aperture, 3 bars).
_WING = 9.3e-3
# Fraction of a pixel's noise that a source may contribute to a blank pixel; factor for the radius of galaxies; smallest
# radius, arcsec.
_VISIBLE_FRACTION, _GALAXY_WIDENING, _MIN_RADIUS = 0.1, 1.5, 1.0
_MAX_RADIUS = 400
# Standard deviations from the median of a tile beyond which a pixel is an outlier; smallest number of blank pixels.
_CLIP, _MIN_PIXELS = 5.0, 400
# Step in rows and columns of the pixels that give the first estimate of the level.
_SAMPLE_STEP = 4
# Standard deviations above its tile from which a pixel counts as hit.
_HIT = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class Tiles:
    """Square tiles of a frame.

    Attributes
    ----------
    pixels : float32 array, shape (t, SIDE, SIDE)
        Pixels, e-.
    blank : bool array, shape (t, SIDE, SIDE)
        True for blank pixels.
    hit : bool array, shape (t, SIDE, SIDE)
        True for pixels far above the level of the tile without a known source.
    row, column : int array, shape (t,)
        First row and column of each tile.
    """

    pixels: Array
    blank: Bool
    hit: Bool
    row: Int
    column: Int

    @property
    def level(self) -> Float:
        """Mean of the blank pixels of each tile, e- per pixel."""
        return np.asarray((self.pixels * self.blank).sum(axis=(1, 2)) / self.blank.sum(axis=(1, 2)))

    def in_amplifier(self, amplifier: Amplifier) -> Tiles:
        """Return the tiles that lie entirely in an amplifier."""
        rows, columns = amplifier.pixels
        return self.select((self.row >= rows.start) & (self.row + SIDE <= rows.stop)
                          & (self.column >= columns.start) & (self.column + SIDE <= columns.stop))  # fmt: skip

    def select(self, mask: Bool) -> Tiles:
        """Return the tiles selected by a mask."""
        return Tiles(self.pixels[mask], self.blank[mask], self.hit[mask], self.row[mask], self.column[mask])


def rough_noise(frame: Frame) -> float:
    """Return the rms noise (e-) of a blank pixel from the middle half of differences of neighbours."""
    sample = frame.electrons[5::37, :].astype(float)
    step = np.diff(sample, axis=1).ravel()
    low, high = np.percentile(step, [25.0, 75.0])
    return float((high - low) / 1.349 / np.sqrt(2.0))


def tiles(frame: Frame, sources: Reference, noise: float, tile_step: int | None = None) -> Tiles:
    """Divide a frame into tiles, and mask sources, outliers and pixels that are not read out.

    Parameters
    ----------
    frame : Frame
        A frame.
    sources : Reference
        Its known sources.
    noise : float
        rms of a pixel of blank sky, e-.
    tile_step : int, optional
        Step in tiles along rows and columns; by default TILE_STEP for large detectors, else 1.

    Returns
    -------
    Tiles
        Tiles with enough blank pixels.
    """
    ny, nx = frame.electrons.shape
    if tile_step is None:
        tile_step = TILE_STEP if ny * nx > _LARGE else 1
    down, across = (np.arange(0, n - SIDE + 1, SIDE * tile_step) for n in (ny, nx))
    row, column = (axis.ravel() for axis in np.meshgrid(down, across, indexing="ij"))
    source_mask = _source_mask(frame, sources, noise)
    pixels: Array = np.stack([frame.electrons[r : r + SIDE, c : c + SIDE] for r, c in zip(row, column, strict=True)])
    hidden = np.stack([source_mask[r : r + SIDE, c : c + SIDE] for r, c in zip(row, column, strict=True)])
    blank = ~_not_blank(pixels, hidden, noise)
    enough = blank.sum(axis=(1, 2)) >= _MIN_PIXELS
    pixels, hidden, blank = pixels[enough], hidden[enough], blank[enough]
    result = Tiles(pixels, blank, np.zeros_like(blank), row[enough], column[enough])
    if not len(pixels):
        return result
    spread = np.sqrt((blank * (pixels - result.level[:, None, None]) ** 2).sum(axis=(1, 2)) / blank.sum(axis=(1, 2)))
    hit = ~hidden & (pixels > (result.level + _HIT * spread)[:, None, None])
    return replace(result, hit=hit)


def _not_blank(pixels: Array, hidden: Bool, noise: float) -> Bool:
    """Mask of pixels that are not blank sky: sources, outliers and their neighbours, and pixels not read out."""
    bad = hidden | (pixels == 0.0)
    # Sources cover little of most tiles, so the median of a sample is a good first level.
    sample = pixels[:, ::_SAMPLE_STEP, ::_SAMPLE_STEP]
    middle = np.median(np.where(bad[:, ::_SAMPLE_STEP, ::_SAMPLE_STEP], np.median(sample), sample), axis=(1, 2))
    out = np.empty(pixels.shape, bool)
    _mark_outliers(pixels, bad, middle, noise, out)
    return np.asarray(bad | out | masks.dilate(out & ~hidden, corners=True))


@exact_jit
def _mark_outliers(pixels: Array, bad: Bool, middle: Float, noise: float, out: Bool) -> None:
    """Mark pixels (t, ny, nx) far from the mean of the other pixels of their tile, in three iterations.

    The first iteration starts from the levels `middle` and the rms `noise` (e-); pixels that are `bad` do not count.
    """
    tiles, ny, nx = pixels.shape
    for t in range(tiles):
        mean, spread = middle[t], noise
        for _ in range(3):
            limit, n, first, second = _CLIP * spread, 0, 0.0, 0.0
            for i in range(ny):
                for j in range(nx):
                    off = pixels[t, i, j] - mean
                    out[t, i, j] = is_outlier = abs(off) > limit
                    if not (is_outlier or bad[t, i, j]):
                        n, first, second = n + 1, first + off, second + off * off
            # Sums are relative to the old mean, which is near the new one, so no digits are lost.
            step = first / max(n, 1)
            mean, spread = mean + step, np.sqrt(max(second / max(n, 1) - step * step, 0.0))


def _source_mask(frame: Frame, sources: Reference, noise: float) -> Bool:
    """Pixels in which a known source may be visible."""
    ny, nx = frame.electrons.shape
    out = np.zeros((ny, nx), bool)
    if not len(sources.x):
        return out
    width = float(frame.header["PSFFWHM"])
    radius = np.cbrt(_WING * np.maximum(sources.expected, 0.0) * frame.scale**2 / (_VISIBLE_FRACTION * noise))
    radius = np.maximum(radius * np.where(sources.point, 1.0, _GALAXY_WIDENING), max(2.0 * width, _MIN_RADIUS))
    # Sources that are invisible even at their peak are not masked: their light is part of the noise of the sky.
    radius[sources.expected * frame.scale**2 < _VISIBLE_FRACTION * noise * width**2] = 0.0
    masks.mark_discs(sources.x, sources.y, np.minimum(radius / frame.scale, _MAX_RADIUS), out)
    return out


def variance(tiles: Tiles) -> tuple[float, float]:
    """Return the variance of a blank pixel around the mean of its tile (e-^2), and its standard error."""
    blank = tiles.blank
    n = blank.sum(axis=(1, 2))
    off = np.where(blank, tiles.pixels - tiles.level[:, None, None], 0.0).astype(float)
    tile_variance = (off**2).sum(axis=(1, 2)) / (n - 1)
    weight = n / n.sum()
    value = float((weight * tile_variance).sum())
    # The error is from the scatter of the tiles.
    error = float(np.sqrt((weight**2 * (tile_variance - value) ** 2).sum())) if len(n) > 1 else np.inf
    return value, error
