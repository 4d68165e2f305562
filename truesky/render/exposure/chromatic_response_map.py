"""The light of sources by colour, for pixels that do not see all colours alike.

with_tints          a scene with it
with_spread_tints   the same of light that a grism spreads out, of which each column has its own colour
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
from truesky.render.effects.scene import NOTICEABLE, Frame, Scene
from truesky.render.exposure import visible_sources
from truesky.render.exposure.visible_sources import Light
from truesky.render.psf.model import Psf, reduce_colours

# Colours of the PSF that they are drawn through, in the detector's centre; and the light that may be aliased in them,
# and left out, as parts of a source: what they change is a part in a hundred of it.
_COLOURS, _PART = 4, 1e-2


def with_chromatic_light(scene: Scene, aim: Aim, light: Light) -> Scene:
    """The scene with the light of those sources whose colour changes a pixel by what is noticed.

    scene : with what is drawn;  aim : the exposure and detector;  light : what shines onto it
    Error : of what they change in a pixel, 3 %: the PSF is that of the detector's centre. Where an accuracy wants a PSF
            of one colour those of the sources are not known: they change nothing
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
    # A picture and a trail are as wide as they are.
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
    """The scene with the spectra of those sources of which a column's colour changes a pixel by what is noticed.

    scene : with what is drawn;  aim : the exposure and detector;  light : dispersed;  tally : of all that was drawn
    known : what drawings of them share
    Error : of each source, a tenth of a pixel's noise beyond the stamps
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
    # What is left out is what changes by less than is noticed.
    settings = replace(dispersed.settings, edge=0.5 * NOTICEABLE / largest, faint=0.5 * NOTICEABLE / largest)

    def draw(weight: Float) -> Frame:
        """The light, each photon times its weight [w]."""
        orders = tuple(replace(order, response=order.response * weight) for order in dispersed.orders)
        weighted_spectra = dispersing.DispersedSources(lambda rows: dispersed.spectra(indices[rows]), orders, settings)
        return dispersing.draw(chosen, weighted_spectra, psf, shape, scene.pixel_noise, None, None, planes_cache)

    light_maps = np.stack([draw(component).astype(np.float32) for component in f.T])
    return replace(scene, chromatic_light=light_maps, chromatic_electrons=float(change.max()))


def _is_inactive(scene: Scene, aim: Aim) -> bool:
    """Whether the effect is not of this channel or image, or switched off."""
    effect = aim.channel.chromatic_effect
    return effect is None or effect not in aim.effects or not scene.forced.get(effect.name, True)


def _peak_fraction(psf: Psf, *, of_rows: bool = False) -> float:
    """The most of a point's light that is in a pixel, or in a row, of any colour."""
    if psf.planes is None:
        return 1.0
    images, samples = psf.planes.images, psf.planes.samples
    first = images.shape[1] // 2 - samples // 2
    core = slice(first, first + samples)
    across = slice(None) if of_rows else core
    return min(float(images[:, core, across].sum(axis=(1, 2)).max()), 1.0)


def _central_psf(psf: Psf) -> Psf:
    """The PSF of the detector's centre, of few colours, as far as its planes go."""
    if psf.planes is None:
        return psf
    planes = replace(psf.planes, drift=psf.planes.drift[:0], powers=())
    few = min(_COLOURS, len(planes.wavelength))
    return reduce_colours(replace(psf, planes=planes, edges=None), few)
