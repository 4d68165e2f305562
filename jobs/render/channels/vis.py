"""Euclid VIS: the order of physics."""

from __future__ import annotations

from jobs.render.effects import adc, background, dark_current, full_well, poisson, read_noise

EFFECTS = (
    background.EFFECT,
    poisson.EFFECT,
    dark_current.EFFECT,
    full_well.EFFECT,
    read_noise.EFFECT,
    adc.EFFECT,
)
