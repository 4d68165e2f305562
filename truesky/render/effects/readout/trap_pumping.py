"""Trap pumping: charge is shuffled over the traps, and each pumped trap moves charge to a neighbour, forming a dipole.

In each cycle a packet leaves an electrode and comes back; all phases take the same time. A trap that captures an
electron may release it one phase later, when the next packet is nearer. In N cycles a trap moves::

    I = N P (exp(-t / tau) - exp(-2 t / tau))

electrons, with the phase time t, the release time tau and the capture probability P. They are the traps of charge
transfer: the same density of each species, at uniformly distributed heights of the volume that a cloud fills. Positions
are fixed for a detector. With age, traps are added to the existing ones.

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
from scipy import stats

from lake_schema.arrays import Bool, Float, Int, Int32
from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import MissionConfiguration
from truesky.render.effects.effect import Effect
from truesky.render.effects.readout import charge_transfer
from truesky.render.effects.readout.traps import Traps
from truesky.render.effects.scene import Frame, Scene

# Phases of a cycle: over the four electrodes, pair by pair, to the next pixel and back.
_PHASES = 6
# Number of traps that are drawn at a time.
_CHUNK_SIZE = 1 << 19
# Base of the numbers in the truth map: one digit per species.
_PER_SPECIES = 256


@dataclass(frozen=True, slots=True)
class Pumping:
    """Shuffling of charge.

    Attributes
    ----------
    shuffles : int
        Number of cycles.
    phase : float
        Time of a phase in seconds.
    efficiency : float
        Fraction of the traps at positions that the cycle pumps, 0 to 1. Half of them pump up, half down.
    capture : float
        Probability of capture, 0 to 1.
    dwell : float
        Time of a transfer in seconds, the unit of the traps' release times.
    """

    shuffles: int
    phase: float
    efficiency: float
    capture: float
    dwell: float


def apply(
    frame: Frame, silicon: Traps, pumping: Pumping, segments: Sequence[tuple[int, int, bool]], rng: np.random.Generator
) -> Frame:
    """Move charge between neighbouring rows by trap pumping.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons, 0 or more.
    silicon : Traps
        Traps along the columns.
    pumping : Pumping
        Shuffling of charge.
    segments : sequence of (int, int, bool)
        Segments of every column: first row, last row + 1, and a value that is not used. No charge moves between
        segments.
    rng : numpy.random.Generator
        Random numbers of the positions of traps, the same in every exposure.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons with the same sum. Whole electrons move.

    Raises
    ------
    OutOfRange
        If a value of `pumping` is outside its limits.
    """
    for name, value, highest in (
        ("shuffles", pumping.shuffles, 1e9), ("pumping efficiency", pumping.efficiency, 1.0),
        ("capture", pumping.capture, 1.0),
    ):  # fmt: skip
        if not 0.0 <= value <= highest:
            raise OutOfRange(name, value, 0.0, highest)
    charge = np.asarray(frame, dtype=float)
    # Rows from which charge may move up (not from the last row of a segment) and down (not from the first).
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
    """Return the electrons that a pumped trap moves; `tau` is its release time in transfers."""
    x = pumping.phase / (tau * pumping.dwell)
    # This is exp(-x) - exp(-2 x) without cancellation.
    return float(-pumping.shuffles * pumping.capture * np.exp(-x) * np.expm1(-x))


@dataclass(frozen=True, slots=True)
class _TrapChunk:
    """Traps as arrays of shape (n,).

    Attributes
    ----------
    species : int array
        Index of the species.
    row, column : int array
        Pixel.
    height : float array
        Height as a fraction of the pixel's volume, 0 to 1.
    electrode : float array
        Position between the electrodes, 0 to 1.
    """

    species: Int
    row: Int
    column: Int
    height: Float
    electrode: Float

    def upward(self, pumping: Pumping) -> Bool:
        """Return a mask of the traps that move charge to the next row."""
        return np.asarray(self.electrode < 0.5 * pumping.efficiency)

    def downward(self, pumping: Pumping) -> Bool:
        """Return a mask of the traps that move charge to the previous row."""
        return np.asarray(self.electrode > 1.0 - 0.5 * pumping.efficiency)


def _draw_traps(shape: tuple[int, ...], density: Sequence[float], rng: np.random.Generator) -> Iterator[_TrapChunk]:
    """Yield the traps of a detector in chunks, in the order in which damage creates them."""
    (ny, nx), total = shape, float(sum(density))
    shares = np.cumsum(density) / total if total > 0.0 else np.ones(len(density))
    remaining = int(stats.poisson.ppf(rng.random(), total * ny * nx)) if total > 0.0 and ny * nx > 0 else 0
    while remaining > 0:
        rank, y, x, height, electrode = rng.random((min(remaining, _CHUNK_SIZE), 5)).T
        species = np.minimum(np.searchsorted(shares, rank, side="right"), len(density) - 1)
        yield _TrapChunk(species, (y * ny).astype(np.int64), (x * nx).astype(np.int64), height, electrode)
        remaining -= _CHUNK_SIZE


def trap_map(scene: Scene, rng: np.random.Generator) -> Int32:
    """Return the traps per pixel, int32[ny, nx]: species 1 plus 256 x species 2 plus 65536 x species 3.

    `rng` must be the generator that `EFFECT` uses for the same scene.
    """
    silicon = charge_transfer.silicon_traps(scene, "parallel")
    out = np.zeros((scene.ny, scene.nx), np.int32)
    for traps in _draw_traps(out.shape, silicon.density, rng):
        np.add.at(out, (traps.row, traps.column), (_PER_SPECIES**traps.species).astype(np.int32))
    return out


def duration(phase: float, section: str, mission: MissionConfiguration) -> float:
    """Time that pumping takes.

    Parameters
    ----------
    phase : float
        Time of a phase in seconds.
    section : str
        Section of the camera in the mission database.
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
