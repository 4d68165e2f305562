"""Trap pumping: charge is moved to and fro over the traps, each of which carries some of it to a neighbour: a dipole.

In a cycle a packet leaves an electrode and comes back, and a phase takes as long as the others. A trap that captures an
electron may release it a phase later, when the next packet is nearer; of N cycles

    I = N P (exp(-t / tau) - exp(-2 t / tau))

electrons are moved, t the phase, tau the time scale of the release, P the probability of capture. Traps are those of
charge transfer: as many of each species, at any height of the volume that a cloud fills. Each lies where its detector
has it, in every exposure; older detectors have those of younger ones and more.

apply, EFFECT    the frame, pumped
moved            electrons of a trap;  trap_map : which pixels have traps of which species
duration         of a frame

Ref   : Hall et al. 2014, IEEE TNS 61, 1826; Murray et al. 2012, SPIE 8453; Skottfelt et al. 2017, JINST 12, C12033
Error : the shot noise of capture and release, less than the root of I, is left out, and that dipoles shrink as
        they empty a pixel: it gives no more than it has
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from lake_schema.arrays import Bool, Float, Int, Int32
from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import MissionConfiguration
from truesky.render.effects.effect import Effect
from truesky.render.effects.readout import charge_transfer
from truesky.render.effects.readout.traps import Traps
from truesky.render.effects.scene import Frame, Scene

# Phases of a cycle: over four electrodes, one pair after the other, to the next pixel's and back.
_PHASES = 6
# Traps that are drawn at a time.
_CHUNK_SIZE = 1 << 19
# Of a pixel's number in the truth map: traps of a species, those of the next one above.
_PER_SPECIES = 256


@dataclass(frozen=True, slots=True)
class Pumping:
    """How charge is shuffled.

    shuffles   : cycles;  phase : s
    efficiency : part of the traps that lie where the cycle pumps them, half of them up, half down
    capture    : its probability;  dwell : s of a transfer, the unit of the traps' release times
    """

    shuffles: int
    phase: float
    efficiency: float
    capture: float
    dwell: float


def apply(
    frame: Frame, silicon: Traps, pumping: Pumping, segments: Sequence[tuple[int, int, bool]], rng: np.random.Generator
) -> Frame:
    """frame [ny, nx] e- >= 0 -> the same charge, whole electrons of it moved to the next row or the one before.

    lattice : traps along the columns;  pumping : how charge is shuffled
    runs    : pieces of the columns, between which no charge is moved: first row, the one past the last, whatever else
    rng     : random numbers of the traps' places
    """
    for name, value, highest in (
        ("shuffles", pumping.shuffles, 1e9), ("pumping efficiency", pumping.efficiency, 1.0),
        ("capture", pumping.capture, 1.0),
    ):  # fmt: skip
        if not 0.0 <= value <= highest:
            raise OutOfRange(name, value, 0.0, highest)
    charge = np.asarray(frame, dtype=float)
    # For each row where a packet may not go: from the last of a piece up, from the first down.
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
    """Electrons that a trap moves; tau : its release time, in transfers."""
    x = pumping.phase / (tau * pumping.dwell)
    # exp(-x) - exp(-2 x) without the difference of almost equal numbers.
    return float(-pumping.shuffles * pumping.capture * np.exp(-x) * np.expm1(-x))


@dataclass(frozen=True, slots=True)
class _TrapChunk:
    """Traps [n]: number of the species, place, height in parts of the volume, and where between the electrodes."""

    species: Int
    row: Int
    column: Int
    height: Float
    electrode: Float

    def upward(self, pumping: Pumping) -> Bool:
        """Those that move charge to the next row."""
        return np.asarray(self.electrode < 0.5 * pumping.efficiency)

    def downward(self, pumping: Pumping) -> Bool:
        """Those that move it to the one before."""
        return np.asarray(self.electrode > 1.0 - 0.5 * pumping.efficiency)


def _draw_traps(shape: tuple[int, ...], density: Sequence[float], rng: np.random.Generator) -> Iterator[_TrapChunk]:
    """The traps of a detector, some at a time, in the order in which they came to be."""
    (ny, nx), total = shape, float(sum(density))
    shares = np.cumsum(density) / total if total > 0.0 else np.ones(len(density))
    remaining = int(stats.poisson.ppf(rng.random(), total * ny * nx)) if total > 0.0 and ny * nx > 0 else 0
    while remaining > 0:
        rank, y, x, height, electrode = rng.random((min(remaining, _CHUNK_SIZE), 5)).T
        species = np.minimum(np.searchsorted(shares, rank, side="right"), len(density) - 1)
        yield _TrapChunk(species, (y * ny).astype(np.int64), (x * nx).astype(np.int64), height, electrode)
        remaining -= _CHUNK_SIZE


def trap_map(scene: Scene, rng: np.random.Generator) -> Int32:
    """int32[ny, nx]: traps of the first species in a pixel, plus 256 times those of the second, 65536 of the third.

    scene : of the exposure;  rng : the numbers that EFFECT has
    """
    silicon = charge_transfer.silicon_traps(scene, "parallel")
    out = np.zeros((scene.ny, scene.nx), np.int32)
    for traps in _draw_traps(out.shape, silicon.density, rng):
        np.add.at(out, (traps.row, traps.column), (_PER_SPECIES**traps.species).astype(np.int32))
    return out


def duration(phase: float, section: str, mission: MissionConfiguration) -> float:
    """Seconds that pumping takes.

    phase : s;  section : of the mission database, of the camera;  mission : the mission database
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
