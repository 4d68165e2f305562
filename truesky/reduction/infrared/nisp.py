"""Make NISP masters (dark current, linearity, flats and the bad-pixel map), and calibrate NISP images::

    image = (linearised(measured - bias) - persistence - dark current x exposure time) / flat

Here `measured` is the signal that the on-board software fits to the reads of a pixel (the ramp), and `bias` is the
systematic error of this fit, see the module `ramps`.
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

# A bad fit of a ramp counts as a cosmic ray only if nonlinearity alone would give a chi^2 below this value.
_MAX_NONLINEAR_CHI2 = 1.0
# Flats are rejected if at least this fraction of their pixels is saturated.
_MAX_SATURATED = 0.01
# A master flat uses only flats whose lamp intensity is at least this fraction of the brightest flat's.
_MIN_RELATIVE_LEVEL = 0.3


@dataclass(frozen=True, slots=True)
class Master:
    """A master (combined calibration frame), with the frames and cards that are written to its header.

    Attributes
    ----------
    kind : str
        Kind of master: "bias", "dark", "linearity", "flat" or "bad_pixels".
    combined : CombinedFrame
        Pixels of the master, their uncertainty and number of frames.
    frames : sequence of Frame
        Frames that were combined.
    cards : tuple of Card
        Further header cards (keyword, value, comment).
    """

    kind: str
    combined: CombinedFrame
    frames: Sequence[Frame]
    cards: tuple[Card, ...] = ()


def incoming_charge(frame: Frame, b: Float | float, persistence: Float | float) -> Float:
    """Return the electrons of light and dark current in each pixel, corrected for nonlinearity and persistence.

    Parameters
    ----------
    frame : Frame
        The raw frame, which is read from its file.
    b : float or float array, shape (ny, nx)
        Nonlinearity in 1/electron: of N electrons, N (1 - b N) are measured. 0 for no correction.
    persistence : float or float array, shape (ny, nx)
        Electrons of persistence, which are subtracted.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons of the exposure.
    """
    estimated = frame.electrons()
    estimated -= Estimator.from_scene(frame.scene, frame.applied).bias(estimated)
    return np.asarray(
        RampNonlinearity.from_scene(frame.scene, frame.applied).linearise(estimated, np.asarray(b)) - persistence
    )


def declared_nonlinearity(frame: Frame) -> float:
    """Return the nonlinearity b (1/electron) of the typical pixel from the mission parameters.

    Of N electrons, N (1 - b N) are measured. The result is 0 if the frame was simulated without nonlinearity.
    """
    nonlinear_effects = {ramp_nonlinearity.EFFECT.name, ramp_nonlinearity.SIGNAL.name} & frame.applied
    return frame.scene.value("nonlinearity", "1 / electron") if nonlinear_effects else 0.0


def make_masters(frames: Sequence[Frame], scratch: Path) -> Iterator[Master]:
    """Make the masters of a NISP detector: darks by readout mode, linearity, flats by band, and the bad-pixel map.

    A master is omitted if the frames do not allow it. The map combines the flags of all darks and flats.

    Parameters
    ----------
    frames : sequence of Frame
        All frames of one detector, including those of the sky: the persistence of every frame is subtracted from later
        frames.
    scratch : Path
        Folder for temporary files, which take 4 bytes per pixel and frame (8 bytes for linearity).

    Yields
    ------
    Master
        First the darks, then the linearity, then the flats, and the bad-pixel map at the end.

    Raises
    ------
    BadInput
        If there is neither a dark nor a flat with less than 1 % saturated pixels, or if frames of a dark or flat differ
        in instrument, detector or seed.
    """
    prediction, darks = PersistencePrediction(frames), dict[tuple[int, int, int], CombinedFrame]()
    bad_pixels, judged = np.zeros((frames[0].scene.ny, frames[0].scene.nx), np.uint8), 0
    for group in _group_frames(
        lake_frames.select_types(frames, ("dark",)), lambda frame: (frame.exposure.channel, *frame.ramp)
    ):
        combined = _combine_frames(
            group, [frame.exposure.exposure_time_s for frame in group], (prediction, 0.0, None), scratch
        )
        darks[group[0].ramp] = combined
        bad_pixels, judged = bad_pixels | calibration.dark_flags(combined), judged + 1
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
        flat = _make_flat(group, (prediction, declared_nonlinearity(group[0]) if b is None else b, darks), scratch)
        bad_pixels, judged = bad_pixels | calibration.response_flags(flat.combined), judged + 1
        yield flat
    counts = np.full(bad_pixels.shape, judged, np.int16)
    combined = CombinedFrame(bad_pixels.astype(np.float32), np.zeros(bad_pixels.shape, np.float32), counts)
    yield Master("bad_pixels", combined, [*lake_frames.select_types(frames, ("dark",)), *flats], files.flag_cards())


def _group_frames(frames: Sequence[Frame], key: object) -> list[list[Frame]]:
    groups: dict[object, list[Frame]] = {}
    for frame in frames:
        groups.setdefault(key(frame), []).append(frame)  # type: ignore[operator]
    return list(groups.values())


Corrections = tuple[PersistencePrediction, Float | float, Mapping[tuple[int, int, int], CombinedFrame] | None]


def _dark_charge(frame: Frame, darks: Mapping[tuple[int, int, int], CombinedFrame] | None) -> Float | float:
    """Return the electrons of dark current in a frame, from the master dark of its readout mode.

    If this mode has no master, another mode's is used. Without any master dark, the result is 0.
    """
    if not darks:
        return 0.0
    master = darks.get(frame.ramp) or next(iter(darks.values()))
    return np.asarray(master.mean * frame.exposure.exposure_time_s)


def _combine_frames(
    frames: Sequence[Frame], units: Sequence[Float | float], corrections: Corrections, scratch: Path
) -> CombinedFrame:
    """Return the clipped mean of frames in units of the master.

    Each frame is divided by its element of `units`: the number of electrons (a scalar or [ny, nx]) that corresponds to
    the value 1 in the master. `corrections` are the persistence, nonlinearity b and darks to subtract.
    """
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
    """Make a master flat of one band.

    The flats of each lamp are divided by the light of the lamp and combined. The result is their weighted mean, with
    the weights for which the colour of the lamps is most similar to the sky.
    """
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
    """Return the electrons per pixel that the lamp of a flat would give at a response of 1, float64[ny, nx]."""
    electrons, *pattern = calibration_lamp.EFFECT.parameters(frame.scene)
    return np.asarray(electrons * illumination.apply(np.ones((frame.scene.ny, frame.scene.nx)), *pattern))


def calibrate(
    frame: Frame, masters: Masters, prediction: PersistencePrediction | None, effects: Sequence[str], unit: float
) -> ReducedImage:
    """Calibrate a NISP frame of the sky.

    Parameters
    ----------
    frame : Frame
        The raw frame, which is read from its file.
    masters : Masters
        Masters of the detector. Their `bias` contains the nonlinearity b in 1/electron, if N (1 - b N) of N electrons
        are measured.
    prediction : PersistencePrediction or None
        Predicts persistence from earlier frames of the detector; None to leave persistence in the image.
    effects : sequence of str
        Names of simulated effects that are corrected. Nonlinearity is corrected only if it is among them.
    unit : float
        Number by which electrons are divided to get the unit of the image: 1 for electrons, the exposure time for
        electrons per second.

    Returns
    -------
    ReducedImage
        The calibrated image. Pixels with response 0 or below, or with NaN, have the value 0 and the weight 0.

    Notes
    -----
    Weights contain the shot noise of a smooth model of the light, not of the counted light. They are for single pixels.
    Neighbouring pixels share charge, so the variance of a sum over pixels is larger than the sum of their variances.
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
    """Return a mask of pixels whose ramp has a step, probably by a cosmic ray, bool[ny, nx].

    A bad fit of the ramp counts only if nonlinearity alone cannot explain it.
    """
    nonlinearity = RampNonlinearity.from_scene(frame.scene, frame.applied)
    return np.asarray(
        frame.misfit_pixels()
        & (nonlinearity.chi_square(charge, np.maximum(b, declared_nonlinearity(frame))) < _MAX_NONLINEAR_CHI2)
    )


def read_masters(folder: Path, frame: Frame, without: Sequence[str]) -> Masters:
    """Read the masters (dark, linearity and flat) with which a NISP frame is calibrated.

    Parameters
    ----------
    folder : Path
        Folder of the master files.
    frame : Frame
        Frame to calibrate.
    without : sequence of str
        Kinds of masters that are not read: "dark" is replaced by 0, "flat" by 1, and "linearity" (or "nonlinearity") by
        the value of the mission parameters.

    Returns
    -------
    Masters
        The masters. The linearity is stored as `bias`. Its flags come from the masters that are read, and from the
        bad-pixel map of the detector if it exists, whatever is omitted.

    Raises
    ------
    BadInput
        If a file does not exist, or does not belong to the detector.
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
    if (bad_pixels := files.master_path(folder, frame, "bad_pixels")).exists():
        bits = files.read_master(bad_pixels, "bad_pixels", frame)[0].mean
        flags |= np.clip(bits, 0, 255).astype(np.uint8)
    flat = replace(combined["flat"], vignetted=True)
    return Masters(combined["linearity"], combined["dark"], flat, flags, dark_time)
