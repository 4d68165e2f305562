"""Follow charge over traps with a coarse and fast method, for detectors with little damage.

Charge is shifted over the pixels of a column or row (a line), whose traps capture and release it. All lines are
followed at once. A larger charge fills a pixel's volume to a larger height, and reaches more traps. The traps of a
pixel are divided into a few levels by their height. The method equals one sweep over a line in the module `traps`, with
one difference. Each level stores only its filled fraction instead of watermarks (heights up to which a charge cloud has
filled traps): a cloud that ends within a level fills the same fraction of all its traps. Most levels are near the
heights at which most clouds end. The method takes a tenth of the time of the module `traps`. Its error is proportional
to the radiation damage (the number of traps).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.arrays import Float
from truesky.numerics.compiling import jit

# The traps are grouped into levels by the charge, in electrons, that a pixel must hold to reach them. Approximate
# largest number of pixels whose charges are sampled to choose the ends of these levels.
_SAMPLE = 100_000
# Quantiles, as fractions, of the charges of those pixels that reach traps. A third of the trap levels (groups of traps
# by the charge that reaches them) lies between these two charges.
_USUAL = (0.002, 0.99)
# Number of trap levels (groups of traps by the charge that reaches them) that lie below most charges of pixels: from
# the notch (charge that meets no trap) to the lower quantile of the charges in `_USUAL`.
_LEVELS_BELOW = 2
# Smallest number of electrons above the notch (charge that meets no trap) at which a level of traps may end. Smaller
# ends are left out: the fading trails of sources have such tiny charges, which single precision does not resolve.
_MIN_THICKNESS = 1e-6
# Smallest allowed number of levels, into which traps are divided by the charge that reaches them. With fewer, there
# would be no separate levels for the faintest and the brightest pixels.
MIN_LEVELS = 6
# Number of columns or rows whose charge is followed over traps together.
_BLOCK = 256
# The full traps of a level are counted as the number of pixels in which all traps of the level are full. This number is
# never below the limit here, which prevents denormal numbers: they make the processor a hundred times slower.
_MIN_FULL = np.float32(1e-30)


def level_ends(frame: Float, notch: float, count: int) -> Float:
    """Divide the traps of a pixel into levels by the charge that reaches them, and return the ends of the levels.

    Parameters
    ----------
    frame : float array, any shape
        Electrons.
    notch : float
        Charge in electrons up to which a packet (the charge of a pixel) meets no trap.
    count : int
        Number of levels, at least `MIN_LEVELS` (not checked).

    Returns
    -------
    float array, shape (count + 1,) or shorter
        Ends of the levels in electrons, ascending from `notch` to the fullest packet or `notch` + 1, whichever is
        larger. The array is shorter if ends coincide, as in a uniform frame or a frame without packets above the notch.
    """
    flat = frame.reshape(-1)
    sample = flat[:: max(len(flat) // _SAMPLE, 1)]
    sample = sample[sample > notch]
    fullest = max(float(flat.max(initial=0.0)), notch + 1.0)
    low, high = np.quantile(sample, _USUAL) if len(sample) else (fullest, fullest)
    usual = max(count // 3, 1)
    steps = [
        np.linspace(notch, low, _LEVELS_BELOW, endpoint=False),
        np.quantile(sample, np.linspace(*_USUAL, usual + 1)) if len(sample) else np.array([fullest]),
        notch + np.geomspace(max(high - notch, 1e-6), fullest - notch, count - _LEVELS_BELOW - usual + 1),
    ]
    ends = np.unique(np.concatenate(steps))
    return ends[(ends <= notch) | (ends > notch + _MIN_THICKNESS)]


def shift(
    plane: Float, axis: int, pixels: int, density: Float, released: Float, ends: Float, volume: Float
) -> float:  # fmt: skip
    """Shift the charge of all lines (columns or rows) of an image over traps to the output, in place.

    Parameters
    ----------
    plane : float array, shape (n, m)
        Electrons, changed in place. Lines are the columns plane[:, k] for axis -2, and the rows plane[k, :] for axis
        -1. The output is at index 0 of a line.
    axis : int
        Axis of the transfer, -2 or -1.
    pixels : int
        Number of packets of a line that start in a pixel. Later packets (overscan) pass all pixels.
    density : float array, shape (species,)
        Traps per pixel.
    released : float array, shape (species,)
        Fraction of the full traps that release their electron per transfer.
    ends, volume : float array, shape (levels + 1,)
        Limits in electrons of the levels, into which traps are divided by the charge that reaches them, ascending (the
        result of `level_ends`), and the fraction of a pixel's volume that each of these charges fills.

    Returns
    -------
    float
        Electrons that are still trapped after the last packet.
    """
    is_present = density > 0.0
    silicon = pixels, density[is_present], released[is_present], ends, volume
    if axis == -2:
        return float(_follow(plane, *silicon))
    trapped = 0.0
    for start in range(0, len(plane), _BLOCK):
        packets = np.array(plane[start : start + _BLOCK].T, order="C")
        trapped += _follow(packets, *silicon)
        plane[start : start + _BLOCK] = packets.T
    return trapped


@jit
def _follow(packets: Float, pixels: int, density: Float, released: Float, ends: Float, volume: Float) -> float:
    """Shift the charge of lines packets[:, k] over traps in place, and return the electrons still trapped at the end.

    Row 0 of `packets` (electrons) is nearest to the output. `pixels` is the number of rows that are pixels; the others
    are overscan. `density` is the number of traps per pixel of each species, and `released` the fraction of its full
    traps that release their electron per transfer. `ends` are the ends of the levels of traps in electrons, and
    `volume` the fraction of a pixel's volume below each end.
    """
    n, total = packets.shape
    gain, captured = np.empty(_BLOCK), np.empty(_BLOCK)
    cloud, filled = np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32)
    # `full` is the number of pixels in which all traps of a species and level are full, which may be a fraction.
    # `held_charge` is the charge in electrons that the traps of a species hold, in all levels together.
    full, held_charge = np.empty((len(density), len(ends) - 1, _BLOCK), np.float32), np.empty((len(density), _BLOCK))
    trapped = 0.0
    for first in range(0, total, _BLOCK):
        m = min(_BLOCK, total - first)
        full[:], held_charge[:] = np.float32(0.0), 0.0
        for i in range(n):
            line, count = packets[i, first : first + m], min(i + 1, pixels)
            passed, inverse = np.float32(count), 1.0 / max(count, 1)
            gain[:], captured[:] = 0.0, 0.0
            for s in range(len(density)):
                species_charge = held_charge[s]
                for c in range(m):
                    emitted = released[s] * species_charge[c]
                    species_charge[c] -= emitted
                    gain[c] += emitted
            for c in range(m):
                cloud[c] = line[c] + gain[c] * inverse
            for s in range(len(density)):
                species_charge, retained = held_charge[s], np.float32(1.0 - released[s])
                filled[:] = np.float32(0.0)
                for k in range(len(ends) - 1):
                    slope, thick = np.float32(1.0 / (ends[k + 1] - ends[k])), np.float32(volume[k + 1] - volume[k])
                    _fill(cloud[:m], full[s, k], filled, np.float32(ends[k]), slope, thick, passed, retained)
                for c in range(m):
                    # A packet cannot lose more electrons than it contains.
                    new = min(density[s] * filled[c], line[c] + gain[c] - captured[c])
                    captured[c] += new
                    species_charge[c] += new
            for c in range(m):
                line[c] += gain[c] - captured[c]
        trapped += held_charge.sum()
    return trapped


@jit
def _fill(cloud: Any, full: Any, filled: Any, start: Any, slope: Any, thick: Any, passed: Any, retained: Any) -> None:
    """Fill one level of traps of one species with a packet of each line (column or row); update `full`, `filled`.

    A level contains the traps that a charge between two limits reaches. `cloud` is the charge of each line's packet in
    electrons. `full` is the number of pixels in which the level is full, and `passed` that of all pixels on the path.
    The newly filled volume, in volumes of a pixel summed over the path, is added to `filled`. `start` is the lower end
    of the level in electrons, `slope` the inverse of its extent in electrons, and `thick` its extent as a fraction of
    the pixel's volume. `retained` is the fraction of traps that stay full in one transfer.
    """
    zero, unity = np.float32(0.0), np.float32(1.0)
    for c in range(len(cloud)):
        reached = min(max((cloud[c] - start) * slope, zero), unity)
        remaining = full[c] * retained + _MIN_FULL
        new = reached * (passed - remaining)
        full[c] = remaining + new
        filled[c] += thick * new
