"""Simulate (render) one detector of one exposure: from catalogue rows to a raw image and its noise-free truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lake_schema.arrays import Array, Float, Int
from lake_schema.ids import kind_from_id
from truesky.randomness import rng
from truesky.render.channels.aim import Aim
from truesky.render.dispersing import draw as dispersing
from truesky.render.drawing import stamp_sizes, stamps
from truesky.render.drawing.stamps import Tally
from truesky.render.drawing.stored_drawing import DrawingStore
from truesky.render.effects.effect import Effect, apply_all
from truesky.render.effects.readout import trap_pumping
from truesky.render.effects.scene import Frame, NeighbourCharge, Scene
from truesky.render.exposure import (
    board_neighbours,
    chromatic_response_map,
    limits,
    persistence,
    rendered_detector,
    scene_factory,
    sky_through_grism,
    truth_maps,
)
from truesky.render.exposure.records import Rows, Variant
from truesky.render.exposure.rendered_detector import RenderedDetector
from truesky.render.exposure.spectrum_truth import Columns, truth_columns
from truesky.render.exposure.visible_sources import Light, visible_light
from truesky.render.exposure.visible_spectra import visible_spectra
from truesky.render.sources.source_list import Sources

# Number that stands for stars in the identifiers of sources (`lake_schema.ids.source_id`, argument `kind`).
_STAR = 5


def render(
    aim: Aim,
    rows: Rows,
    variant: Variant,
    seed: int,
    truth: Sequence[str] = (),
    progress: Callable[[int], None] | None = None,
    noise_seed: int | None = None,
    drawings: DrawingStore | None = None,
) -> RenderedDetector:
    """Simulate the image of one detector in one exposure.

    Parameters
    ----------
    aim : Aim
        Exposure and detector.
    rows : Rows
        Catalogue rows that may have light on the detector.
    variant : Variant
        Mission database, accuracy, and the effects that the request switches on or off.
    seed : int
        Seed of the request.
    truth : sequence of str, optional
        Names of truth maps to make in addition to `noise_free`, from lake_schema.tables.products.CONTENTS. Maps that
        this kind of image does not have are ignored.
    progress : callable, optional
        Function that is called from time to time with the number of stamps (images of single sources) that are drawn.
        It is not called for spectra.
    noise_seed : int, optional
        Seed of the random numbers that differ between exposures, such as noise. By default `seed`.
    drawings : DrawingStore, optional
        Sources that were drawn in an earlier call for the same detector, exposure and accuracy. An empty store is
        filled. It has no effect on spectra.

    Returns
    -------
    RenderedDetector
        Raw image, truth maps and drawn sources. BadInput is raised by called functions, for example if the image would
        need too much memory or time.
    """
    limits.refuse_too_many_pixels(aim)
    if drawings is not None:
        drawings.check((aim.exposure, aim.detector, variant.accuracy, seed))
    scene = replace(
        scene_factory.from_aim(aim, variant),
        persistence_charge=persistence.total_charge(aim, rows.previous_exposures, variant, seed),
    )
    scene = sky_through_grism.with_sky_change(scene, aim, seed)
    is_dispersed = aim.channel.dispersion is not None and aim.sees_sky
    light = (visible_spectra if is_dispersed else visible_light)(aim, rows, scene, seed)
    limits.refuse_too_large(aim, light)

    def charge() -> NeighbourCharge | None:
        return board_neighbours.neighbour_charge(light, aim, rows, variant, seed)

    # The response inside a pixel is only taken into account if a source is bright enough.
    key = "neighbour charge", None if light.psf is None else light.psf.intra_pixel
    neighbour_charge = charge() if drawings is None else drawings.keep(key, charge)
    light = replace(light, scene=replace(light.scene, neighbour_charge=neighbour_charge))
    drawn, frame = (
        _draw_images(aim, light, truth, progress, drawings)
        if light.dispersed is None
        else _draw_spectra(aim, rows, light, truth)
    )
    return _apply_effects(aim, rows, light, drawn, frame, (seed, noise_seed, truth))


@dataclass(frozen=True, slots=True)
class _DrawnLight:
    """Result of drawing the sources of a detector, before detector effects are applied.

    Attributes
    ----------
    sources : Sources
        The n sources with light of their stamps (square images around them) on pixels that the detector reads. Stars
        are also included if they are so bright that their light is drawn far beyond their stamps.
    sizes : int array, shape (n,)
        Sides of the sources' stamps, pixels.
    electrons : float array, shape (n,)
        Electrons of each source's stamp on pixels that the detector reads.
    maps : dict of str to array
        Truth maps (ny, nx) by name.
    scene : Scene
        Properties of the exposure on which effects depend, with the brightest pixel of the drawn image.
    spectra : dict, optional
        Columns of the table `rendered_spectra`. None without a grism.
    """

    sources: Sources
    sizes: Int
    electrons: Float
    maps: dict[str, Array]
    scene: Scene
    spectra: Columns | None = None


def _draw_images(
    aim: Aim,
    light: Light,
    truth: Sequence[str],
    progress: Callable[[int], None] | None,
    drawings: DrawingStore | None,
) -> tuple[_DrawnLight, list[Frame]]:
    """Draw direct images of all sources, and return the drawn light and a list with one frame of expected electrons.

    The caller can remove the frame (image of the detector) from the list, so that its memory is freed as early as
    possible.
    """
    sources, sizes, scene, detector = light.sources, light.sizes, light.scene, aim.detector
    if light.psf is None:
        empty = np.zeros((detector.ny, detector.nx))
        maps: dict[str, Array] = {"noise_free": empty.astype(np.float32)}
        return _DrawnLight(sources, sizes, np.zeros(0), maps, scene), [empty]
    drawn_electrons, maps = np.zeros(len(sources)), {}
    tally, shape = Tally(drawn_electrons, scene.unread_rows), (detector.nx, detector.ny)
    if drawings is None:
        frame = stamps.draw(sources, sizes, light.psf, *shape, progress, light.neglected, tally)
    else:
        frame = drawings.draw(sources, sizes, light.psf, shape, progress, light.neglected, tally)
    scene = chromatic_response_map.with_chromatic_light(scene_factory.with_peak_electrons(scene, frame), aim, light)
    if "stars" in truth:
        is_star = kind_from_id(sources.ids) == _STAR
        stars, neglected = sources.take(is_star), light.neglected[is_star]
        star_light = stamps.draw(stars, sizes[is_star], light.psf, detector.nx, detector.ny, None, neglected)
        maps["stars"] = star_light.astype(np.float32)
    # A source of which only faint light outside its stamp (the square image around it) reaches the detector is drawn,
    # but it is not in the list of drawn sources. A star with bright light far beyond its stamp is always listed.
    piece_electrons = sources.electrons / stamp_sizes.piece_count(sources.trail_length)
    is_listed = (drawn_electrons > 0.0) | stamp_sizes.has_far_light(
        piece_electrons, sizes, sources.shape, sources.picture, light.psf
    )
    maps["noise_free"] = frame.astype(np.float32)
    return _DrawnLight(sources.take(is_listed), sizes[is_listed], drawn_electrons[is_listed], maps, scene), [frame]


def _draw_spectra(aim: Aim, rows: Rows, light: Light, truth: Sequence[str]) -> tuple[_DrawnLight, list[Frame]]:
    """Draw slitless spectra of all sources, and return the drawn light and a list with one frame of expected electrons.

    The drawn light lists the sources of which some spectral order has light on the detector. The caller can remove the
    frame (image of the detector) from the list, so that its memory is freed as early as possible.
    """
    assert light.dispersed is not None
    assert light.psf is not None
    sources, dispersed, psf, noise = light.sources, light.dispersed, light.psf, light.scene.pixel_noise
    shape, tally = (aim.detector.ny, aim.detector.nx), dispersing.Tally.empty(len(sources), len(dispersed.orders))
    layers: dict[int, Float] = {}
    planes_cache: dispersing.PlanesCache = {}
    requested_orders = {order: name for order, name in truth_maps.ORDER_MAPS.items() if name in truth}
    frame = dispersing.draw(
        sources, dispersed, psf, shape, noise, tally, layers if requested_orders else None, planes_cache
    )
    maps: dict[str, Array] = {"noise_free": frame.astype(np.float32)}
    for order, name in requested_orders.items():
        maps[name] = layers.get(order, np.zeros(shape)).astype(np.float32)
    if "stars" in truth:
        star_indices = np.flatnonzero(kind_from_id(sources.ids) == _STAR)
        star_spectra = replace(dispersed, spectra=lambda chosen: dispersed.spectra(star_indices[chosen]))
        maps["stars"] = dispersing.draw(sources.take(star_indices), star_spectra, psf, shape, noise).astype(np.float32)
    drawn_electrons, scene = tally.electrons.sum(axis=1), scene_factory.with_peak_electrons(light.scene, frame)
    is_listed, expected = drawn_electrons > 0.0, replace(sources, electrons=tally.expected.sum(axis=1))
    scene = chromatic_response_map.with_dispersed_light(scene, aim, light, tally, planes_cache)
    spectra = truth_columns(light, tally, aim, rows, scene)
    return _DrawnLight(
        expected.take(is_listed), tally.sizes[is_listed], drawn_electrons[is_listed], maps, scene, spectra
    ), [frame]


def _apply_effects(
    aim: Aim,
    rows: Rows,
    light: Light,
    drawn: _DrawnLight,
    frame: list[Frame],
    seeds_and_truth: tuple[int, int | None, Sequence[str]],
) -> RenderedDetector:
    """Apply all detector effects of the channel to the drawn image, simulate the readout, and complete truth maps.

    `frame` is a list with one image of expected electrons, which is removed from the list. `seeds_and_truth` are seed,
    noise seed and names of truth maps, as for `render`.
    """
    exposure, detector, (seed, noise_seed, truth) = aim.exposure, aim.detector, seeds_and_truth
    scene = scene_factory.with_non_source_light(drawn.scene, aim.channel, aim.effects)

    def stream(effect: Effect) -> np.random.Generator:
        return rng.stream(*rendered_detector.random_identity(effect, exposure, detector.name, seed, noise_seed))

    mode = aim.channel.readout
    record_truth = truth_maps.map_recorder(drawn.maps, scene, truth, mode)
    final_frame, decisions = apply_all(
        frame.pop(), aim.effects, scene, stream, record_truth, truth_maps.recorded_effects(truth), reuse_frame=True
    )
    if "traps" in truth and trap_pumping.EFFECT in aim.effects:
        drawn.maps["traps"] = trap_pumping.trap_map(scene, stream(trap_pumping.EFFECT))
    readout = mode.make_readout(final_frame, scene, detector.name, aim.wcs)
    truth_maps.complete(drawn.maps, readout.raw, aim.effects, scene, truth, mode)
    return RenderedDetector(
        exposure, detector, aim.wcs, light.psf, readout, drawn.maps, drawn.sources, drawn.sizes, drawn.electrons,
        exposure.zero_point, scene, (*light.decisions, *decisions), scene.accuracy, seed, rows.complete_margin_arcsec,
        noise_seed, drawn.spectra,
    )  # fmt: skip
