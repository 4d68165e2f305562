"""A rendered detector before it is files.

numbers_of      whose random numbers an effect takes
"""

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
    """One detector's products before they are files.

    readout    : the arrays of its file
    maps       : truth [ny, nx] by its name: noise_free, and what was asked for besides
    sources    : what was drawn, ascending id: those with light of their stamps on pixels that are read, and stars whose
                 spikes may be noticed
    sizes      : int[n] sides of their stamps;  drawn : float64[n] electrons of each stamp on the detector
    zero_point : AB magnitude of one electron per second
    complete   : how far beyond the detector every source was known that may reach it, arcsec
    noise_seed : of the noise, None = the seed
    spectra    : columns of the table `rendered_spectra`; None where nothing is dispersed
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
        """The arrays as they are read, with pre- and overscan, in readout order."""
        return self.readout.raw

    @property
    def science(self) -> Array:
        """[ny, nx] the pixels alone, in the detector's own axes, as they are read."""
        return self.readout.pixels

    @property
    def noise_free(self) -> Float32:
        """float32[ny, nx] expected electrons of the sources alone."""
        return self.maps["noise_free"]


def random_identity(
    effect: Effect, exposure: ExposureRow, detector: str, seed: int, noise_seed: int | None = None
) -> tuple[int | str, ...]:
    """The identity of an effect's random numbers: nobody else's, but where it follows another's pattern.

    A detector's own patterns are in every exposure, and of the seed whatever the noise is of.
    noise_seed : of the noise, None = the seed
    effect, exposure, detector, seed : what is applied, in which exposure, to which detector, of which request
    """
    scope = exposure.camera if effect.fixed else image_types.identity(exposure)
    effect_seed = seed if effect.fixed or noise_seed is None else noise_seed
    return effect_seed, scope, "" if effect.shared else detector, effect.random_stream or effect.name
