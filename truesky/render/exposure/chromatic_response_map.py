"""Compute the light of sources weighted by colour, for detectors with a chromatic response."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lake_schema.arrays import Float
from truesky.render.channels.aim import Aim
from truesky.render.dispersing import draw as dispersing
from truesky.render.drawing import stamp_sizes, stamps
from truesky.render.drawing.settings import settings_for
from truesky.render.effects.light import chromatic_response
from truesky.render.effects.scene import NOTICEABLE, Frame, Scene
from truesky.render.exposure import visible_sources
from truesky.render.exposure.visible_sources import Light
from truesky.render.psf.model import Psf, reduce_colours

# Number of colours of the PSF at the detector's centre, and fraction of a source's light that may be aliased or left
# out in its stamp. The change of a pixel is only a hundredth of the light.
_COLOURS, _PART = 4, 1e-2


def with_chromatic_light(scene: Scene, aim: Aim, light: Light) -> Scene:
    """Add the light of sources whose colour changes a pixel noticeably to a scene.

    Parameters
    ----------
    scene : Scene
        Scene with the brightest pixel of the drawn sources.
    aim : Aim
        Exposure and detector.
    light : Light
        Light on the detector.

    Returns
    -------
    Scene
        Scene with `chromatic_light` and `chromatic_electrons`.

    Notes
    -----
    The error is 3 % of the change of a pixel, because the PSF at the detector's centre is used. If the accuracy uses a
    PSF of one colour, the colours of sources are not known and change nothing.
    """
    sources, psf = light.sources, light.psf
    if _is_inactive(scene, aim) or psf is None or sources.photons is None or not len(sources):
        return scene
    components = chromatic_response.sub_band_components(scene.section, aim.band, scene.mission)
    source_colours = chromatic_response.source_colours(sources.photons, components)
    peak_fraction = _peak_fraction(psf)
    change = chromatic_response.colour_changes(
        sources.electrons * peak_fraction, source_colours, components, chromatic_response.map_strength(scene)
    )
    is_chosen = visible_sources.touches_detector(sources, light.sizes, aim.detector) & (
        change > NOTICEABLE * scene.pixel_noise
    )
    if not is_chosen.any():
        return scene
    chosen, shares, change = sources.take(is_chosen), sources.photons[is_chosen], change[is_chosen]
    settings = replace(settings_for(scene.accuracy), edge=NOTICEABLE, aliased=_PART, floor=_PART)
    noise = scene.pixel_noise
    sizes = stamp_sizes.stamp_sizes(change / peak_fraction, chosen.shape, chosen.shapes, psf, noise, settings)
    # Stamps of pictures and trails cannot be smaller.
    is_extended = (chosen.trail_length > 0.0) | (
        np.zeros(len(chosen), bool) if chosen.picture is None else chosen.picture >= 0
    )
    sizes = np.where(is_extended, light.sizes[is_chosen], np.minimum(sizes, light.sizes[is_chosen]))
    neglected, central_psf = stamp_sizes.neglected_flux(change / peak_fraction, noise, settings), _central_psf(psf)

    def draw(electrons: Float, photons: Float) -> Frame:
        weighted_sources = replace(chosen, electrons=electrons, photons=photons)
        return stamps.draw(weighted_sources, sizes, central_psf, aim.detector.nx, aim.detector.ny, None, neglected)

    drawn = chromatic_response.weighted_light(chosen.electrons, shares, components, draw)
    return replace(scene, chromatic_light=drawn, chromatic_electrons=float(change.max()))


def with_dispersed_light(
    scene: Scene, aim: Aim, light: Light, tally: dispersing.Tally, planes_cache: dispersing.PlanesCache
) -> Scene:
    """Add the spectra of sources for which the colour of a column changes a pixel noticeably to a scene.

    Parameters
    ----------
    scene : Scene
        Scene with the brightest pixel of the drawn sources.
    aim : Aim
        Exposure and detector.
    light : Light
        Dispersed light on the detector.
    tally : Tally
        Light of each source that was drawn.
    planes_cache : dict
        Images of the PSF that several drawings share.

    Returns
    -------
    Scene
        Scene with `chromatic_light` and `chromatic_electrons`.

    Notes
    -----
    The light that is left out of the stamps of a source is at most a tenth of a pixel's noise.
    """
    dispersed, psf = light.dispersed, light.psf
    if _is_inactive(scene, aim) or psf is None or dispersed is None or not len(light.sources):
        return scene
    f = chromatic_response.component_spectra(scene.section, dispersed.orders[0].wavelength, aim.band, scene.mission)
    largest = float(np.hypot(*(f * np.array(chromatic_response.map_strength(scene))).T).max())
    change = tally.peak.max(axis=1) * _peak_fraction(psf, of_rows=True) * largest
    (indices,) = np.nonzero(change > NOTICEABLE * scene.pixel_noise)
    if not len(indices):
        return scene
    chosen, shape = light.sources.take(indices), (aim.detector.ny, aim.detector.nx)
    # Only light whose colour changes a pixel by less than is noticeable is left out.
    settings = replace(dispersed.settings, edge=0.5 * NOTICEABLE / largest, faint=0.5 * NOTICEABLE / largest)

    def draw(weight: Float) -> Frame:
        """Return the light with each photon multiplied by a weight, shape (w,)."""
        orders = tuple(replace(order, response=order.response * weight) for order in dispersed.orders)
        weighted_spectra = dispersing.DispersedSources(lambda rows: dispersed.spectra(indices[rows]), orders, settings)
        return dispersing.draw(chosen, weighted_spectra, psf, shape, scene.pixel_noise, None, None, planes_cache)

    light_maps = np.stack([draw(component).astype(np.float32) for component in f.T])
    return replace(scene, chromatic_light=light_maps, chromatic_electrons=float(change.max()))


def _is_inactive(scene: Scene, aim: Aim) -> bool:
    """Return True if the channel or the image type has no chromatic response map, or if the request switches it off."""
    effect = aim.channel.chromatic_effect
    return effect is None or effect not in aim.effects or not scene.forced.get(effect.name, True)


def _peak_fraction(psf: Psf, *, of_rows: bool = False) -> float:
    """Return the largest fraction of a point's light in one pixel, or in one row, in any colour."""
    if psf.planes is None:
        return 1.0
    images, samples = psf.planes.images, psf.planes.samples
    first = images.shape[1] // 2 - samples // 2
    core = slice(first, first + samples)
    across = slice(None) if of_rows else core
    return min(float(images[:, core, across].sum(axis=(1, 2)).max()), 1.0)


def _central_psf(psf: Psf) -> Psf:
    """Return the PSF at the detector's centre with few colours and without spikes beyond its planes."""
    if psf.planes is None:
        return psf
    planes = replace(psf.planes, drift=psf.planes.drift[:0], powers=())
    few = min(_COLOURS, len(planes.wavelength))
    return reduce_colours(replace(psf, planes=planes, edges=None), few)
