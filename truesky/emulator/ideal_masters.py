"""Masters of a detector whose response and dark current are known exactly from the simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lake_schema.arrays import Float
from truesky.randomness import rng
from truesky.reduction import calibration, files
from truesky.reduction.calibration import Masters
from truesky.reduction.frames import Frame
from truesky.reduction.infrared import nisp
from truesky.render.effects.charge import dark_current, dark_map, pixel_response
from truesky.render.effects.effect import Effect
from truesky.render.exposure import rendered_detector


def known_masters(frame: Frame, without: Sequence[str], variance: float) -> Masters:
    """Return the masters of a frame without noise, from the simulated patterns of its detector.

    Parameters
    ----------
    frame : Frame
        The raw frame.
    without : sequence of str
        All kinds of masters of the frame. Masters other than dark and flat, such as the bias, are constant.
    variance : float
        Variance of a pixel of blank sky in electrons^2.

    Returns
    -------
    Masters
        The flat has the sensitivity of each pixel, and the dark its mean dark current, if both were simulated. Pixels
        are flagged as for measured masters, except that a pixel is hot if its dark electrons exceed the median by more
        than the standard deviation of blank sky.
    """
    read = nisp.read_masters if frame.scene.ramp else files.read_masters
    masters = read(Path(), frame, without)
    electrons, response = _dark_electrons(frame), _response(frame)
    dark = (electrons / frame.scene.exposure_time_s).astype(np.float32)
    flat = replace(masters.flat, mean=response.astype(np.float32))
    is_hot = electrons - np.median(electrons) > np.sqrt(variance)
    flags = masters.flags | calibration.response_flags(flat) | np.where(is_hot, calibration.HOT, 0).astype(np.uint8)
    return replace(masters, dark=replace(masters.dark, mean=dark), flat=flat, flags=flags)


def _dark_electrons(frame: Frame) -> Float:
    """Return the mean dark electrons of each pixel in the exposure."""
    scene, blank = frame.scene, np.zeros((frame.scene.ny, frame.scene.nx))
    if dark_map.EFFECT.name in frame.applied:
        effect = dark_map.EFFECT
        return np.asarray(effect.apply(blank, *effect.parameters(scene), _generator(frame, effect)))
    if dark_current.EFFECT.name in frame.applied:
        blank += scene.dark_electrons
    if dark_current.HOT.name in frame.applied:
        effect = dark_current.HOT
        return np.asarray(effect.apply(blank, *effect.parameters(scene), _generator(frame, effect)))
    return blank


def _response(frame: Frame) -> Float:
    """Return the sensitivity of each pixel relative to the mean."""
    effect, shape = pixel_response.EFFECT, (frame.scene.ny, frame.scene.nx)
    if effect.name not in frame.applied:
        return np.ones(shape)
    return pixel_response.response(shape, *pixel_response.parameters(frame.scene), _generator(frame, effect))


def _generator(frame: Frame, effect: Effect) -> np.random.Generator:
    """Return the random generator of a fixed pattern of the detector, in the state in which the image got it."""
    seed = int(frame.card("SEED"))
    return rng.stream(*rendered_detector.random_identity(effect, frame.exposure, frame.detector, seed))
