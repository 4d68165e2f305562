"""Ground cameras: the order of physics."""

from __future__ import annotations

from collections.abc import Mapping

from jobs.render.effects import adc, background, dark_current, full_well, poisson, read_noise
from jobs.render.effects.effect import Effect

SKY = (
    background.EFFECT,
    poisson.EFFECT,
    dark_current.EFFECT,
    full_well.EFFECT,
    read_noise.EFFECT,
    adc.EFFECT,
)

EFFECTS: Mapping[str, tuple[Effect, ...]] = {"science": SKY, "deep": SKY}
