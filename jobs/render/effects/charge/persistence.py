"""Persistence: charge that traps caught in earlier exposures comes out in this one.

Of I electrons in a pixel of an exposure that began dt earlier

    I_p = (p0 + 1e-5 p1 I) (1 - exp(-I / p2)) (dt / t0)^power

come in an exposure of the nominal length, as a current: they are counted up the ramp, with the light.  What several
exposures left adds up.

left_of         of the charge of one of them
apply, EFFECT   a pixel has its own share of it

Ref : Serrano et al. 2024 (the form); fall with time, the mission database
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from jobs.compiling import jit
from jobs.render.effects import pixel_random
from jobs.render.effects.effect import Effect
from jobs.render.effects.scene import Frame, Scene
from lake_schema.errors import BadInput, OutOfRange


@dataclass(frozen=True, slots=True)
class Traps:
    """Of a detector.

    p0, p1, p2      : e-, no unit, e-, of the formula
    power           : of time, at most 0;  reference : t0, s
    length          : s, of the exposure that p0 and p1 are of
    full_well       : e-: no pixel held more
    """

    p0: float
    p1: float
    p2: float
    power: float
    reference: float
    length: float
    full_well: float

    @classmethod
    def of(cls, scene: Scene) -> Traps:
        """Of the mission database."""

        def of(name: str, unit: str) -> float:
            return scene.value(f"persistence.{name}", unit)

        return cls(
            p0=of("p0", "electron"), p1=of("p1", ""), p2=of("p2", "electron"), power=of("time_power", ""),
            reference=of("time_reference", "s"), length=of("exposure_time", "s"),
            full_well=scene.value("full_well", "electron"),
        )  # fmt: skip

    def left(self, charge: Frame, delay: float, seconds: float) -> Frame:
        """Of charge [..] e- what comes `delay` s later in an exposure of `seconds` s, e-."""
        if not delay > 0.0:
            raise OutOfRange("delay of persistence", delay, 0.0, np.inf)
        held = np.clip(charge, 0.0, self.full_well)
        faded = (delay / self.reference) ** self.power * seconds / self.length
        # Most pixels have the sky alone, all the same.
        least = held.min(initial=self.full_well)
        more = held > least
        found = np.full(held.shape, self._of(least) * faded)
        found[more] = self._of(held[more]) * faded
        return found

    def _of(self, held: Frame) -> Frame:
        return np.asarray((self.p0 + 1e-5 * self.p1 * held) * -np.expm1(-held / self.p2))


def apply(frame: Frame, remembered: Frame | None, spread: float, rng: np.random.Generator) -> Frame:
    """Expected e- [ny, nx] -> plus what earlier exposures left.

    frame      : expected e-
    remembered : [ny, nx] e- of a usual pixel; None = nothing;  spread : rms of a pixel's own share, which is never < 0
    rng        : random numbers of the detector's pixels
    """
    if not 0.0 <= spread <= 10.0:
        raise OutOfRange("spread of persistence", spread, 0.0, 10.0)
    out = np.array(frame, dtype=float, order="C")
    if remembered is None:
        return out
    if remembered.shape != frame.shape:
        raise BadInput(f"persistence of {remembered.shape} pixels for a frame of {frame.shape}")
    left = np.ascontiguousarray(remembered, dtype=float)
    _add(out.reshape(-1), left.reshape(-1), spread, pixel_random.key(rng))
    return out


@jit
def _add(out: Any, left: Any, spread: float, key: Any) -> None:
    for i in range(len(out)):
        if left[i] != 0.0:
            out[i] += left[i] * max(1.0 + spread * pixel_random.normal(pixel_random.word(key, i)), 0.0)


def _parameters(scene: Scene) -> tuple[Frame | None, float]:
    return scene.remembered, scene.value("persistence.spread", "")


def _contribution(scene: Scene) -> float:
    return 0.0 if scene.remembered is None else float(scene.remembered.max(initial=0.0))


EFFECT = Effect("persistence", apply, _parameters, _contribution, fixed=True, cost=1e-2)
