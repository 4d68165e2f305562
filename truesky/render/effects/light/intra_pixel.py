"""Intra-pixel response: the centre of a pixel is more sensitive than its corners, so that sources are slightly sharper.

The response at the position (u, v) in a pixel is 1 - a (u^2 + v^2), with u and v from -1 to 1 between the edges and a
constant a of the detector. The mean of the response over the pixel is part of the quantum efficiency. The response
belongs to the pixel's transfer function, with which sources are drawn. It cannot be applied after light is summed in
pixels: a filter on the final image would correct at most half of it.
"""

from __future__ import annotations

from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Scene
from truesky.render.psf import pixel_response


def _strength(scene: Scene) -> float:
    return scene.value("intra_pixel_response", "")


# Relative change of the brightest pixel of a star in a VIS image, divided by the parameter a of the response
# 1 - a (u^2 + v^2) inside a pixel.
_CHANGE = 0.07
EFFECT = Effect(
    "intra_pixel",
    pixel_response.transform,
    lambda scene: (_strength(scene),),
    lambda scene: _CHANGE * _strength(scene) * scene.peak_electrons,
)
