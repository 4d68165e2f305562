"""Measure the time, memory and output size of tasks."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lake_schema.store.plan import Json, Task

# On Linux, writing 5 to this file resets the peak memory of the process to its current memory.
_CLEAR, _RESET, _STATUS = Path("/proc/self/clear_refs"), "5", Path("/proc/self/status")


class WithMetrics:
    """Wrap a task function so that its receipt also records time, peak memory and output size.

    Instances can be pickled and sent to Spark workers.
    """

    def __init__(self, run_task: Callable[[Task], Json]) -> None:
        self.run_task = run_task

    def __call__(self, task: Task) -> dict[str, Any]:
        reset_peak_memory()
        start, cpu_start = time.perf_counter(), time.process_time()
        receipt = self.run_task(task)
        metrics: dict[str, Any] = {
            "seconds": time.perf_counter() - start,
            "cpu_s": time.process_time() - cpu_start,
            "peak_gb": peak_memory_gb(),
        }
        if "files" in receipt:
            metrics["bytes"] = sum(file["bytes"] for file in receipt["files"])
        return {**receipt, **metrics}


def reset_peak_memory() -> None:
    """Reset the record of peak memory, if the operating system supports it."""
    try:
        _CLEAR.write_text(_RESET)
    except OSError:
        return


def peak_memory_gb() -> float:
    """Return the peak resident memory in GB since the last reset.

    If resetting is not supported, the peak is since the start of the process.
    """
    try:
        line = next(line for line in _STATUS.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) * 1024 / 1e9
    except (OSError, StopIteration, ValueError):
        # The value is in kilobytes on Linux and in bytes on macOS.
        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9
