"""Define a detector effect, and apply the effects of a channel in their order."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lake_schema.errors import BadInput
from truesky.render.effects.scene import NOTICEABLE, STACK_SIZE, Frame, Scene


@dataclass(frozen=True, slots=True)
class Effect:
    """One physical effect.

    Attributes
    ----------
    name : str
        Name of the effect, unique in a channel.
    apply : callable
        Function (frame, *parameters, rng) -> new frame. It does not modify its arguments.
    parameters : callable
        Function scene -> tuple of the parameters of `apply`.
    contribution : callable
        Function scene -> largest change of a pixel in electrons; standard deviation for random changes.
    optional : bool
        False if frames cannot be made without the effect.
    fixed : bool
        True for a pattern of the detector: its random numbers are the same in every exposure.
    shared : bool
        True if the effect is common to all detectors: its random numbers are the same on every detector.
    random_stream : str
        Name of another effect whose random numbers this one uses. By default the effect has separate random numbers.
    cost : float
        CPU seconds per million pixels on one core, measured by benchmarks/effects.py. It is more than 0 for every
        effect of a channel.
    systematic : callable, optional
        Function scene -> part of the contribution that remains in a mean over frames or pixels, in electrons. By
        default the whole contribution remains.
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

    def margin(self, scene: Scene) -> float:
        """Return the contribution relative to the noticeable change of a pixel or mean: above 1 it is needed."""
        change = float(self.contribution(scene))
        systematic = change if self.systematic is None else float(self.systematic(scene))
        change = max(change, math.sqrt(STACK_SIZE) * systematic)
        noise = NOTICEABLE * scene.pixel_noise
        # Without noise every change is noticeable.
        return change / noise if noise > 0.0 else math.inf if change > 0.0 else 0.0

    def is_needed(self, scene: Scene) -> bool:
        """Return True if the scene needs the effect, whatever the request forces."""
        return not self.optional or self.margin(scene) > 1.0

    def is_applied(self, scene: Scene) -> bool:
        """Return True if the effect is applied: as the request forces it, otherwise if the scene needs it."""
        return scene.forced.get(self.name, self.is_needed(scene))


def zero_contribution(scene: Scene) -> float:
    """Return 0: the systematic contribution of pure noise, which averages out."""
    return 0.0


def map_pixels(kernel: Callable[..., None], frame: Frame, *arguments: Any) -> Frame:
    """Apply a compiled function to the pixels of a frame.

    Parameters
    ----------
    kernel : callable
        Compiled function (pixels, out_pixels, *arguments) that fills `out_pixels`. Both arrays are float64, shape (n,).
    frame : float array, shape (ny, nx) or (q, ...)
        Input frame. The first axis counts amplifiers if an argument has one value per amplifier.
    *arguments : float, uint64 or array, shape (q,)
        Further arguments of `kernel`: one value for the frame, or one value for each of its q amplifiers.

    Returns
    -------
    float array, shape of `frame`
        New frame.

    Raises
    ------
    BadInput
        If arguments have values for another number of amplifiers than the frame has.
    """
    out = np.empty(frame.shape)
    pixels, out_pixels = np.ascontiguousarray(frame, dtype=float).reshape(-1), out.reshape(-1)
    n_amplifiers = max(np.size(number) for number in arguments)
    if n_amplifiers == 1:
        kernel(pixels, out_pixels, *arguments)
        return out
    if frame.shape[0] != n_amplifiers:
        raise BadInput(f"parameters have values for {n_amplifiers} amplifiers, but the frame has {frame.shape[0]}")
    for number, (amplifier_pixels, amplifier_out) in enumerate(
        zip(np.split(pixels, n_amplifiers), np.split(out_pixels, n_amplifiers), strict=True)
    ):
        kernel(amplifier_pixels, amplifier_out, *(n[number] if np.ndim(n) else n for n in arguments))
    return out


@dataclass(frozen=True, slots=True)
class Decision:
    """Decision on an effect.

    Attributes
    ----------
    name : str
        Name of the effect.
    applied : bool
        True if the effect is applied.
    forced : bool
        True if the request switches it on or off.
    margin : float
        Contribution relative to the noticeable change, see `Effect.margin`.
    """

    name: str
    applied: bool
    forced: bool
    margin: float


def decide(effects: Sequence[Effect], scene: Scene) -> tuple[Decision, ...]:
    """Decide which effects to apply: all that the scene needs or its request forces on.

    Names of effects of other channels in `scene.forced` are ignored. Raises BadInput if the request switches off an
    effect that is not optional.
    """
    for effect in effects:
        if not effect.optional and not effect.is_applied(scene):
            raise BadInput(f"effect {effect.name} cannot be switched off")
    decisions = []
    for effect in effects:
        # The margin is computed only once, because some contributions take as long as the effect.
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
) -> tuple[Frame, tuple[Decision, ...]]:
    """Apply the effects of a channel in their order.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Input frame.
    effects : sequence of Effect
        Effects in the order of the channel.
    scene : Scene
        Exposure from which the parameters of the effects are taken.
    stream : callable
        Function effect -> random generator. Each effect has a separate generator, so that switching one effect off does
        not change the random numbers of the others.
    callback : callable, optional
        Function (name, previous frame, new frame), called after each applied effect.

    Returns
    -------
    frame : float array
        Frame after all applied effects.
    decisions : tuple of Decision
        One decision per effect.
    """
    decisions = decide(effects, scene)
    for effect, decision in zip(effects, decisions, strict=True):
        if decision.applied:
            previous, frame = frame, effect.apply(frame, *effect.parameters(scene), rng=stream(effect))
            if callback is not None:
                callback(effect.name, previous, frame)
            # Free the memory of the previous frame before the next effect allocates one.
            del previous
    return frame, decisions
