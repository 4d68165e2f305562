"""A perfect calibrator: it knows each detector's patterns, and undoes them."""

import numpy as np

from truesky.randomness.rng import stream
from truesky.render.effects.charge import pixel_borders, pixel_response
from truesky.render.effects.light import illumination
from truesky.render.effects.readout import bias_structure, crosstalk, nonlinearity, quadrants


def electrons(raw, scene, seed, applied):
    """Raw ADU ([ny, nx], or quadrants) -> e- [ny, nx] as they were counted, sky and dark current included.

    applied : names of the effects that are in the image
    """
    gain = np.reshape(scene.amplifier_values("gain", "electron / adu"), (-1, 1, 1))
    found = (raw.astype(float) - scene.value("bias", "adu")) * gain

    def fixed(effect):
        return stream(seed, camera_of(scene), scene.detector.name, effect.name)

    if "bias_structure" in applied:
        parameters = bias_structure.EFFECT.parameters(scene)
        found -= bias_structure.structure(len(raw), raw.shape[2], *parameters, fixed(bias_structure.EFFECT))[:, None]
    if "crosstalk" in applied:
        # To first order in the coefficients: 1e-8.
        found = 2.0 * found - crosstalk.apply(found, *crosstalk.EFFECT.parameters(scene))
    if "nonlinearity" in applied:
        found = nonlinearity.linearise(found, *nonlinearity.EFFECT.parameters(scene))
    if scene.layout is not None:
        return scene.layout.assemble(found) / flat(scene, seed, applied)
    return quadrants.assemble(found, *quadrants.overscan_sizes(scene)) / flat(scene, seed, applied)


def camera_of(scene):
    return scene.section.rpartition(".")[2]


def flat(scene, seed, applied):
    """What of the light each pixel counts, 1 in the mean; nothing where it is blind."""
    out = np.ones((scene.detector.ny, scene.detector.nx))
    for effect in (illumination.EFFECT, illumination.SHUTTER):
        if effect.name in applied:
            out = effect.apply(out, *effect.parameters(scene))
    for effect in (pixel_response.EFFECT, pixel_borders.RINGS, pixel_borders.EDGES):
        if effect.name in applied:
            own = stream(seed, camera_of(scene), scene.detector.name, effect.name)
            out = effect.apply(out, *effect.parameters(scene), rng=own)
    return np.where(out > 0.7, out, np.nan)


def without_hits(electrons, hits, reach=40):
    """NaN where a cosmic ray is, and in the rows after it that its trail is in."""
    bad = hits > 0
    upper = len(bad) // 2
    for half in (bad[:upper], bad[upper:][::-1]):
        for _ in range(reach):
            half[1:] |= half[:-1]
    return np.where(bad, np.nan, electrons)
