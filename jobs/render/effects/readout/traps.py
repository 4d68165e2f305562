"""Charge traps that a line of pixels is shifted over: who captures, who releases, what is left behind.

Model: a cloud of n electrons fills the fraction V(n) of a pixel's volume and at once every trap in it; each trap
gives its electron back with its species' time scale, into whichever packet lies there then.

A line is n packets; packet i is shifted over the pixels i, i - 1 .. 0. Taken one pixel at a time this is exact and
slow. Here many pixels are taken together: all see the same packets, so one stack of watermarks (the heights up to which
clouds have filled traps, and when) serves them all, and every species.

Let m pixels see packet i, of n electrons, and let species s have rho_s traps in a pixel, of time scale tau_s in
transfers. At height z of the volume the m pixels were last filled by packet j(z), when there were m(z) of them: pixel i
joins empty when packet i arrives. Of the traps in dz, rho_s m(z) exp(-(i - j(z)) / tau_s) are full, H_s in all.
One transfer on,

    released   G = sum_s rho_s H_s (1 - exp(-1 / tau_s)), each pixel its share of it;
    reached    V(n + G / m);
    captured   C = integral from 0 to V of sum_s rho_s (m - m(z) exp(-(i - j(z)) / tau_s)) dz, at most n + G;
    left over  n + G - C, and m(z) = m, j(z) = i below V.

Both m(z) and j(z) are steps, the lower the newer, so that a packet looks at those below V alone and replaces them by
one: the cost of a line is that of its packets, not of packets times pixels. What is left out is that packets change
on their way: the second order in the losses. Heun's rule brings it in, with the change c of a sweep,
n' = n + (c(n) + c(n + c(n))) / 2, and further steps along the line make it as small as wanted. Each electron is counted
once, captured or not: charge is conserved.

Ref : Massey et al. 2014 (volume and watermarks), Massey et al. 2010
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from jobs.compiling import jit
from jobs.render.effects.readout import trap_levels
from lake_schema.arrays import Float
from lake_schema.errors import BadInput, OutOfRange

# Lines that are copied together where a line's packets do not lie next to each other in memory.
_BLOCK = 64
# Species are followed together, in one register; those that are missing have no traps.
_SPECIES = 4
# V(n) is tabulated: 2^6 linear segments of an octave of n, and octaves below the full well.
_SEGMENT_BITS, _OCTAVES = 6, 60


@dataclass(frozen=True, slots=True)
class Traps:
    """The traps of one direction of transfer.

    density   : traps of each species in a pixel;  release : their time scales, in transfers
    full_well : electrons that fill the pixel's volume;  notch : electrons that meet no trap
    power     : of V = ((n - notch) / (full_well - notch))^power
    """

    density: tuple[float, ...]
    release: tuple[float, ...]
    full_well: float
    notch: float
    power: float

    def __post_init__(self) -> None:
        if len(self.density) != len(self.release) or not 1 <= len(self.density) <= _SPECIES:
            raise BadInput(
                f"traps: {len(self.density)} densities, {len(self.release)} release times, wanted are 1 to {_SPECIES}"
            )
        for name, values, lo, hi in (
            ("trap density", self.density, 0.0, 1e6),
            ("trap release time", self.release, 1e-6, 1e9),
            ("trap well-filling power", (self.power,), 1e-3, 10.0),
            ("trap notch", (self.notch,), 0.0, 1e8),
            ("trap full well", (self.full_well,), 1.0, 1e9),
        ):
            for value in values:
                if not lo <= value <= hi:
                    raise OutOfRange(name, value, lo, hi)
        if self.notch >= self.full_well:
            raise OutOfRange("trap notch", self.notch, 0.0, self.full_well)

    def volume(self, electrons: npt.ArrayLike) -> Float:
        """Fraction of a pixel's traps that a cloud reaches."""
        part = (np.asarray(electrons, float) - self.notch) / (self.full_well - self.notch)
        return np.asarray(np.clip(part, 0.0, 1.0) ** self.power)


@dataclass(frozen=True, slots=True)
class Sweeps:
    """How a line is followed: steps along it, and sweeps a step (1: packets as they were; 2: Heun's rule).

    levels : 0, or into how many levels the traps of a pixel are put instead of watermarks, in one sweep of one step
    """

    steps: int
    order: int
    levels: int = 0

    def __post_init__(self) -> None:
        if self.levels and not trap_levels.FEWEST <= self.levels <= 1000:
            raise OutOfRange("levels of traps", self.levels, trap_levels.FEWEST, 1000)
        if self.levels and (self.steps, self.order) != (1, 1):
            raise BadInput(f"{self.levels} levels of traps take one sweep of one step")
        if not 1 <= self.steps <= 10_000:
            raise OutOfRange("steps of a transfer", self.steps, 1, 10_000)
        if self.order not in (1, 2):
            raise OutOfRange("sweeps a step", self.order, 1, 2)


def shifted(frame: Float, traps: Traps, sweeps: Sweeps, axis: int, pixels: int | None = None) -> tuple[Float, float]:
    """Read out lines of packets over traps.

    frame  : float64[.., ny, nx] electrons >= 0; the output lies at index 0 of `axis` (-2: rows, -1: columns)
    pixels : how many packets of a line start in a pixel; those after (overscan) follow through all of them
    traps  : their density and release times;  sweeps : how closely charge is followed
    returns: frame, and the electrons still trapped when the last packet has passed
    """
    if axis not in (-1, -2):
        raise OutOfRange("axis of transfer", axis, -2, -1)
    out = np.ascontiguousarray(frame, dtype=np.float64).copy()
    n = out.shape[axis]
    physical = n if pixels is None else pixels
    if not 0 <= physical <= n:
        raise OutOfRange("pixels of a line", physical, 0, n)
    if not any(traps.density) or out.size == 0:
        return out, 0.0
    missing = _SPECIES - len(traps.density)
    density, release = np.array(traps.density + (0.0,) * missing), np.array(traps.release + (1.0,) * missing)
    left = np.exp(-np.arange(n + 1)[:, None] / release)
    # 1 - exp(-1 / tau) without the difference of almost equal numbers.
    released = -np.expm1(-1.0 / release)
    edges = np.rint(np.linspace(physical, 0, min(sweeps.steps, max(physical, 1)) + 1)).astype(np.int64)
    volumes = _volumes(traps)
    ends = trap_levels.heights(out, traps.notch, sweeps.levels) if sweeps.levels else None
    trapped = 0.0
    for plane in out.reshape(-1, *out.shape[-2:]):
        lines = plane if axis == -1 else plane.T
        if ends is not None:
            trapped += trap_levels.shift(plane, axis, physical, density, released, ends, traps.volume(ends))
            continue
        # Some lines at a time: those that are columns lie far apart in memory.
        for start in range(0, len(lines), _BLOCK):
            some = np.array(lines[start : start + _BLOCK], order="C")
            trapped += _shift(some, density, left, released, *volumes, edges, sweeps.order)
            lines[start : start + _BLOCK] = some
    return out, trapped


def _volumes(traps: Traps) -> tuple[Float, float, float]:
    """V at the ends of the segments of (n - notch) / (full_well - notch), from 2^-_OCTAVES to 1; notch; 1 / range."""
    octave = np.arange(_OCTAVES)[:, None] - _OCTAVES
    part = np.ldexp(1.0 + np.arange(1 << _SEGMENT_BITS) / (1 << _SEGMENT_BITS), octave).ravel()
    return np.append(part, 1.0) ** traps.power, traps.notch, 1.0 / (traps.full_well - traps.notch)


@jit
def _shift(
    lines: Any, density: Float, left: Float, released: Float, volumes: Float, notch: float, scale: float, edges: Any,
    order: int,
) -> float:  # fmt: skip
    """Every line lines[k, :], in place; returns what is still trapped."""
    n = lines.shape[1]
    first, second = np.empty(n), np.empty(n)
    height, full, since = np.empty(n + 1), np.empty(n + 1), np.empty(n + 1, np.int64)
    part = np.empty(1)
    bits = part.view(np.int64)
    # What a pixel filled so many rows ago holds, of all species; 1 / n.
    filled, inverse = np.zeros(n + 1), np.zeros(n + 1)
    for i in range(n + 1):
        for s in range(_SPECIES):
            filled[i] += density[s] * left[i, s]
        inverse[i] = 1.0 / max(i, 1)
    trapped = 0.0
    for line in lines:
        if line.max() <= notch:
            continue
        for e in range(len(edges) - 1):
            high, low = edges[e], edges[e + 1]
            held_back = _sweep(line, first, low, high, edges[0], density, left, filled, inverse, released, volumes,
                               notch, scale, height, full, since, part, bits)  # fmt: skip
            for i in range(n):
                first[i] += line[i]
            if order == 2:
                again = _sweep(first, second, low, high, edges[0], density, left, filled, inverse, released, volumes,
                               notch, scale, height, full, since, part, bits)  # fmt: skip
                held_back = 0.5 * (held_back + again)
                for i in range(n):
                    line[i] = 0.5 * (line[i] + first[i] + second[i])
            else:
                line[:] = first
            trapped += held_back
    return trapped


@jit
def _sweep(
    line: Any, change: Any, low: int, high: int, pixels: int, density: Float, left: Float, filled: Float,
    inverse: Float, released: Float, volumes: Float, notch: float, scale: float, height: Float, full: Float,
    since: Any, part: Float, bits: Any,
) -> float:  # fmt: skip
    """Fills `change` with what the pixels low .. high - 1 do to the packets; returns what they hold at the end.

    height, full, since : the stack of watermarks, lowest last: up to which height, how many pixels, from which row
    part, bits          : scratch of `_volume`
    """
    # Species by species, in registers: an array of four would be read and written at every packet.
    d0, d1, d2, d3 = density[0], density[1], density[2], density[3]
    r0, r1, r2, r3 = released[0], released[1], released[2], released[3]
    h0, h1, h2, h3 = 0.0, 0.0, 0.0, 0.0
    depth, total = 0, d0 + d1 + d2 + d3
    for i in range(min(low, len(line))):
        change[i] = 0.0
    for i in range(low, len(line)):
        count = min(min(i, pixels - 1) + 1, high) - low
        reached = float(count)
        g0, g1, g2, g3 = h0 * r0, h1 * r1, h2 * r2, h3 * r3
        h0, h1, h2, h3 = h0 - g0, h1 - g1, h2 - g2, h3 - g3
        gain = d0 * g0 + d1 * g1 + d2 * g2 + d3 * g3
        # Never more than the packet has: the cloud then ends lower.
        most = line[i] + gain
        top = _volume(line[i] + gain * inverse[count], volumes, notch, scale, part, bits)
        if top <= 0.0:
            change[i] = gain
            continue
        taken, bottom, empty = 0.0, 0.0, reached * total
        while depth > 0:
            end, weight, age = height[depth - 1], full[depth - 1], i - since[depth - 1]
            free = empty - weight * filled[age]
            step = min(end, top) - bottom
            short = taken + step * free > most
            if short:
                step = (most - taken) / free
                top = bottom + step
            emptied = step * weight
            h0 -= emptied * left[age, 0]
            h1 -= emptied * left[age, 1]
            h2 -= emptied * left[age, 2]
            h3 -= emptied * left[age, 3]
            taken += step * free
            bottom += step
            if short or end > top:
                break
            depth -= 1
            bottom = end
        if depth == 0 and bottom < top:
            step = min(top - bottom, (most - taken) / empty)
            taken += step * empty
            bottom += step
        if bottom > 0.0:
            height[depth], full[depth], since[depth] = bottom, reached, i
            depth += 1
            more = bottom * reached
            h0, h1, h2, h3 = h0 + more, h1 + more, h2 + more, h3 + more
        change[i] = gain - taken
    return float(d0 * h0 + d1 * h1 + d2 * h2 + d3 * h3)


@jit
def _volume(electrons: float, volumes: Float, notch: float, scale: float, part: Float, bits: Any) -> float:
    """V from its table: linear between the segments' ends (1e-4 of V), and to zero below the last octave.

    part, bits : scratch, one number and its binary form: exponent and first bits of the mantissa tell the segment
    """
    x = (electrons - notch) * scale
    if x >= 1.0:
        return 1.0
    if x <= 0.0:
        return 0.0
    part[0] = x
    at = (bits[0] >> (52 - _SEGMENT_BITS)) - ((1023 - _OCTAVES) << _SEGMENT_BITS)
    if at < 0:
        return float(x * volumes[0] * 2.0**_OCTAVES)
    beyond = (bits[0] & ((1 << (52 - _SEGMENT_BITS)) - 1)) * 2.0 ** (_SEGMENT_BITS - 52)
    return float(volumes[at] + beyond * (volumes[at + 1] - volumes[at]))
