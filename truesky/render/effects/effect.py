"""The class `Effect`, which describes one detector effect such as dark current, and functions that apply effects.

The effects of a channel (an instrument mode such as Euclid VIS) are applied one after the other to a frame, an array of
pixels. An effect too small to be noticed in the image is omitted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lake_schema.errors import BadInput
from truesky.render.effects.scene import NOTICEABLE, Frame, Scene

# Bytes of the rows of a frame that are treated together, so that they stay in the cache of the processor.
_BLOCK_BYTES = 2**19


@dataclass(frozen=True, slots=True)
class Effect:
    """One physical effect that changes the pixels of an image, such as dark current or read noise.

    Attributes
    ----------
    name : str
        Name of the effect, different from the names of all other effects of the channel (the instrument mode).
    apply : callable
        Function (frame, *parameters, rng) that returns the changed frame. It does not modify its arguments, except
        for `out`, where it has this parameter.
    parameters : callable
        Function of a `Scene` (the settings of one detector's exposure) that returns the tuple of the parameters of
        `apply`.
    contribution : callable
        Function of a `Scene` that returns the largest change of a pixel in electrons. For random changes it is their
        standard deviation.
    optional : bool
        False if no image can be made without the effect, such as the analogue-to-digital conversion.
    fixed : bool
        True if the effect is a fixed pattern of the camera: its random numbers are the same in every exposure.
    shared : bool
        True if the effect is common to all detectors of an exposure: its random numbers are the same on every detector.
    random_stream : str
        Name of another effect whose sequence of random numbers is used. The default "" gives the effect a separate
        sequence.
    cost : float
        CPU seconds per million pixels on one core, measured by benchmarks/effects.py. It is more than 0 for every
        effect of a channel.
    systematic : callable, optional
        Function of a `Scene` that returns the part of the contribution that does not average out in a mean over many
        frames or pixels, in electrons. By default the whole contribution does not average out.
    in_place : bool
        True if `apply` has a parameter `out`, an array for the changed frame, which may be the frame itself. Allocating
        memory for a new frame takes longer than most effects.
    apply_to_scans : callable, optional
        Function (frame, scene, rng, out) that applies the effect to prescan and overscan only. It is used if the effect
        is not needed in the pixels, whose light hides it, unless the request switches the effect off.
    """

    name: str
    apply: Callable[..., Frame]
    parameters: Callable[[Scene], tuple[Any, ...]]
    contribution: Callable[[Scene], float]
    optional: bool = True
    fixed: bool = False
    shared: bool = False
    random_stream: str = ""
    cost: float = 0.0
    systematic: Callable[[Scene], float] | None = None
    in_place: bool = False
    apply_to_scans: Callable[[Frame, Scene, np.random.Generator, Frame | None], Frame] | None = None

    def margin(self, scene: Scene) -> float:
        """Return the size of the effect divided by the noticeable change. Above 1 the effect is needed.

        The noticeable change of a single pixel is 0.1 times its noise. The part of the effect that does not average out
        is compared with 0.1 times the noise of the mean of 1024 pixels. Both limits are larger if the request allows
        larger errors (`Scene.noticeable_electrons`, `Scene.noticeable_mean_electrons`), except for effects that average
        out completely: they are noise, and an image with too little noise would look deeper than it is. The larger of
        the two ratios is returned. Without noise the result is infinite, or 0 for an effect of size 0.
        """
        change = float(self.contribution(scene))
        systematic = change if self.systematic is None else float(self.systematic(scene))
        is_noise = self.systematic is zero_contribution
        limit = NOTICEABLE * scene.pixel_noise if is_noise else scene.noticeable_electrons
        mean_limit = scene.noticeable_mean_electrons
        # Without noise, any change above 0 is noticeable.
        if limit == 0.0:
            return math.inf if max(change, systematic) > 0.0 else 0.0
        return max(change / limit, systematic / mean_limit)

    def is_needed(self, scene: Scene) -> bool:
        """Return True if the effect is not optional or is noticeable.

        Whether the request switches the effect on or off (`scene.forced`) is ignored.
        """
        return not self.optional or self.margin(scene) > 1.0

    def is_applied(self, scene: Scene) -> bool:
        """Return True if the effect is applied: if the request switches it on, or does not mention it but it is needed.

        The switches of the request are in `scene.forced`.
        """
        return scene.forced.get(self.name, self.is_needed(scene))


def zero_contribution(scene: Scene) -> float:
    """Return 0 electrons for any scene.

    Effects that are pure noise use this function as `Effect.systematic`: they average out in a mean over many frames or
    pixels.
    """
    return 0.0


def copy_frame(frame: Frame, out: Frame | None) -> Frame:
    """Return a copy of a frame as float64 numbers: a new array, or `out`, which may be the frame itself."""
    if out is None:
        return np.array(frame, dtype=float, order="C")
    if out is not frame:
        out[...] = frame
    return out


def row_blocks(frame: Frame) -> Iterator[slice]:
    """Yield slices of successive rows of a frame (..., ny, nx), small enough for the cache of the processor."""
    rows = max(_BLOCK_BYTES // max(frame.itemsize * frame.size // max(frame.shape[-2], 1), 1), 1)
    for first in range(0, frame.shape[-2], rows):
        yield slice(first, first + rows)


def map_pixels(kernel: Callable[..., None], frame: Frame, *arguments: Any, out: Frame | None = None) -> Frame:
    """Apply a compiled function to all pixels of a frame, with different parameters for each amplifier if necessary.

    Parameters
    ----------
    kernel : callable
        Compiled function (pixels, *arguments) that changes `pixels` in place, a flat float64 array of the pixels of the
        frame, or of one of its amplifiers.
    frame : float array, shape (ny, nx) or (q, ...)
        Input frame. If any argument has one value per amplifier, the first axis counts the q amplifiers.
    *arguments : float, uint64 or array, shape (q,)
        Further arguments of `kernel`, at least one. Each is one value for the whole frame, or an array with one value
        for each of the q amplifiers.
    out : float64 array, shape of `frame`, optional
        Array for the result in C order, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape of `frame`
        Changed frame.

    Raises
    ------
    BadInput
        If an argument has q values and the first axis of the frame does not have the length q.
    """
    n_amplifiers = max(np.size(number) for number in arguments)
    if n_amplifiers > 1 and frame.shape[0] != n_amplifiers:
        raise BadInput(f"parameters have values for {n_amplifiers} amplifiers, but the frame has {frame.shape[0]}")
    out = copy_frame(frame, out)
    if n_amplifiers == 1:
        kernel(out.reshape(-1), *arguments)
        return out
    for number, pixels in enumerate(np.split(out.reshape(-1), n_amplifiers)):
        kernel(pixels, *(n[number] if np.ndim(n) else n for n in arguments))
    return out


@dataclass(frozen=True, slots=True)
class Decision:
    """Whether an effect is applied to an exposure, and why.

    Attributes
    ----------
    name : str
        Name of the effect.
    applied : bool
        True if the effect is applied.
    forced : bool
        True if the request of the user switches the effect on or off explicitly.
    margin : float
        Size of the effect relative to the change that is noticeable in the image. Above 1 the effect is needed.
    """

    name: str
    applied: bool
    forced: bool
    margin: float


def decide(effects: Sequence[Effect], scene: Scene) -> tuple[Decision, ...]:
    """Decide which effects to apply: the ones that the request switches on, and noticeable ones it does not switch off.

    The result has one `Decision` per effect, in the given order. Effects that are not optional are always applied;
    BadInput is raised if `scene.forced` switches one off. Names in `scene.forced` that are not among `effects` are
    ignored.
    """
    for effect in effects:
        if not effect.optional and not effect.is_applied(scene):
            raise BadInput(f"effect {effect.name} cannot be switched off")
    decisions = []
    for effect in effects:
        # Compute `margin` only once: for some effects it takes as long as applying the effect.
        margin = effect.margin(scene)
        applied = scene.forced.get(effect.name, not effect.optional or margin > 1.0)
        decisions.append(Decision(effect.name, applied, effect.name in scene.forced, margin))
    return tuple(decisions)


def apply_all(
    frame: Frame,
    effects: Sequence[Effect],
    scene: Scene,
    stream: Callable[[Effect], np.random.Generator],
    callback: Callable[[str, Frame, Frame], None] | None = None,
    recorded: Container[str] | None = None,
    reuse_frame: bool = False,
) -> tuple[Frame, tuple[Decision, ...]]:
    """Apply the effects of a channel (an instrument mode), one after the other, if they are noticeable or forced.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Input frame.
    effects : sequence of Effect
        Effects in the order in which they are applied.
    scene : Scene
        Settings of the exposure, from which the parameters of the effects are computed.
    stream : callable
        Function of an effect that returns its random generator. Each effect has a separate generator, so that switching
        one effect off does not change the random numbers of the others.
    callback : callable, optional
        Function (name, previous frame, new frame), called after each applied effect.
    recorded : container of str, optional
        Names of the effects after which `callback` is called. By default all.
    reuse_frame : bool, optional
        True to allow that the input frame is changed.

    Returns
    -------
    frame : float array
        Frame after all applied effects.
    decisions : tuple of Decision
        One decision per effect, also for the effects that were not applied.

    Raises
    ------
    BadInput
        If `scene.forced` switches off an effect that is not optional.
    """
    decisions, is_new = decide(effects, scene), reuse_frame
    for effect, decision in zip(effects, decisions, strict=True):
        if decision.applied:
            is_recorded = callback is not None and (recorded is None or effect.name in recorded)
            # The frame of the caller must not change (unless it allows this), nor a frame that the callback compares
            # with the next one.
            reusable = effect.in_place and is_new and not is_recorded
            reusable = reusable and frame.dtype == np.float64 and frame.flags.c_contiguous
            options = {"out": frame} if reusable else {}
            previous, frame = frame, effect.apply(frame, *effect.parameters(scene), rng=stream(effect), **options)
            is_new = is_new or not np.may_share_memory(previous, frame)
            if callback is not None and is_recorded:
                callback(effect.name, previous, frame)
            # Free the previous frame before the next effect allocates a new one, to reduce the peak memory.
            del previous
        elif effect.apply_to_scans is not None and not decision.forced:
            frame = effect.apply_to_scans(frame, scene, stream(effect), frame if is_new else None)
            is_new = True
    return frame, decisions
