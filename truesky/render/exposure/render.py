"""One detector of one exposure: catalogue rows in, a raw image and its noise-free truth out.

render          the whole of it
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lake_schema.arrays import Array, Float, Int
from lake_schema.ids import kind_of
from truesky.randomness import rng
from truesky.render.channels.aim import Aim
from truesky.render.dispersing import draw as dispersing
from truesky.render.drawing import stamp_sizes, stamps
from truesky.render.drawing.stamps import Tally
from truesky.render.effects.effect import Effect, apply_all
from truesky.render.effects.readout import trap_pumping
from truesky.render.effects.scene import Frame, Scene
from truesky.render.exposure import elsewhere, limits, persistence, rendered, scene_of, spread_sky, tints, truth_maps
from truesky.render.exposure.records import Rows, Variant
from truesky.render.exposure.rendered import Rendered
from truesky.render.exposure.traced import Columns, traced
from truesky.render.exposure.visible_sources import Light, visible_light
from truesky.render.exposure.visible_spectra import visible_spectra
from truesky.render.sources.source_list import Sources

# Code of a star in an identifier.
_STAR = 5


def render(
    aim: Aim,
    rows: Rows,
    variant: Variant,
    seed: int,
    truth: Sequence[str] = (),
    progress: Callable[[int], None] | None = None,
    noise_seed: int | None = None,
) -> Rendered:
    """Render one detector.

    truth    : maps that are wanted besides the noise-free one, of lake_schema.tables.products.CONTENTS
    progress : called now and then with the number of sources drawn
    noise_seed : of what differs between exposures, None = the seed
    aim      : the exposure and detector;  rows : catalogue rows that it may see
    variant  : mission, accuracy, and the effects that are forced on or off;  seed : of the request
    """
    scene = replace(scene_of.of_aim(aim, variant), remembered=persistence.remembered(aim, rows.earlier, variant, seed))
    scene = spread_sky.with_sky(scene, aim, seed)
    spread = aim.channel.disperses is not None and aim.sees_sky
    light = (visible_spectra if spread else visible_light)(aim, rows, scene, seed)
    limits.refuse_too_large(aim, light)
    light = elsewhere.with_charge(light, aim, rows, variant, seed)
    drawn, frame = _drawn(aim, light, truth, progress) if light.dispersed is None else _spread(aim, rows, light, truth)
    return _detected(aim, rows, light, drawn, frame, (seed, noise_seed, truth))


@dataclass(frozen=True, slots=True)
class _Drawn:
    """What was drawn.

    sources, sizes, electrons : those with light of their stamps on pixels that are read, and what of it fell there
    maps  : truth by its name
    scene : with the brightest pixel
    spectra : columns of the table `rendered_spectra`; None: nothing is dispersed
    """

    sources: Sources
    sizes: Int
    electrons: Float
    maps: dict[str, Array]
    scene: Scene
    spectra: Columns | None = None


def _drawn(
    aim: Aim, light: Light, truth: Sequence[str], progress: Callable[[int], None] | None
) -> tuple[_Drawn, list[Frame]]:
    """(what was drawn, [expected electrons of the sources alone]): handed over, to be freed as early as can be."""
    sources, sizes, scene, detector = light.sources, light.sizes, light.scene, aim.detector
    if light.psf is None:
        empty = np.zeros((detector.ny, detector.nx))
        maps: dict[str, Array] = {"noise_free": empty.astype(np.float32)}
        return _Drawn(sources, sizes, np.zeros(0), maps, scene), [empty]
    drawn, maps = np.zeros(len(sources)), {}
    frame = stamps.draw(
        sources, sizes, light.psf, detector.nx, detector.ny, progress, light.neglected, Tally(drawn, scene.unread)
    )
    scene = tints.with_tints(scene_of.with_peak(scene, frame), aim, light)
    if "stars" in truth:
        of_stars = kind_of(sources.ids) == _STAR
        some, neglected = sources.take(of_stars), light.neglected[of_stars]
        light_of = stamps.draw(some, sizes[of_stars], light.psf, detector.nx, detector.ny, None, neglected)
        maps["stars"] = light_of.astype(np.float32)
    # What sends in no more than faint wings is drawn, not listed.
    a_piece = sources.electrons / stamp_sizes.piece_count(sources.length)
    listed = (drawn > 0.0) | stamp_sizes.has_far_light(a_piece, sizes, sources.shape, sources.picture, light.psf)
    maps["noise_free"] = frame.astype(np.float32)
    return _Drawn(sources.take(listed), sizes[listed], drawn[listed], maps, scene), [frame]


def _spread(aim: Aim, rows: Rows, light: Light, truth: Sequence[str]) -> tuple[_Drawn, list[Frame]]:
    """The same of sources whose light a grism spreads out; what is listed has light of some order on the detector."""
    assert light.dispersed is not None
    assert light.psf is not None
    sources, dispersed, psf, noise = light.sources, light.dispersed, light.psf, light.scene.pixel_noise
    shape, tally = (aim.detector.ny, aim.detector.nx), dispersing.Tally.of(len(sources), len(dispersed.orders))
    layers: dict[int, Float] = {}
    known: dispersing.Known = {}
    asked = {order: name for order, name in truth_maps.ORDERS.items() if name in truth}
    frame = dispersing.draw(sources, dispersed, psf, shape, noise, tally, layers if asked else None, known)
    maps: dict[str, Array] = {"noise_free": frame.astype(np.float32)}
    for order, name in asked.items():
        maps[name] = layers.get(order, np.zeros(shape)).astype(np.float32)
    if "stars" in truth:
        of_stars = np.flatnonzero(kind_of(sources.ids) == _STAR)
        some = replace(dispersed, spectra=lambda chosen: dispersed.spectra(of_stars[chosen]))
        maps["stars"] = dispersing.draw(sources.take(of_stars), some, psf, shape, noise).astype(np.float32)
    fallen, scene = tally.electrons.sum(axis=1), scene_of.with_peak(light.scene, frame)
    listed, expected = fallen > 0.0, replace(sources, electrons=tally.expected.sum(axis=1))
    scene = tints.with_spread_tints(scene, aim, light, tally, known)
    spectra = traced(light, tally, aim, rows, scene)
    return _Drawn(expected.take(listed), tally.sizes[listed], fallen[listed], maps, scene, spectra), [frame]


def _detected(
    aim: Aim, rows: Rows, light: Light, drawn: _Drawn, frame: list[Frame], asked: tuple[int, int | None, Sequence[str]]
) -> Rendered:
    """The frame, taken from its list, after all effects of the channel; asked : seeds and truth maps."""
    exposure, detector, (seed, noise_seed, truth) = aim.exposure, aim.detector, asked
    scene = scene_of.with_own_light(drawn.scene, aim.channel, aim.effects)

    def stream(effect: Effect) -> np.random.Generator:
        return rng.stream(*rendered.numbers_of(effect, exposure, detector.name, seed, noise_seed))

    mode = aim.channel.readout
    watch = truth_maps.watch(drawn.maps, scene, truth, mode)
    found, decisions = apply_all(frame.pop(), aim.effects, scene, stream, watch)
    if "traps" in truth and trap_pumping.EFFECT in aim.effects:
        drawn.maps["traps"] = trap_pumping.trap_map(scene, stream(trap_pumping.EFFECT))
    readout = mode.arrays(found, scene, detector.name, aim.wcs)
    truth_maps.complete(drawn.maps, readout.raw, aim.effects, scene, truth, mode)
    return Rendered(
        exposure, detector, aim.wcs, light.psf, readout, drawn.maps, drawn.sources, drawn.sizes, drawn.electrons,
        exposure.zero_point, scene, (*light.decisions, *decisions), scene.accuracy, seed, rows.complete,
        noise_seed, drawn.spectra,
    )  # fmt: skip
