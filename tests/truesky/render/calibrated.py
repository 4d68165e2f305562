"""Ideal calibration of images with the true patterns of each detector."""

import numpy as np

from truesky.randomness.rng import stream
from truesky.reduction import amplifiers
from truesky.render.effects.charge import pixel_borders, pixel_response
from truesky.render.effects.light import illumination
from truesky.render.effects.readout import bias_structure, crosstalk, nonlinearity, quadrants


def electrons(raw, scene, seed, applied):
    """Convert raw ADU ([ny, nx], or quadrants) to electrons [ny, nx], sky and dark current included.

    `applied` contains the names of the effects in the image.
    """
    gain, bias = (
        np.reshape(scene.amplifier_values(*key), (-1, 1, 1)) for key in (("gain", "electron / adu"), ("bias", "adu"))
    )
    found = (raw.astype(float) - bias) * gain

    def fixed(effect):
        return stream(seed, camera_of(scene), scene.detector.name, effect.name)

    if "bias_structure" in applied:
        parameters = bias_structure.EFFECT.parameters(scene)
        found -= bias_structure.structure(len(raw), raw.shape[2], *parameters, fixed(bias_structure.EFFECT))[:, None]
    if "bias_drift" in applied:
        drift = bias_structure.DRIFT
        found -= drift.apply(np.zeros((len(raw), 1, 1)), *drift.parameters(scene), fixed(drift))
    if "crosstalk" in applied:
        # First order in the coefficients; the error is 1e-8.
        found = 2.0 * found - crosstalk.apply(found, *crosstalk.EFFECT.parameters(scene))
    if "nonlinearity" in applied:
        found = nonlinearity.linearise(found, *nonlinearity.EFFECT.parameters(scene))
    if scene.layout is not None:
        return scene.layout.assemble(found) / flat(scene, seed, applied)
    return quadrants.assemble(found, *quadrants.overscan_sizes(scene)) / flat(scene, seed, applied)


def of_pixels(scene, key, unit):
    """Return a parameter of the amplifier of each pixel, such as its gain: shape (ny, nx), or a number."""
    return amplifiers.to_pixels(scene.amplifier_values(key, unit), scene)


def adu_to_electrons(science, scene):
    """Return pixels [ny, nx] in electrons above the bias level of their amplifier."""
    return (science - of_pixels(scene, "bias", "adu")) * of_pixels(scene, "gain", "electron / adu")


def camera_of(scene):
    return scene.section.rpartition(".")[2]


def flat(scene, seed, applied):
    """Return the relative sensitivity of each pixel (mean 1), NaN for blind pixels."""
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
    """Set cosmic rays, and the rows after them with their trails, to NaN."""
    bad = hits > 0
    upper = len(bad) // 2
    for half in (bad[:upper], bad[upper:][::-1]):
        for _ in range(reach):
            half[1:] |= half[:-1]
    return np.where(bad, np.nan, electrons)
