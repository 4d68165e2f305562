"""Compute images of sources weighted by wavelength, for detectors whose pixel response depends on wavelength.

The effect `chromatic_response` changes pixels by a map that depends on the wavelength of the light. It needs images of
the sources in which photons are weighted by functions of wavelength (components of the response).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lake_schema.arrays import Float
from truesky.render.channels.aim import Aim
from truesky.render.dispersing import draw as dispersing
from truesky.render.drawing import stamp_sizes, stamps
from truesky.render.drawing.settings import settings_for
from truesky.render.effects.light import chromatic_response
from truesky.render.effects.scene import Frame, Scene
from truesky.render.exposure import visible_sources
from truesky.render.exposure.visible_sources import Light
from truesky.render.psf.model import Psf, reduce_colours

# Largest number of wavelengths in a passband at which the PSF is used for images in which photons are weighted by
# wavelength.
_COLOURS = 4
# Fraction of a source's light that may be neglected, or moved to wrong pixels because Fourier transforms are periodic
# (aliasing), in an image in which photons are weighted by wavelength. It can be large, since the chromatic response
# changes a pixel by only a hundredth of its light.
_PART = 1e-2


def with_chromatic_light(scene: Scene, aim: Aim, light: Light) -> Scene:
    """Add images of the sources, in which photons are weighted by wavelength, to the scene of a direct image.

    From them the chromatic response is computed: the dependence of each pixel's efficiency on wavelength. Only sources
    whose colour changes a pixel noticeably are drawn.

    Parameters
    ----------
    scene : Scene
        Properties of the exposure, with the brightest pixel of the drawn sources.
    aim : Aim
        Exposure and detector.
    light : Light
        Sources with light on the detector.

    Returns
    -------
    Scene
        Scene with `chromatic_light` (the two weighted images, electrons) and `chromatic_electrons` (the largest change
        of a pixel). It is unchanged if no source has a noticeable effect, if the effect is not applied, or if the PSF
        has only one wavelength, because colours are then not computed.

    Notes
    -----
    The error is 3 % of the change of a pixel, because the PSF at the detector's centre is used for all sources.
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
    is_chosen = visible_sources.touches_frame(sources, light.sizes, aim.drawn) & (change > scene.noticeable_electrons)
    if not is_chosen.any():
        return scene
    chosen, shares, change = sources.take(is_chosen), sources.photons[is_chosen], change[is_chosen]
    settings = replace(settings_for(scene.accuracy), edge=scene.noticeable_fraction, aliased=_PART, floor=_PART)
    noise = scene.pixel_noise
    sizes = stamp_sizes.stamp_sizes(change / peak_fraction, chosen.shape, chosen.shapes, psf, noise, settings)
    # Images of sources that are drawn from pictures, or that move, must not be cut. Their stamps (square images around
    # them) are as large as in the image without weights. Other sources may have smaller stamps, since lower accuracy is
    # sufficient.
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
    """Add spectra of the sources, in which photons are weighted by wavelength, to the scene of a slitless image.

    From them the chromatic response is computed: the dependence of each pixel's efficiency on wavelength. Only sources
    whose brightest column changes a pixel noticeably are drawn.

    Parameters
    ----------
    scene : Scene
        Properties of the exposure, with the brightest pixel of the drawn sources.
    aim : Aim
        Exposure and detector.
    light : Light
        Sources with their spectra and the orders of the grism.
    tally : Tally
        Electrons of each source that were drawn, in total and in its brightest column.
    planes_cache : dict
        Cache of Fourier transforms of the PSF, which other calls of `dispersing.draw` also use.

    Returns
    -------
    Scene
        Scene with `chromatic_light` (the two weighted images, electrons) and `chromatic_electrons` (the largest change
        of a pixel). It is unchanged if no source has a noticeable effect, or if the effect is not applied.

    Notes
    -----
    The light that is neglected at the edges of stamps changes a pixel by less than a noticeable amount.
    """
    dispersed, psf = light.dispersed, light.psf
    if _is_inactive(scene, aim) or psf is None or dispersed is None or not len(light.sources):
        return scene
    f = chromatic_response.component_spectra(scene.section, dispersed.orders[0].wavelength, aim.band, scene.mission)
    largest = float(np.hypot(*(f * np.array(chromatic_response.map_strength(scene))).T).max())
    change = tally.peak.max(axis=1) * _peak_fraction(psf, of_rows=True) * largest
    (indices,) = np.nonzero(change > scene.noticeable_electrons)
    if not len(indices):
        return scene
    chosen, shape = light.sources.take(indices), (aim.detector.ny, aim.detector.nx)
    # Light may be neglected if the chromatic response changes it by less than half of a noticeable change.
    limit = 0.5 * scene.noticeable_fraction / largest
    settings = replace(dispersed.settings, edge=limit, faint=limit)

    def draw(weight: Float) -> Frame:
        """Return the image of the chosen spectra; `weight` has a factor for the photons of each wavelength."""
        orders = tuple(replace(order, response=order.response * weight) for order in dispersed.orders)
        weighted_spectra = dispersing.DispersedSources(lambda rows: dispersed.spectra(indices[rows]), orders, settings)
        return dispersing.draw(chosen, weighted_spectra, psf, shape, scene.pixel_noise, None, None, planes_cache)

    light_maps = np.stack([draw(component).astype(np.float32) for component in f.T])
    return replace(scene, chromatic_light=light_maps, chromatic_electrons=float(change.max()))


def _is_inactive(scene: Scene, aim: Aim) -> bool:
    """Return True if the effect of a chromatic response is not simulated.

    This is so if the channel (instrument mode) has no such effect, if it does not apply to the image type, or if the
    request switches it off.
    """
    effect = aim.channel.chromatic_effect
    return effect is None or effect not in aim.effects or not scene.forced.get(effect.name, True)


def _peak_fraction(psf: Psf, *, of_rows: bool = False) -> float:
    """Return the largest fraction, at any wavelength, of a point source's light in one pixel (in one row if `of_rows`).

    It is 1 for a PSF that is given as an analytic profile.
    """
    if psf.planes is None:
        return 1.0
    images, samples = psf.planes.images, psf.planes.samples
    first = images.shape[1] // 2 - samples // 2
    core = slice(first, first + samples)
    across = slice(None) if of_rows else core
    return min(float(images[:, core, across].sum(axis=(1, 2)).max()), 1.0)


def _central_psf(psf: Psf) -> Psf:
    """Return a simpler PSF for the whole detector: that at its centre, with at most four wavelengths.

    Light beyond the border of the PSF images, such as spikes, is omitted.
    """
    if psf.planes is None:
        return psf
    planes = replace(psf.planes, drift=psf.planes.drift[:0], powers=())
    few = min(_COLOURS, len(planes.wavelength))
    return reduce_colours(replace(psf, planes=planes, edges=None), few)
