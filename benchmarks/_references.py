"""galsim's own drawing at its tightest thresholds, kept in the cache: slow, and the same every time."""

from __future__ import annotations

from dataclasses import fields

import galsim
import numpy as np
import numpy.typing as npt

from jobs import cache
from jobs.render import psf, stamps
from jobs.render.stamps import Sources

Float = npt.NDArray[np.float64]
# Thresholds of folding and of the largest frequency.
ACCURACY = 1e-4


def image(one: Sources, spread: psf.Psf, side: int, highest: float = ACCURACY) -> Float | None:
    """The only source, through a PSF that is its own, on a frame [side, side]; None where memory does not suffice.

    highest : threshold of the largest frequency
    """
    shapes = one.shapes.take(one.shape)
    seen = [
        one.column,
        one.row,
        one.jacobian,
        one.electrons,
        *(getattr(shapes, field.name) for field in fields(shapes)),
    ]
    through = [repr(spread.profile)] if spread.planes is None else ["Lanczos 31", spread.planes.images]
    key = cache.content_key(
        galsim.__version__, highest, side, spread.pixel_scale, spread.intra_pixel, *seen, *through
    )  # fmt: skip

    def make() -> dict[str, Float]:
        try:
            return {"image": stamps.reference(one, 0, spread, side, ACCURACY, highest)}
        except (MemoryError, RuntimeError):
            return {"image": np.zeros((0, 0))}

    found = cache.cached_arrays("reference", key, make)["image"]
    return found if found.size else None
