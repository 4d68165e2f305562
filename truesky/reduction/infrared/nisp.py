"""Make NISP masters of dark current, linearity and flats, and calibrate NISP images::

    signal = (linearised(estimated - bias of the estimator) - dark time - persistence) / flat

The module `ramps` describes the estimator of the signal of a ramp.
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

# Largest chi^2 of a ramp due to nonlinearity alone. Above it, a bad fit is not a sign of a cosmic ray.
_MAX_NONLINEAR_CHI2 = 1.0
# Flats with this fraction of saturated pixels or more are rejected. A master flat uses flats of at least this fraction
# of the brightest level.
_MAX_SATURATED, _MIN_RELATIVE_LEVEL = 0.01, 0.3


@dataclass(frozen=True, slots=True)
class Master:
    """A master frame.

    Attributes
    ----------
    kind : str
        Kind of master.
    combined : CombinedFrame
        The master.
    frames : sequence of Frame
        Frames that were combined.
    cards : tuple of Card
        Further cards of its header.
    """

    kind: str
    combined: CombinedFrame
    frames: Sequence[Frame]
    cards: tuple[Card, ...] = ()


def incoming_charge(frame: Frame, b: Float | float, persistence: Float | float) -> Float:
    """Return the electrons that each pixel received, including dark current, without persistence.

    Parameters
    ----------
    frame : Frame
        The frame.
    b : float or float array, shape (ny, nx)
        b of N (1 - b N) in 1/electron; 0 for no correction.
    persistence : float or float array, shape (ny, nx)
        Electrons of persistence.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons.
    """
    estimated = frame.electrons()
    estimated -= Estimator.from_scene(frame.scene, frame.applied).bias(estimated)
    return np.asarray(
        RampNonlinearity.from_scene(frame.scene, frame.applied).linearise(estimated, np.asarray(b)) - persistence
    )


def declared_nonlinearity(frame: Frame) -> float:
    """Return b of the typical pixel from the mission parameters, 0 for a frame without nonlinearity."""
    nonlinear_effects = {ramp_nonlinearity.EFFECT.name, ramp_nonlinearity.SIGNAL.name} & frame.applied
    return frame.scene.value("nonlinearity", "1 / electron") if nonlinear_effects else 0.0


def make_masters(frames: Sequence[Frame], scratch: Path) -> Iterator[Master]:
    """Make the masters that a detector's frames allow: a dark of each ramp, linearity, and a flat of each band.

    Parameters
    ----------
    frames : sequence of Frame
        All frames of one detector. Persistence of each frame in later frames is subtracted.
    scratch : Path
        Folder for temporary files, 4 bytes per pixel and frame (8 bytes for linearity).

    Yields
    ------
    Master
        The masters.

    Raises
    ------
    BadInput
        If there is neither a dark nor a flat.
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
        raise BadInput(f"detector {frames[0].detector}: the lake has neither a dark nor a flat")
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
    """Return the electrons of dark current in a frame, from the master of its ramp, or else of another ramp."""
    if not darks:
        return 0.0
    master = darks.get(frame.ramp) or next(iter(darks.values()))
    return np.asarray(master.mean * frame.exposure.exposure_time_s)


def _combine_frames(
    frames: Sequence[Frame], units: Sequence[Float | float], corrections: Corrections, scratch: Path
) -> CombinedFrame:
    """Return the mean of frames; `units` has the electrons [ny, nx] of each frame per unit of the master."""
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
    """Make a flat of each lamp divided by its light, and return the mixture that is most similar to the sky."""
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
        cards += [
            (f"LAMP{i}", number, "LED of the calibration unit"),
            (f"WEIGHT{i}", weight, "weight of this LED in the mixed flat"),
        ]
    return Master("flat", mixed, bright_frames, tuple(cards))


def _lamp_charge(frame: Frame) -> Float:
    """Return the electrons that the lamp of a flat would give if all light were counted, float64[ny, nx]."""
    electrons, *pattern = calibration_lamp.EFFECT.parameters(frame.scene)
    return np.asarray(electrons * illumination.apply(np.ones((frame.scene.ny, frame.scene.nx)), *pattern))


def calibrate(
    frame: Frame, masters: Masters, prediction: PersistencePrediction | None, effects: Sequence[str], unit: float
) -> ReducedImage:
    """Calibrate a frame of the sky.

    Parameters
    ----------
    frame : Frame
        The frame.
    masters : Masters
        Masters of the detector. Their `bias` contains b of N (1 - b N).
    prediction : PersistencePrediction or None
        Persistence in the detector's frames; None to leave it in the image.
    effects : sequence of str
        Effects of the frame that are undone.
    unit : float
        Electrons per unit of the image.

    Returns
    -------
    ReducedImage
        The calibrated image.

    Notes
    -----
    Weights contain the shot noise of the expected light, not of the counted light. Neighbouring pixels share charge, so
    the noise of a single pixel is smaller than the noise of sums over many pixels suggests.
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
    """Return True for pixels with a step in their ramp, bool[ny, nx]."""
    nonlinearity = RampNonlinearity.from_scene(frame.scene, frame.applied)
    return np.asarray(
        frame.misfit_pixels()
        & (nonlinearity.chi_square(charge, np.maximum(b, declared_nonlinearity(frame))) < _MAX_NONLINEAR_CHI2)
    )


def read_masters(folder: Path, frame: Frame, without: Sequence[str]) -> Masters:
    """Read the masters for a frame.

    Parameters
    ----------
    folder : Path
        Folder of the masters.
    frame : Frame
        Frame to calibrate.
    without : sequence of str
        Kinds that are not read but replaced by constants; "nonlinearity" also omits the linearity.

    Returns
    -------
    Masters
        The masters.
    """
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
