"""Draw the light of one source on the part of a frame that it reaches, independently of all other sources."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lake_schema.arrays import Float
from truesky.render.drawing import stamp_sizes, stamps, wings
from truesky.render.drawing.settings import Settings, settings_for
from truesky.render.injection.frame_psf import image_side, psf_at
from truesky.render.psf.model import Psf
from truesky.render.sources.source_list import Sources
from truesky.request.accuracy import REFERENCE

# Light below this number of electrons per pixel is neglected at the edge of a stamp (square image of a source); for
# faint sources, light below this fraction of their electrons.
_NEGLIGIBLE_ELECTRONS, _NEGLIGIBLE_FRACTION = 1.0, 1e-5


@dataclass(frozen=True, slots=True)
class SourceLight:
    """Light of a source on a rectangle of a frame.

    Attributes
    ----------
    column, row : int
        Column and row of the frame at which the rectangle begins, from 0.
    electrons : float array, shape (rows, columns)
        Expected electrons per pixel.
    """

    column: int
    row: int
    electrons: Float

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of the rectangle, as an index of the frame."""
        rows, columns = self.electrons.shape
        return slice(self.row, self.row + rows), slice(self.column, self.column + columns)


def draw_source(source: Sources, psf: Psf, nx: int, ny: int) -> SourceLight | None:
    """Draw the expected electrons of one source on a frame.

    Parameters
    ----------
    source : Sources
        One source at rest; its position is a pixel of the frame.
    psf : Psf
        PSF of the frame.
    nx, ny : int
        Number of columns and rows of the frame.

    Returns
    -------
    SourceLight or None
        The light, or None if none of it reaches the frame.
    """
    settings = settings_for(REFERENCE)
    noise = min(_NEGLIGIBLE_ELECTRONS, _NEGLIGIBLE_FRACTION * max(float(source.electrons[0]), 1e-300))
    size = _stamp_size(source, psf, noise, settings)
    half = size / 2
    if source.shape[0] >= 0:
        light_reach, _ = stamp_sizes.light_beyond_stamps(
            source.shapes.take(source.shape), np.array([size]), psf.pixel_scale
        )
        half = max(half, float(light_reach[0]))
    # The light of a galaxy that exceeds the largest stamp may reach the whole frame.
    reach = float(nx + ny) if stamp_sizes.on_largest(source.shape, np.array([size]))[0] else half
    reach = 0.5 * float(wings.region_side(np.array(2.0 * reach))) + 1.0
    x, y = float(source.column[0]), float(source.row[0])
    first_x, first_y = max(int(np.floor(x - reach)), 0), max(int(np.floor(y - reach)), 0)
    columns = min(int(np.ceil(x + reach)) + 1, nx) - first_x
    rows = min(int(np.ceil(y + reach)) + 1, ny) - first_y
    if columns <= 0 or rows <= 0:
        return None
    local = psf_at(psf, x, y)
    moved = replace(source, column=source.column - first_x, row=source.row - first_y)
    neglected = stamp_sizes.neglected_flux(source.electrons, noise, settings)
    light = stamps.draw(moved, np.array([size]), local, columns, rows, None, neglected)
    return SourceLight(first_x, first_y, light)


def _stamp_size(source: Sources, psf: Psf, noise: float, settings: Settings) -> int:
    """Return the side of the stamp of a source, pixels, which includes the whole image of the PSF."""
    sizes = stamp_sizes.stamp_sizes(source.electrons, source.shape, source.shapes, psf, noise, settings)
    sizes = stamp_sizes.smallest_allowed_sizes(sizes, np.array([float(min(image_side(psf), psf.side))]))
    return int(sizes[0])
