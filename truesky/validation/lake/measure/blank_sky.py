"""Measure the level and the noise of blank sky (pixels without known sources) in square tiles of a frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lake_schema.arrays import Array, Bool, Float, Int
from truesky.numerics.compiling import exact_jit
from truesky.validation.lake.measure import masks
from truesky.validation.lake.measure.frames import Amplifier, Frame
from truesky.validation.lake.measure.references import Reference

# Side of a square tile, pixels.
SIDE = 64
# On large detectors (more pixels than _LARGE), only every n-th tile along rows and along columns is measured.
TILE_STEP = 2
# A detector is large if it has more pixels than this number.
_LARGE = 2 << 20
# Wings of a point source: surface brightness per arcsec^2 at r arcsec is this number times the flux / r^3, as for a
# telescope with central obscuration and three bars.
_WING = 9.3e-3
# A pixel is not blank if a known source may contribute more than this fraction of the pixel's noise.
_VISIBLE_FRACTION = 0.1
# Radius of the masked disc around a galaxy, divided by that of a point source with the same light.
_GALAXY_WIDENING = 1.5
# Smallest radius of the masked disc around a visible source, arcsec. It is also at least twice the FWHM of the PSF.
_MIN_RADIUS = 1.0
# Largest radius of the masked disc around a source, pixels.
_MAX_RADIUS = 400
# A pixel is an outlier if it differs from the mean of its tile by more than this number of standard deviations.
_CLIP = 5.0
# Tiles with fewer pixels of blank sky than this number are not used.
_MIN_PIXELS = 400
# The first estimate of the sky level of a tile uses every n-th pixel along rows and along columns.
_SAMPLE_STEP = 4
# A pixel without a known source counts as hit by a cosmic ray if it is at least this number of standard deviations
# above the mean of its tile.
_HIT = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class Tiles:
    """Square tiles of 64 x 64 pixels of a frame, with masks of blank sky and of cosmic rays.

    Attributes
    ----------
    pixels : float32 array, shape (t, 64, 64)
        Pixels of the t tiles, e-.
    blank : bool array, shape (t, 64, 64)
        True for pixels of blank sky: without a known source, neither an outlier nor next to one, and read out.
    hit : bool array, shape (t, 64, 64)
        True for pixels without a known source that are far above the level of their tile (cosmic rays).
    row, column : int array, shape (t,)
        Row and column of each tile's first pixel in the frame, from 0.
    """

    pixels: Array
    blank: Bool
    hit: Bool
    row: Int
    column: Int

    @property
    def level(self) -> Float:
        """Return the mean of the blank pixels of each tile in e-, shape (t,); NaN for a tile without blank pixels."""
        return np.asarray((self.pixels * self.blank).sum(axis=(1, 2)) / self.blank.sum(axis=(1, 2)))

    def in_amplifier(self, amplifier: Amplifier) -> Tiles:
        """Return only the tiles whose pixels are all read by the given amplifier."""
        rows, columns = amplifier.pixels
        return self.select((self.row >= rows.start) & (self.row + SIDE <= rows.stop)
                          & (self.column >= columns.start) & (self.column + SIDE <= columns.stop))  # fmt: skip

    def select(self, mask: Bool) -> Tiles:
        """Return only the tiles for which `mask`, shape (t,), is True."""
        return Tiles(self.pixels[mask], self.blank[mask], self.hit[mask], self.row[mask], self.column[mask])


def rough_noise(frame: Frame) -> float:
    """Return the rms noise of a pixel of blank sky in e-, from differences between adjacent pixels.

    It is computed from the quartiles of these differences, so sources and cosmic rays hardly matter.
    """
    sample = frame.electrons[5::37, :].astype(float)
    step = np.diff(sample, axis=1).ravel()
    low, high = np.percentile(step, [25.0, 75.0])
    return float((high - low) / 1.349 / np.sqrt(2.0))


def tiles(frame: Frame, sources: Reference, noise: float, tile_step: int | None = None) -> Tiles:
    """Divide a frame into square tiles, and find their pixels of blank sky and their cosmic rays.

    Parameters
    ----------
    frame : Frame
        Raw frame in electrons, at least 64 x 64 pixels.
    sources : Reference
        Known sources of the frame.
    noise : float
        rms noise of a pixel of blank sky, e-.
    tile_step : int, optional
        Only every n-th tile along rows and columns is used. The default is 2 for detectors of more than 2 million
        pixels, otherwise 1.

    Returns
    -------
    Tiles
        Tiles with at least 400 pixels of blank sky; there may be none.
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
    """Return a mask of the tiles' pixels that are not blank sky.

    These are sources (`hidden`), outliers and their neighbours, and pixels that were not read out, whose value is 0.
    """
    bad = hidden | (pixels == 0.0)
    # Estimate the level of each tile by the median of every 16th pixel: sources cover only a small part of most tiles.
    sample = pixels[:, ::_SAMPLE_STEP, ::_SAMPLE_STEP]
    middle = np.median(np.where(bad[:, ::_SAMPLE_STEP, ::_SAMPLE_STEP], np.median(sample), sample), axis=(1, 2))
    out = np.empty(pixels.shape, bool)
    _mark_outliers(pixels, bad, middle, noise, out)
    return np.asarray(bad | out | masks.dilate(out & ~hidden, corners=True))


@exact_jit
def _mark_outliers(pixels: Array, bad: Bool, middle: Float, noise: float, out: Bool) -> None:
    """Set `out` to True for pixels that differ from the mean of their tile by more than 5 standard deviations.

    `pixels`, `bad` and `out` have the shape (t, ny, nx). Mean and standard deviation are computed from the pixels that
    are neither `bad` nor outliers, in three iterations. They start from the levels `middle`, shape (t,), and the rms
    `noise`, all in e-.
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
            # The sums are relative to the previous mean, which is near the new mean, so rounding errors are small.
            step = first / max(n, 1)
            mean, spread = mean + step, np.sqrt(max(second / max(n, 1) - step * step, 0.0))


def _source_mask(frame: Frame, sources: Reference, noise: float) -> Bool:
    """Return a mask of a frame's pixels to which a known source may contribute more than a tenth of the noise."""
    ny, nx = frame.electrons.shape
    out = np.zeros((ny, nx), bool)
    if not len(sources.x):
        return out
    width = float(frame.header["PSFFWHM"])
    radius = np.cbrt(_WING * np.maximum(sources.expected, 0.0) * frame.scale**2 / (_VISIBLE_FRACTION * noise))
    radius = np.maximum(radius * np.where(sources.point, 1.0, _GALAXY_WIDENING), max(2.0 * width, _MIN_RADIUS))
    # Do not mask sources whose peak is below a tenth of the noise: their light counts as part of the sky.
    radius[sources.expected * frame.scale**2 < _VISIBLE_FRACTION * noise * width**2] = 0.0
    masks.mark_discs(sources.x, sources.y, np.minimum(radius / frame.scale, _MAX_RADIUS), out)
    return out


def variance(tiles: Tiles) -> tuple[float, float]:
    """Return the variance of blank pixels around the mean of their tile in e-^2, and its standard error.

    The variance is averaged over the tiles, weighted by their numbers of blank pixels. With a single tile the error is
    infinite.
    """
    blank = tiles.blank
    n = blank.sum(axis=(1, 2))
    off = np.where(blank, tiles.pixels - tiles.level[:, None, None], 0.0).astype(float)
    tile_variance = (off**2).sum(axis=(1, 2)) / (n - 1)
    weight = n / n.sum()
    value = float((weight * tile_variance).sum())
    # Standard error from the scatter of the variance between tiles.
    error = float(np.sqrt((weight**2 * (tile_variance - value) ** 2).sum())) if len(n) > 1 else np.inf
    return value, error
