"""Hold the products of one rendered detector before they are written to files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from astropy.wcs import WCS

from lake_schema.arrays import Array, Float, Float32, Int
from lake_schema.tables.exposures import ExposureRow
from truesky.render.camera.detectors import Detector
from truesky.render.channels import image_types
from truesky.render.channels.readout import Readout
from truesky.render.effects.effect import Decision, Effect
from truesky.render.effects.scene import Scene
from truesky.render.psf.model import Psf
from truesky.render.sources.source_list import Sources
from truesky.request.accuracy import Accuracy


@dataclass(frozen=True, slots=True)
class RenderedDetector:
    """Products of one detector.

    Attributes
    ----------
    exposure : ExposureRow
        Row of the exposure.
    detector : Detector
        Detector.
    wcs : WCS
        World coordinates of the detector.
    psf : Psf or None
        PSF of the detector. None without light of the sky.
    readout : Readout
        Arrays of the detector's file.
    maps : mapping of str to array
        Truth maps (ny, nx) by name: noise_free and the requested maps.
    sources : Sources
        Drawn sources by ascending identifier, with light of their stamps on pixels that are read; also stars whose
        spikes may be noticeable.
    sizes : int array, shape (n,)
        Sides of their stamps in pixels.
    drawn_electrons : float64 array, shape (n,)
        Electrons of each stamp on the detector.
    zero_point : float
        AB magnitude of one electron per second.
    scene : Scene
        Scene with the brightest pixel.
    decisions : tuple of Decision
        Decisions on effects.
    accuracy : Accuracy
        Accuracy of the request.
    seed : int
        Seed of the request.
    complete_margin_arcsec : float
        Distance beyond the detector up to which all sources were known, in arcsec.
    noise_seed : int, optional
        Seed of the noise, by default `seed`.
    spectra : mapping, optional
        Columns of the table `rendered_spectra`. None without a grism.
    """

    exposure: ExposureRow
    detector: Detector
    wcs: WCS
    psf: Psf | None
    readout: Readout
    maps: Mapping[str, Array]
    sources: Sources
    sizes: Int
    drawn_electrons: Float
    zero_point: float
    scene: Scene
    decisions: tuple[Decision, ...]
    accuracy: Accuracy
    seed: int
    complete_margin_arcsec: float
    noise_seed: int | None = None
    spectra: Mapping[str, Any] | None = None

    @property
    def raw(self) -> Array:
        """Pixel values in readout order, with prescan and overscan."""
        return self.readout.raw

    @property
    def science(self) -> Array:
        """Pixel values in detector axes without prescan and overscan, shape (ny, nx)."""
        return self.readout.pixels

    @property
    def noise_free(self) -> Float32:
        """Expected electrons of the sources alone, float32[ny, nx]."""
        return self.maps["noise_free"]


def random_identity(
    effect: Effect, exposure: ExposureRow, detector: str, seed: int, noise_seed: int | None = None
) -> tuple[int | str, ...]:
    """Identity of the random numbers of an effect.

    Parameters
    ----------
    effect : Effect
        Effect.
    exposure : ExposureRow
        Exposure.
    detector : str
        Name of the detector.
    seed : int
        Seed of the request.
    noise_seed : int, optional
        Seed of the noise, by default `seed`.

    Returns
    -------
    tuple of int or str
        Identity for `rng.stream`. It is unique except for effects that share a stream, see `Effect.random_stream`.

    Notes
    -----
    Fixed patterns of a detector are the same in every exposure, and depend on `seed` even if the noise has another
    seed.
    """
    scope = exposure.camera if effect.fixed else image_types.identity(exposure)
    effect_seed = seed if effect.fixed or noise_seed is None else noise_seed
    return effect_seed, scope, "" if effect.shared else detector, effect.random_stream or effect.name
