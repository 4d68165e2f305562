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
from truesky.reduction import frames as lake_frames
from truesky.reduction.calibration import COSMIC_RAY, PERSISTENCE, SATURATED, Masters, ReducedImage
from truesky.reduction.combining import CombinedFrame, clipped_mean
from truesky.reduction.frames import Frame
from truesky.reduction.infrared import lamp_mix, linearity
from truesky.reduction.infrared.persistence_prediction import PersistencePrediction
from truesky.reduction.infrared.ramps import Estimator, RampNonlinearity
from truesky.render.effects.charge import ramp_nonlinearity
from truesky.render.effects.light import calibration_lamp, illumination

# chi^2 that non-linearity alone makes of a ramp, above which that it does not fit says nothing of cosmic rays.
_MAX_NONLINEAR_CHI2 = 1.0
# Of the pixels of a flat that are full; of its brightest flats the least level of those that a master is of.
_MAX_SATURATED, _MIN_RELATIVE_LEVEL = 0.01, 0.3


@dataclass(frozen=True, slots=True)
class Master:
    """A master: its kind, what it is, the frames that it is of, and more cards of its header."""

    kind: str
    combined: CombinedFrame
    frames: Sequence[Frame]
    cards: tuple[Card, ...] = ()


def incoming_charge(frame: Frame, b: Float | float, persistence: Float | float) -> Float:
    """Electrons [ny, nx] that came into each pixel, dark current with them, without what earlier exposures left.

    b : of N (1 - b N), 1/e-; 0 = as it is read;  left : e- of persistence
    """
    estimated = frame.electrons()
    estimated -= Estimator.from_scene(frame.scene, frame.applied).bias(estimated)
    return np.asarray(
        RampNonlinearity.from_scene(frame.scene, frame.applied).linearise(estimated, np.asarray(b)) - persistence
    )


def declared_nonlinearity(frame: Frame) -> float:
    """b of the usual pixel as the mission has it; 0 where a frame has none."""
    nonlinear_effects = {ramp_nonlinearity.EFFECT.name, ramp_nonlinearity.SIGNAL.name} & frame.applied
    return frame.scene.value("nonlinearity", "1 / electron") if nonlinear_effects else 0.0


def make_masters(frames: Sequence[Frame], scratch: Path) -> Iterator[Master]:
    """Masters of what a detector's frames allow: dark of each ramp, linearity, flat of each band.

    frames  : all of one detector: of what they show the others' persistence is taken off
    scratch : folder for the frames while they are combined: 4 bytes a pixel and frame
    Errors  : BadInput where there is neither a dark nor a flat
    """
    prediction, darks = PersistencePrediction(frames), dict[tuple[int, int, int], CombinedFrame]()
    for group in _group_frames(
        lake_frames.select_types(frames, ("dark",)), lambda frame: (frame.exposure.channel, *frame.ramp)
    ):
        combined = _combine_frames(
            group, [frame.exposure.exposure_time_s for frame in group], (prediction, 0.0, None), scratch
        )
        darks[group[0].ramp] = combined
        yield Master("dark", combined, group)
    flats = [
        frame
        for frame in lake_frames.select_types(frames, ("flat",))
        if frame.saturated_pixels().mean() < _MAX_SATURATED
    ]
    if not darks and not flats:
        raise BadInput(f"detector {frames[0].detector}: the lake has no dark and no flat of it")
    b: Float | float | None = None
    if series := linearity.longest_series(flats):
        combined = linearity.fit(
            series, lambda frame: (prediction.charge_in(frame), _dark_charge(frame, darks)), scratch
        )
        b = combined.mean.astype(float)
        yield Master("linearity", combined, series)
    for group in _group_frames(flats, lambda frame: (frame.exposure.channel, frame.exposure.band)):
        yield _make_flat(group, (prediction, declared_nonlinearity(group[0]) if b is None else b, darks), scratch)


def _group_frames(frames: Sequence[Frame], key: object) -> list[list[Frame]]:
    groups: dict[object, list[Frame]] = {}
    for frame in frames:
        groups.setdefault(key(frame), []).append(frame)  # type: ignore[operator]
    return list(groups.values())


Corrections = tuple[PersistencePrediction, Float | float, Mapping[tuple[int, int, int], CombinedFrame] | None]


def _dark_charge(frame: Frame, darks: Mapping[tuple[int, int, int], CombinedFrame] | None) -> Float | float:
    """Electrons of its dark current: of its own ramp's master, else of another's."""
    if not darks:
        return 0.0
    master = darks.get(frame.ramp) or next(iter(darks.values()))
    return np.asarray(master.mean * frame.exposure.exposure_time_s)


def _combine_frames(
    frames: Sequence[Frame], units: Sequence[Float | float], corrections: Corrections, scratch: Path
) -> CombinedFrame:
    """Mean of frames in their units; units : electrons [ny, nx] of each that are 1 in the master."""
    prediction, b, darks = corrections
    lake_frames.common_values(frames, (*files.SHARED_CARDS,))
    scene = frames[0].scene
    stack = np.memmap(scratch / "frames", np.float32, "w+", shape=(len(frames), scene.ny, scene.nx))
    mean_unit, mean_persistence = np.zeros((scene.ny, scene.nx)), np.zeros((scene.ny, scene.nx))
    for number, (frame, unit) in enumerate(zip(frames, units, strict=True)):
        persistence = prediction.charge_in(frame)
        stack[number] = (incoming_charge(frame, b, persistence) - _dark_charge(frame, darks)) / unit
        mean_unit += np.asarray(unit) / len(frames)
        mean_persistence += persistence / len(frames)
    estimator = Estimator.from_scene(scene, frames[0].applied)
    spread = scene.value("persistence.spread", "")

    def variance(expected: Float, rows: slice) -> Float:
        read_variance = estimator.variance(np.maximum(expected, 0.0) * mean_unit[rows] + mean_persistence[rows])
        return np.asarray((read_variance + (spread * mean_persistence[rows]) ** 2) / mean_unit[rows] ** 2)

    combined = clipped_mean(stack, variance)
    del stack
    (scratch / "frames").unlink()
    return combined


def _make_flat(frames: Sequence[Frame], corrections: Corrections, scratch: Path) -> Master:
    """Of each lamp that shines in the band its master over its light; and their mix that the sky's light is like."""
    brightest = max(frame.scene.value("flat.signal", "electron") for frame in frames)
    bright_frames = [
        frame for frame in frames if frame.scene.value("flat.signal", "electron") >= _MIN_RELATIVE_LEVEL * brightest
    ]
    by_lamp = _group_frames(bright_frames, lambda frame: frame.scene.lamp)
    lamp_flats = [
        _combine_frames(group, [_lamp_charge(frame) for frame in group], corrections, scratch) for group in by_lamp
    ]
    scene, numbers = bright_frames[0].scene, [group[0].scene.lamp for group in by_lamp]
    weights = lamp_mix.weights(scene, numbers)
    mean = np.sum([weight * lamp_flat.mean for weight, lamp_flat in zip(weights, lamp_flats, strict=True)], axis=0)
    uncertainties = [
        np.where(weight > 0.0, weight * lamp_flat.uncertainty, 0.0)
        for weight, lamp_flat in zip(weights, lamp_flats, strict=True)
    ]
    counts = [lamp_flat.count for weight, lamp_flat in zip(weights, lamp_flats, strict=True) if weight > 0.0]
    mixed = CombinedFrame(
        mean.astype(np.float32),
        np.sqrt(np.sum(np.square(uncertainties), axis=0)).astype(np.float32),
        np.min(counts, axis=0),
    )
    cards: list[Card] = []
    for i, (number, weight) in enumerate(zip(numbers, weights, strict=True), start=1):
        cards += [(f"LAMP{i}", number, "LED of the calibration unit"), (f"WEIGHT{i}", weight, "of it in the mix")]
    return Master("flat", mixed, bright_frames, tuple(cards))


def _lamp_charge(frame: Frame) -> Float:
    """Electrons [ny, nx] that the lamp of a flat would bring were all its light counted."""
    electrons, *pattern = calibration_lamp.EFFECT.parameters(frame.scene)
    return np.asarray(electrons * illumination.apply(np.ones((frame.scene.ny, frame.scene.nx)), *pattern))


def calibrate(
    frame: Frame, masters: Masters, prediction: PersistencePrediction | None, effects: Sequence[str], unit: float
) -> ReducedImage:
    """A calibrated frame that sees the sky.

    own      : masters of its detector, of which the bias is b of N (1 - b N)
    foreseen : what is left in the detector's frames; None = it is left as it is
    undone   : of the frame's effects those that are undone;  unit : electrons that the image's unit is
    Error    : of the weight: shot noise of the light that is expected, not counted; neighbours share their charge: a
               pixel's noise is less than that of the mean of many tells
    """
    time = frame.scene.exposure_time_s
    dark = masters.dark.mean * time
    persistence = np.zeros(dark.shape) if prediction is None else prediction.charge_in(frame)
    nonlinear_effects = {ramp_nonlinearity.EFFECT.name, ramp_nonlinearity.SIGNAL.name} & {*effects}
    b = masters.bias.mean.astype(float) if nonlinear_effects else np.zeros(1)
    charge = incoming_charge(frame, b, persistence)
    response = np.asarray(masters.flat.mean, float)
    flags = masters.flags | np.where(frame.saturated_pixels(), SATURATED, 0).astype(np.uint8)
    flags |= np.where(_hit_pixels(frame, charge, b) & (flags & SATURATED == 0), COSMIC_RAY, 0).astype(np.uint8)
    has_value = (response > 0.0) & np.isfinite(charge)
    image = np.where(has_value, charge - dark, 0.0) / np.where(has_value, response, 1.0)
    used = has_value & (flags & ~np.uint8(calibration.GOOD) == 0)
    estimator = Estimator.from_scene(frame.scene, frame.applied)
    light = calibration.expected_light(image, used, float(estimator.variance(np.zeros(1))[0]))
    variance = estimator.variance(np.maximum(light * response + dark + persistence, 0.0))
    flags |= np.where(persistence > np.sqrt(variance), PERSISTENCE, 0).astype(np.uint8)
    variance += (frame.scene.value("persistence.spread", "") * persistence) ** 2
    variance += (masters.dark.uncertainty * time) ** 2 + (light * response * masters.flat.uncertainty) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(used, response**2 / variance, 0.0)
    weight = np.where(np.isfinite(weight), weight * unit**2, 0.0).astype(np.float32)
    return ReducedImage((image / unit).astype(np.float32), weight, flags)


def _hit_pixels(frame: Frame, charge: Float, b: Float) -> Bool:
    """Pixels [ny, nx] whose ramp has a step."""
    nonlinearity = RampNonlinearity.from_scene(frame.scene, frame.applied)
    return np.asarray(
        frame.misfit_pixels()
        & (nonlinearity.chi_square(charge, np.maximum(b, declared_nonlinearity(frame))) < _MAX_NONLINEAR_CHI2)
    )


def read_masters(folder: Path, frame: Frame, without: Sequence[str]) -> Masters:
    """The masters of a frame; without : those that are not wanted, and `nonlinearity`: as it is read."""
    shape, combined, dark_time = (frame.scene.ny, frame.scene.nx), {}, np.inf
    for kind in files.master_kinds(frame):
        if kind in without or (kind == "linearity" and "nonlinearity" in without):
            neutral = {"flat": 1.0, "dark": 0.0, "linearity": declared_nonlinearity(frame)}[kind]
            combined[kind] = calibration.neutral_master(shape, neutral)
        else:
            combined[kind], time = files.read_master(files.master_path(folder, frame, kind), kind, frame)
            dark_time = time if kind == "dark" else dark_time
    flags = calibration.master_flags(shape, combined, without)
    flat = replace(combined["flat"], vignetted=True)
    return Masters(combined["linearity"], combined["dark"], flat, flags, dark_time)
