"""Trap pumping: the electrons of a trap against a simulation cycle by cycle, and traps recovered from their dipoles."""

import numpy as np
import pytest
from scipy import optimize

from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import resolve
from tests.truesky.render.fields import small
from truesky.render.effects.readout import trap_pumping
from truesky.render.effects.readout.trap_pumping import Pumping
from truesky.render.effects.readout.traps import Traps
from truesky.render.effects.scene import Scene

DWELL = 0.034
LEVEL = 15_000.0
RELEASE = (0.8, 3.5, 20.0)
SHAPE = (400, 300)
# One piece: read downwards.
RUNS = ((0, SHAPE[0], False),)


def traps(*density):
    return Traps(density, RELEASE, 2e5, 0.0, 0.58)


def pumped(lattice, phase, frame=None, seed=1, shuffles=2000, efficiency=0.5):
    frame = np.full(SHAPE, LEVEL) if frame is None else frame
    pumping = Pumping(shuffles, phase, efficiency, 1.0, DWELL)
    return trap_pumping.apply(frame, lattice, pumping, RUNS, np.random.default_rng(seed))


@pytest.mark.parametrize("phase", [0.01, 0.05, 0.3])
@pytest.mark.parametrize("tau", RELEASE)
def test_a_trap_moves_what_cycles_one_by_one_do(tau, phase):
    """An electron is caught as a cycle begins, held for an exponential time, and moves if it is let go in phase two.

    Sample of 200,000 cycles; significance 6e-5 (4 standard errors).
    """
    cycles = 200_000
    held = np.random.default_rng(1).exponential(tau * DWELL, cycles)
    carried = ((held > phase) & (held < 2 * phase)).sum()
    expected = trap_pumping.moved_electrons(tau, Pumping(cycles, phase, 0.5, 1.0, DWELL))
    assert expected == pytest.approx(carried, abs=4 * np.sqrt(carried))


def test_a_trap_is_a_dipole_along_its_column():
    """The dipole contains the electrons that the trap moves, to the row above or below."""
    change = pumped(traps(0.0, 0.0, 1e-3), 0.1) - LEVEL
    row, column = np.nonzero(change > 0)
    assert 5 < len(row) < 60
    up, down = (change[np.clip(row + step, 0, SHAPE[0] - 1), column] for step in (1, -1))
    assert ((up == -change[row, column]) ^ (down == -change[row, column])).all()
    assert 0.2 < np.mean(up < 0) < 0.8
    expected = trap_pumping.moved_electrons(20.0, Pumping(2000, 0.1, 0.5, 1.0, DWELL))
    np.testing.assert_array_equal(change[row, column], np.rint(expected))
    assert change.sum() == 0


def dipoles(frames):
    """Find dipoles in frames (n, ny, nx) at several phase times, and return their amplitudes (n, k).

    As an observer would, take half the difference of neighbouring rows if one is as much brighter as the other is
    fainter.
    """
    change = frames - np.median(frames, axis=2, keepdims=True)
    pairs = 0.5 * (change[:, 1:] - change[:, :-1])
    even = np.abs(change[:, 1:] + change[:, :-1])
    size = np.abs(pairs).max(axis=0)
    found = (size > 30.0) & (even.max(axis=0) < 10.0)
    return np.abs(pairs[:, found])


@pytest.mark.parametrize(("species", "phases"), [(0, (0.005, 0.01, 0.02, 0.04)), (2, (0.05, 0.15, 0.5, 1.2))])
def test_release_times_and_densities_are_recovered(species, phases):
    """From the dipoles alone, by the curve's fit and by counting those of the volume that the charge fills.

    Sample of the traps of one frame; significance 6e-5 of their number (4 standard errors).
    """
    rho = 4e-3
    density = [0.0, 0.0, 0.0]
    density[species] = rho
    noise = np.random.default_rng(5)
    frames = np.stack([pumped(traps(*density), phase) for phase in phases])
    amplitudes = dipoles(frames + noise.normal(0.0, 2.0, frames.shape))

    def curve(t, tau, cycles):
        return cycles * (np.exp(-t / tau) - np.exp(-2 * t / tau))

    each = [
        optimize.curve_fit(curve, phases, one, (np.mean(phases), 2000.0), bounds=(0, np.inf))[0] for one in amplitudes.T
    ]
    tau, cycles = np.median(each, axis=0)
    assert tau == pytest.approx(RELEASE[species] * DWELL, rel=0.03)
    assert cycles == pytest.approx(2000, rel=0.03)
    filled = (LEVEL / 2e5) ** 0.58
    expected = rho * filled * 0.5 * SHAPE[0] * SHAPE[1]
    assert len(each) == pytest.approx(expected, abs=4 * np.sqrt(expected))


def test_more_charge_reaches_more_traps():
    lattice = traps(0.0, 0.0, 0.02)
    count = [
        sum((pumped(lattice, 0.3, np.full(SHAPE, level), seed) != level).sum() for seed in range(8))
        for level in (1500.0, 15_000.0)
    ]
    assert count[1] / count[0] == pytest.approx(10**0.58, rel=0.15)


def test_traps_stay_and_more_come():
    """Traps are the same in all exposures of a detector, and traps of a young detector are also in the old one.

    Sample of one detector; significance 6e-5 of each species' number (4 standard errors).
    """
    mission = resolve()
    found = []
    for age in (0.03, 0.03, 0.06):
        own = resolve(overrides={"vis.cti.age": (age, "")})
        scene = Scene(own, "vis", 600.0, 0.0, 0.0, small("vis", "3-4"))
        found.append(trap_pumping.trap_map(scene, np.random.default_rng(3)))
    np.testing.assert_array_equal(found[0], found[1])
    by_species = [np.stack([one >> (8 * s) & 0xFF for s in range(3)]) for one in found[1:]]
    assert (by_species[1] >= by_species[0]).all()
    pixels = found[0].size
    for s, own in enumerate(by_species[0]):
        expected = 0.03 * mission.value(f"vis.cti.density_{s + 1}") * pixels
        assert own.sum() == pytest.approx(expected, abs=4 * np.sqrt(expected) + 1)


def test_no_charge_crosses_the_pieces_of_a_column_and_no_pixel_gives_more_than_it_has():
    lattice, frame = traps(0.0, 0.0, 5.0), np.full((40, 30), 300.0)
    pumping = Pumping(2000, 0.5, 1.0, 1.0, DWELL)
    runs = (0, 18, False), (22, 40, True)
    out = trap_pumping.apply(frame, lattice, pumping, runs, np.random.default_rng(1))
    assert out.min() >= 0
    assert out[:18].sum() == frame[:18].sum()
    assert out[22:].sum() == frame[22:].sum()
    np.testing.assert_array_equal(out[18:22], frame[18:22])
    for wrong in ({"shuffles": -1}, {"efficiency": 1.1}):
        with pytest.raises(OutOfRange):
            pumped(lattice, 0.1, **wrong)
