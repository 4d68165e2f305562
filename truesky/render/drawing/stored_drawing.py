"""Keep the drawn sources of a detector, so that only additional ones are drawn when it is rendered again."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from lake_schema.arrays import Bool, Float, Int
from truesky.render.drawing import stamps
from truesky.render.drawing.drawn_units import DrawnUnits
from truesky.render.drawing.stamps import Tally
from truesky.render.psf.model import Psf
from truesky.render.sources.source_list import Sources

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class _Drawn:
    """Sources that were drawn, in order, with properties on which their light depends."""

    ids: Int
    properties: tuple[Float, ...]
    response: float | None
    drawn_electrons: Float
    light: DrawnUnits


@dataclass(slots=True)
class DrawingStore:
    """Light of the sources that were drawn on one detector of one exposure of one lake, with one accuracy.

    The light of a source does not depend on other sources, and the sum is exact. An image with additional sources is
    therefore the same, bit by bit, whether all sources are drawn or only the additional ones. A store has 8 bytes per
    pixel of the detector, and what `keep` holds.

    Attributes
    ----------
    is_additional : callable
        Function that returns, for an array of identifiers, the mask of the sources that are drawn in every call.
    """

    is_additional: Callable[[Int], Bool]
    _key: object = field(default=None, repr=False)
    _drawn: _Drawn | None = field(default=None, repr=False)
    _kept: dict[Hashable, Any] = field(default_factory=dict, repr=False)

    def keep(self, key: Hashable, compute: Callable[[], _T]) -> _T:
        """Return what `compute` returned when it was first called for this key.

        The key contains everything that may differ between images with and without additional sources.
        """
        if key not in self._kept:
            self._kept[key] = compute()
        result: _T = self._kept[key]
        return result

    def check(self, key: object) -> None:
        """Raise ValueError unless `key` (exposure, detector and accuracy) equals the key of the first call."""
        if self._key is None:
            self._key = key
        if key != self._key:
            raise ValueError("a drawing store is for one detector of one exposure, with one accuracy")

    def draw(
        self,
        sources: Sources,
        sizes: Int,
        psf: Psf,
        shape: tuple[int, int],
        progress: Callable[[int], None] | None,
        neglected: Float,
        tally: Tally,
    ) -> Float:
        """Draw sources as `stamps.draw` does. Sources of the first call that are not additional are drawn only once.

        Parameters
        ----------
        sources : Sources
            Sources to be drawn.
        sizes : int array, shape (n,)
            Sides of the sources' stamps, pixels.
        psf : Psf
            PSF of the detector.
        shape : (int, int)
            Number of columns and of rows of the detector.
        progress, neglected, tally
            As for `stamps.draw`.

        Returns
        -------
        float array, shape (ny, nx)
            Expected electrons.
        """
        none = np.zeros((len(sources), 0))
        properties = (
            sources.column, sources.row, sources.electrons, sources.jacobian, sizes.astype(float), neglected,
            none if sources.trail is None else sources.trail, none if sources.photons is None else sources.photons,
        )  # fmt: skip
        new, unit = self.is_additional(sources.ids), stamps.unit_for(sources)
        if self._drawn is None:
            drawn_electrons = np.zeros(int(np.sum(~new)))
            light = stamps.draw_in_units(
                sources.take(~new), sizes[~new], psf, shape, progress, neglected[~new],
                Tally(drawn_electrons, tally.unread_rows), unit,
            )  # fmt: skip
            drawn_properties = tuple(values[~new] for values in properties)
            self._drawn = _Drawn(sources.ids[~new], drawn_properties, psf.intra_pixel, drawn_electrons, light)
        elif not self._has_drawn(sources.ids[~new], [values[~new] for values in properties], psf, unit):
            return stamps.draw(sources, sizes, psf, *shape, progress, neglected, tally)
        added = np.zeros(int(new.sum()))
        light = stamps.draw_in_units(
            sources.take(new), sizes[new], psf, shape, progress, neglected[new],
            Tally(added, tally.unread_rows), unit,
        )  # fmt: skip
        tally.electrons[~new], tally.electrons[new] = self._drawn.drawn_electrons, added
        return self._drawn.light.electrons_with(light)

    def _has_drawn(self, ids: Int, properties: Sequence[Float], psf: Psf, unit: float) -> bool:
        """Return True if exactly these sources were drawn. A very bright additional source needs another unit."""
        assert self._drawn is not None
        return (
            np.array_equal(ids, self._drawn.ids)
            and all(map(np.array_equal, properties, self._drawn.properties))
            and (psf.intra_pixel, unit) == (self._drawn.response, self._drawn.light.unit)
        )
