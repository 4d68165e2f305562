"""Peak memory is that of the task, not of earlier work in the same process."""

import numpy as np
import pytest

from lake_schema.store.plan import Task
from truesky.running.task_metrics import WithMetrics, peak_memory_gb, reset_peak_memory


@pytest.fixture(scope="module", autouse=True)
def _memory_is_reused():
    """These tests measure memory, so none is kept for them."""


def test_the_peak_is_that_of_the_part():
    def work(part):
        np.ones(part.facts["n"])
        return {"part": part.name}

    large, small = (WithMetrics(work)(Task(name, {"n": n})) for name, n in (("large", 40_000_000), ("small", 10)))
    assert large["part"] == "large"
    assert large["peak_gb"] - small["peak_gb"] > 0.3
    assert 0 < large["cpu_s"] < large["seconds"] + 0.05 < 60


def test_a_peak_is_never_below_what_is_held():
    reset_peak_memory()
    held = np.ones(20_000_000)
    assert peak_memory_gb() > held.nbytes / 1e9
