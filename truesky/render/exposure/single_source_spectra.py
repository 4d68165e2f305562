"""Draw the slitless spectra of single sources on a detector, each without all other sources."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lake_schema.arrays import Float, Float32, Int
from lake_schema.errors import BadInput
from truesky.render.channels.aim import Aim
from truesky.render.dispersing import draw
from truesky.render.dispersing.draw import Spectra
from truesky.render.exposure import scene_factory, sky_through_grism
from truesky.render.exposure.records import Rows, Variant
from truesky.render.exposure.visible_spectra import visible_spectra


@dataclass(frozen=True, slots=True)
class SourceSpectrum:
    """Slitless spectrum of one source on a detector, without noise.

    Attributes
    ----------
    id : int
        Identifier of the source.
    frame : float64 array, shape (ny, nx)
        Expected electrons, the sum of all orders.
    orders : dict of int to float64 array, shape (ny, nx)
        Expected electrons of each spectral order of the grism.
    """

    id: int
    frame: Float
    orders: dict[int, Float]


def draw_sources(
    aim: Aim, rows: Rows, variant: Variant, seed: int, ids: Sequence[int] | None = None
) -> Iterator[SourceSpectrum]:
    """Draw the spectra of sources one after the other.

    The float64 frames of all sources add up exactly to the noise-free image of the detector.

    Parameters
    ----------
    aim, rows, variant, seed : Aim, Rows, Variant, int
        Exposure and detector; catalogue rows that may have light on the detector; mission database, accuracy and
        switched effects; and seed of the request. They are the arguments with which `render.render` makes the image.
    ids : sequence of int, optional
        Identifiers of the sources. The default is all sources that may have light on the detector.

    Returns
    -------
    iterator of SourceSpectrum
        The source spectra in the order of `ids`. Each is drawn when the iterator reaches it.

    Raises
    ------
    BadInput
        When the function is called, if the exposure has no spectra or a source has no light on the detector.
    """
    exposure = aim.exposure
    if aim.channel.dispersion is None or not aim.sees_sky:
        description = f"{exposure.channel} {exposure.image_type}"
        raise BadInput(f"exposure {exposure.exposure_id}: {description} is no image of spectra")
    light = visible_spectra(
        aim, rows, sky_through_grism.with_sky_change(scene_factory.from_aim(aim, variant), aim, seed), seed
    )
    sources, dispersed, psf = light.sources, light.dispersed, light.psf
    assert dispersed is not None
    assert psf is not None
    index_of_id = {number: i for i, number in enumerate(sources.ids.tolist())}
    chosen = list(index_of_id) if ids is None else list(ids)
    if missing := [number for number in chosen if number not in index_of_id]:
        where = f"exposure {exposure.exposure_id}, detector {aim.detector.name}"
        raise BadInput(f"{where}: source {missing[0]} has no light on the detector")
    shape, source_spectra = (aim.detector.ny, aim.detector.nx), dispersed.spectra
    planes_cache: draw.PlanesCache = {}
    noise = light.scene.pixel_noise

    def draw_source(number: int) -> SourceSpectrum:
        index = np.array([index_of_id[number]])
        dispersed_source = replace(dispersed, spectra=partial(_spectra_of_rows, source_spectra, index))
        layers: dict[int, Float] = {}
        frame = draw.draw(sources.take(index), dispersed_source, psf, shape, noise, None, layers, planes_cache)
        return SourceSpectrum(number, frame, layers)

    return map(draw_source, chosen)


def _spectra_of_rows(spectra: Spectra, rows: Int, indices: Int) -> Float32:
    return spectra(rows[indices])
