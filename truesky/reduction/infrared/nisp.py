"""NISP's frames: masters of dark current, linearity and flats, and calibrated images.

signal = (linearised(estimated - bias of the estimator) - dark time - persistence) / flat

Detectors   what is done with frames of one detector: .masters, .reduced
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lake_schema.arrays import Bool, Float
from lake_schema.errors import BadInput
from lake_schema.fits.images import Card
from truesky.reduction import calibration, files
from truesky.reduction import frames as frames_of
from truesky.reduction.calibration import COSMIC_RAY, PERSISTENCE, SATURATED, Masters, Reduced
from truesky.reduction.combining import Combined, clipped_mean
from truesky.reduction.frames import Frame
from truesky.reduction.infrared import lamp_mix, linearity
from truesky.reduction.infrared.foreseen import Foreseen
from truesky.reduction.infrared.ramps import Bend, Estimator
from truesky.render.effects.charge import ramp_nonlinearity
from truesky.render.effects.light import calibration_lamp, illumination

# chi^2 that non-linearity alone makes of a ramp, above which that it does not fit says nothing of cosmic rays.
_BENT = 1.0
# Of the pixels of a flat that are full; of its brightest flats the least level of those that a master is of.
_FULL, _BRIGHT = 0.01, 0.3


@dataclass(frozen=True, slots=True)
class Made:
    """A master: its kind, what it is, the frames that it is of, and more cards of its header."""

    kind: str
    combined: Combined
    frames: Sequence[Frame]
    cards: tuple[Card, ...] = ()


def counted(frame: Frame, b: Float | float, left: Float | float) -> Float:
    """Electrons [ny, nx] that came into each pixel, dark current with them, without what earlier exposures left.

    b : of N (1 - b N), 1/e-; 0 = as it is read;  left : e- of persistence
    """
    estimated = frame.electrons()
    estimated -= Estimator.of(frame.scene, frame.applied).bias(estimated)
    return np.asarray(Bend.of(frame.scene, frame.applied).linearised(estimated, np.asarray(b)) - left)


def declared(frame: Frame) -> float:
    """b of the usual pixel as the mission has it; 0 where a frame has none."""
    bent = {ramp_nonlinearity.EFFECT.name, ramp_nonlinearity.SIGNAL.name} & frame.applied
    return frame.scene.value("nonlinearity", "1 / electron") if bent else 0.0


def masters(frames: Sequence[Frame], scratch: Path) -> Iterator[Made]:
    """Masters of what a detector's frames allow: dark of each ramp, linearity, flat of each band.

    frames  : all of one detector: of what they show the others' persistence is taken off
    scratch : folder for the frames while they are combined: 4 bytes a pixel and frame
    Errors  : BadInput where there is neither a dark nor a flat
    """
    foreseen, darks = Foreseen(frames), dict[tuple[int, int, int], Combined]()
    for own in _alike(frames_of.of_types(frames, ("dark",)), lambda frame: (frame.exposure.channel, *frame.ramp)):
        made = _combined(own, [frame.exposure.exposure_time_s for frame in own], (foreseen, 0.0, None), scratch)
        darks[own[0].ramp] = made
        yield Made("dark", made, own)
    flats = [frame for frame in frames_of.of_types(frames, ("flat",)) if frame.full().mean() < _FULL]
    if not darks and not flats:
        raise BadInput(f"detector {frames[0].detector}: the lake has no dark and no flat of it")
    b: Float | float | None = None
    if series := linearity.series(flats):
        made = linearity.fitted(series, lambda frame: (foreseen.of(frame), _dark(frame, darks)), scratch)
        b = made.mean.astype(float)
        yield Made("linearity", made, series)
    for own in _alike(flats, lambda frame: (frame.exposure.channel, frame.exposure.band)):
        yield _flat(own, (foreseen, declared(own[0]) if b is None else b, darks), scratch)


def _alike(frames: Sequence[Frame], key: object) -> list[list[Frame]]:
    found: dict[object, list[Frame]] = {}
    for frame in frames:
        found.setdefault(key(frame), []).append(frame)  # type: ignore[operator]
    return list(found.values())


Undone = tuple[Foreseen, Float | float, Mapping[tuple[int, int, int], Combined] | None]


def _dark(frame: Frame, darks: Mapping[tuple[int, int, int], Combined] | None) -> Float | float:
    """Electrons of its dark current: of its own ramp's master, else of another's."""
    if not darks:
        return 0.0
    master = darks.get(frame.ramp) or next(iter(darks.values()))
    return np.asarray(master.mean * frame.exposure.exposure_time_s)


def _combined(frames: Sequence[Frame], units: Sequence[Float | float], undone: Undone, scratch: Path) -> Combined:
    """Mean of frames in their units; units : electrons [ny, nx] of each that are 1 in the master."""
    foreseen, b, darks = undone
    frames_of.common(frames, (*files.SAME,))
    scene = frames[0].scene
    stack = np.memmap(scratch / "frames", np.float32, "w+", shape=(len(frames), scene.ny, scene.nx))
    mean, left = np.zeros((scene.ny, scene.nx)), np.zeros((scene.ny, scene.nx))
    for number, (frame, unit) in enumerate(zip(frames, units, strict=True)):
        persistence = foreseen.of(frame)
        stack[number] = (counted(frame, b, persistence) - _dark(frame, darks)) / unit
        mean += np.asarray(unit) / len(frames)
        left += persistence / len(frames)
    estimator = Estimator.of(scene, frames[0].applied)
    spread = scene.value("persistence.spread", "")

    def variance(expected: Float, rows: slice) -> Float:
        read = estimator.variance(np.maximum(expected, 0.0) * mean[rows] + left[rows])
        return np.asarray((read + (spread * left[rows]) ** 2) / mean[rows] ** 2)

    found = clipped_mean(stack, variance)
    del stack
    (scratch / "frames").unlink()
    return found


def _flat(frames: Sequence[Frame], undone: Undone, scratch: Path) -> Made:
    """Of each lamp that shines in the band its master over its light; and their mix that the sky's light is like."""
    brightest = max(frame.scene.value("flat.signal", "electron") for frame in frames)
    some = [frame for frame in frames if frame.scene.value("flat.signal", "electron") >= _BRIGHT * brightest]
    by_lamp = _alike(some, lambda frame: frame.scene.lamp)
    found = [_combined(own, [_lamp(frame) for frame in own], undone, scratch) for own in by_lamp]
    scene, numbers = some[0].scene, [own[0].scene.lamp for own in by_lamp]
    weights = lamp_mix.weights(scene, numbers)
    mean = np.sum([weight * one.mean for weight, one in zip(weights, found, strict=True)], axis=0)
    parts = [np.where(weight > 0.0, weight * one.uncertainty, 0.0) for weight, one in zip(weights, found, strict=True)]
    used = [one.count for weight, one in zip(weights, found, strict=True) if weight > 0.0]
    mixed = Combined(
        mean.astype(np.float32), np.sqrt(np.sum(np.square(parts), axis=0)).astype(np.float32), np.min(used, axis=0)
    )
    cards: list[Card] = []
    for i, (number, weight) in enumerate(zip(numbers, weights, strict=True), start=1):
        cards += [(f"LAMP{i}", number, "LED of the calibration unit"), (f"WEIGHT{i}", weight, "of it in the mix")]
    return Made("flat", mixed, some, tuple(cards))


def _lamp(frame: Frame) -> Float:
    """Electrons [ny, nx] that the lamp of a flat would bring were all its light counted."""
    electrons, *pattern = calibration_lamp.EFFECT.parameters(frame.scene)
    return np.asarray(electrons * illumination.apply(np.ones((frame.scene.ny, frame.scene.nx)), *pattern))


def reduced(frame: Frame, own: Masters, foreseen: Foreseen | None, undone: Sequence[str], unit: float) -> Reduced:
    """A calibrated frame that sees the sky.

    own      : masters of its detector, of which the bias is b of N (1 - b N)
    foreseen : what is left in the detector's frames; None = it is left as it is
    undone   : of the frame's effects those that are undone;  unit : electrons that the image's unit is
    Error    : of the weight: shot noise of the light that is expected, not counted; neighbours share their charge: a
               pixel's noise is less than that of the mean of many tells
    """
    time = frame.scene.exposure_time_s
    dark = own.dark.mean * time
    left = np.zeros(dark.shape) if foreseen is None else foreseen.of(frame)
    bent = {ramp_nonlinearity.EFFECT.name, ramp_nonlinearity.SIGNAL.name} & {*undone}
    b = own.bias.mean.astype(float) if bent else np.zeros(1)
    came = counted(frame, b, left)
    response = np.asarray(own.flat.mean, float)
    flags = own.flags | np.where(frame.full(), SATURATED, 0).astype(np.uint8)
    flags |= np.where(_hit(frame, came, b) & (flags & SATURATED == 0), COSMIC_RAY, 0).astype(np.uint8)
    known = (response > 0.0) & np.isfinite(came)
    image = np.where(known, came - dark, 0.0) / np.where(known, response, 1.0)
    used = known & (flags & ~np.uint8(calibration.GOOD) == 0)
    estimator = Estimator.of(frame.scene, frame.applied)
    light = calibration.expected(image, used, float(estimator.variance(np.zeros(1))[0]))
    variance = estimator.variance(np.maximum(light * response + dark + left, 0.0))
    flags |= np.where(left > np.sqrt(variance), PERSISTENCE, 0).astype(np.uint8)
    variance += (frame.scene.value("persistence.spread", "") * left) ** 2
    variance += (own.dark.uncertainty * time) ** 2 + (light * response * own.flat.uncertainty) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(used, response**2 / variance, 0.0)
    weight = np.where(np.isfinite(weight), weight * unit**2, 0.0).astype(np.float32)
    return Reduced((image / unit).astype(np.float32), weight, flags)


def _hit(frame: Frame, came: Float, b: Float) -> Bool:
    """Pixels [ny, nx] whose ramp has a step."""
    bend = Bend.of(frame.scene, frame.applied)
    return np.asarray(frame.misfit() & (bend.misfit(came, np.maximum(b, declared(frame))) < _BENT))


def of_frame(folder: Path, frame: Frame, without: Sequence[str]) -> Masters:
    """The masters of a frame; without : those that are not wanted, and `nonlinearity`: as it is read."""
    shape, found, dark_time = (frame.scene.ny, frame.scene.nx), {}, np.inf
    for kind in files.kinds(frame):
        if kind in without or (kind == "linearity" and "nonlinearity" in without):
            neutral = {"flat": 1.0, "dark": 0.0, "linearity": declared(frame)}[kind]
            found[kind] = calibration.nothing(shape, neutral)
        else:
            found[kind], time = files.read_master(files.master_name(folder, frame, kind), kind, frame)
            dark_time = time if kind == "dark" else dark_time
    flags = calibration.master_flags(shape, found, without)
    flat = replace(found["flat"], vignetted=True)
    return Masters(found["linearity"], found["dark"], flat, flags, dark_time)
