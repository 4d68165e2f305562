"""The simulated scheduler agrees with cases that can be counted by hand."""

import math

import numpy as np
import pytest

from benchmarks import scheduler
from benchmarks.scheduler import CORES_PER_MACHINE, REPAIR_H, SLOWDOWN, Site, simulate

AT_ONCE = 1e12
SOUND = {"slow_fraction": 0.0, "mean_life_h": math.inf}


def ran(seconds, cores, rate=AT_ONCE, **site):
    return simulate(np.asarray(seconds, float), Site(cores, rate, **{**SOUND, **site}), np.random.default_rng(1))


def test_equal_tasks_fill_equal_cores():
    found = ran(np.full(600, 10.0), 100)
    assert found.makespan == pytest.approx(60.0)
    assert (found.busy, found.lost, found.repeated) == (pytest.approx(6000.0), 0.0, 0)
    assert found.efficiency(100, 6000.0) == pytest.approx(1.0)


def test_a_long_task_that_comes_last_is_waited_for():
    seconds = [1.0] * 99 + [50.0]
    assert ran(seconds, 10).makespan == pytest.approx(9.0 + 50.0)
    assert ran(seconds[::-1], 10).makespan == pytest.approx(50.0)


def test_the_driver_dispatches_one_task_after_another():
    found = ran(np.full(1000, 1.0), 10_000, rate=100.0)
    assert found.makespan == pytest.approx(1000 / 100.0 + 1.0)


def test_at_least_one_machine_is_slow():
    found = ran(np.full(40_000, 1.0), 4 * CORES_PER_MACHINE, slow_fraction=0.02)
    per_core = 40_000 / (CORES_PER_MACHINE * (3.0 + 1.0 / SLOWDOWN))
    assert found.makespan == pytest.approx(per_core, rel=0.01)


def test_interrupted_tasks_run_again():
    found = ran(np.full(4 * CORES_PER_MACHINE, 100.0), 4 * CORES_PER_MACHINE, mean_life_h=1e9)
    # The failure comes in the middle of the tasks. Other machines take them when their tasks are done.
    assert (found.repeated, found.lost) == (CORES_PER_MACHINE, pytest.approx(50.0 * CORES_PER_MACHINE))
    assert found.makespan == pytest.approx(200.0)
    assert REPAIR_H * 3600.0 > 100.0


def test_tasks_have_an_order():
    seconds, exposures = np.array([3.0, 9.0, 5.0]), np.array([2, 3, 1])
    found = {name: order.tolist() for name, order in scheduler.task_orders(seconds, exposures).items()}
    assert found == {"longest": [1, 2, 0], "observed": [2, 0, 1], "shortest": [0, 2, 1]}
