"""The light of one source alone on a detector, spread out by a grism: what all others are to be told from.

spectra    of some sources, each by itself
"""

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
from truesky.render.exposure import scene_of, spread_sky
from truesky.render.exposure.records import Rows, Variant
from truesky.render.exposure.visible_spectra import visible_spectra


@dataclass(frozen=True, slots=True)
class Alone:
    """A source's light.

    orders : order -> expected electrons float64[ny, nx];  frame : their sum
    """

    id: int
    frame: Float
    orders: dict[int, Float]


def spectra(aim: Aim, rows: Rows, variant: Variant, seed: int, ids: Sequence[int] | None = None) -> Iterator[Alone]:
    """Draw one source after the other. The float64 frames of all sources add up exactly to the noise-free frame.

    Parameters
    ----------
    aim, rows, variant, seed : Aim, Rows, Variant, int
        As for `render`.
    ids : sequence of int, optional
        Identifiers of the sources. The default is all sources that may have light on the detector.

    Raises
    ------
    BadInput
        At the call, if the image is not dispersed or a source is not among them.
    """
    exposure = aim.exposure
    if aim.channel.disperses is None or not aim.sees_sky:
        what = f"{exposure.channel} {exposure.image_type}"
        raise BadInput(f"exposure {exposure.exposure_id}: {what} is no image of spectra")
    light = visible_spectra(aim, rows, spread_sky.with_sky(scene_of.of_aim(aim, variant), aim, seed), seed)
    sources, dispersed, psf = light.sources, light.dispersed, light.psf
    assert dispersed is not None
    assert psf is not None
    place = {number: i for i, number in enumerate(sources.ids.tolist())}
    chosen = list(place) if ids is None else list(ids)
    if missing := [number for number in chosen if number not in place]:
        where = f"exposure {exposure.exposure_id}, detector {aim.detector.name}"
        raise BadInput(f"{where}: no light of source {missing[0]} is drawn there")
    shape, of = (aim.detector.ny, aim.detector.nx), dispersed.spectra
    known: draw.Known = {}
    noise = light.scene.pixel_noise

    def drawn(number: int) -> Alone:
        at = np.array([place[number]])
        one = replace(dispersed, spectra=partial(_of_some, of, at))
        layers: dict[int, Float] = {}
        frame = draw.draw(sources.take(at), one, psf, shape, noise, None, layers, known)
        return Alone(number, frame, layers)

    return map(drawn, chosen)


def _of_some(spectra: Spectra, which: Int, some: Int) -> Float32:
    return spectra(which[some])
