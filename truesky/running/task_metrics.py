"""Measure the time, memory and output size of tasks. A task makes one file (partition) of a table."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lake_schema.store.plan import Json, Task

# On Linux, writing _RESET to the file _CLEAR resets the peak memory of this process to its current memory.
_CLEAR, _RESET = Path("/proc/self/clear_refs"), "5"
# Linux file with the peak memory of this process, in the line VmHWM.
_STATUS = Path("/proc/self/status")


class WithMetrics:
    """Wrap a function that runs a task, and add time, peak memory and output size to the dictionary that it returns.

    The added keys are `seconds` and `cpu_s` (wall and CPU time in s), `peak_gb` (GB) and `bytes` (total size of the
    entries of `files`, if there are any). Instances can be pickled and sent to Spark workers.
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
    """Reset the peak memory that the operating system records for this process; do nothing where this is impossible."""
    try:
        _CLEAR.write_text(_RESET)
    except OSError:
        return


def peak_memory_gb() -> float:
    """Return the peak resident memory of this process in GB (1e9 bytes) since the last `reset_peak_memory`.

    If the operating system cannot reset the peak, the result is the peak since the start of the process.
    """
    try:
        line = next(line for line in _STATUS.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) * 1024 / 1e9
    except (OSError, StopIteration, ValueError):
        # `ru_maxrss` is in kilobytes on Linux and in bytes on macOS.
        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9
