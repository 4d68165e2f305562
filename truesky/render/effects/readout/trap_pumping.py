"""Trap pumping: charge is shifted back and forth over traps, which then form dipoles of a bright and a dark pixel.

In each cycle the charge packet of a pixel leaves an electrode and comes back; all phases of the cycle take the same
time. A trap that captures an electron may release it one phase later, when the packet of the neighbouring pixel is
nearer. In N cycles a trap moves I electrons to the neighbour::

    I = N P (exp(-t / tau) - exp(-2 t / tau))

with the phase time t, the release time tau and the capture probability P. The same traps, with the same species and
densities, cause charge transfer inefficiency. They are uniformly distributed over the height of a pixel's volume, which
a charge cloud fills up to a certain height. Their positions are fixed for a detector. As the detector ages, traps are
added to the existing ones.

Not modelled: the shot noise of capture and release (less than the square root of I), and the decrease of dipoles while
they empty a pixel. A pixel gives no more charge than it has.

References
----------
Hall et al. 2014, IEEE TNS 61, 1826. Murray et al. 2012, SPIE 8453. Skottfelt et al. 2017, JINST 12, C12033.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from lake_schema.arrays import Bool, Float, Int, Int32
from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import MissionConfiguration
from truesky.render.effects.effect import Effect
from truesky.render.effects.readout import charge_transfer
from truesky.render.effects.readout.traps import Traps
from truesky.render.effects.scene import Frame, Scene

# Number of phases of a cycle: the charge moves over the four electrodes, pair by pair, to the next pixel and back.
_PHASES = 6
# Number of traps that are drawn together, to limit the memory.
_CHUNK_SIZE = 1 << 19
# `trap_map` stores the numbers of traps of all species in a pixel as the digits of one number with this base. More than
# 255 traps of a species in a pixel would spill into the digit of the next species; this is not checked.
_PER_SPECIES = 256


@dataclass(frozen=True, slots=True)
class Pumping:
    """Parameters of trap pumping: how charge is shifted back and forth.

    Attributes
    ----------
    shuffles : int
        Number of pumping cycles.
    phase : float
        Time of one phase of a cycle in seconds.
    efficiency : float
        Fraction of the traps that the cycle pumps because of their positions, 0 to 1. Half of them move charge to the
        next row, the other half to the previous row.
    capture : float
        Probability that a trap captures an electron in a cycle, 0 to 1.
    dwell : float
        Time in seconds of the transfer from pixel to pixel in a normal readout, the unit of the release times in
        `Traps`.
    """

    shuffles: int
    phase: float
    efficiency: float
    capture: float
    dwell: float


def apply(
    frame: Frame, silicon: Traps, pumping: Pumping, segments: Sequence[tuple[int, int, bool]], rng: np.random.Generator
) -> Frame:
    """Move charge between neighbouring rows, as traps do during pumping.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons, 0 or more.
    silicon : Traps
        Density and release times of the traps along the columns, and the volume of a pixel that charge fills.
    pumping : Pumping
        Number and duration of the pumping cycles, and fraction of traps that are pumped.
    segments : sequence of (int, int, bool)
        Parts of every column that are read through one serial register, each (first row, last row + 1, value that is
        not used). No charge moves between segments.
    rng : numpy.random.Generator
        Random generator of the positions of traps, in the same state in every exposure.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons with the same sum. Whole numbers of electrons move, and no pixel becomes negative.

    Raises
    ------
    OutOfRange
        If `shuffles` (0 to 1e9), `efficiency` or `capture` of `pumping` is outside its limits or NaN.
    """
    for name, value, highest in (
        ("shuffles", pumping.shuffles, 1e9), ("pumping efficiency", pumping.efficiency, 1.0),
        ("capture", pumping.capture, 1.0),
    ):  # fmt: skip
        if not 0.0 <= value <= highest:
            raise OutOfRange(name, value, 0.0, highest)
    charge = np.asarray(frame, dtype=float)
    # Mark the rows from which charge may move up (all but the last row of a segment) and down (all but the first row).
    up, down = np.zeros((2, len(charge)), bool)
    for first, end, _ in segments:
        up[first : end - 1], down[first + 1 : end] = True, True
    flows = np.zeros((2, *charge.shape))
    electrons = np.array([moved_electrons(tau, pumping) for tau in silicon.release])
    for traps in _draw_traps(charge.shape, silicon.density, rng):
        for flow, free, pumped in ((flows[0], up, traps.upward(pumping)), (flows[1], down, traps.downward(pumping))):
            indices = np.flatnonzero(pumped & free[traps.row])
            indices = indices[traps.height[indices] < silicon.volume(charge[traps.row[indices], traps.column[indices]])]
            np.add.at(flow, (traps.row[indices], traps.column[indices]), electrons[traps.species[indices]])
    whole_flows = np.rint(flows)
    outflow = whole_flows.sum(axis=0)
    short = outflow > charge
    whole_flows[:, short] = np.floor(whole_flows[:, short] * (charge[short] / outflow[short]))
    out = charge - whole_flows.sum(axis=0)
    out[1:] += whole_flows[0, :-1]
    out[:-1] += whole_flows[1, 1:]
    return np.asarray(out)


def moved_electrons(tau: float, pumping: Pumping) -> float:
    """Return the electrons that one pumped trap moves to the neighbouring pixel in all cycles together.

    `tau` is the mean release time of the trap, in units of `pumping.dwell` seconds (one transfer of a normal readout).
    """
    x = pumping.phase / (tau * pumping.dwell)
    # The last two factors are exp(-x) - exp(-2 x), up to the sign, without cancellation of digits.
    return float(-pumping.shuffles * pumping.capture * np.exp(-x) * np.expm1(-x))


@dataclass(frozen=True, slots=True)
class _TrapChunk:
    """A number n of traps and their positions in the detector.

    Attributes
    ----------
    species : int array
        Index of the trap's species.
    row, column : int array
        Row and column of the pixel that contains the trap.
    height : float array
        Height of the trap in the pixel as a fraction of its volume, 0 to 1. A charge cloud reaches all traps below its
        top.
    electrode : float array
        Random number from 0 to 1 for the position of the trap under the electrodes of the pixel, which decides whether
        pumping moves charge to the next row (lowest numbers), to the previous row (highest numbers) or not at all.
    """

    species: Int
    row: Int
    column: Int
    height: Float
    electrode: Float

    def upward(self, pumping: Pumping) -> Bool:
        """Return a mask, bool[n], of the traps whose pumping moves charge to the next row (row number + 1)."""
        return np.asarray(self.electrode < 0.5 * pumping.efficiency)

    def downward(self, pumping: Pumping) -> Bool:
        """Return a mask, bool[n], of the traps whose pumping moves charge to the previous row (row number - 1)."""
        return np.asarray(self.electrode > 1.0 - 0.5 * pumping.efficiency)


def _draw_traps(shape: tuple[int, ...], density: Sequence[float], rng: np.random.Generator) -> Iterator[_TrapChunk]:
    """Yield the random traps of a detector in chunks, in the order in which radiation damage creates them.

    `shape` is (rows, columns), and `density` the traps per pixel of each species. A higher density gives the same traps
    and additional ones, for the same state of `rng` and the same ratios of species.
    """
    (ny, nx), total = shape, float(sum(density))
    shares = np.cumsum(density) / total if total > 0.0 else np.ones(len(density))
    remaining = int(scipy.stats.poisson.ppf(rng.random(), total * ny * nx)) if total > 0.0 and ny * nx > 0 else 0
    while remaining > 0:
        rank, y, x, height, electrode = rng.random((min(remaining, _CHUNK_SIZE), 5)).T
        species = np.minimum(np.searchsorted(shares, rank, side="right"), len(density) - 1)
        yield _TrapChunk(species, (y * ny).astype(np.int64), (x * nx).astype(np.int64), height, electrode)
        remaining -= _CHUNK_SIZE


def trap_map(scene: Scene, rng: np.random.Generator) -> Int32:
    """Return the number of traps in each pixel: species 1 plus 256 x species 2 plus 65536 x species 3, int32[ny, nx].

    The sum is unambiguous for at most 255 traps of a species per pixel, which is not checked. `rng` must be in
    the same state as the generator with which `EFFECT` draws the traps of the same scene.
    """
    silicon = charge_transfer.silicon_traps(scene, "parallel")
    out = np.zeros((scene.ny, scene.nx), np.int32)
    for traps in _draw_traps(out.shape, silicon.density, rng):
        np.add.at(out, (traps.row, traps.column), (_PER_SPECIES**traps.species).astype(np.int32))
    return out


def duration(phase: float, section: str, mission: MissionConfiguration) -> float:
    """Return the time in seconds that all cycles of trap pumping take.

    Parameters
    ----------
    phase : float
        Time of one phase of a cycle in seconds.
    section : str
        Prefix of the camera's parameters in the mission database.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float
        Time in seconds.
    """
    return mission.value(f"{section}.pumping.shuffles") * _PHASES * phase


def _parameters(scene: Scene) -> tuple[Traps, Pumping, tuple[tuple[int, int, bool], ...]]:
    pumping = Pumping(
        int(scene.value("pumping.shuffles", "")), scene.value("pumping.phase_time", "s"),
        scene.value("pumping.efficiency", ""), scene.value("pumping.capture", ""), scene.value("cti.dwell_time", "s"),
    )  # fmt: skip
    return charge_transfer.silicon_traps(scene, "parallel"), pumping, scene.column_segments


def _contribution(scene: Scene) -> float:
    silicon, pumping, _ = _parameters(scene)
    electrons = [
        moved_electrons(tau, pumping) for rho, tau in zip(silicon.density, silicon.release, strict=True) if rho > 0.0
    ]
    return max(electrons, default=0.0) if pumping.efficiency > 0.0 else 0.0


EFFECT = Effect("trap_pumping", apply, _parameters, _contribution, fixed=True, cost=1.5e-2)
