"""Masters of a detector whose response and dark current are known exactly from the simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lake_schema.arrays import Float
from truesky.randomness.rng import stream
from truesky.reduction import calibration, files
from truesky.reduction.calibration import Masters
from truesky.reduction.frames import Frame
from truesky.reduction.infrared import nisp
from truesky.render.effects.charge import dark_current, dark_map, pixel_borders, pixel_response
from truesky.render.effects.effect import Effect
from truesky.render.exposure.rendered_detector import random_identity


def replaced_kinds(frame: Frame) -> tuple[str, ...]:
    """Return all kinds of masters that could calibrate a frame, in whose place ideal ones are used."""
    return files.master_kinds(frame) + (("fringes",) if "fringes" in frame.applied else ())


def ideal_masters(frame: Frame, hot_electrons: float) -> Masters:
    """Return the true response and dark current of each pixel as masters without noise.

    Parameters
    ----------
    frame : Frame
        A raw frame.
    hot_electrons : float
        A pixel is hot if its dark current in the exposure exceeds the median by more than this, electrons.

    Returns
    -------
    Masters
        The masters; those other than dark and flat are constant. Hot pixels have the flag HOT, and pixels with a
        response far from 1 the flag RESPONSE.
    """
    read = nisp.read_masters if frame.scene.ramp else files.read_masters
    masters = read(Path(), frame, replaced_kinds(frame))
    response = _pattern(frame, (pixel_response.EFFECT, pixel_borders.RINGS), 1.0)
    # The dark current of a CCD is equal in all normal pixels; the map of NISP contains it.
    mean_dark = frame.scene.dark_electrons if dark_current.EFFECT.name in frame.applied else 0.0
    electrons = _pattern(frame, (dark_map.EFFECT, dark_current.HOT), mean_dark)
    dark = (electrons / max(frame.scene.exposure_time_s, 1e-9)).astype(np.float32)
    flat = replace(masters.flat, mean=response.astype(np.float32))
    is_hot = electrons - np.median(electrons) > hot_electrons
    flags = masters.flags | calibration.response_flags(flat) | np.where(is_hot, calibration.HOT, 0).astype(np.uint8)
    return replace(masters, dark=replace(masters.dark, mean=dark), flat=flat, flags=flags)


def _pattern(frame: Frame, effects: Sequence[Effect], start: float) -> Float:
    """Return a constant image after the applied ones of some effects with fixed patterns of the detector."""
    out = np.full((frame.scene.ny, frame.scene.nx), start)
    seed = int(frame.card("SEED"))
    for effect in effects:
        if effect.name in frame.applied:
            rng = stream(*random_identity(effect, frame.exposure, frame.detector, seed))
            out = effect.apply(out, *effect.parameters(frame.scene), rng=rng)
    return out
