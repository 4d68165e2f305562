"""Follow the capture and release of charge by traps while columns or rows of pixels (lines) are shifted to the output.

In the model, a cloud of n electrons fills the fraction V(n) of a pixel's volume and at once every trap in it. Each trap
releases its electron with the time scale of its species, into the packet that is there at that time.

The packets of a line are the charges of its pixels. Packet i is shifted over the pixels i, i - 1, ..., 0. Shifting one
pixel at a time is exact and slow. Here many pixels are treated together: they meet the same packets, so that they all
share one stack of watermarks, for all species. A watermark is a height up to which a cloud has filled traps, with the
time of the filling.

Let m pixels meet packet i with n electrons. Let species s have rho_s traps per pixel and the time scale tau_s in
transfers. At height z of the volume the pixels were last filled by packet j(z), when there were m(z) of them: pixel i
joins empty when packet i arrives. In the layer dz, rho_s m(z) exp(-(i - j(z)) / tau_s) dz traps are full. Over all
heights, rho_s H_s traps of the species are full. In one transfer::

    released   G = sum_s rho_s H_s (1 - exp(-1 / tau_s)), shared equally by the pixels
    reached    V(n + G / m)
    captured   C = integral from 0 to V of sum_s rho_s (m - m(z) exp(-(i - j(z)) / tau_s)) dz, at most n + G
    remaining  n + G - C, and m(z) = m, j(z) = i below V

Both m(z) and j(z) are step functions with newer steps at lower heights. A packet therefore uses only the steps below V
and replaces them by one. The cost of a line is proportional to its number of packets, not to packets times pixels. The
method neglects that packets change on their way, which is of second order in the losses. Heun's method includes this
change: with the change c of a packet by one sweep over the line, n' = n + (c(n) + c(n + c(n))) / 2. Several steps along
the line reduce the error further. Each electron is counted once, captured or not, so that charge is conserved.

References
----------
Massey et al. 2014 (volume and watermarks). Massey et al. 2010.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float
from lake_schema.errors import BadInput, OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects.effect import copy_frame
from truesky.render.effects.readout import trap_levels

# Number of columns that are copied together to a contiguous array, because the packets of a column are far apart in
# memory.
_BLOCK = 64
# Number of trap species (traps with the same release time) that are followed together, the largest allowed number. If a
# detector has fewer, the remaining species have the density 0.
_SPECIES = 3
# A packet gains charge that traps release. If the gain per pixel of its path, relative to its charge, is at most this
# number, it is neglected in the volume that the charge cloud fills. The relative error of the volume is 0.6 times this.
_MAX_GAIN = 1e-4
# V(n), the fraction of a pixel's volume that n electrons fill, is tabulated with 2 to this power segments per octave of
# n.
_SEGMENT_BITS = 6
# Number of octaves (factors of 2) of the charge above the notch (charge that meets no trap) in the table of V(n), the
# fraction of a pixel's volume that n electrons fill. The table ends at the full well. V is 0 for charges below the
# table.
_OCTAVES = 60


@dataclass(frozen=True, slots=True)
class Traps:
    """Traps of a detector along one direction of charge transfer, and the volume that charge fills in a pixel.

    Attributes
    ----------
    density : tuple of float
        Traps per pixel of each species, 0 to 1e6.
    release : tuple of float
        Mean time after which a trap of each species releases its electron, in transfers from pixel to pixel, 1e-6 to
        1e9.
    full_well : float
        Electrons that fill the pixel's volume, 1 to 1e9.
    notch : float
        Electrons of a packet that meet no trap, 0 to 1e8, less than `full_well`.
    power : float
        Exponent of the filled fraction V of a pixel's volume, ((n - notch) / (full_well - notch))^power for n
        electrons, 1e-3 to 10.

    Raises
    ------
    BadInput
        If `density` and `release` have different lengths, or there are not 1 to 3 species.
    OutOfRange
        If a value is outside its limits or NaN.
    """

    density: tuple[float, ...]
    release: tuple[float, ...]
    full_well: float
    notch: float
    power: float

    def __post_init__(self) -> None:
        if len(self.density) != len(self.release) or not 1 <= len(self.density) <= _SPECIES:
            raise BadInput(
                f"traps: {len(self.density)} densities, {len(self.release)} release times, must be 1 to {_SPECIES}"
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
        """Return the fraction of a pixel's traps, 0 to 1, that charges of `electrons` reach, with the same shape."""
        part = (np.asarray(electrons, float) - self.notch) / (self.full_well - self.notch)
        return np.asarray(np.clip(part, 0.0, 1.0) ** self.power)


@dataclass(frozen=True, slots=True)
class Sweeps:
    """Numerical method with which charge is followed over the traps of a column or row (a line).

    Attributes
    ----------
    steps : int
        Number of ranges into which the pixels of a line are divided, 1 to 10,000. All charge is shifted over one range
        after the other. More ranges are more accurate and slower.
    order : int
        Number of sweeps of all packets (charges of pixels) over each range, 1 or 2. 1 neglects that packets change on
        their way, 2 is Heun's method, which includes it.
    levels : int
        Number of groups into which the traps of a pixel are divided by the charge that reaches them, 6 to 1000, for a
        fast and coarse method. It requires `steps` and `order` of 1. With 0, watermarks (heights up to which traps are
        filled) are used.

    Raises
    ------
    OutOfRange
        If a value is outside its limits.
    BadInput
        If `levels` is not 0, and `steps` or `order` is not 1.
    """

    steps: int
    order: int
    levels: int = 0

    def __post_init__(self) -> None:
        if self.levels and not trap_levels.MIN_LEVELS <= self.levels <= 1000:
            raise OutOfRange("levels of traps", self.levels, trap_levels.MIN_LEVELS, 1000)
        if self.levels and (self.steps, self.order) != (1, 1):
            raise BadInput(f"{self.levels} levels of traps require steps = 1 and order = 1")
        if not 1 <= self.steps <= 10_000:
            raise OutOfRange("steps of a transfer", self.steps, 1, 10_000)
        if self.order not in (1, 2):
            raise OutOfRange("sweeps a step", self.order, 1, 2)


def shift_charge(
    frame: Float, traps: Traps, sweeps: Sweeps, axis: int, pixels: int | None = None, out: Float | None = None
) -> tuple[Float, float]:
    """Shift the charge of all columns or rows of a frame over traps to the output.

    Parameters
    ----------
    frame : float64 array, shape (..., ny, nx)
        Electrons, 0 or more. The output is at index 0 of `axis`.
    traps : Traps
        Density and release times of the traps in the direction of the transfer, and the volume that charge fills.
    sweeps : Sweeps
        Numerical method to follow the charge.
    axis : int
        Axis of the transfer: -2 along columns, -1 along rows.
    pixels : int, optional
        Number of packets of a line that start in a pixel, by default all. Later packets (overscan) pass all pixels.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    frame : float array, shape (..., ny, nx)
        Electrons after the transfer.
    trapped : float
        Electrons that are still trapped after the last packet, summed over all lines.

    Raises
    ------
    OutOfRange
        If `axis` is not -1 or -2, or `pixels` is negative or larger than the length of a line.
    """
    if axis not in (-1, -2):
        raise OutOfRange("axis of transfer", axis, -2, -1)
    out = copy_frame(frame, out)
    n = out.shape[axis]
    physical = n if pixels is None else pixels
    if not 0 <= physical <= n:
        raise OutOfRange("pixels of a line", physical, 0, n)
    if not any(traps.density) or out.size == 0:
        return out, 0.0
    missing = _SPECIES - len(traps.density)
    density, release = np.array(traps.density + (0.0,) * missing), np.array(traps.release + (1.0,) * missing)
    # Electrons in the traps of one pixel, [number of transfers since the traps were filled, species].
    occupancy = density * np.exp(-np.arange(n + 1)[:, None] / release)
    # Fraction released per transfer, 1 - exp(-1 / tau), without cancellation of digits.
    released = -np.expm1(-1.0 / release)
    edges = np.rint(np.linspace(physical, 0, min(sweeps.steps, max(physical, 1)) + 1)).astype(np.int64)
    volumes = _volume_table(traps)
    ends = trap_levels.level_ends(out, traps.notch, sweeps.levels) if sweeps.levels else None
    trapped = 0.0
    for plane in out.reshape(-1, *out.shape[-2:]):
        if ends is not None:
            trapped += trap_levels.shift(plane, axis, physical, density, released, ends, traps.volume(ends))
        elif axis == -1:
            trapped += _shift_lines(plane, density, occupancy, released, *volumes, edges, sweeps.order)
        else:
            # Copy columns in blocks to a contiguous array, because the packets of a column are far apart in memory.
            lines = np.empty((_BLOCK, n))
            for start in range(0, plane.shape[1], _BLOCK):
                block = lines[: plane.shape[1] - start]
                block[:] = plane[:, start : start + _BLOCK].T
                trapped += _shift_lines(block, density, occupancy, released, *volumes, edges, sweeps.order)
                plane[:, start : start + _BLOCK] = block.T
    return out, trapped


def _volume_table(traps: Traps) -> tuple[Float, float, float]:
    """Return a table of the filled fraction V of a pixel's volume, the notch in electrons, and 1 / (full well - notch).

    The notch is the charge that meets no trap. V is tabulated as a function of (n - notch) / (full_well - notch) for n
    electrons, at the ends of segments from 2^-_OCTAVES to 1, ascending. All segments between two powers of 2 are equal.
    """
    octave = np.arange(_OCTAVES)[:, None] - _OCTAVES
    part = np.ldexp(1.0 + np.arange(1 << _SEGMENT_BITS) / (1 << _SEGMENT_BITS), octave).ravel()
    # Repeat the last value, because the full well itself is also the start of a segment.
    return np.concatenate([part, [1.0, 1.0]]) ** traps.power, traps.notch, 1.0 / (traps.full_well - traps.notch)


@jit
def _shift_lines(
    lines: Any,
    density: Float,
    occupancy: Float,
    released: Float,
    volumes: Float,
    notch: float,
    scale: float,
    edges: Any,
    order: int,
) -> float:
    """Shift the charge of every line lines[k, :] over traps in place, and return the electrons trapped at the end.

    `density` is the number of traps per pixel of each species. `occupancy` [transfers since the traps were filled,
    species] are the electrons in the traps of a pixel. `released` is the fraction of its trapped electrons that a
    species releases per transfer. `volumes` is the table of the volume that charge fills, `notch` the electrons that
    meet no trap, and `scale` is 1 / (full well - notch). A line is divided into ranges of pixels, from the farthest to
    the nearest to the output. `edges` are their limits, descending from the number of pixels to 0, and `order` is the
    number of sweeps over each range.
    """
    n = lines.shape[1]
    first, second = np.empty(n), np.empty(n)
    counts, inverse, reached, part = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    height, full, filled_at = np.empty(n + 2), np.empty(n + 2), np.empty(n + 2, np.int64)
    trapped = 0.0
    for line in lines:
        if line.max() <= notch:
            continue
        for e in range(len(edges) - 1):
            high, low = edges[e], edges[e + 1]
            for i in range(low, n):
                counts[i] = min(min(i, edges[0] - 1) + 1, high) - low
                inverse[i] = 1.0 / max(counts[i], 1.0)
            _volumes_of_line(line, volumes, notch, scale, part, part.view(np.int64), reached)
            held_back = _sweep(
                line,
                first,
                low,
                counts,
                inverse,
                reached,
                density,
                occupancy,
                released,
                volumes,
                notch,
                scale,
                height,
                full,
                filled_at,
                part,
            )
            for i in range(n):
                first[i] += line[i]
            if order == 2:
                _volumes_of_line(first, volumes, notch, scale, part, part.view(np.int64), reached)
                second_held = _sweep(
                    first,
                    second,
                    low,
                    counts,
                    inverse,
                    reached,
                    density,
                    occupancy,
                    released,
                    volumes,
                    notch,
                    scale,
                    height,
                    full,
                    filled_at,
                    part,
                )
                held_back = 0.5 * (held_back + second_held)
                for i in range(n):
                    line[i] = 0.5 * (line[i] + first[i] + second[i])
            else:
                line[:] = first
            trapped += held_back
    return trapped


@jit
def _sweep(
    line: Any,
    change: Any,
    low: int,
    counts: Float,
    inverse: Float,
    reached: Float,
    density: Float,
    occupancy: Float,
    released: Float,
    volumes: Float,
    notch: float,
    scale: float,
    height: Float,
    full: Float,
    filled_at: Any,
    part: Float,
) -> float:
    """Fill `change` with the change of each packet (electrons) by traps in one range of the pixels of a line.

    Return the electrons still trapped at the end. The range begins at pixel `low`. `line` are the packets (charges of
    the pixels) in electrons. `counts` and `inverse` are the number of pixels of the range that each packet passes, and
    its inverse. `reached` is the fraction of a pixel's volume that each packet fills at the start. The arrays `height`
    (fraction of the volume up to which traps are filled), `full` (number of pixels) and `filled_at` (index of the
    packet that filled them) form a stack of watermarks, lowest last.

    `density` is the number of traps per pixel of each species, `occupancy` [transfers since the traps were filled,
    species] the electrons in the traps of a pixel, and `released` the fraction of trapped electrons released per
    transfer. `volumes` is the table of the fraction of a pixel's volume that charge fills, `notch` the electrons that
    meet no trap, `scale` is 1 / (full well - notch), and `part` is temporary memory.
    """
    # Use separate variables for the species: an array would be read and written at every packet.
    d0, d1, d2 = density[0], density[1], density[2]
    r0, r1, r2 = released[0], released[1], released[2]
    h0, h1, h2 = 0.0, 0.0, 0.0
    total, held_charge = d0 + d1 + d2, 0.0
    # Keep the lowest watermark (height up to which traps are filled) in separate variables, too: its height `th`, the
    # number of pixels `tf`, and the index `ti` of the packet that filled them. The values at the start mean that no
    # pixel has full traps at any height.
    th, tf, ti = np.inf, 0.0, 0
    depth = -1
    for i in range(min(low, len(line))):
        change[i] = 0.0
    for i in range(low, len(line)):
        count, top = counts[i], reached[i]
        h0, h1, h2 = h0 - h0 * r0, h1 - h1 * r1, h2 - h2 * r2
        remaining = h0 + h1 + h2
        gain = held_charge - remaining
        # Released charge usually makes the charge cloud of a packet hardly larger. Use its height `reached`, computed
        # without released charge, so that the processor need not wait. Compute the height again if the gain is large.
        if gain * inverse[i] > _MAX_GAIN * line[i]:
            top = _volume(line[i] + gain * inverse[i], volumes, notch, scale, part, part.view(np.int64))
        if top <= 0.0:
            change[i], held_charge = gain, remaining
            continue
        e0, e1, e2, bottom = 0.0, 0.0, 0.0, 0.0
        available = line[i] + gain
        if top * count * total <= available:
            if th > top:
                emptied, age = top * tf, i - ti
                e0, e1, e2 = _add_occupied(e0, e1, e2, emptied, occupancy, age)
                depth += 1
                height[depth], full[depth], filled_at[depth] = th, tf, ti
            else:
                emptied, age = th * tf, i - ti
                e0, e1, e2 = _add_occupied(e0, e1, e2, emptied, occupancy, age)
                bottom = th
                while height[depth] <= top:
                    emptied, age = (height[depth] - bottom) * full[depth], i - filled_at[depth]
                    e0, e1, e2 = _add_occupied(e0, e1, e2, emptied, occupancy, age)
                    bottom = height[depth]
                    depth -= 1
                emptied, age = (top - bottom) * full[depth], i - filled_at[depth]
                e0, e1, e2 = _add_occupied(e0, e1, e2, emptied, occupancy, age)
        else:
            # A packet cannot lose more electrons than it contains: the cloud of this packet ends lower.
            depth += 1
            height[depth], full[depth], filled_at[depth] = th, tf, ti
            top, depth, e0, e1, e2 = _fill_partly(
                available, top, count * total, i, depth, occupancy, height, full, filled_at
            )
        if top <= 0.0:
            th, tf, ti = height[depth], full[depth], filled_at[depth]
            depth -= 1
        else:
            th, tf, ti = top, count, i
            filled = top * count
            h0, h1, h2 = h0 + (filled * d0 - e0), h1 + (filled * d1 - e1), h2 + (filled * d2 - e2)
        remaining = h0 + h1 + h2
        change[i], held_charge = held_charge - remaining, remaining
    return float(held_charge)


@jit
def _add_occupied(
    e0: float, e1: float, e2: float, emptied: float, occupancy: Float, age: int
) -> tuple[float, float, float]:
    """Add the electrons that the traps of each species hold in the volume `emptied` to e0, e1 and e2.

    `emptied` is in volumes of a pixel, summed over pixels. Its traps were last filled `age` transfers ago. `occupancy`
    [age, species] are the electrons that are left in the traps of a whole pixel.
    """
    return e0 + emptied * occupancy[age, 0], e1 + emptied * occupancy[age, 1], e2 + emptied * occupancy[age, 2]


@jit
def _fill_partly(
    available: float,
    top: float,
    empty: float,
    i: int,
    depth: int,
    occupancy: Float,
    height: Float,
    full: Float,
    filled_at: Any,
) -> tuple[float, int, float, float, float]:
    """Fill traps with a packet that has fewer electrons than the traps in its charge cloud could capture.

    `available` is the charge of the packet in electrons, and `empty` the electrons that all traps of the passed pixels
    can hold. The cloud could reach the height `top`, a fraction of a pixel's volume. `i` is the index of the packet.
    The lowest watermark (height up to which traps are filled) has the index `depth` in the stack `height`, `full`
    (number of pixels) and `filled_at` (index of a packet). `occupancy` [transfers since then, species] are the
    electrons left in a pixel. The result is the height at which the cloud ends, the new depth of the stack, and the
    electrons that the refilled traps held before, for each species.
    """
    e0, e1, e2, captured, bottom = 0.0, 0.0, 0.0, 0.0, 0.0
    while bottom < top:
        end, age = height[depth], i - filled_at[depth]
        occupied = occupancy[age, 0] + occupancy[age, 1] + occupancy[age, 2]
        free, step = empty - full[depth] * occupied, min(end, top) - bottom
        if captured + step * free > available:
            step = (available - captured) / free
            top = bottom + step
        captured += step * free
        emptied = step * full[depth]
        e0, e1, e2 = _add_occupied(e0, e1, e2, emptied, occupancy, age)
        if end > top:
            break
        bottom = end
        depth -= 1
    return top, depth, e0, e1, e2


@jit
def _volumes_of_line(
    line: Any, volumes: Float, notch: float, scale: float, part: Float, bits: Any, reached: Float
) -> None:
    """Fill `reached` with V, the fraction of a pixel's volume that each packet of a line (electrons) fills.

    V is interpolated linearly in the table `volumes`. `notch` are the electrons that fill no volume, and `scale` is
    1 / (full well - notch). `part` and `bits` are temporary memory: the same array as float64 and as int64.
    """
    for i in range(len(line)):
        part[i] = min(max((line[i] - notch) * scale, 0.0), 1.0)
    for i in range(len(line)):
        at = (bits[i] >> (52 - _SEGMENT_BITS)) - ((1023 - _OCTAVES) << _SEGMENT_BITS)
        fraction = (bits[i] & ((1 << (52 - _SEGMENT_BITS)) - 1)) * 2.0 ** (_SEGMENT_BITS - 52)
        segment = max(at, 0)
        volume = volumes[segment] + fraction * (volumes[segment + 1] - volumes[segment])
        reached[i] = volume if at >= 0 else 0.0


@jit
def _volume(electrons: float, volumes: Float, notch: float, scale: float, part: Float, bits: Any) -> float:
    """Interpolate V, the filled fraction of a pixel's volume, in its table `volumes` for a number of electrons.

    `notch` are the electrons that fill no volume, and `scale` is 1 / (full well - notch). V is linear in each segment
    of the table, with a relative error below 1e-5 if V is proportional to the power 0.58 of the charge above the notch.
    V is 0 below the first segment. `part` and `bits` are temporary memory, one number as float64 and as int64. The
    exponent and the first bits of its mantissa select the segment.
    """
    part[0] = min(max((electrons - notch) * scale, 0.0), 1.0)
    at = (bits[0] >> (52 - _SEGMENT_BITS)) - ((1023 - _OCTAVES) << _SEGMENT_BITS)
    if at < 0:
        return 0.0
    fraction = (bits[0] & ((1 << (52 - _SEGMENT_BITS)) - 1)) * 2.0 ** (_SEGMENT_BITS - 52)
    return float(volumes[at] + fraction * (volumes[at + 1] - volumes[at]))
