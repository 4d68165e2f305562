"""Peak memory is that of the task, not of earlier work in the same process."""

import mmap

import numpy as np

from lake_schema.store.plan import Task
from truesky.running.task_metrics import WithMetrics, peak_memory_gb, reset_peak_memory


def _fill_new_pages(n_bytes):
    """Return memory that the operating system maps now. numpy may use pages that earlier tests left in the process."""
    pages = mmap.mmap(-1, n_bytes)
    np.frombuffer(pages, np.uint8)[:] = 1
    return pages


def test_the_peak_is_that_of_the_part():
    def work(part):
        _fill_new_pages(part.facts["n"])
        return {"part": part.name}

    large, small = (WithMetrics(work)(Task(name, {"n": n})) for name, n in (("large", 320_000_000), ("small", 80)))
    assert large["part"] == "large"
    assert large["peak_gb"] - small["peak_gb"] > 0.3
    assert 0 < large["cpu_s"] < large["seconds"] + 0.05 < 60


def test_a_peak_is_never_below_what_is_held():
    reset_peak_memory()
    held = _fill_new_pages(160_000_000)
    assert peak_memory_gb() > len(held) / 1e9
