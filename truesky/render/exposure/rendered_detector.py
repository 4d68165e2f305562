"""Data class with the simulated image of one detector and its truth, before they are written to files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from astropy.wcs import WCS


@dataclass(frozen=True, slots=True)
class RenderedDetector:
    """Simulated image of one detector in one exposure, with everything that its files contain.

    Attributes
    ----------
    exposure : ExposureRow
        Row of the table `exposures`.
    detector : Detector
        The detector.
    wcs : WCS
        World coordinate system of the detector.
    psf : Psf or None
        PSF of the detector. None if the image has no light of the sky.
    readout : Readout
        Result of the readout: arrays of the detector's file.
    maps : mapping of str to array
        Truth maps (ny, nx) by name: `noise_free` and the requested maps.
    sources : Sources
        The n drawn sources by ascending identifier. Their stamps (square images around them) have light on pixels that
        are read. Stars are also included if their diffraction spikes may be noticeable.
    sizes : int array, shape (n,)
        Sides of the sources' stamps, pixels.
    drawn_electrons : float64 array, shape (n,)
        Electrons of each source's stamp on pixels that are read.
    zero_point : float
        AB magnitude of a source of one electron per second.
    scene : Scene
        Properties of the exposure on which effects depend, with the brightest pixel of the drawn image.
    decisions : tuple of Decision
        For each detector effect, whether it was applied.
    accuracy : Accuracy
        Errors that the request accepts.
    seed : int
        Seed of the request.
    complete_margin_arcsec : float
        Distance beyond the detector up to which all sources were known, arcsec.
    noise_seed : int, optional
        Seed of the noise; None if it was `seed`.
    spectra : mapping, optional
        Columns of the table `rendered_spectra`, by name. None without a grism.
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
        """Raw pixel values after the last effect, in the order in which they are read, with prescan and overscan."""
        return self.readout.raw

    @property
    def science(self) -> Array:
        """Pixel values in the axes of the detector, without prescan and overscan, shape (ny, nx)."""
        return self.readout.pixels

    @property
    def noise_free(self) -> Float32:
        """Expected electrons of the sources alone, without sky, noise and detector effects, float32[ny, nx]."""
        return self.maps["noise_free"]


def random_identity(
    effect: Effect, exposure: ExposureRow, detector: str, seed: int, noise_seed: int | None = None
) -> tuple[int | str, ...]:
    """Return the identity from which the random numbers of a detector effect are drawn.

    Equal identities give equal random numbers, on any machine and in any order.

    Parameters
    ----------
    effect : Effect
        The effect.
    exposure : ExposureRow
        Row of the table `exposures`.
    detector : str
        Name of the detector.
    seed : int
        Seed of the request.
    noise_seed : int, optional
        Seed of random numbers that differ between exposures, by default `seed`.

    Returns
    -------
    tuple of int or str
        Arguments of `rng.stream`. They differ between effects, unless two effects use the same random numbers
        (`Effect.random_stream`).

    Notes
    -----
    An effect with `fixed` True (a fixed pattern of the detector) has the same identity in every exposure of the camera,
    and always depends on `seed`. An effect with `shared` True has the same identity in all detectors.
    """
    scope = exposure.camera if effect.fixed else image_types.identity(exposure)
    effect_seed = seed if effect.fixed or noise_seed is None else noise_seed
    return effect_seed, scope, "" if effect.shared else detector, effect.random_stream or effect.name
