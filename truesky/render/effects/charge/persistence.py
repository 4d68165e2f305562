"""Persistence: traps in a pixel that were filled in earlier exposures release their charge during this one.

A pixel collects I electrons in an earlier exposure of length T, which begins a time dt before this one. It releases I_p
electrons in an exposure of the nominal length T0::

    I_p = (p0 + 1e-5 p1 I) (1 - exp(-I / p2)) (T / T0)^soak (dt / t0)^power

The parameters p0, p1, p2, T0, t0 (a reference delay), soak and power are in the mission database. The charge is
released as a current, and is collected together with the light. An exposure of another length than T0 receives the
integral of the same power law of time. Contributions of several earlier exposures add up. Every pixel has its own p0,
p1, p2 and power; p0 and p1 are proportional to its number of traps.

References
----------
Serrano et al. 2024: the equation, and how it depends on the pixel, the delay and the length of the earlier exposure.
Long, Baggett & MacKenty 2013, WFC3 Instrument Science Reports: power law in time; longer exposures fill more traps.
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

# A pixel needs two independent normal deviates, and the ziggurat method may use more than one word of random bits for
# the first. The bits for the second are combined with this constant (xor), so that they do not repeat those of the
# first.
_SECOND_STREAM = np.uint64(0x5851F42D4C957F2D)


@dataclass(frozen=True, slots=True)
class PersistenceModel:
    """Parameters of the persistence of a detector, and its equation.

    I_p = (p0 + 1e-5 p1 I) (1 - exp(-I / p2)) (T / T0)^soak (dt / t0)^power are the electrons released in an exposure of
    the nominal length T0. I are the electrons collected in an earlier exposure of length T, which began a time dt
    before.

    Attributes
    ----------
    p0, p1, p2 : float
        Parameters of the equation for the median pixel: electrons, dimensionless, electrons.
    power : float
        Exponent of the delay dt / t0, at most 0.
    reference : float
        Reference delay t0 in seconds.
    nominal_length : float
        Nominal exposure length T0 in seconds.
    full_well : float
        Full well in electrons. A pixel with more charge is treated as a full one.
    soak : float
        Exponent of the relative length T / T0 of the earlier exposure.
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
        """Read the parameters of the scene's detector from the mission database. A missing one raises BadInput."""

        def value(name: str, unit: str) -> float:
            return scene.value(f"persistence.{name}", unit)

        return cls(
            p0=value("p0", "electron"), p1=value("p1", ""), p2=value("p2", "electron"), power=value("time_power", ""),
            reference=value("time_reference", "s"), nominal_length=value("exposure_time", "s"),
            full_well=scene.value("full_well", "electron"), soak=value("soak_power", ""),
        )  # fmt: skip

    def released_charge(
        self,
        charge: Frame | Float32,
        delay: float,
        seconds: float,
        earlier_seconds: float | None = None,
        variation: PixelVariation | None = None,
    ) -> Frame:
        """Return the charge that each pixel releases during an exposure because of one earlier exposure.

        Parameters
        ----------
        charge : float array
            Electrons collected in the earlier exposure. Values are limited to 0 and the full well.
        delay : float
            Time from the start of the earlier exposure to the start of the later one, in seconds, more than 0.
        seconds : float
            Length of the later exposure in seconds.
        earlier_seconds : float, optional
            Length of the earlier exposure in seconds, by default the nominal length.
        variation : PixelVariation, optional
            Variation of the parameters from pixel to pixel. By default all pixels behave like the median pixel.

        Returns
        -------
        float array, shape of `charge`, or of `variation.p2` if it is given
            Electrons released during the later exposure.

        Raises
        ------
        OutOfRange
            If `delay` is not positive or is NaN.

        Notes
        -----
        The effect of an exposure length other than the nominal one is computed with the power law of the median pixel.
        """
        filling = np.clip(np.asarray(charge, dtype=float), 0.0, self.full_well)
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
        # Most pixels hold only the charge of the sky, which is equal in all pixels: compute its exponential only once.
        lowest = filling.min(initial=self.full_well)
        above = filling > lowest
        released = np.full(filling.shape, self._charge_at_reference(lowest) * scale)
        released[above] = self._charge_at_reference(filling[above]) * scale
        return released

    def time_scaling(self, delay: float, seconds: float, earlier_seconds: float | None = None) -> float:
        """Return the factor by which delay and exposure lengths change the released charge of the median pixel.

        Parameters
        ----------
        delay : float
            Time from the start of the earlier exposure to the start of the later one, in seconds, more than 0.
        seconds : float
            Length of the later exposure in seconds.
        earlier_seconds : float, optional
            Length of the earlier exposure in seconds, by default the nominal length.

        Returns
        -------
        float
            Released charge, divided by the charge for the reference delay t0 and two exposures of the nominal length
            T0.

        Raises
        ------
        OutOfRange
            If `delay` is not positive or is NaN.
        """
        if not delay > 0.0:
            raise OutOfRange("delay of persistence", delay, 0.0, np.inf)
        return float(
            self._soak_factor(earlier_seconds)
            * (delay / self.reference) ** self.power
            * self._length_factor(delay, seconds)
        )

    def _soak_factor(self, earlier_seconds: float | None) -> float:
        """Return the number of traps filled in an earlier exposure, relative to one of the nominal length T0.

        It is (T / T0)^soak, where `earlier_seconds` is the length T in seconds. None gives 1.
        """
        return 1.0 if earlier_seconds is None else float((earlier_seconds / self.nominal_length) ** self.soak)

    def _length_factor(self, delay: float, seconds: float) -> float:
        """Return the charge released in an exposure of `seconds`, relative to one of the nominal length.

        The released current is proportional to t^power at the time t since the start of the earlier exposure. The
        result is the ratio of its integrals over the two exposure lengths, both from t = `delay` (seconds).
        """
        logs, power = (np.log1p(time / delay) for time in (seconds, self.nominal_length)), 1.0 + self.power
        charge, nominal = (x if power == 0.0 else np.expm1(power * x) / power for x in logs)
        return float(charge / nominal)

    def _charge_at_reference(self, filling: Frame) -> Frame:
        return np.asarray((self.p0 + 1e-5 * self.p1 * filling) * -np.expm1(-filling / self.p2))


@dataclass(frozen=True, slots=True)
class PixelVariation:
    """Variation of the persistence parameters p2 and power from pixel to pixel.

    Attributes
    ----------
    p2 : float32 array, shape (ny, nx)
        p2 of each pixel divided by p2 of the median pixel. The released charge is proportional to 1 - exp(-I / p2) for
        I collected electrons.
    power : float32 array, shape (ny, nx)
        Exponent of the time delay of each pixel minus that of the median pixel.
    """

    p2: Float32
    power: Float32


def draw_variation(
    shape: tuple[int, int], p2_spread: float, power_spread: float, rng: np.random.Generator
) -> PixelVariation | None:
    """Draw the variation of the persistence parameters p2 and power from pixel to pixel, from normal distributions.

    Parameters
    ----------
    shape : (int, int)
        Number of rows and columns of the detector.
    p2_spread : float
        Standard deviation of p2 relative to its median, 0 to 1. Ratios below 0.1 are set to 0.1.
    power_spread : float
        Standard deviation of `power`, the exponent of the time delay, 0 to 1.
    rng : numpy.random.Generator
        Random generator of the detector, in the same state in every exposure, so that pixels do not change.

    Returns
    -------
    PixelVariation or None
        For each pixel, p2 divided by its median and `power` minus its median. None if both standard deviations are 0.

    Raises
    ------
    OutOfRange
        If `p2_spread` or `power_spread` is outside its limits or NaN.
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
    """Draw the pixel-to-pixel variation of the persistence of the scene's detector; None if it has no variation.

    The standard deviations are taken from the mission database. `rng` must be in the same state for every exposure of
    the detector.
    """
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
        # The released charge is proportional to the delay to a power. Limit this exponent to 0, so that the charge
        # never grows with the delay.
        growth = small_exp(min(power[i], max_power) * log_time)
        out[i] = (offset + slope * filling[i]) * -small_expm1(-filling[i] * inverse / p2[i]) * scale * growth
    # Compute pixels again for which the power series of exp in the first loop is not accurate. An `if` in that loop
    # would prevent its vectorisation, which costs more than computing a few pixels twice.
    for i in range(len(filling)):
        x, time = filling[i] * inverse / p2[i], min(power[i], max_power) * log_time
        if x > SMALL or abs(time) > SMALL_EXP:
            out[i] = (offset + slope * filling[i]) * -math.expm1(-x) * scale * math.exp(time)


def apply(frame: Frame, released: Frame | None, spread: float, rng: np.random.Generator) -> Frame:
    """Add the charge released from traps that were filled in earlier exposures to a frame.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    released : float array, shape (ny, nx), or None
        Electrons released by each pixel if it had the median number of traps. None if there are no earlier exposures.
    spread : float
        Standard deviation of the number of traps per pixel, relative to the median, 0 to 10. Negative numbers of traps
        are set to 0.
    rng : numpy.random.Generator
        Random generator of the detector, in the same state in every exposure, so that the number of traps is the same.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons including persistence.

    Raises
    ------
    OutOfRange
        If `spread` is outside its limits or NaN.
    BadInput
        If the shapes of `frame` and `released` differ.
    """
    if not 0.0 <= spread <= 10.0:
        raise OutOfRange("spread of persistence", spread, 0.0, 10.0)
    out = np.array(frame, dtype=float, order="C")
    if released is None:
        return out
    if released.shape != frame.shape:
        raise BadInput(f"persistence has the shape {released.shape}, the frame {frame.shape}: they must be equal")
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
