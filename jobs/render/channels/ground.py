"""Ground cameras: the order of physics."""

from __future__ import annotations

from collections.abc import Mapping

from jobs.render.effects.charge import dark_current, full_well, poisson
from jobs.render.effects.effect import Effect
from jobs.render.effects.light import background
from jobs.render.effects.readout import adc, read_noise

SKY = (
    background.EFFECT,
    poisson.EFFECT,
    dark_current.EFFECT,
    full_well.EFFECT,
    read_noise.EFFECT,
    adc.EFFECT,
)

EFFECTS: Mapping[str, tuple[Effect, ...]] = {"science": SKY, "deep": SKY}
