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
_SECOND_STREAM = np.uint64(0x5851F42D4C957F2D)


@dataclass(frozen=True, slots=True)
class PersistenceModel:
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
    nominal_length: float
    full_well: float
    soak: float = 0.0

    @classmethod
    def from_scene(cls, scene: Scene) -> PersistenceModel:
        """Of the mission database."""

        def value(name: str, unit: str) -> float:
            return scene.value(f"persistence.{name}", unit)

        return cls(
            p0=value("p0", "electron"), p1=value("p1", ""), p2=value("p2", "electron"), power=value("time_power", ""),
            reference=value("time_reference", "s"), nominal_length=value("exposure_time", "s"),
            full_well=scene.value("full_well", "electron"), soak=value("soak_power", ""),
        )  # fmt: skip

    def released_charge(
        self,
        charge: Frame,
        delay: float,
        seconds: float,
        earlier_seconds: float | None = None,
        variation: PixelVariation | None = None,
    ) -> Frame:
        """Of charge [..] e- what comes `delay` s later in an exposure of `seconds` s, e-.

        charge, delay, seconds : of the earlier exposure, from start to start, of the later one
        lasted : s of the earlier exposure, None = the nominal length
        own    : of each pixel; None = all are as the usual one
        Error  : how much more comes in a longer exposure is of the usual pixel's power of time
        """
        filling = np.clip(charge, 0.0, self.full_well)
        scale = self.time_scaling(delay, seconds, earlier_seconds)
        if variation is not None:
            filling = np.ascontiguousarray(np.broadcast_to(filling, variation.p2.shape), dtype=float)
            released = np.empty(filling.shape)
            constants = (self.p0, 1e-5 * self.p1, self.p2, scale, float(np.log(delay / self.reference)), -self.power)
            _release(
                filling.reshape(-1),
                variation.p2.reshape(-1),
                variation.power.reshape(-1),
                constants,
                released.reshape(-1),
            )
            return released
        # Most pixels have the sky alone, all the same.
        lowest = filling.min(initial=self.full_well)
        above = filling > lowest
        released = np.full(filling.shape, self._charge_at_reference(lowest) * scale)
        released[above] = self._charge_at_reference(filling[above]) * scale
        return released

    def time_scaling(self, delay: float, seconds: float, earlier_seconds: float | None = None) -> float:
        """What times do to what is left, over the reference time and nominal lengths; as of `left`."""
        if not delay > 0.0:
            raise OutOfRange("delay of persistence", delay, 0.0, np.inf)
        return float(
            self._soak_factor(earlier_seconds)
            * (delay / self.reference) ** self.power
            * self._length_factor(delay, seconds)
        )

    def _soak_factor(self, earlier_seconds: float | None) -> float:
        """Traps that are filled in an exposure of `lasted` s, over those in one of the nominal length."""
        return 1.0 if earlier_seconds is None else float((earlier_seconds / self.nominal_length) ** self.soak)

    def _length_factor(self, delay: float, seconds: float) -> float:
        """What comes from a delay on in so many seconds, over what comes in the nominal length."""
        logs, power = (np.log1p(time / delay) for time in (seconds, self.nominal_length)), 1.0 + self.power
        charge, nominal = (x if power == 0.0 else np.expm1(power * x) / power for x in logs)
        return float(charge / nominal)

    def _charge_at_reference(self, filling: Frame) -> Frame:
        return np.asarray((self.p0 + 1e-5 * self.p1 * filling) * -np.expm1(-filling / self.p2))


@dataclass(frozen=True, slots=True)
class PixelVariation:
    """Of each pixel of a detector, float32[ny, nx].

    p2 : over the usual one;  power : what its power of time is more
    """

    p2: Float32
    power: Float32


def draw_variation(
    shape: tuple[int, int], p2_spread: float, power_spread: float, rng: np.random.Generator
) -> PixelVariation | None:
    """What each pixel has of its own, normally distributed; None = nothing.

    shape : ny, nx;  p2_spread : rms as a fraction, no pixel has less than a tenth of the usual p2
    power_spread : rms;  rng : random numbers of the detector's pixels
    """
    for name, value in (("p2", p2_spread), ("time power", power_spread)):
        if not 0.0 <= value <= 1.0:
            raise OutOfRange(f"spread of persistence, {name}", value, 0.0, 1.0)
    if p2_spread == 0.0 == power_spread:
        return None
    planes = np.empty((2, *shape), np.float32)
    _draw(planes[0].reshape(-1), planes[1].reshape(-1), p2_spread, power_spread, pixel_random.draw_key(rng))
    return PixelVariation(planes[0], planes[1])


def variation_of_scene(scene: Scene, rng: np.random.Generator) -> PixelVariation | None:
    """Of a detector by the mission database; rng : as of `pixels`."""
    p2, power = (scene.value(f"persistence.{name}_spread", "") for name in ("p2", "time_power"))
    return draw_variation((scene.ny, scene.nx), p2, power, rng)


@jit
def _draw(p2: Any, power: Any, p2_spread: float, power_spread: float, key: Any) -> None:
    for i in range(len(p2)):
        bits = pixel_random.pixel_bits(key, i)
        p2[i] = max(1.0 + p2_spread * pixel_random.normal(bits), 0.1)
        power[i] = power_spread * pixel_random.normal(pixel_random.next_bits(bits ^ _SECOND_STREAM))


@jit
def _release(filling: Any, p2: Any, power: Any, constants: Any, out: Any) -> None:
    offset, slope, median_p2, scale, log_time, max_power = constants
    inverse = 1.0 / median_p2
    for i in range(len(filling)):
        # Nothing that is left becomes more with time.
        growth = small_exp(min(power[i], max_power) * log_time)
        out[i] = (offset + slope * filling[i]) * -small_expm1(-filling[i] * inverse / p2[i]) * scale * growth
    # Most pixels are faint: a branch above would cost more than the few that are done twice.
    for i in range(len(filling)):
        x, time = filling[i] * inverse / p2[i], min(power[i], max_power) * log_time
        if x > SMALL or abs(time) > SMALL_EXP:
            out[i] = (offset + slope * filling[i]) * -math.expm1(-x) * scale * math.exp(time)


def apply(frame: Frame, released: Frame | None, spread: float, rng: np.random.Generator) -> Frame:
    """Expected e- [ny, nx] -> plus what earlier exposures left.

    frame      : expected e-
    remembered : [ny, nx] e- of a usual pixel; None = nothing;  spread : rms of a pixel's own share, which is never < 0
    rng        : random numbers of the detector's pixels
    """
    if not 0.0 <= spread <= 10.0:
        raise OutOfRange("spread of persistence", spread, 0.0, 10.0)
    out = np.array(frame, dtype=float, order="C")
    if released is None:
        return out
    if released.shape != frame.shape:
        raise BadInput(f"persistence of {released.shape} pixels for a frame of {frame.shape}")
    charge = np.ascontiguousarray(released, dtype=float)
    _add_released(out.reshape(-1), charge.reshape(-1), spread, pixel_random.draw_key(rng))
    return out


@jit
def _add_released(out: Any, released: Any, spread: float, key: Any) -> None:
    for i in range(len(out)):
        if released[i] != 0.0:
            out[i] += released[i] * max(1.0 + spread * pixel_random.normal(pixel_random.pixel_bits(key, i)), 0.0)


def _parameters(scene: Scene) -> tuple[Frame | None, float]:
    return scene.persistence_charge, scene.value("persistence.spread", "")


def _contribution(scene: Scene) -> float:
    return 0.0 if scene.persistence_charge is None else float(scene.persistence_charge.max(initial=0.0))


EFFECT = Effect("persistence", apply, _parameters, _contribution, fixed=True, cost=1e-2)
