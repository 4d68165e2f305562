"""Add sources to the pixels of a frame: light, its Poisson noise, weights and flags of saturated pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Array, Bool, Float
from truesky.randomness import rng
from truesky.render.injection.calibration import Calibration
from truesky.render.injection.source_light import draw_source
from truesky.render.psf.model import Psf
from truesky.render.sources.source_list import Sources

# Mean number of electrons in a pixel up to which numpy can draw from a Poisson distribution.
_MAX_MEAN = 1e18


@dataclass(frozen=True, slots=True)
class FramePixels:
    """Pixels of a frame.

    Attributes
    ----------
    image : float array, shape (ny, nx)
        Image, counts. NaN for missing pixels.
    weight : float array, shape (ny, nx), or None
        Inverse variance of the pixels, 1 / counts^2; 0 for bad pixels.
    flags : int array, shape (ny, nx), or None
        Flag bits of the pixels.
    """

    image: Array
    weight: Array | None
    flags: Array | None


def add_sources(
    pixels: FramePixels,
    sources: Sources,
    identities: Sequence[tuple[str, int]],
    psf: Psf,
    calibration: Calibration,
    seed: int,
    noise: bool,
    saturated_flag: int,
) -> tuple[FramePixels, Float]:
    """Add the light of sources to the pixels of a frame.

    Parameters
    ----------
    pixels : FramePixels
        The frame, which is not changed.
    sources : Sources
        n sources at rest, with the electrons that they add to the frame.
    identities : sequence of (str, int)
        Kind and number of each source. The noise of a source depends on them and on `seed`, but not on other sources.
    psf : Psf
        PSF of the frame.
    calibration : Calibration
        Gain and saturation of the frame.
    seed : int
        Seed of the noise.
    noise : bool
        True to add Poisson noise of the light. The variances that belong to the weights then increase by the variance
        of the added light.
    saturated_flag : int
        Flag bit that is set in pixels that become saturated.

    Returns
    -------
    (FramePixels, float array of shape (n,))
        The new frame, and the counts that each source added to it.

    Notes
    -----
    Saturated pixels, and missing ones, are not changed. A pixel that becomes saturated gets the saturation level.
    """
    ny, nx = pixels.image.shape
    added, drawn = np.zeros((ny, nx)), np.zeros(len(sources))
    expected = np.zeros((ny, nx)) if noise and pixels.weight is not None else None
    touched = _Touched()
    for i, (kind, number) in enumerate(identities):
        light = draw_source(sources.take(np.array([i])), psf, nx, ny)
        if light is None:
            continue
        place, electrons = light.slices, light.electrons
        touched.add(place)
        if expected is not None:
            expected[place] += np.maximum(electrons, 0.0)
        if noise:
            electrons = _with_noise(electrons, rng.stream(seed, "injection.noise", kind, number))
        counts = electrons / calibration.gain
        added[place] += counts
        drawn[i] = np.sum(counts, where=_usable(pixels.image[place], calibration))
    return _add_light(pixels, added, expected, touched.slices, calibration, saturated_flag), drawn


def _usable(image: Array, calibration: Calibration) -> Bool:
    """Return True for the pixels of an image that are neither missing nor saturated."""
    return np.isfinite(image) & (image < calibration.saturation)


class _Touched:
    """Rectangle about all parts of a frame that sources have reached."""

    def __init__(self) -> None:
        self._edges: tuple[int, int, int, int] | None = None

    def add(self, place: tuple[slice, slice]) -> None:
        """Enlarge the rectangle by the rows and columns `place`."""
        rows, columns = place
        edges = rows.start, columns.start, rows.stop, columns.stop
        old = self._edges or edges
        self._edges = min(old[0], edges[0]), min(old[1], edges[1]), max(old[2], edges[2]), max(old[3], edges[3])

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of the rectangle; empty if nothing was added."""
        edges = self._edges or (0, 0, 0, 0)
        return slice(edges[0], edges[2]), slice(edges[1], edges[3])


def _with_noise(electrons: Float, generator: np.random.Generator) -> Float:
    """Return electrons drawn from Poisson distributions; expected values below 0 (rounding errors) have no noise."""
    mean = np.clip(electrons, 0.0, _MAX_MEAN)
    return np.asarray(generator.poisson(mean) + (electrons - mean))


def _add_light(
    pixels: FramePixels,
    added: Float,
    expected: Float | None,
    place: tuple[slice, slice],
    calibration: Calibration,
    saturated_flag: int,
) -> FramePixels:
    """Return the frame with `added` counts, and with the variance of `expected` electrons, in the rectangle `place`."""
    image, weight, flags = pixels.image.copy(), pixels.weight, pixels.flags
    old = pixels.image[place]
    good = _usable(old, calibration)
    with np.errstate(invalid="ignore"):
        new = np.where(good, old + added[place], old)
    is_full = good & (new >= calibration.saturation)
    image[place] = np.where(is_full, calibration.saturation, new)
    if weight is not None and expected is not None:
        weight = weight.copy()
        old = weight[place].astype(float)
        variance = np.where(good, expected[place], 0.0) / calibration.gain**2
        weight[place] = np.where(good, old / (1.0 + old * variance), old)
    if flags is not None and is_full.any():
        flags = flags.copy()
        flags[place] |= np.where(is_full, flags.dtype.type(saturated_flag), flags.dtype.type(0))
    return FramePixels(image, weight, flags)
