"""What an effect is, what it may know of an exposure, and the loop that applies a channel's effects."""

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

    apply        : (frame, *parameters, rng) -> frame; never writes its argument
    parameters   : scene -> the numbers that `apply` wants
    contribution : scene -> its largest change of a pixel, electrons; rms, of what is random
    repeated     : scene -> the part of it that a mean over frames or pixels keeps, electrons; None = all of it
    optional     : False where the frame is no product without it
    fixed        : a pattern of the detector itself: its random numbers are the same in every exposure
    shared       : one thing for all detectors of an exposure: its random numbers are the same on each
    numbers      : the effect whose random numbers it takes, "" = its own
    cost         : seconds a million pixels take on one core (benchmarks/effects.py); a channel has none of 0
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
        """Contribution over what would be noticed, in a pixel or in a mean: above 1 the effect is needed."""
        change = float(self.contribution(scene))
        systematic = change if self.systematic is None else float(self.systematic(scene))
        change = max(change, math.sqrt(STACK_SIZE) * systematic)
        noise = NOTICEABLE * scene.pixel_noise
        # Without any noise everything is noticed.
        return change / noise if noise > 0.0 else math.inf if change > 0.0 else 0.0

    def is_needed(self, scene: Scene) -> bool:
        """Whether the scene needs it, or no frame can do without it, whatever a request forces."""
        return not self.optional or self.margin(scene) > 1.0

    def is_applied(self, scene: Scene) -> bool:
        """Whether it is applied to the scene: as its request forces it, else as the scene needs it."""
        return scene.forced.get(self.name, self.is_needed(scene))


def zero_contribution(scene: Scene) -> float:
    """Of a contribution what a mean keeps, where it is noise."""
    return 0.0


def map_pixels(kernel: Callable[..., None], frame: Frame, *arguments: Any) -> Frame:
    """A new frame of the same shape, in which a compiled kernel(before [n], after [n], *numbers) has set each pixel.

    numbers : each for the frame, or [q] for its q amplifiers, which are then set one by one: frame [q, ..]
    """
    out = np.empty(frame.shape)
    pixels, out_pixels = np.ascontiguousarray(frame, dtype=float).reshape(-1), out.reshape(-1)
    n_amplifiers = max(np.size(number) for number in arguments)
    if n_amplifiers == 1:
        kernel(pixels, out_pixels, *arguments)
        return out
    if frame.shape[0] != n_amplifiers:
        raise BadInput(f"numbers of {n_amplifiers} amplifiers for a frame of {frame.shape[0]}")
    for number, (amplifier_pixels, amplifier_out) in enumerate(
        zip(np.split(pixels, n_amplifiers), np.split(out_pixels, n_amplifiers), strict=True)
    ):
        kernel(amplifier_pixels, amplifier_out, *(n[number] if np.ndim(n) else n for n in arguments))
    return out


@dataclass(frozen=True, slots=True)
class Decision:
    """Whether an effect was applied, why, and by which margin."""

    name: str
    applied: bool
    forced: bool
    margin: float


def decide(effects: Sequence[Effect], scene: Scene) -> tuple[Decision, ...]:
    """What a scene needs, and what is forced on or off in it (effects of other channels do nothing)."""
    for effect in effects:
        if not effect.optional and not effect.is_applied(scene):
            raise BadInput(f"effect {effect.name} cannot be switched off")
    decisions = []
    for effect in effects:
        # Once: some contributions take as long as the effect itself.
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
    """Apply a channel's effects in their order.

    stream : effect -> its own generator, so that switching one effect off leaves the draws of the others as they were
    watch  : sees the name of an effect that is applied, and the frame before and after it
    frame  : [ny, nx];  effects : in the order of the channel;  scene : what their parameters are taken from
    """
    decisions = decide(effects, scene)
    for effect, decision in zip(effects, decisions, strict=True):
        if decision.applied:
            previous, frame = frame, effect.apply(frame, *effect.parameters(scene), rng=stream(effect))
            if callback is not None:
                callback(effect.name, previous, frame)
            # Frames are large: the next effect needs one.
            del previous
    return frame, decisions
