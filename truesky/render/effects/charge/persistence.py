"""Persistence: charge that traps caught in earlier exposures comes out in this one.

Of I electrons in a pixel of an exposure that began dt earlier and lasted T

    I_p = (p0 + 1e-5 p1 I) (1 - exp(-I / p2)) (T / T0)^soak (dt / t0)^power

come in an exposure of the nominal length T0, as a current: they are counted up the ramp, with the light.  In a longer
one come more, as many as the same fall brings by its end.  What several exposures left adds up.  p0, p1, p2 and the
power are each pixel's own: p0 and p1 are of the number of its traps and go together.

Traps           of a detector: .left of the charge of one exposure
Pixels, pixels  what each pixel has of its own besides the number of its traps
apply, EFFECT   a pixel has its own number of traps

Ref : Serrano et al. 2024 (the form, and that p_i are of the pixel, the time between exposures and the length of the
      first); Long, Baggett & MacKenty 2013, WFC3 Instrument Science Reports (fall as a power of time; longer exposures
      fill more traps)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from lake_schema.arrays import Float32
from lake_schema.errors import BadInput, OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene
from truesky.render.effects.series import SMALL, SMALL_EXP, small_exp, small_expm1

# Of a pixel's second number: other bits than of its first, of which the ziggurat may take more.
_OTHER = np.uint64(0x5851F42D4C957F2D)


@dataclass(frozen=True, slots=True)
class Traps:
    """Of a detector.

    p0, p1, p2      : e-, no unit, e-, of the formula
    power           : of time, at most 0;  reference : t0, s
    length          : T0, s
    full_well       : e-: no pixel held more
    soak            : power of the time that the charge was held
    """

    p0: float
    p1: float
    p2: float
    power: float
    reference: float
    length: float
    full_well: float
    soak: float = 0.0

    @classmethod
    def of(cls, scene: Scene) -> Traps:
        """Of the mission database."""

        def of(name: str, unit: str) -> float:
            return scene.value(f"persistence.{name}", unit)

        return cls(
            p0=of("p0", "electron"), p1=of("p1", ""), p2=of("p2", "electron"), power=of("time_power", ""),
            reference=of("time_reference", "s"), length=of("exposure_time", "s"),
            full_well=scene.value("full_well", "electron"), soak=of("soak_power", ""),
        )  # fmt: skip

    def left(
        self, charge: Frame, delay: float, seconds: float, lasted: float | None = None, own: Pixels | None = None
    ) -> Frame:
        """Of charge [..] e- what comes `delay` s later in an exposure of `seconds` s, e-.

        charge, delay, seconds : of the earlier exposure, from start to start, of the later one
        lasted : s of the earlier exposure, None = the nominal length
        own    : of each pixel; None = all are as the usual one
        Error  : how much more comes in a longer exposure is of the usual pixel's power of time
        """
        held = np.clip(charge, 0.0, self.full_well)
        scale = self.scale(delay, seconds, lasted)
        if own is not None:
            held = np.ascontiguousarray(np.broadcast_to(held, own.p2.shape), dtype=float)
            found = np.empty(held.shape)
            numbers = (self.p0, 1e-5 * self.p1, self.p2, scale, float(np.log(delay / self.reference)), -self.power)
            _leave(held.reshape(-1), own.p2.reshape(-1), own.power.reshape(-1), numbers, found.reshape(-1))
            return found
        # Most pixels have the sky alone, all the same.
        least = held.min(initial=self.full_well)
        more = held > least
        found = np.full(held.shape, self._of(least) * scale)
        found[more] = self._of(held[more]) * scale
        return found

    def scale(self, delay: float, seconds: float, lasted: float | None = None) -> float:
        """What times do to what is left, over the reference time and nominal lengths; as of `left`."""
        if not delay > 0.0:
            raise OutOfRange("delay of persistence", delay, 0.0, np.inf)
        return float(self._filled(lasted) * (delay / self.reference) ** self.power * self._more(delay, seconds))

    def _filled(self, lasted: float | None) -> float:
        """Traps that are filled in an exposure of `lasted` s, over those in one of the nominal length."""
        return 1.0 if lasted is None else float((lasted / self.length) ** self.soak)

    def _more(self, delay: float, seconds: float) -> float:
        """What comes from a delay on in so many seconds, over what comes in the nominal length."""
        one, power = (np.log1p(time / delay) for time in (seconds, self.length)), 1.0 + self.power
        counted, nominal = (x if power == 0.0 else np.expm1(power * x) / power for x in one)
        return float(counted / nominal)

    def _of(self, held: Frame) -> Frame:
        return np.asarray((self.p0 + 1e-5 * self.p1 * held) * -np.expm1(-held / self.p2))


@dataclass(frozen=True, slots=True)
class Pixels:
    """Of each pixel of a detector, float32[ny, nx].

    p2 : over the usual one;  power : what its power of time is more
    """

    p2: Float32
    power: Float32


def pixels(shape: tuple[int, int], p2_spread: float, power_spread: float, rng: np.random.Generator) -> Pixels | None:
    """What each pixel has of its own, normally distributed; None = nothing.

    shape : ny, nx;  p2_spread : rms as a fraction, no pixel has less than a tenth of the usual p2
    power_spread : rms;  rng : random numbers of the detector's pixels
    """
    for name, value in (("p2", p2_spread), ("time power", power_spread)):
        if not 0.0 <= value <= 1.0:
            raise OutOfRange(f"spread of persistence, {name}", value, 0.0, 1.0)
    if p2_spread == 0.0 == power_spread:
        return None
    found = np.empty((2, *shape), np.float32)
    _draw(found[0].reshape(-1), found[1].reshape(-1), p2_spread, power_spread, pixel_random.key(rng))
    return Pixels(found[0], found[1])


def pixels_of(scene: Scene, rng: np.random.Generator) -> Pixels | None:
    """Of a detector by the mission database; rng : as of `pixels`."""
    p2, power = (scene.value(f"persistence.{name}_spread", "") for name in ("p2", "time_power"))
    return pixels((scene.ny, scene.nx), p2, power, rng)


@jit
def _draw(p2: Any, power: Any, p2_spread: float, power_spread: float, key: Any) -> None:
    for i in range(len(p2)):
        word = pixel_random.word(key, i)
        p2[i] = max(1.0 + p2_spread * pixel_random.normal(word), 0.1)
        power[i] = power_spread * pixel_random.normal(pixel_random.next_word(word ^ _OTHER))


@jit
def _leave(held: Any, p2: Any, power: Any, numbers: Any, out: Any) -> None:
    constant, slope, usual, scale, log_time, steepest = numbers
    inverse = 1.0 / usual
    for i in range(len(held)):
        # Nothing that is left becomes more with time.
        grown = small_exp(min(power[i], steepest) * log_time)
        out[i] = (constant + slope * held[i]) * -small_expm1(-held[i] * inverse / p2[i]) * scale * grown
    # Most pixels are faint: a branch above would cost more than the few that are done twice.
    for i in range(len(held)):
        light, time = held[i] * inverse / p2[i], min(power[i], steepest) * log_time
        if light > SMALL or abs(time) > SMALL_EXP:
            out[i] = (constant + slope * held[i]) * -math.expm1(-light) * scale * math.exp(time)


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
